"""Poses chained along the shortest paths from frame 0: the start of least squares."""

from jaxtyping import Array, Float

from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key
from jaxreg.averaging.base import (
    AbstractAverager,
    AveragingSolution,
    of_start,
    solution,
)
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.graph.shortest_paths import shortest_paths


class ShortestPaths(AbstractAverager):
    """Chains relative motions along the shortest paths from frame 0.

    An edge is 1 / weight long: the chains are those of least variance, and a
    breadth-first tree for equal weights. Other edges are not used, and none is judged:
    `edge_weight` is 1 for every edge. `init` is ignored.

    Gradients: none; asking for them raises a TypeError.
    """

    @kept_program
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Chains the motions of a prepared graph."""
        args = (graph.edges, graph.T_i_j, graph.weight, graph.num_poses)
        found = solution(graph, shortest_paths(*args).T_root_i)
        return of_start(self, graph, found)
