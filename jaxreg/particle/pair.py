"""`Pair`: two prepared clouds, of which one finds the other's points, or both."""

import equinox as eqx
import jax.numpy as jnp

from jaxreg._core.arrays import on_both
from jaxreg._core.typing import Scalar
from jaxreg.cloud import PointCloud, levelled, median_spacing
from jaxreg.matching import Problem, Witness
from jaxreg.neighbours import AbstractIndex, index_within


class Pair(eqx.Module):
    """Two prepared clouds, the index of the target, and how far samples are apart."""

    source: PointCloud
    target: PointCloud
    target_index: AbstractIndex
    spacings: tuple[Scalar, Scalar]

    @classmethod
    def of(
        cls, source: PointCloud, target: PointCloud, target_index: AbstractIndex
    ) -> "Pair":
        """With the spacings of the clouds."""
        spacings = on_both(
            lambda cloud: median_spacing(cloud.points, cloud.mask),
            *levelled(source, target),
        )
        return cls(source, target, target_index, spacings)

    @property
    def problem(self) -> Problem:
        """The source to be registered to the target, all points."""
        return Problem.of(self.source, self.target, self.target_index)

    @property
    def exact(self) -> "ExactPair":
        """With indexes that miss no near point; tables miss every other."""
        source, target = levelled(self.source, self.target)
        indexes = on_both(
            lambda side: index_within(side[0].points, side[0].mask, side[1]),
            (source, self.spacings[0]),
            (target, self.spacings[1]),
        )
        return ExactPair(self.source, self.target, *indexes)

    @property
    def judged(self) -> "Pair":
        """With as many points as poses are judged by; itself if these are as many."""
        if self.source.judged is None and self.target.judged is None:
            return self
        clouds = levelled(self.source.as_judged, self.target.as_judged)
        return Pair.of(*clouds, self.target_index)

    @property
    def spacing(self) -> Scalar:
        """Between samples of the coarser cloud."""
        return jnp.maximum(*self.spacings)


class ExactPair(eqx.Module):
    """Two clouds with indexes that miss no near point, in either direction."""

    source: PointCloud
    target: PointCloud
    source_index: AbstractIndex
    target_index: AbstractIndex

    @property
    def problem(self) -> Problem:
        """The source to be registered to the target, all points."""
        return Problem.of(self.source, self.target, self.target_index)

    @property
    def witness(self) -> Witness:
        """Who tells how likely poses are."""
        clouds = self.source, self.target
        return Witness.of(*clouds, self.source_index, self.target_index)
