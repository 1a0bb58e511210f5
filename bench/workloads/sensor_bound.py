"""Accuracy beside the best that scans of a sensor allow."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

import jaxreg as jr
from bench.case import Case, Judged, Method, Options
from bench.peers.local_pairs import exponential
from bench.peers.local_settings import peers
from bench.peers.multiview import Multiway
from bench.records import Metric, error
from bench.sensor_model import (
    SensorScan,
    pair_bound,
    pose_bounds,
    sensor_scans,
)
from bench.workloads.local_pairs import own_methods
from bench.workloads.multiview import own_method, peer_method


_VIEWS, _EXTENT = 12, 0.25
# Of the peers those that are accurate here, each at all points.
_PEERS = ("small_gicp GICP", "small_gicp PLANE tight", "Open3D GICP", "Open3D plane")


def cases(options: Options) -> Iterator[Case]:
    """Pairs of neighbours, and all views."""
    del options
    scans = [sensor_scans(_VIEWS, seed) for seed in range(3)]
    pairs = [(x[k], x[k + 1]) for x in scans for k in range(0, _VIEWS - 1, 2)]
    yield Case(
        name="pairs of neighbours",
        data="30 degrees apart, from 3 degrees and 5 mm off",
        methods=[
            *own_methods(),
            Method("jaxreg register", "jaxreg", "no guess", _without_guess),
            *(p.method for p in peers() if p.method.name in _PEERS),
        ],
        trials=[(_near(s, t, n), t.points, _EXTENT) for n, (s, t) in enumerate(pairs)],
        judge=partial(_judged_pairs, pairs),
        reference="small_gicp GICP",
    )
    peer = Multiway(0.0075, 0.003, 0.4, camera_at_origin=False)
    yield Case(
        name=f"{_VIEWS} views",
        data=f"{len(scans[0][0].points)} points in the first",
        methods=[own_method(_reconstructed), peer_method(peer, peer.solve)],
        trials=[([s.points for s in x], n) for n, x in enumerate(scans)],
        judge=partial(_judged_poses, scans),
        long=True,
    )


def _near(source: SensorScan, target: SensorScan, seed: int) -> np.ndarray:
    """The source's points, near where they belong in the frame of the target."""
    T = _off(seed) @ _true(source, target)
    return (source.points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)


def _off(seed: int) -> np.ndarray:
    """By 3 degrees and 5 mm."""
    rng = np.random.default_rng(seed)
    turn, shift = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    return exponential(np.append(5e-3 * shift, np.radians(3) * turn))


def _true(source: SensorScan, target: SensorScan) -> np.ndarray:
    return np.linalg.inv(target.T_world_scan) @ source.T_world_scan


def _without_guess(source: np.ndarray, target: np.ndarray, _: float) -> np.ndarray:
    sol = jr.register(source, target, key=jax.random.key(0))
    return np.asarray(sol.T_target_source)


def _reconstructed(scans: list[np.ndarray], seed: int) -> np.ndarray:
    return np.asarray(jr.reconstruct(scans, key=jax.random.key(seed)).T_world_i)


def _judged_pairs(
    pairs: list[tuple[SensorScan, SensorScan]], answers: list[Any]
) -> Judged:
    errors, bounds = [], []
    for n, ((source, target), T) in enumerate(zip(pairs, answers, strict=True)):
        found = np.asarray(T, np.float64) @ _off(n) @ _true(source, target)
        # As a motion of the world, which the source's points are moved by.
        D = target.T_world_scan @ found @ np.linalg.inv(source.T_world_scan)
        middle = source.true.mean(axis=0)
        errors.append(_error(D, middle))
        bounds.append(_at(pair_bound(source, target), middle))
    return _ratios(errors, bounds)


def _judged_poses(scans: list[list[SensorScan]], answers: list[Any]) -> Judged:
    errors, bounds = [], []
    for own, T_world_i in zip(scans, answers, strict=True):
        C, first = pose_bounds(own), own[0].T_world_scan
        for k in range(1, len(own)):
            T = np.asarray(T_world_i[k], np.float64)
            D = first @ T @ np.linalg.inv(own[k].T_world_scan)
            middle = own[k].true.mean(axis=0)
            errors.append(_error(D, middle))
            bounds.append(_at(C[k], middle))
    return _ratios(errors, bounds)


def _error(D: np.ndarray, middle: np.ndarray) -> tuple[float, float]:
    """Radians, and metres at a place."""
    chord = np.linalg.norm(D[:3, :3] - np.eye(3)) / np.sqrt(8)
    shift = D[:3, :3] @ middle + D[:3, 3] - middle
    return 2 * np.arcsin(min(chord, 1)), float(np.linalg.norm(shift))


def _at(C: np.ndarray, middle: np.ndarray) -> tuple[float, float]:
    """Root mean squares that a covariance about the origin allows at a place."""
    x, y, z = middle
    lever = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    J = np.concatenate([np.eye(3), lever], axis=1)
    return float(np.sqrt(np.trace(C[3:, 3:]))), float(np.sqrt(np.trace(J @ C @ J.T)))


def _ratios(errors: list, bounds: list) -> Judged:
    """Root mean square errors, and over their bounds; of those that are near."""
    e, b = np.array(errors), np.array(bounds)
    ok = e[:, 0] < np.radians(5)
    e_R, e_t = np.sqrt(np.mean(e[ok] ** 2, axis=0))
    over = np.sqrt(np.mean((e[ok] / b[ok]) ** 2, axis=0))
    return Judged(
        [
            Metric("found", 100 * float(ok.mean()), "%", "up", 1.0),
            error("over_bound_R", float(over[0]), "", 0.05),
            error("over_bound_t", float(over[1]), "", 0.05),
            error("e_R", float(e_R), "rad", 1e-5),
            error("e_t", 1e3 * float(e_t), "mm", 1e-3),
        ],
        {"over_bound_R": (e[:, 0] / b[:, 0]).tolist()},
    )
