"""Relative motions drawn with the sizes and errors of the MCC paper's Tables I, II.

The motions that the paper averaged are not published. What is known of them is how
many there are and the mean, median and root mean square of their errors. A share of
wrong ones, all as wrong, beside right ones with normal errors has about these three.
The poses are on a circle, as of a turntable, and each scan has motions to those next
to it, in both directions, as 46 motions of 10 scans need.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bench.workloads.averaging_data import motions, on_group, small_rotations
from jaxreg.graph import PoseGraph


class Line(NamedTuple):
    """An object of Tables I and II; radians and millimetres.

    `wrong` of the motions are off by `turn` and `shift`: chosen such that means and
    root mean squares come near the printed ones. Results are e_R and e_t of Table III.
    """

    scans: int
    motions: int
    median: tuple[float, float]
    wrong: int
    turn: float
    shift: float


TABLE_II = {
    "armadillo": Line(12, 68, (0.0045, 0.6271), 14, 1.35, 48.0),
    "buddha": Line(15, 79, (0.0088, 0.7141), 7, 1.75, 13.0),
    "bunny": Line(10, 46, (0.0054, 0.0906), 6, 0.15, 18.0),
    "dragon": Line(15, 103, (0.0043, 0.6799), 7, 1.6, 55.0),
}
#: Of the turntable: from its axis to a scan's origin, in millimetres.
RADIUS = 100.0
#: All graphs are padded to the largest, so that a method is compiled once.
_SCANS, _MOTIONS = 15, 103
# The median length of three normal numbers.
_MEDIAN = 1.5382


class Drawn(NamedTuple):
    """Graphs of one line, their true poses, and their errors in words."""

    graphs: list[PoseGraph]
    T_world_i: np.ndarray
    words: str


def drawn_graphs(name: str, num: int, seed: int = 0) -> Drawn:
    """Graphs with new errors on the same pairs of scans."""
    line, rng = TABLE_II[name], np.random.default_rng(seed)
    T, edges = _turntable(line.scans), _edges(line)
    true = np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]]
    found = [_with_errors(line, true, rng) for _ in range(num)]
    padded = np.zeros((_MOTIONS, 2), int)
    padded[: len(edges)] = edges
    padded[len(edges) :, 1] = 1
    T_i_j = np.tile(np.eye(4), (num, _MOTIONS, 1, 1))
    T_i_j[:, : len(edges)] = found
    mask = np.arange(_MOTIONS) < len(edges)
    graphs = [
        PoseGraph.from_edges(padded, T.astype(np.float32), _SCANS, mask=mask)
        for T in T_i_j
    ]
    return Drawn(graphs, T, _in_words(line, found[0], true))


def _turntable(scans: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(scans) / scans
    R = Rotation.from_euler("z", angle[:, None]).as_matrix()
    t = RADIUS * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    T = motions(R, t)
    return np.linalg.inv(T[0]) @ T


def _edges(line: Line) -> np.ndarray:
    """The nearest neighbours along the circle, in both directions."""
    i, j = np.meshgrid(np.arange(line.scans), np.arange(line.scans), indexing="ij")
    apart = (j - i) % line.scans
    near = np.minimum(apart, line.scans - apart)
    pairs = np.stack([i, j], axis=-1)[near > 0]
    order = np.argsort(near[near > 0], kind="stable")
    return pairs[order][: line.motions]


def _with_errors(line: Line, true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    num = len(true)
    turn, shift = (m / _MEDIAN for m in line.median)
    R = small_rotations(rng, num, np.rad2deg(turn))
    t = shift * rng.normal(size=(num, 3))
    wrong = rng.choice(num, line.wrong, replace=False)
    axis, way = (rng.normal(size=(line.wrong, 3)) for _ in range(2))
    axis, way = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (axis, way))
    R[wrong] = Rotation.from_rotvec(line.turn * axis).as_matrix()
    t[wrong] = line.shift * way
    out = on_group(true.copy())
    out[:, :3, :3] = out[:, :3, :3] @ R
    out[:, :3, 3] += t
    return out


def _in_words(line: Line, T_i_j: np.ndarray, true: np.ndarray) -> str:
    gap = np.swapaxes(true[:, :3, :3], 1, 2) @ T_i_j[:, :3, :3]
    angle = Rotation.from_matrix(gap).magnitude()
    shift = np.linalg.norm((T_i_j - true)[:, :3, 3], axis=1)
    told = [
        f"{np.mean(x):.2g} / {np.median(x):.2g} / {np.sqrt(np.mean(x**2)):.2g} {unit}"
        for x, unit in ((angle, "rad"), (shift, "mm"))
    ]
    return (
        f"{len(true)} motions of {line.scans} scans, {line.wrong} of them wrong; "
        f"mean / median / RMSE {told[0]}, {told[1]}"
    )
