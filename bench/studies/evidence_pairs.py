"""Pairs to study the evidence on: generated, of sensors and objects, and strangers."""

from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.motion_scans import SETS, load_scans
from bench.room_views import room_views
from bench.studies.buildings import SPINS, Building
from bench.studies.streets import TOLERANCE, street_pair
from bench.workloads import sensor_data
from bench.workloads.filter_data import horse_model
from bench.workloads.global_data import half, so3
from bench.workloads.sensor_data import pose_errors
from jaxreg.datasets import sculpture_scans
from jaxreg.io import read_log


class Pair(NamedTuple):
    """Two clouds `(n, 3)`, `(m, 3)` with the truth; None where they share no scene.

    `tolerance`: of the translation at the source's centroid, beside 5 degrees.
    """

    name: str
    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray | None
    tolerance: float

    def errors(self, T: np.ndarray) -> tuple[float, float]:
        """Degrees, and the translation error in tolerances; infinite of strangers."""
        if self.T_target_source is None:
            return np.inf, np.inf
        degrees, distance = pose_errors(self.source, T, self.T_target_source)
        return degrees, distance / self.tolerance


def streets(data: Path) -> Iterator[Pair]:
    """Generated."""
    for seed in range(40):
        yield Pair(f"street {seed}", *street_pair(seed), TOLERANCE)


def sculpture(data: Path) -> Iterator[Pair]:
    """Generated: all pairs of twelve views, many of which share no surface."""
    scans, T = sculpture_scans(12, seed=0)
    yield from _all_pairs("sculpture", list(scans), np.asarray(T, float), 0.02)


def horses(data: Path) -> Iterator[Pair]:
    """A tenth as many points on the whole, turned; and one half of it."""
    folder = data / "horse"
    model = horse_model(folder if folder.is_dir() else None)
    for name, trials in (("whole", so3(12, 0, model)), ("half", half(12, 0, model))):
        rows = zip(trials.source, trials.T_target_source, strict=True)
        for k, (source, T) in enumerate(rows):
            yield Pair(f"{name} horse {k}", source, trials.target, T, 5.0)


def objects(name: str, data: Path) -> Iterator[Pair]:
    """All pairs of the Bunny's or of the Dragon's scans, where they lie."""
    if (data / SETS[name][0]).is_dir():
        _, scans, T = load_scans(name, data)
        yield from _all_pairs(name, scans, T, 0.005)


def kitchen(data: Path) -> Iterator[Pair]:
    """Fragments of a room."""
    folder = data / "kitchen_fragments"
    if not folder.is_dir():
        return
    with np.load(folder / "fragments.npz") as file:
        scans = [file[name] for name in file.files]
    truth = read_log(folder / "gt.log")
    rows = zip(np.asarray(truth.edges), np.asarray(truth.T_i_j, float), strict=True)
    for (i, j), T in rows:
        yield Pair(f"kitchen {i} {j}", scans[j], scans[i], T, 0.2)


def views(data: Path) -> Iterator[Pair]:
    """What cameras that stand in the room would see, many of little but a wall."""
    for seed in (0, 5):
        yield from _views(data, seed)


def other_views(data: Path) -> Iterator[Pair]:
    """Of other cameras, to which no weight was fitted."""
    yield from _views(data, 7)


def _views(data: Path, seed: int) -> Iterator[Pair]:
    folder = data / "kitchen_fragments"
    if folder.is_dir():
        yield from _all_pairs(f"view {seed}", *room_views(folder, 24, seed), 0.15)


def sequences(data: Path) -> Iterator[Pair]:
    """All pairs of scans of two lidars that drive and are carried."""
    for found in sensor_data.sequences(data):
        yield from _all_pairs(found.name, found.scans, found.T_world_i, 0.6)


def sensors(data: Path) -> Iterator[Pair]:
    """Pairs of eleven sensors."""
    for x in sensor_data.sensor_pairs(data):
        yield Pair(x.name, x.source, x.target, x.T_target_source, x.tolerance)


# Each in groups: a lidar's scan is no match for that of a camera anyhow.
_STRANGERS = (
    (
        "kitti07_dump_3_1",
        "lidar_3dtk_1_0",
        "lidar_lpm_1_0",
        "newer01_10_0",
        "oxford_456_270",
        "webots",
    ),
    ("kinect_pcl_2_1", "rgbd_geotransformer", "rgbd_home_38_41"),
    ("kinect_pcl_4_3", "rgbd_mac_demo", "rgbd_home_38_41"),
    ("clutter_chef_rs1", "hippo_2_1"),
)


def strangers(data: Path) -> Iterator[Pair]:
    """Clouds of different scenes: any pose is wrong.

    Of the cameras, two pairs of files show one room and are kept apart.
    """
    known = {pair.name: pair for pair in sensor_data.sensor_pairs(data)}
    for group in _STRANGERS:
        for a, b in combinations([name for name in group if name in known], 2):
            clouds = known[a].source, known[b].target
            yield Pair(f"{a} on {b}", *clouds, None, 1.0)
    if all((data / folder).is_dir() for folder, *_ in SETS.values()):
        (_, bunny, _), (_, dragon, _) = (load_scans(name, data) for name in SETS)
        rng = np.random.default_rng(0)
        for _ in range(16):
            i, j = rng.integers(len(bunny)), rng.integers(len(dragon))
            yield Pair(f"bunny {i} on dragon {j}", bunny[i], dragon[j], None, 1.0)


def rooms(data: Path) -> Iterator[Pair]:
    """Walls, boxes and nothing else, by a lidar that spins; and of two buildings."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        building, other = Building.drawn(rng), Building.drawn(rng)
        T = building.poses(60, rng)
        for i in rng.integers(0, 57, 8):
            target = building.scan(T[i], SPINS, rng)
            for j in (i + 1, i + 3):
                source = building.scan(T[j], SPINS, rng)
                T_i_j = np.linalg.inv(T[i]) @ T[j]
                yield Pair(f"rooms {seed} {i} {j}", source, target, T_i_j, 0.3)
            stranger = other.scan(other.poses(1, rng)[0], SPINS, rng)
            yield Pair(f"rooms {seed} {i} and others", stranger, target, None, 1.0)


def _all_pairs(
    name: str, scans: list[np.ndarray], T_world_i: np.ndarray, tolerance: float
) -> Iterator[Pair]:
    """The later on the earlier."""
    for i, j in combinations(range(len(scans)), 2):
        T = np.linalg.inv(T_world_i[i]) @ T_world_i[j]
        yield Pair(f"{name} {i} {j}", scans[j], scans[i], T, tolerance)


#: By name, those that are generated first.
KINDS: dict[str, Callable[[Path], Iterator[Pair]]] = {
    "streets": streets,
    "sculpture": sculpture,
    "horses": horses,
    "bunny": lambda data: objects("bunny", data),
    "dragon": lambda data: objects("dragon", data),
    "kitchen": kitchen,
    "views": views,
    "other_views": other_views,
    "sequences": sequences,
    "sensors": sensors,
    "strangers": strangers,
    "rooms": rooms,
}
GENERATED = "streets", "sculpture"
#: Those that the regression does not see.
CHECKED = "other_views", "rooms"
