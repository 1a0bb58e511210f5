"""Sequences of other people's lidars into one frame, without a guess, and a drive."""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.multiview import Multiway
from bench.peers.odometry import VOXEL, kiss_odometry
from bench.records import Metric, error
from bench.studies.streets import street_drive
from bench.workloads.multiview import PEER, peer_method
from bench.workloads.sensor_data import Sequence, pose_errors, sequences
from jaxreg import reconstruct
from jaxreg.metrics import rotation_error, translation_error


# A scan so far from where it belongs, in degrees and metres, is wrong.
_WRONG = 5.0, 0.6
# Frames of the generated drive.
_FRAMES = 60
_ODOMETRY = "KISS-ICP"
#: Number of the connected group of each scan, negative of none; and poses.
Placed = tuple[np.ndarray, np.ndarray]


def cases(options: Options) -> Iterator[Case]:
    """A case per sequence, and a drive along a generated street and back."""
    for data in sequences(options.data):
        peer = Multiway(
            data.voxel,
            0.4 * data.voxel,
            data.least,
            camera_at_origin=data.camera_at_origin,
        )
        multiway = peer_method(peer, partial(by_peer, peer, data.scans))
        own = [_own(data, order) for order in ("any", "sequential")]
        yield _case(data, [*own, _odometry(data), multiway], PEER)
    drive = Sequence(
        f"street there and back, {_FRAMES} frames (generated)",
        *street_drive(5, _FRAMES),
        voxel=VOXEL,
        least=0.3,
        camera_at_origin=True,
    )
    yield _case(drive, [_own(drive, "sequential"), _odometry(drive)], _ODOMETRY)


def _case(data: Sequence, methods: list[Method], reference: str) -> Case:
    return Case(
        name=data.name,
        data=f"{len(data.scans)} scans of {len(data.scans[0])} points",
        methods=methods,
        trials=[(seed,) for seed in range(3)],
        judge=partial(judge, data),
        long=True,
        reference=reference,
    )


def _own(data: Sequence, order: str) -> Method:
    return Method(
        f"jaxreg reconstruct, {order}",
        "jaxreg",
        f"order={order!r}",
        partial(by_reconstruct, order, data.scans),
    )


def _odometry(data: Sequence) -> Method:
    return Method(
        _ODOMETRY,
        "kiss-icp",
        f"voxel {VOXEL} m, no deskewing",
        partial(by_odometry, data.scans),
    )


def by_reconstruct(order, scans: list[np.ndarray], seed: int) -> Placed:
    """As a user calls it."""
    found = reconstruct(scans, order=order, key=jax.random.key(seed))
    component = np.where(np.asarray(found.placed), np.asarray(found.component), -1)
    return component, np.asarray(found.T_world_i, float)


def by_odometry(scans: list[np.ndarray], seed: int) -> Placed:
    """Frame by frame; nothing is drawn."""
    return np.zeros(len(scans), int), kiss_odometry(scans)


def by_peer(peer: Multiway, scans: list[np.ndarray], seed: int) -> Placed:
    """The same of Open3D."""
    T = peer.solve(scans, seed)
    return np.where(np.isnan(T[:, 0, 0]), -1, 0), T


def judge(data: Sequence, answers: list[Placed]) -> Judged:
    """Scans of the largest group, and their mean errors; the worst of the keys."""
    placed, wrong, turns, shifts = [], [], [], []
    for component, T in answers:
        some = component[component >= 0]
        largest = np.bincount(some).argmax() if len(some) else 0
        ids = np.flatnonzero(component == largest)
        both = np.array([_error(data, T, ids[0], i) for i in ids[1:]]).reshape(-1, 2)
        placed.append(len(ids))
        wrong.append(np.sum(np.any(both > _WRONG, axis=1)))
        found, true = (jnp.asarray(x[ids], jnp.float32) for x in (T, data.T_world_i))
        turns.append(float(rotation_error(found, true)) if len(both) else np.inf)
        shifts.append(1e3 * float(translation_error(found, true)))
    return Judged(
        [
            Metric("placed", float(min(placed)), "scans", "up", 0.0),
            Metric("wrong", float(max(wrong)), "scans", "down", 0.0),
            error("e_R", float(max(turns)), "rad", 2e-4),
            error("e_t", float(max(shifts)), "mm", 1.0),
        ]
    )


def _error(data: Sequence, T: np.ndarray, first: int, scan: int) -> tuple[float, float]:
    """Degrees and metres of a scan in the frame of another."""
    found, true = (np.linalg.inv(x[first]) @ x[scan] for x in (T, data.T_world_i))
    return pose_errors(data.scans[scan], found, true)
