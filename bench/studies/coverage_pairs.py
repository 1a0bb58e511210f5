"""Pairs of which the true pose is known, for the study of covariances."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import jaxreg
from bench.motion_scans import SETS, load_scans
from bench.room_views import kitchen
from bench.workloads.sensor_data import sequences


#: Points of each generated cloud.
NUM_POINTS = 600


class CoveragePair(NamedTuple):
    """Two clouds, the motion between them, and a guess near it."""

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray
    init: np.ndarray


class Kind(NamedTuple):
    """Surfaces that are sampled twice.

    Attributes:
        surface: draws so many points, `(n, d)`, of a shape of a number.
        noise: of every coordinate, in sample spacings.
        kept: share of each surface that is left beyond a plane of its own.
    """

    surface: Callable[[np.random.Generator, int, int], np.ndarray]
    noise: float
    kept: float = 1.0


def lump(rng: np.random.Generator, shape: int, num: int, d: int = 3) -> np.ndarray:
    """Points on a smooth closed surface."""
    own = np.random.default_rng(1000 + shape)
    waves, height = 1.8 * own.normal(size=(5, d)), 0.15 * own.normal(size=5)
    phase = own.uniform(0, 2 * np.pi, 5)
    x = rng.normal(size=(num, d))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return (1 + np.sin(x @ waves.T + phase) @ height)[:, None] * x


def outline(rng: np.random.Generator, shape: int, num: int) -> np.ndarray:
    """Points on a smooth closed curve."""
    return lump(rng, shape, num, 2)


def box(rng: np.random.Generator, shape: int, num: int) -> np.ndarray:
    """Points on the faces of a box."""
    sides = np.random.default_rng(2000 + shape).uniform(0.5, 1.5, 3)
    area = np.prod(sides) / sides
    axis = rng.choice(3, num, p=area / area.sum())
    x = rng.uniform(-0.5, 0.5, (num, 3))
    x[np.arange(num), axis] = rng.choice([-0.5, 0.5], num)
    return x * sides


def tee(rng: np.random.Generator, shape: int, num: int) -> np.ndarray:
    """Points on two cylinders that meet, as pipes do, without caps."""
    own = np.random.default_rng(3000 + shape)
    radius, length = own.uniform(0.2, 0.4, 2), own.uniform(0.8, 1.6, 2)
    lean = Rotation.from_rotvec([own.uniform(0.9, 1.4), 0, 0]).as_matrix()
    which = rng.choice(2, 4 * num, p=(radius * length) / (radius @ length))
    angle = rng.uniform(0, 2 * np.pi, 4 * num)
    r, z = radius[which], rng.uniform(-0.5, 0.5, 4 * num) * length[which]
    x = np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)
    branch = which == 1
    x[branch, 2] += length[1] / 2
    x[branch] = x[branch] @ lean.T
    # What lies inside the other pipe is not seen.
    in_other = np.linalg.norm(x[:, :2], axis=1) < 0.99 * radius[0]
    back = x @ lean
    in_branch = (np.linalg.norm(back[:, :2], axis=1) < 0.99 * radius[1]) & (
        back[:, 2] > 0
    )
    inside = np.where(branch, in_other & (np.abs(x[:, 2]) < length[0] / 2), in_branch)
    return x[~inside][:num]


KINDS = {
    "lump": Kind(lump, 0.0),
    "lump, noise 0.2": Kind(lump, 0.2),
    "lump, noise 0.4": Kind(lump, 0.4),
    "lump, 70 %": Kind(lump, 0.0, 0.7),
    "lump, 70 %, noise 0.2": Kind(lump, 0.2, 0.7),
    "lump, 70 %, noise 0.4": Kind(lump, 0.4, 0.7),
    "box": Kind(box, 0.0),
    "box, noise 0.2": Kind(box, 0.2),
    "box, noise 0.4": Kind(box, 0.4),
    "pipes": Kind(tee, 0.0),
    "pipes, noise 0.2": Kind(tee, 0.2),
    "pipes, noise 0.4": Kind(tee, 0.4),
    "outline": Kind(outline, 0.0),
    "outline, noise 0.2": Kind(outline, 0.2),
    "outline, noise 0.4": Kind(outline, 0.4),
}


def generated(kind: Kind, num: int, first: int) -> Iterator[CoveragePair]:
    """Pairs, of eight shapes; those of even numbers are the half to choose on."""
    for n in range(first, first + num):
        rng = np.random.default_rng(n)
        whole = int(NUM_POINTS / kind.kept)
        clouds = []
        for _ in range(2):
            x = kind.surface(rng, n % 8, whole)
            away = x @ rng.normal(size=x.shape[1])
            clouds.append(x[np.argsort(away)[:NUM_POINTS]])
        near = KDTree(clouds[0]).query(clouds[0], 5)[0]
        # Of a curve the next point on either side.
        d = clouds[0].shape[1]
        spacing = np.median(near[:, 2 if d == 2 else 4])
        clouds = [x + kind.noise * spacing * rng.normal(size=x.shape) for x in clouds]
        T = _motion(rng, d, np.pi, 1.0)
        source, target = clouds[0], clouds[1] @ T[:d, :d].T + T[:d, d]
        yield CoveragePair(source, target, T, _motion(rng, d, 0.1, 0.1) @ T)


def _motion(rng: np.random.Generator, d: int, angle: float, shift: float) -> np.ndarray:
    T = np.eye(d + 1)
    turn = rng.normal(size=3)
    if d == 2:
        turn[:2] = 0
    turn *= angle / np.linalg.norm(turn)
    T[:d, :d] = Rotation.from_rotvec(turn).as_matrix()[:d, :d]
    T[:d, d] = shift * rng.normal(size=d)
    return T


def real(name: str, data: Path, key: int = 0) -> Iterator[CoveragePair]:
    """Pairs of a set of scans that overlap; the true pose is that of all together."""
    scans = [x[_some(len(x))] for x in _scans(name, data)]
    found = jaxreg.reconstruct(scans, key=jax.random.key(key))
    T = np.asarray(found.T_world_i, np.float64)
    edges, overlap = np.asarray(found.graph.edges), np.asarray(found.overlap)
    trusted = np.asarray(found.edge_weight) > 0.5
    for n, (i, j) in enumerate(edges[trusted & (overlap > 0.3)].tolist()):
        rng = np.random.default_rng(n)
        T_i_j = np.linalg.inv(T[i]) @ T[j]
        middle, size = scans[j].mean(axis=0), scans[j].std()
        near = _motion(rng, 3, 0.02, 0.02 * size)
        moved = T_i_j @ [*middle, 1]
        near[:3, 3] += moved[:3] - near[:3, :3] @ moved[:3]
        yield CoveragePair(scans[j], scans[i], T_i_j, near @ T_i_j)


def _scans(name: str, data: Path) -> list[np.ndarray]:
    if name == "kitchen":
        return kitchen(data / "kitchen_fragments")[0]
    if name in SETS:
        return load_scans(name, data)[1]
    return next(x.scans for x in sequences(data) if x.name == name)


def _some(num: int, most: int = 8_000) -> np.ndarray:
    rows = np.random.default_rng(0).permutation(num)
    return np.sort(rows[:most])
