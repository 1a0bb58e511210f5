"""`Pair`: two prepared clouds that can find each other's points."""

import equinox as eqx
import jax.numpy as jnp

from jaxreg._core.arrays import on_both
from jaxreg._core.typing import Scalar
from jaxreg.cloud import PointCloud, levelled, median_spacing
from jaxreg.matching import Problem, Witness
from jaxreg.neighbours import AbstractIndex, index_within


class Pair(eqx.Module):
    """Two prepared clouds with their indexes."""

    source: PointCloud
    target: PointCloud
    source_index: AbstractIndex
    target_index: AbstractIndex

    @property
    def problem(self) -> Problem:
        """The source to be registered to the target, all points."""
        return Problem.of(self.source, self.target, self.target_index)

    @property
    def exact(self) -> "Pair":
        """With indexes that miss no near point; tables miss every other."""
        indexes = on_both(
            lambda cloud: index_within(
                cloud.points, cloud.mask, median_spacing(cloud.points, cloud.mask)
            ),
            *levelled(self.source, self.target),
        )
        return Pair(self.source, self.target, *indexes)

    @property
    def fine(self) -> "Pair":
        """With the most points there are, and such indexes."""
        source, target = levelled(self.source.finest, self.target.finest)
        pair = Pair(source, target, self.source_index, self.target_index)
        return pair.exact

    def witness(self, exact: "Pair") -> Witness:
        """Who tells how likely poses are; `exact` is that of this pair."""
        source, target = self.source.judged, self.target.judged
        if source is not None or target is not None:
            clouds = levelled(self.source.as_judged, self.target.as_judged)
            exact = Pair(*clouds, self.source_index, self.target_index).exact
        clouds = exact.source, exact.target
        return Witness.of(*clouds, exact.source_index, exact.target_index)

    @property
    def spacing(self) -> Scalar:
        """Between samples of the coarser cloud."""
        return jnp.maximum(
            *on_both(
                lambda cloud: median_spacing(cloud.points, cloud.mask),
                *levelled(self.source, self.target),
            )
        )
