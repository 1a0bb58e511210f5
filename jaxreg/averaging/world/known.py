"""What is known of the world, as programs have it."""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxreg.averaging.world.levels import Levels
from jaxreg.averaging.world.points import ControlPoints
from jaxreg.graph.anchored import KnownPoses


class Known(eqx.Module):
    """Poses, points and tilts that are known.

    Attributes:
        poses: priors and fixed frames, of which there may be none.
        points: control points, or None without any.
        levels: tilts, or None without any.
        origin: `(d,)` float64 on the host, subtracted from all positions in the world,
            which may be map coordinates; None where a number is traced.
        num_fixed: how many frames are fixed at most (static).
        counts: rows of priors, points and levels that are no padding; None in programs,
            which are of any number (static).
    """

    poses: KnownPoses
    points: ControlPoints | None
    levels: Levels | None
    origin: np.ndarray | None
    num_fixed: int = eqx.field(static=True)
    counts: tuple[int, int, int] | None = eqx.field(static=True)

    @property
    def num_rows(self) -> int:
        """How many priors, points and levels there are, with padding."""
        return sum(self._lengths)

    @property
    def _lengths(self) -> list[int]:
        some = (self.poses, self.points, self.levels)
        return [0 if x is None else len(x.frame) for x in some]

    @property
    def of_any_number(self) -> "Known":
        """For programs."""
        return dataclasses.replace(self, counts=None)

    def without_padding(self, trust: Float[Array, " k"]) -> Float[Array, " n"]:
        """Of each row that there is."""
        if self.counts is None:
            return trust
        lengths = self._lengths
        begin = np.cumsum([0, *lengths[:-1]])
        rows = [np.arange(k) + b for k, b in zip(self.counts, begin, strict=True)]
        return trust[np.concatenate(rows)]
