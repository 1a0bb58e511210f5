"""How the rows of the system of motion averaging are scaled by the weights of edges.

The MCC paper multiplies the rows of an edge by its weight (Eq. 17), and so minimises
the sum of weight^2 |residual|^2. Half-quadratic theory asks for weight |residual|^2:
rows by its root.
"""

import abc
from typing import ClassVar

from jaxtyping import Array, Float

from jaxreg._core.brief import BriefModule
from jaxreg.graph.pose_graph import PoseGraph


class AbstractRows(BriefModule):
    """What an edge counts in the least squares of a step."""

    described: ClassVar[str] = "rows such as RootRows()"

    @abc.abstractmethod
    def squared(
        self, graph: PoseGraph, trust: Float[Array, " e"]
    ) -> Float[Array, " e"]:
        """The square of the factor of an edge's rows: its weight in the Laplacian.

        Args:
            graph: its `weight` is the prior weight of each edge.
            trust: `(e,)` the weight by the edge's residual, from 0 to 1.
        """


class RootRows(AbstractRows):
    """Rows by the root of weight and trust: minimises weight |residual|^2."""

    def squared(
        self, graph: PoseGraph, trust: Float[Array, " e"]
    ) -> Float[Array, " e"]:
        """Weight times trust."""
        return graph.weight * trust


class WeightRows(AbstractRows):
    """Rows by weight and trust themselves, as printed in Eq. 17 of the MCC paper."""

    def squared(
        self, graph: PoseGraph, trust: Float[Array, " e"]
    ) -> Float[Array, " e"]:
        """The square of weight times trust."""
        return (graph.weight * trust) ** 2


class EqualRows(AbstractRows):
    """Rows as they are: every edge of positive weight counts the same."""

    def squared(
        self, graph: PoseGraph, trust: Float[Array, " e"]
    ) -> Float[Array, " e"]:
        """One, or zero for an edge of no weight."""
        return (graph.weight > 0).astype(trust.dtype)
