"""Time against the number of scans: the sculpture from 12 to 100 sides, a room."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.multiview import Multiway
from bench.records import Metric
from bench.room_views import room_views
from bench.workloads.multiview import judge as judge_poses
from bench.workloads.multiview import own_method, peer_method
from jaxreg import reconstruct
from jaxreg.datasets import sculpture_scans


# All pairs of more are minutes for the peer.
_PEER_UP_TO = 24


def cases(options: Options) -> Iterator[Case]:
    """A case per number of scans."""
    peer = Multiway(0.005, 0.002, 0.5, camera_at_origin=False)
    for num in (12, 24, 48, 100):
        scans, T_world_i = sculpture_scans(num, seed=0)
        yield Case(
            name=f"{num} scans",
            data=f"sculpture, {num} views of 8,000 points",
            methods=_methods(num, peer),
            trials=[(scans, seed) for seed in range(3)],
            long=True,
            judge=partial(judge, T_world_i),
            x=float(num),
            x_label="scans",
        )
    yield from _room(options)


def _room(options: Options) -> Iterator[Case]:
    """Views of a kitchen, of which many show little but a wall."""
    folder = options.data / "kitchen_fragments"
    if not folder.exists():
        return
    peer = Multiway(0.05, 0.02, 0.3, camera_at_origin=False)
    for num in (24, 60):
        views, T_world_i = room_views(folder, num)
        yield Case(
            name=f"{num} views of a room",
            data=f"kitchen, {num} views of up to 20,000 points",
            methods=_methods(num, peer),
            trials=[(views, seed) for seed in range(3)],
            long=True,
            judge=partial(judge, T_world_i),
        )


def _methods(num: int, peer: Multiway) -> list[Method]:
    """Ours, and the peer's where its pairs are few enough."""
    if num > _PEER_UP_TO:
        return [own_method(_own)]
    return [own_method(_own), peer_method(peer, partial(_theirs, peer))]


def _own(scans: list[np.ndarray], seed: int) -> tuple[np.ndarray, int]:
    found = reconstruct(scans, key=jax.random.key(seed))
    placed = np.asarray(found.placed)[:, None, None]
    T = np.where(placed, np.asarray(found.T_world_i), np.nan)
    return T, len(np.asarray(found.overlap))


def _theirs(
    peer: Multiway, scans: list[np.ndarray], seed: int
) -> tuple[np.ndarray, int]:
    return peer.solve(scans, seed), len(scans) * (len(scans) - 1) // 2


def judge(T_true: np.ndarray, answers: list[Any]) -> Judged:
    """As for `multiview`, and the registrations that were spent."""
    judged = judge_poses(T_true, [T for T, _ in answers])
    spent = float(np.median([pairs for _, pairs in answers]))
    return Judged([*judged.metrics, Metric("pairs", spent, "", "down")], judged.samples)
