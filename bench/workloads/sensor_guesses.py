"""Pairs of other people's sensors from the guesses that were published with them."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from scipy.spatial import KDTree

import jaxreg as jr
from bench.case import Case, Judged, Method, Options
from bench.peers.local_pairs import open3d, small_gicp
from bench.workloads.global_scans import BELIEVED
from bench.workloads.local_pairs import written_out
from bench.workloads.sensor_data import (
    Answer,
    SensorPair,
    by_register,
    judge,
    sensor_pairs,
)


PEER = "small_gicp GICP"
# Two stages of the peers: sides of voxels and reaches, in the voxels of the pair.
_STAGES = (2, 20), (1, 3)
_RESIDUALS = jr.PointToPoint, jr.PointToPlane, jr.Symmetric


def cases(options: Options) -> Iterator[Case]:
    """A case per pair with a guess."""
    for pair in sensor_pairs(options.data):
        if pair.T_init is None:
            continue
        guess = pair.T_init.astype(np.float32)
        own = {"jaxreg ICP": jr.ICP()}
        for residual in _RESIDUALS:
            own[f"jaxreg ICP {residual.__name__}"] = jr.ICP(residual=residual())
        methods = [
            Method(
                name, "jaxreg", written_out(icp), partial(by_register, icp, pair, guess)
            )
            for name, icp in own.items()
        ]
        for name, library, solve, kind in _PEERS:
            solve = partial(solve, kind=kind, stages=_STAGES)
            text = f"kind={kind}, stages={_STAGES} voxels of the pair"
            there = partial(from_guess, solve, pair, pair.T_init)
            methods.append(Method(name, library, text, there))
        yield Case(
            name=pair.name,
            data=f"{pair.kind}, {len(pair.source)} on {len(pair.target)} points",
            methods=methods,
            # Nothing is drawn.
            trials=[(0,)],
            repeats=5,
            judge=partial(judged, pair),
            reference=PEER,
        )


_PEERS = (
    ("small_gicp PLANE", "small_gicp", small_gicp, "PLANE_ICP"),
    (PEER, "small_gicp", small_gicp, "GICP"),
    ("Open3D plane", "open3d", open3d, "plane"),
    ("Open3D GICP", "open3d", open3d, "gicp"),
)


def from_guess(
    solve: Callable, pair: SensorPair, T_init: np.ndarray, seed: int
) -> np.ndarray:
    """By a peer, which starts from the identity and counts in voxels here."""
    moved = pair.source @ T_init[:3, :3].T + T_init[:3, 3]
    return solve(moved.astype(np.float32), pair.target, pair.voxel) @ T_init


def judged(pair: SensorPair, answers: list[Answer | np.ndarray]) -> Judged:
    """A peer's pose is believed as its user would: by the points that have met."""
    told = [a if isinstance(a, Answer) else Answer(a, met(pair, a)) for a in answers]
    return judge(pair, told)


def met(pair: SensorPair, T: np.ndarray) -> bool:
    """Whether enough points of either cloud are within 1.5 voxels of the other."""
    moved = pair.source @ T[:3, :3].T + T[:3, 3]
    for a, b in ((moved, pair.target), (pair.target, moved)):
        distance, _ = KDTree(b).query(a, distance_upper_bound=1.5 * pair.voxel)
        if np.isfinite(distance).mean() <= BELIEVED:
            return False
    return True
