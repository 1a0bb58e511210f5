"""The shape vocabulary of the package.

Letters in shape strings: `n` source points, `m` target points, `d` space (2 or 3),
`k` tangent (3 or 6), `D` = d + 1, `p` particles, `v` views, `e` edges. Shapes are
checked at run time in the tests only, through jaxtyping's pytest hook.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import jax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped


Points: TypeAlias = Float[Array, "n d"]
Mask: TypeAlias = Bool[Array, " n"]
Motion: TypeAlias = Float[Array, "D D"]
Motions: TypeAlias = Float[Array, "*b D D"]
Scalar: TypeAlias = Float[Array, ""]
StatusArray: TypeAlias = Int[Array, "*b"]
Key: TypeAlias = PRNGKeyArray | Shaped[Array, "..."]

if TYPE_CHECKING:

    class SupportsDLPack(Protocol):
        """An array of another library."""

        def __dlpack__(self) -> object:
            """Its memory."""

    #: What `numpy.asarray` or DLPack takes: arrays of any library, nested lists.
    ArrayLike: TypeAlias = jax.typing.ArrayLike | SupportsDLPack | Sequence[Any]
else:
    # At run time anything: what does not fit is told by name, in `_core.checks`.
    ArrayLike = object

#: Called as `progress(stage, done, total)` from host code between compiled pieces.
Progress: TypeAlias = Callable[[str, int, int], None]
