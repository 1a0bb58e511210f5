"""Trials of the PF paper's experiments (section 5), with known truth.

A trial is a source, a target and the motion between them; a set of trials shares the
target. The paper prints neither point counts, displacements nor units for most of its
experiments. What is chosen here is said in each docstring. Float32 throughout.
"""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.datasets import (
    cube_points,
    horse_like_points,
    letter_offset,
    truck_front,
    truck_points,
    word_points,
)
from jaxreg.io import read_points


TEXT = "CVPR ALASKA"
HEIGHT = 20.0  # of a letter
SIDE = 20.0  # of the cube
# Diagonal of the paper's horse, [-36, 33] x [-67, 74] x [-75, 82].
_HORSE_DIAGONAL = 222.0


class Trials(NamedTuple):
    """Pairs to register.

    `source` is `(b, n, d)`, `target` `(m, d)`, `T_target_source` `(b, d+1, d+1)` the
    truth in float64. `shape_turns` are the rotations about the target's origin that
    leave its shape as it is, `(s, d, d)`. Success is a rotation error of at most
    `degrees` and a shift of the source's centroid of at most `shift`.
    """

    source: np.ndarray
    target: np.ndarray
    T_target_source: np.ndarray
    degrees: float
    shift: float
    shape_turns: np.ndarray


def letter(num: int, seed: int = 0) -> Trials:
    """The S of the words, displaced: 2D, partial.

    S is drawn anew with another spacing of its points, so that they are no copies of
    those of the words. It is turned by up to 60 degrees either way and its centroid
    moved by one to two letter heights in any direction. Success: 5 degrees and a
    twentieth of a height.
    """
    rng = np.random.default_rng(seed)
    offset = letter_offset(TEXT, TEXT.index("S"), height=HEIGHT)
    points = word_points("S", height=HEIGHT, spacing=0.045 * HEIGHT) + offset
    target = word_points(TEXT, height=HEIGHT)
    middle = target.mean(axis=0)
    points, target = points - middle, target - middle
    motions = [
        _about(
            points.mean(axis=0),
            _turn_2d(np.deg2rad(rng.uniform(-60, 60))),
            rng.uniform(1, 2) * HEIGHT * _direction(rng, 2),
        )
        for _ in range(num)
    ]
    return _trials([points] * num, motions, target, 5.0, 0.05 * HEIGHT)


def cube(num: int, seed: int = 0) -> Trials:
    """50 of a cube's 400 points, displaced: one set dense, the other sparse.

    Each trial has another 50. They are turned by up to 60 degrees about any axis and
    moved by half a side to a whole side. Success: 5 degrees and a fortieth of a side.
    """
    rng = np.random.default_rng(seed)
    target = cube_points(400, side=SIDE)
    points = [target[rng.choice(400, 50, replace=False)] for _ in range(num)]
    motions = [
        _about(
            few.mean(axis=0),
            _turn_3d(_direction(rng, 3), rng.uniform(0, 60)),
            rng.uniform(0.5, 1) * SIDE * _direction(rng, 3),
        )
        for few in points
    ]
    turns = Rotation.create_group("O").as_matrix()
    return _trials(points, motions, target, 5.0, 0.025 * SIDE, turns)


def truck(num: int, seed: int = 0) -> Trials:
    """The front of a truck, put at its rear and turned by 60 degrees about z.

    200 points of the front against 2,000 of the whole, each trial with other points of
    the front. Success: 10 degrees and 0.3 m, about the spacing of the target.
    """
    rng = np.random.default_rng(seed)
    target = truck_points(2000)
    middle = (target.min(axis=0) + target.max(axis=0)) / 2
    pool = truck_points(6000, seed=1) - middle
    pool = pool[truck_front(pool + middle)]
    points = [pool[rng.choice(len(pool), 200, replace=False)] for _ in range(num)]
    motions = [
        _about(
            few.mean(axis=0),
            _turn_3d(np.array([0.0, 0.0, 1.0]), 60),
            np.array([-2 * few[:, 0].mean(), 0.0, 0.0]),
        )
        for few in points
    ]
    return _trials(points, motions, target - middle, 10.0, 0.3)


#: What the paper shows one run of, by the number of trials.
EXPERIMENTS = {"letter": letter, "cube": cube, "truck": truck}


