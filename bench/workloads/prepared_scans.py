"""Searches between real scans, prepared once or by plain calls of `register`."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from bench.workloads.global_data import ScanPairs
from jaxreg.cloud import PointCloud, centroid, rms_radius
from jaxreg.neighbours import VoxelTable
from jaxreg.particle import AbstractSearch


class Prepared(NamedTuple):
    """A scan about its centroid, in the common unit, and its index."""

    cloud: PointCloud
    table: VoxelTable
    centre: jax.Array


def padded(points: ScanPairs) -> tuple[np.ndarray, np.ndarray]:
    """Scans `(v, n, 3)` of one size and their masks: one compilation for all."""
    most = max(len(scan) for scan in points.scans)
    many = np.zeros((len(points.scans), most, 3), np.float32)
    mask = np.zeros(many.shape[:2], bool)
    for row, scan in enumerate(points.scans):
        many[row, : len(scan)], mask[row, : len(scan)] = scan, True
    return many, mask


class Own:
    """Searches between scans that are prepared once."""

    def __init__(self, method: AbstractSearch, data: ScanPairs) -> None:
        """Prepares all scans."""
        points, mask = (jnp.asarray(x) for x in padded(data))
        self.method = method
        self.radius = jnp.median(jax.vmap(rms_radius)(points, mask))
        scans = list(zip(points, mask, strict=True))
        self.scans: list[Prepared] = [self._prepare(*scan) for scan in scans]

    def _prepare(self, points: jax.Array, mask: jax.Array) -> Prepared:
        return jax.block_until_ready(_prepare(self.method, points, mask, self.radius))

    def solve(
        self,
        source: int,
        target: int,
        seed: int,
        method: AbstractSearch | None = None,
    ) -> tuple[np.ndarray, Any]:
        """The pose in the frames of the scans, and the solution.

        By `method` if that is given, which must prepare clouds in the same way.
        """
        method = self.method if method is None else method
        found = _search(
            method, self.scans[source], self.scans[target], jax.random.key(seed)
        )
        T = np.array(found.T_target_source, np.float64)
        T[:3, 3] *= float(self.radius)
        T = self._frame(target) @ T @ np.linalg.inv(self._frame(source))
        return T, jax.device_get(found)

    def _frame(self, scan: int) -> np.ndarray:
        T = np.eye(4)
        T[:3, 3] = self.scans[scan].centre
        return T


@eqx.filter_jit
def _prepare(
    method: AbstractSearch, points: jax.Array, mask: jax.Array, radius: jax.Array
) -> Prepared:
    centre = centroid(points, mask)
    cloud = method.prepare((points - centre) / radius, mask)
    return Prepared(cloud, VoxelTable.build(cloud.points, cloud.mask), centre)


@eqx.filter_jit
def _search(method: AbstractSearch, source: Prepared, target: Prepared, key: jax.Array):
    return method.solve_indexed(source.cloud, target.cloud, target.table, None, key)
