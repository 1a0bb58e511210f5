"""Poses chained along a spanning tree: the start of every other method."""

from typing import Literal

import equinox as eqx
from jaxtyping import Array, Float

from jaxreg._core.compile import compiled
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution, solution
from jaxreg.graph import trees
from jaxreg.graph.pose_graph import PoseGraph


class SpanningTree(AbstractAverager):
    """Chains relative motions along a tree; edges outside of it are not used.

    `init` is ignored. `edge_weight` is 1 on the edges that the tree agrees with only
    in so far as no method judged them: it is 1 for every edge.

    Attributes:
        by: "weight" for the spanning tree of greatest total weight (Boruvka), "path"
            for the tree of shortest paths from frame 0 where an edge is 1 / weight
            long: chains of least variance, a breadth-first tree for equal weights.

    Gradients: none (the topology and the start are cut).
    """

    by: Literal["weight", "path"] = eqx.field(static=True, default="weight")

    def __check_init__(self) -> None:
        if self.by not in ("weight", "path"):
            raise ValueError(f"by: wanted 'weight' or 'path', found {self.by!r}.")

    @compiled
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Chains the motions of a prepared graph."""
        args = (graph.edges, graph.T_i_j, graph.weight, graph.num_poses)
        if self.by == "weight":
            return solution(graph, trees.maximum_spanning_tree(*args).T_world_i)
        return solution(graph, trees.shortest_paths(*args).T_root_i)
