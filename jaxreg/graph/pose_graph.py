"""`PoseGraph`: relative motions between frames, the input of motion averaging."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.checks import as_float_array
from jaxreg.geometry import lie


class PoseGraph(eqx.Module):
    """Edges (i, j) that hold `T_i_j`, which maps frame j into frame i.

    A pytree of arrays with a static number of poses. Padded edges have `mask` False
    and count for nothing.

    Attributes:
        edges: `(e, 2)` int32, the frames i and j of each edge.
        T_i_j: `(e, d+1, d+1)` relative motions, `inv(T_world_i) @ T_world_j`.
        weight: `(e,)` prior weight of each edge, at least 0.
        mask: `(e,)` True for real edges.
        information: `(e, k, k)` information matrix of the left tangent error of
            `T_i_j` (translation first), or None.
        num_poses: number of frames, static.
    """

    edges: Int[Array, "e 2"]
    T_i_j: Float[Array, "e D D"]
    weight: Float[Array, " e"]
    mask: Bool[Array, " e"]
    information: Float[Array, "e k k"] | None
    num_poses: int = eqx.field(static=True)
