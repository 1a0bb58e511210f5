"""`Described`: points with local features, which `jaxreg.features` finds."""

import equinox as eqx
from jaxtyping import Array, Bool, Float


class Described(eqx.Module):
    """Points with features.

    Attributes:
        points: `(n, 3)`.
        normals: `(n, 3)` of either sign.
        even: `(n, 33)` the part of the feature that the normal's sign leaves.
        odd: `(n, 33)` the part that changes its sign with the normal's.
        mask: which have a feature: those with a normal, and neighbours with normals.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    even: Float[Array, "n f"]
    odd: Float[Array, "n f"]
    mask: Bool[Array, " n"]
