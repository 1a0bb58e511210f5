"""Pairs of point sets with known motion, and errors of the motions found."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.case import Judged
from bench.records import Metric, error, share
from jaxreg.datasets import sculpture_scans
from jaxreg.io.poses.stanford import read_conf


class Draw(NamedTuple):
    """A pair with its truth."""

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray


class Shape(NamedTuple):
    """All points of an object in one frame."""

    name: str
    points: np.ndarray
    extent: float


def load(folder: Path | None) -> Shape:
    """The Bunny's scans in one frame, or the generated sculpture's."""
    bunny = None if folder is None else folder / "stanford_bunny"
    if bunny is not None and (bunny / "bunny_scans.npz").exists():
        name, poses = "Stanford Bunny", read_conf(bunny / "bun.conf")
        with np.load(bunny / "bunny_scans.npz") as file:
            scans = [(file[key], T) for key, T in poses.items()]
    else:
        name = "generated sculpture"
        parts, T_world_i = sculpture_scans(12, seed=0, points_per_scan=20_000)
        scans = list(zip(parts, T_world_i, strict=True))
    moved = [x @ T[:3, :3].T + T[:3, 3] for x, T in scans]
    points = np.concatenate(moved).astype(np.float64)
    return Shape(name, points, float(np.linalg.norm(np.ptp(points, axis=0))))


def draw(shape: Shape, num: int, seed: int) -> Draw:
    """Disjoint subsets, the source 10 degrees and 5 % of the extent off."""
    rng = np.random.default_rng([num, seed])
    rows = rng.choice(len(shape.points), 2 * num, replace=False)
    source, target = shape.points[rows[:num]], shape.points[rows[num:]]
    x, y, z = (axis := rng.standard_normal(3)) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(10)
    R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)
    shift = rng.standard_normal(3)
    shift *= 0.05 * shape.extent / np.linalg.norm(shift)
    centre = source.mean(0)
    T_moved_source = np.eye(4)
    T_moved_source[:3, :3], T_moved_source[:3, 3] = R, centre - R @ centre + shift
    moved = (source - centre) @ R.T + centre + shift
    return Draw(
        moved.astype(np.float32),
        target.astype(np.float32),
        np.linalg.inv(T_moved_source),
    )


def errors(T: np.ndarray, pair: Draw, extent: float) -> tuple[float, float]:
    """Degrees, and % of the extent at the centroid of the source."""
    D = np.asarray(T, np.float64) @ np.linalg.inv(pair.T_target_source)
    # The angle from the chord: exact for small ones, unlike the arc cosine.
    chord = np.linalg.norm(D[:3, :3] - np.eye(3)) / np.sqrt(8)
    place = pair.T_target_source @ [*pair.source.astype(np.float64).mean(0), 1]
    shift = np.linalg.norm((D @ place - place)[:3])
    return float(np.degrees(2 * np.arcsin(min(chord, 1)))), float(100 * shift / extent)


def accuracy(found: list[np.ndarray], pairs: list[Draw], extent: float) -> Judged:
    """Medians with quartiles and maxima of the errors, and the share of successes."""
    scores = [errors(T, pair, extent) for T, pair in zip(found, pairs, strict=True)]
    rot, shift = np.array(scores).T
    ok = (rot < 1) & (shift < 1)
    return Judged(
        [
            share("success", ok, 100 / len(ok) + 1e-6),
            error("e_rot", float(np.median(rot)), "deg", 0.005),
            error("e_trans", float(np.median(shift)), "% of extent", 0.005),
            Metric("e_rot_max", float(rot.max()), "deg", "down"),
        ],
        {"e_rot": rot.tolist()},
    )
