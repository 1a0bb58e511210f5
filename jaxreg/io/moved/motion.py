"""A motion as it acts on blocks of points, and on the directions beside them."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np


# Coordinates that grow so many times, as into a map's, are stored as float64.
_MUCH_FARTHER = 16


class Moving(NamedTuple):
    """Motion or similarity `(d+1, d+1)` in float64."""

    T: np.ndarray

    @property
    def dim(self) -> int:
        """Two or three."""
        return len(self.T) - 1

    @property
    def scale(self) -> float:
        """The factor of its rotation."""
        return float(abs(np.linalg.det(self.T[:-1, :-1])) ** (1 / self.dim))

    def points(self, x: np.ndarray) -> np.ndarray:
        """`(n, d)` points in float64; rows with NaN stay without meaning."""
        with np.errstate(invalid="ignore"):
            return x.astype(np.float64) @ self.T[:-1, :-1].T + self.T[:-1, -1]

    def directions(self, x: np.ndarray) -> np.ndarray:
        """`(n, d)` normals, which keep their lengths."""
        with np.errstate(invalid="ignore"):
            return x.astype(np.float64) @ self.T[:-1, :-1].T / self.scale

    def goes_far(self, blocks: Iterable[np.ndarray]) -> bool:
        """Whether float32, fit for these points, holds too few digits once moved."""
        before = after = 0.0
        for x in blocks:
            x = x[np.isfinite(x).all(axis=1)].astype(np.float64)
            before = max(before, np.abs(x).max(initial=0))
            after = max(after, np.abs(self.points(x)).max(initial=0))
        return bool(after > _MUCH_FARTHER * before * max(1.0, self.scale))
