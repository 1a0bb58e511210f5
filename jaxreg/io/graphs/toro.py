"""Pose graphs in TORO text files (`.graph`): 2D and 3D, any ids.

`EDGE2 i j x y theta` and `EDGE3 i j x y z roll pitch yaw` hold `T_i_j`, with the
rotation Rz(yaw) Ry(pitch) Rx(roll). The 2D information comes in TORO's own order.
"""

from pathlib import Path

import numpy as np

from jaxreg.geometry import lie
from jaxreg.graph.edge_checks import EdgeError
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.io.errors import InputError
from jaxreg.io.rows import Line, ids, numbers, read_lines


_EDGE = {"EDGE2": 2, "EDGE3": 3}
_OTHER = ("VERTEX2", "VERTEX3", "VERTEX", "EQUIV")
# Rows and columns of the six numbers of EDGE2: xx, xy, yy, tt, xt, yt.
_ORDER_2D = ([0, 0, 1, 2, 0, 1], [0, 1, 1, 2, 2, 2])


def read_toro(path: str | Path) -> PoseGraph:
    """Reads the edges of a TORO file; VERTEX and EQUIV lines are not needed.

    Returns:
        The graph, with information matrices. Its frames are the ids of the edges in
        increasing order.

    Raises:
        InputError: for a file that cannot be read or a line that makes no sense, which
            the message names.
    """
    edges: list[tuple[Line, int]] = []
    for number, words in read_lines(path):
        if words[0] in _EDGE:
            edges.append(((number, words[1:]), _EDGE[words[0]]))
        elif words[0] not in _OTHER:
            raise InputError(
                f"{path}, line {number}: {words[0]!r} is no kind of line of TORO."
            )
    dims = {d for _, d in edges}
    if len(dims) != 1:
        what = "EDGE2 and EDGE3 in one file" if dims else "no EDGE2 or EDGE3 line"
        raise InputError(
            f"{path}: {what}; this is no pose graph.\n"
            "Give a TORO file of one dimension; scans go to: jaxreg multiview"
        )
    d = dims.pop()
    k = lie.tangent_dim(d)
    width = 2 + k + k * (k + 1) // 2
    rows = np.stack([numbers(path, line, width, f"EDGE{d}") for line, _ in edges])
    names = np.array([ids(path, line, 2) for line, _ in edges], dtype=np.int64)
    upper = _ORDER_2D if d == 2 else np.triu_indices(k)
    information = np.zeros((len(rows), k, k))
    information[:, upper[0], upper[1]] = rows[:, 2 + k :]
    information[:, upper[1], upper[0]] = rows[:, 2 + k :]
    frames, at = np.unique(names, return_inverse=True)
    try:
        return PoseGraph.from_edges(
            at.reshape(-1, 2),
            _motions(rows[:, 2 : 2 + k]),
            len(frames),
            None,
            information,
        )
    except EdgeError as err:
        raise InputError(f"{path}, line {edges[err.edge][0][0]}: {err}") from err


def _motions(pose: np.ndarray) -> np.ndarray:
    """Of `x y theta` or `x y z roll pitch yaw`."""
    num, k = pose.shape
    d = 2 if k == 3 else 3
    T = np.tile(np.eye(d + 1), (num, 1, 1))
    T[:, :d, d] = pose[:, :d]
    turn = _about(pose[:, -1], 0, 1, d)
    if d == 3:
        turn = turn @ _about(pose[:, 4], 2, 0, 3) @ _about(pose[:, 3], 1, 2, 3)
    T[:, :d, :d] = turn
    return T


def _about(angle: np.ndarray, a: int, b: int, d: int) -> np.ndarray:
    """The rotation by `angle` from axis a to axis b."""
    R = np.tile(np.eye(d), (len(angle), 1, 1))
    R[:, a, a] = R[:, b, b] = np.cos(angle)
    R[:, b, a], R[:, a, b] = np.sin(angle), -np.sin(angle)
    return R