class Noise(NamedTuple):
    """What takes the place of some points of a horse: draws N(0, deviation^2).

    Attributes:
        deviation: of each component.
        around: what the draws are around: the middle of the moved "model", the
            "points" that they replace, or the origin of the "frame" they are given in.
        share: of the points is replaced.
    """

    deviation: float
    around: Literal["model", "points", "frame"]
    share: float

    def placed(self, draws: np.ndarray, points: np.ndarray, T: np.ndarray):
        """Normal draws in the place of points, both at home; T moves them away."""
        far = self.deviation * draws
        if self.around == "points":
            return points + far
        return moved(np.linalg.inv(T), far) if self.around == "frame" else far


def horse(num: int, noise: float, model: np.ndarray, seed: int = 0) -> Trials:
    """Table 1: 400 points of a model, moved, some replaced by noise.

    The paper's noise, N(0, 40) isotropic, is read as a deviation of 40 in each
    component, about the middle of the moved model; see `noisy_horse`.
    """
    return noisy_horse(num, Noise(40, "model", noise), model, 400, seed)


def noisy_horse(
    num: int, noise: Noise, model: np.ndarray, num_points: int, seed: int = 0
) -> Trials:
    """Table 1: points of a model, moved, some replaced by noise.

    Translations N(0, 45) in each component, a turn about z of U(0, 60) degrees.
    Success: 10 degrees and 5 units.

    Args:
        num: trials.
        noise: what replaces how many of the points.
        model: `(8000, 3)` points in the paper's unit: the first half is the target,
            the data are some of the others, none of which the target has.
        num_points: of the data.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    target, pool = model[:4000], model[4000:]
    replaced = round(num_points * noise.share)
    points, motions = [], []
    for _ in range(num):
        few = pool[rng.choice(len(pool), num_points, replace=False)]
        draws = rng.normal(size=(replaced, 3))
        order = rng.permutation(num_points)
        turn = _turn_3d(np.array([0.0, 0.0, 1.0]), rng.uniform(0, 60))
        motions.append(_about(np.zeros(3), turn, rng.normal(0, 45, 3)))
        few[:replaced] = noise.placed(draws, few[:replaced], motions[-1])
        points.append(few[order])
    return _trials(points, motions, target, 10.0, 5.0)


def horse_model(folder: Path | None) -> np.ndarray:
    """8,000 points of the horse in the paper's unit, about their middle, shuffled.

    The scanned horse of the folder, scaled to the paper's diagonal, else, where there
    is no such folder, one made of our own.
    """
    scan = _scan(folder)
    if scan is None:
        return horse_like_points(8000)
    points = read_points(scan).astype(float)
    low, high = points.min(axis=0), points.max(axis=0)
    points = (points - (low + high) / 2) * _HORSE_DIAGONAL / np.linalg.norm(high - low)
    return points[np.random.default_rng(0).permutation(len(points))[:8000]]


def horse_name(folder: Path | None) -> str:
    """What `horse_model` takes, as told to the reader."""
    return "generated horse" if _scan(folder) is None else "scanned horse"


def _scan(folder: Path | None) -> Path | None:
    path = None if folder is None else folder / "horse.ply.gz"
    return path if path is not None and path.is_file() else None


def moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points under a motion, both with any leading axes."""
    return points @ np.swapaxes(T[..., :-1, :-1], -1, -2) + T[..., None, :-1, -1]


def _trials(
    points: list[np.ndarray],
    displacements: list[np.ndarray],
    target: np.ndarray,
    degrees: float,
    shift: float,
    shape_turns: np.ndarray | None = None,
) -> Trials:
    """Of points at their place on the target and the motions that take them away."""
    T = np.array(displacements)
    source = moved(T, np.array(points)).astype(np.float32)
    turns = np.eye(target.shape[1])[None] if shape_turns is None else shape_turns
    truth = np.linalg.inv(T)
    return Trials(source, target.astype(np.float32), truth, degrees, shift, turns)


def _about(centre: np.ndarray, R: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """The motion that turns about a centre, then shifts."""
    T = np.eye(len(centre) + 1)
    T[:-1, :-1] = R
    T[:-1, -1] = centre - R @ centre + shift
    return T


def _direction(rng: np.random.Generator, d: int) -> np.ndarray:
    x = rng.standard_normal(d)
    return x / np.linalg.norm(x)


def _turn_2d(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def _turn_3d(axis: np.ndarray, degrees: float) -> np.ndarray:
    return Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
