"""Motion averaging under the maximum correntropy criterion.

Reference: Zhu, Hu, Lu, Chen, Li, Li, Robust Motion Averaging under Maximum Correntropy
Criterion (the MCC paper): Algorithm 1, with the update of Eq. 21 on the left, where
Eq. 14 needs it, and "until change is negligible and k >= K" read as "or".
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.typing import Key
from jaxreg.averaging.base import (
    AbstractAverager,
    AveragingSolution,
    frobenius,
    length_scale,
    solution,
    weighted_mean,
)
from jaxreg.averaging.iterate import iterate
from jaxreg.averaging.plain import check_rows, scaled_rows
from jaxreg.averaging.tree import SpanningTree, start
from jaxreg.graph.pose_graph import PoseGraph


class Correntropy(AbstractAverager):
    """Robust motion averaging: edges count by a Gaussian of their residual (Eq. 12).

    Attributes:
        alpha: kernel width over the mean residual, sigma_k = alpha e_k (Eq. 22).
        rows: "sqrt" scales rows by the root of the weight, as half-quadratic theory
            asks; "weight" by the weight itself, as printed in Eq. 17.
        max_steps: largest number of steps (static).
        tolerance: stop below this change, radians and share of the size of the scene.
        initialiser: finds the start when `init` is None.

    Lengths are measured in the graph's own length scale, so another unit does not
    change the answer.

    Gradients: implicit at the fixed point with respect to `T_i_j` and `weight`; the
    kernel width and the start are cut.
    """

    width: Literal["paper"] = eqx.field(static=True, default="paper")
    alpha: Array | float = traced(1.0)
    rows: Literal["sqrt", "weight"] = eqx.field(static=True, default="sqrt")
    max_steps: int = eqx.field(static=True, default=100)
    tolerance: Array | float = traced(1e-8)
    initialiser: AbstractAverager = SpanningTree()

    def __check_init__(self) -> None:
        check_rows(self.rows)

    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Averages a prepared graph."""
        scale = length_scale(graph)
        root_two = jnp.sqrt(jnp.asarray(2, scale.dtype))

        def adaptive(g: PoseGraph, T: Array) -> Array:
            e = weighted_mean(frobenius(g, T, scale), g.weight)
            sigma = self.alpha * jnp.maximum(e, 64 * jnp.finfo(e.dtype).eps)
            # The Frobenius norm of a small rotation is sqrt(2) times its angle.
            return jnp.stack([sigma * scale, sigma / root_two])

        end = iterate(
            graph,
            start(self.initialiser, graph, init, key),
            adaptive,
            gaussian_trust,
            scaled_rows(self.rows),
            max_steps=self.max_steps,
            tolerance=self.tolerance,
        )
        return solution(
            graph,
            end.T_world_i,
            edge_weight=end.trust,
            converged=end.converged,
            kernel_width=end.width,
            num_steps=end.num_steps,
        )


def gaussian_trust(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"], width: Float[Array, "2"]
) -> Float[Array, " e"]:
    """G_sigma of the residual of each edge (Eq. 12); widths are (length, angle)."""
    rotation, translation = graph.differences(T_world_i)
    sq = translation / width[0] ** 2 + rotation / (2 * width[1] ** 2)
    return jnp.exp(-sq / 2)
