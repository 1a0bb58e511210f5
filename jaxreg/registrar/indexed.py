"""What a registrar may offer for clouds that enter many pairs."""

import abc

import equinox as eqx
from jaxtyping import Array

from jaxreg._core.typing import Key, Motion
from jaxreg.cloud import PointCloud
from jaxreg.neighbours import AbstractIndex
from jaxreg.registrar.base import AbstractRegistrar, RegistrationSolution


class AbstractIndexedRegistrar(AbstractRegistrar):
    """A registrar that takes an index built before, and knows several answers.

    `reconstruct` takes any registrar. Of this kind it builds the index of each scan
    once, keeps the best of the modes of each pair, believes by its `min_log_evidence`;
    of others it keeps one pose a pair.

    Attributes:
        num_modes: rows of the `modes` of a solution.
        min_log_evidence: of less evidence the status is LOW_OVERLAP.
    """

    num_modes: eqx.AbstractVar[int]
    min_log_evidence: eqx.AbstractVar[Array | float]

    @abc.abstractmethod
    def index_of(self, cloud: PointCloud) -> AbstractIndex:
        """Closest points of a prepared cloud."""

    @abc.abstractmethod
    def solve_indexed(
        self,
        source: PointCloud,
        target: PointCloud,
        target_index: AbstractIndex,
        init: Motion | None,
        key: Key | None,
    ) -> RegistrationSolution:
        """`solve` with the index of the target."""
