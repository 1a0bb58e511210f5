"""Scans into one frame without a guess: two objects, a sculpture, a room."""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options, Solve
from bench.motion_scans import SETS, load_scans
from bench.peers.multiview import Multiway
from bench.records import Metric, error
from bench.room_views import kitchen
from bench.surfaces import Surface, surface_distance
from bench.turntable import without_displacement
from jaxreg import reconstruct
from jaxreg.datasets import sculpture_scans
from jaxreg.metrics import rotation_error, translation_error


#: The name of Open3D's pipeline.
PEER = "Open3D FPFH + RANSAC, multiway"


class Scans(NamedTuple):
    """Scans in metres with their truth, and what a user knows of them.

    Attributes:
        voxel: about five times the distance of points.
        least: share of points that must meet; smooth surfaces ask for more.
        camera_at_origin: whether frames are those of the scanner.
    """

    name: str
    scans: list[np.ndarray]
    T_world_i: np.ndarray
    voxel: float
    least: float
    camera_at_origin: bool


def cases(options: Options) -> Iterator[Case]:
    """A case per object."""
    for data in _quick() if options.quick else _full(options):
        method = Multiway(
            data.voxel,
            0.4 * data.voxel,
            data.least,
            camera_at_origin=data.camera_at_origin,
        )
        yield Case(
            name=data.name,
            data=f"{len(data.scans)} scans of {len(data.scans[0])} points",
            methods=[own_method(_own), peer_method(method, method.solve)],
            trials=[(data.scans, seed) for seed in range(5)],
            judge=partial(_judged, data),
            reference=PEER,
        )


def own_method(solve: Solve) -> Method:
    """`reconstruct` as it is."""
    name = "jaxreg reconstruct"
    return Method(name, "jaxreg", "defaults", solve, on_accelerator=True)


def peer_method(peer: Multiway, solve: Solve) -> Method:
    """Open3D's pipeline."""
    return Method(PEER, "open3d", f"all pairs, {peer}", solve)


def _quick() -> Iterator[Scans]:
    scans, T_world_i = sculpture_scans(8, seed=0, points_per_scan=2_000)
    yield Scans("sculpture, 8 views", scans, T_world_i, 0.0075, 0.5, False)


def _full(options: Options) -> Iterator[Scans]:
    scans, T_world_i = sculpture_scans(12, seed=0)
    yield Scans("sculpture, 12 views", scans, T_world_i, 0.005, 0.5, False)
    for name, (folder, file, _) in SETS.items():
        if (options.data / folder / file).exists():
            title, scans, T_world_i = load_scans(name, options.data)
            yield Scans(title, scans, T_world_i, 0.0025, 0.5, True)
    folder = options.data / "kitchen_fragments"
    if folder.exists():
        scans, T_world_i = kitchen(folder)
        yield Scans("kitchen, 6 fragments", scans, T_world_i, 0.05, 0.3, True)


def _own(scans: list[np.ndarray], seed: int) -> np.ndarray:
    found = reconstruct(scans, key=jax.random.key(seed))
    placed = np.asarray(found.placed)[:, None, None]
    return np.where(placed, np.asarray(found.T_world_i), np.nan)


def _judged(data: Scans, answers: list[Any]) -> Judged:
    """Errors, and how the surfaces meet at the answers and at the published poses."""
    judged = judge(data.T_world_i, answers)
    rng, reach = np.random.default_rng(0), 0.6 * data.voxel
    surfaces = [Surface.of(points, rng) for points in data.scans]
    gaps = [1e3 * surface_distance(surfaces, T, reach) for T in answers]
    truth = 1e3 * surface_distance(surfaces, data.T_world_i, reach)
    more = [
        Metric("surfaces", float(np.median(gaps)), "mm", "down", 0.02),
        Metric("surfaces_truth", truth, "mm", "down"),
    ]
    if data.camera_at_origin and data.name.startswith("Stanford"):
        more += _left(data.T_world_i, answers)
    return Judged([*judged.metrics, *more], judged.samples)


def _left(T_true: np.ndarray, answers: list[Any]) -> list[Metric]:
    """Errors that are left without the displacement of the turntable's axis."""
    e_R, e_t = [], []
    for T in answers:
        some = ~np.isnan(T[:, 0, 0])
        fitted = without_displacement(T[some], T_true[some])
        off = np.linalg.inv(fitted) @ np.asarray(T[some], np.float64)
        chord = np.linalg.norm(off[:, :3, :3] - np.eye(3), axis=(1, 2))
        e_R.append(float(np.mean(2 * np.arcsin(chord / np.sqrt(8)))))
        e_t.append(1e3 * float(np.mean(np.linalg.norm(off[:, :3, 3], axis=1))))
    return [
        error("e_R_left", float(np.median(e_R)), "rad", 2e-4),
        error("e_t_left", float(np.median(e_t)), "mm", 0.02),
    ]


def judge(T_true: np.ndarray, answers: list[Any]) -> Judged:
    """Scans placed, and mean errors of those, medians over the runs."""
    placed, e_R, e_t = [], [], []
    for T in answers:
        some = ~np.isnan(T[:, 0, 0])
        placed.append(100 * some.mean())
        found, true = (jnp.asarray(x[some], jnp.float32) for x in (T, T_true))
        e_R.append(float(rotation_error(found, true)))
        e_t.append(1e3 * float(translation_error(found, true)))
    return Judged(
        [
            Metric("placed", float(np.median(placed)), "%", "up", 1.0),
            error("e_R", float(np.median(e_R)), "rad", 2e-4),
            error("e_t", float(np.median(e_t)), "mm", 0.02),
        ],
        {"e_R": e_R},
    )
