"""How well surfaces lie on each other at given poses: what truth has to do, too."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree


# Points drawn of each scan; neighbours of a normal; least share of them that meet.
_POINTS, _NEIGHBOURS, _SHARE = 2000, 12, 0.15


class Surface(NamedTuple):
    """A scan to be looked up: all points, normals, and rows that are drawn of them."""

    tree: KDTree
    normals: np.ndarray
    drawn: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, rng: np.random.Generator) -> "Surface":
        """Of `(n, 3)` points."""
        points = np.asarray(points, np.float64)
        tree = KDTree(points)
        near = points[tree.query(points, _NEIGHBOURS)[1]]
        near -= near.mean(axis=1, keepdims=True)
        normals = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
        return cls(tree, normals, rng.permutation(len(points))[:_POINTS])

    def distances(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Along its normals, of those of `(n, 3)` points that it has within reach."""
        far, row = self.tree.query(points, distance_upper_bound=reach)
        met = np.isfinite(far)
        shift = points[met] - self.tree.data[row[met]]
        return np.abs(np.sum(shift * self.normals[row[met]], axis=1))


def surface_distance(
    surfaces: list[Surface], T_world_i: np.ndarray, reach: float
) -> float:
    """Median over ordered pairs that overlap of their median distance along normals.

    Args:
        surfaces: v scans.
        T_world_i: `(v, 4, 4)`; NaN where a scan is not placed.
        reach: points farther apart do not count.
    """
    placed = np.flatnonzero(np.isfinite(T_world_i[:, 0, 0]))
    medians = []
    for i in placed:
        for j in placed[placed != i]:
            T_i_j = np.linalg.inv(T_world_i[i]) @ T_world_i[j]
            points = surfaces[j].tree.data[surfaces[j].drawn]
            found = surfaces[i].distances(
                points @ T_i_j[:3, :3].T + T_i_j[:3, 3], reach
            )
            if len(found) > _SHARE * len(points):
                medians.append(np.median(found))
    return float(np.median(medians)) if medians else np.inf
