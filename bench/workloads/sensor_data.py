"""Pairs and sequences of other people's sensors, and how answers on them are judged."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxreg as jr
from bench.case import Judged
from bench.records import Metric, error, share


FOLDER = "sensor_pairs"
_DEGREES = 5.0
# Sizes that clouds are padded to: two programs for all pairs.
_SIZES = 32768, 98304


class SensorPair(NamedTuple):
    """A pair with its truth, and what a user knows of the sensor.

    Attributes:
        source, target: `(n, 3)`, `(m, 3)` float32.
        T_target_source: the truth.
        tolerance: of the translation at the source's centroid, in the clouds' unit,
            beside 5 degrees.
        kind: lidar, rgbd or object.
        voxel: side of the voxels that thin the clouds.
        camera_at_origin: whether frames are those of the scanner.
        T_init: a published guess, if there is one.
    """

    name: str
    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray
    tolerance: float
    kind: str
    voxel: float
    camera_at_origin: bool
    T_init: np.ndarray | None = None

    def errors(self, T: np.ndarray) -> tuple[float, float]:
        """Degrees, and the distance at the centroid of the source."""
        return pose_errors(self.source, T, self.T_target_source)

    def right(self, T: np.ndarray) -> bool:
        """Within 5 degrees and the tolerance."""
        degrees, distance = self.errors(T)
        return degrees < _DEGREES and distance < self.tolerance


class Sequence(NamedTuple):
    """Scans of a sensor that moves, `T_world_i` `(v, 4, 4)`, `voxel` as of a pair.

    `least` is the share of points that must meet for a user of features to believe a
    pair.
    """

    name: str
    scans: list[np.ndarray]
    T_world_i: np.ndarray
    voxel: float
    least: float
    camera_at_origin: bool


class Answer(NamedTuple):
    """A pose and whether its method believes it; the evidence where it tells any."""

    T_target_source: np.ndarray
    believed: bool
    overlap: float | None = None
    log_evidence: float | None = None


def sensor_pairs(data: Path) -> list[SensorPair]:
    """All that are there."""
    found = []
    for path in sorted((data / FOLDER).glob("*.npz")):
        with np.load(path, allow_pickle=False) as file:
            if "source" not in file:
                continue
            known = {name: file[name] for name in file if name in SensorPair._fields}
        tolerance, voxel = (float(known.pop(name)) for name in ("tolerance", "voxel"))
        found.append(
            SensorPair(
                path.stem,
                tolerance=tolerance,
                voxel=voxel,
                kind=str(known.pop("kind")),
                camera_at_origin=bool(known.pop("camera_at_origin")),
                **known,
            )
        )
    return found


def sequences(data: Path) -> list[Sequence]:
    """All that are there."""
    found = []
    for path in sorted((data / FOLDER).glob("seq_*.npz")):
        with np.load(path, allow_pickle=False) as file:
            T = file["T_world_i"]
            scans = [file[f"scan_{k:02d}"] for k in range(len(T))]
            voxel, least = float(file["voxel"]), float(file["least"])
            camera = bool(file["camera_at_origin"])
        name = path.stem.removeprefix("seq_")
        found.append(Sequence(name, scans, T, voxel, least, camera))
    return found


def pose_errors(
    points: np.ndarray, T: np.ndarray, T_true: np.ndarray
) -> tuple[float, float]:
    """Degrees, and the distance at the centroid of the points."""
    apart = (np.asarray(T, float) - T_true)[:3]
    chord = np.linalg.norm(apart[:, :3]) / np.sqrt(8)
    distance = np.linalg.norm(apart @ [*points.mean(0, dtype=float), 1])
    return float(np.degrees(2 * np.arcsin(min(chord, 1)))), float(distance)


def by_register(method: Any, pair: SensorPair, init: Any, seed: int) -> Answer:
    """The answer of `register`; clouds are padded to one of two sizes."""
    most = max(len(pair.source), len(pair.target))
    size = next((n for n in _SIZES if n >= most), most)

    def padded(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = size - len(points)
        return np.pad(points, ((0, rows), (0, 0))), np.arange(size) < len(points)

    (source, source_mask), (target, target_mask) = map(padded, pair[1:3])
    found = jr.register(
        source,
        target,
        method,
        init,
        key=jax.random.key(seed),
        source_mask=source_mask,
        target_mask=target_mask,
    )
    return Answer(
        np.asarray(found.T_target_source, float),
        int(found.status) == jr.Status.CONVERGED,
        float(found.overlap),
        float(found.log_evidence),
    )


def judge(pair: SensorPair, answers: list[Answer]) -> Judged:
    """Right, believed, and errors: medians over the keys."""
    right = np.array([pair.right(a.T_target_source) for a in answers])
    believed = np.array([a.believed for a in answers])
    both = np.array([pair.errors(a.T_target_source) for a in answers])
    e_rot, e_trans = np.median(both, axis=0)
    metrics = [
        share("right", right, 1.0),
        share("right and believed", right & believed, 1.0),
        Metric("wrong and believed", float(np.sum(believed & ~right)), "", "down", 0.0),
        error("e_rot", float(e_rot), "deg", 0.02),
        error("e_trans", float(e_trans), "units", 0.005),
    ]
    for name in ("overlap", "log_evidence"):
        told = [getattr(a, name) for a in answers]
        if None not in told:
            metrics.append(Metric(name, float(np.median(told)), "", "up"))
    samples = {"right": right.astype(float), "believed": believed.astype(float)}
    return Judged(metrics, {k: v.tolist() for k, v in samples.items()})
