"""The shape vocabulary of the package.

Letters in shape strings: `n` source points, `m` target points, `d` space (2 or 3),
`k` tangent (3 or 6), `D` = d + 1, `p` particles, `v` views, `e` edges. Shapes are
checked at run time in the tests only, through jaxtyping's pytest hook.
"""

from collections.abc import Callable
from typing import TypeAlias

from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped


Points: TypeAlias = Float[Array, "n d"]
Mask: TypeAlias = Bool[Array, " n"]
Motion: TypeAlias = Float[Array, "D D"]
Motions: TypeAlias = Float[Array, "*b D D"]
Scalar: TypeAlias = Float[Array, ""]
StatusArray: TypeAlias = Int[Array, "*b"]
Key: TypeAlias = PRNGKeyArray | Shaped[Array, "..."]

#: Called as `progress(stage, done, total)` from host code between compiled pieces.
Progress: TypeAlias = Callable[[str, int, int], None]
