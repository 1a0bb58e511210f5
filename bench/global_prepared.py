"""Searches between real scans, prepared once or by plain calls of `register`."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from bench.global_data import ScanPairs
from bench.timing import Timed, timed
from jaxreg import Status, register
from jaxreg.cloud import PointCloud, centroid, rms_radius
from jaxreg.neighbours import VoxelTable
from jaxreg.particle import AbstractSearch, GivenParticles, MultiStart


class Prepared(NamedTuple):
    """A scan about its centroid, in the common unit, and its index."""

    cloud: PointCloud
    table: VoxelTable
    centre: jax.Array


class Result(NamedTuple):
    """Of a pair: the pose, its score, whether its method believes it, its time."""

    T_target_source: np.ndarray
    score: float
    believed: bool
    seconds: float


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
        """Prepares; the time a scan is `prepare_s`."""
        points, mask = (jnp.asarray(x) for x in padded(data))
        self.method = method
        self.radius = jnp.median(jax.vmap(rms_radius)(points, mask))
        scans = list(zip(points, mask, strict=True))
        self._prepare(*scans[0])
        took = timed(lambda: [self._prepare(*scan) for scan in scans])
        self.scans: list[Prepared] = took.value
        self.prepare_s = took.cpu / len(scans)

    def _prepare(self, points: jax.Array, mask: jax.Array) -> Prepared:
        return jax.block_until_ready(_prepare(self.method, points, mask, self.radius))

    def at(self, source: int, target: int, T: np.ndarray) -> float:
        """The score of a pose after a refinement from there."""
        near = MultiStart(num_starts=1, num_steps=1, num_modes=1, width_start=0.06)
        T = np.linalg.inv(self._frame(target)) @ T @ self._frame(source)
        T[:3, 3] /= float(self.radius)
        given = GivenParticles(T.astype(np.float32)[None])
        near = eqx.tree_at(lambda m: m.prior, near, given, is_leaf=lambda x: x is None)
        return float(self.solve(source, target, 0, near)[1].overlap)

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
    return method.solve_indexed(
        source.cloud, target.cloud, source.table, target.table, None, key
    )


def run_own(own: Own, data: ScanPairs) -> list[Result]:
    """Every pair, by prepared scans."""
    own.solve(1, 0, 0)

    def one(pair: int) -> Result:
        target, source = data.pairs[pair].tolist()
        took = timed(lambda: own.solve(source, target, pair))
        return _result(took)

    return [one(pair) for pair in range(len(data.pairs))]


def run_register(data: ScanPairs) -> list[Result]:
    """Every pair, by `register` on all points of the scans."""
    points, mask = padded(data)

    def call(pair: int) -> tuple[np.ndarray, Any]:
        target, source = data.pairs[pair]
        key = jax.random.key(pair)
        found = register(
            points[source],
            points[target],
            key=key,
            source_mask=mask[source],
            target_mask=mask[target],
        )
        found = jax.device_get(found)
        return np.asarray(found.T_target_source, np.float64), found

    call(0)
    calls = [timed(partial(call, pair)) for pair in range(len(data.pairs))]
    return [_result(took) for took in calls]


def _result(took: Timed) -> Result:
    T, found = took.value
    believed = int(found.status) == Status.CONVERGED
    return Result(T, float(found.overlap), believed, took.cpu)
