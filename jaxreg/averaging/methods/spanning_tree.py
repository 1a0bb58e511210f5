"""Poses chained along a spanning tree: the start of robust methods."""

from jaxtyping import Array, Float

from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Key
from jaxreg.averaging.base import (
    AbstractAverager,
    AveragingSolution,
    of_start,
    solution,
)
from jaxreg.graph import trees
from jaxreg.graph.pose_graph import PoseGraph


class SpanningTree(AbstractAverager):
    """Chains relative motions along the spanning tree of greatest weight (Boruvka).

    Other edges are not used, and none is judged: `edge_weight` is 1 for every edge.
    `init` is ignored.

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
        found = solution(graph, trees.maximum_spanning_tree(*args).T_world_i)
        return of_start(self, graph, found)
