"""Relative motions of fragments in Redwood and 3DMatch text files (`.log`, `.info`).

A block of a `.log` is a line `i j n` (n fragments) and a 4 x 4 matrix, which maps
points of fragment j into the frame of fragment i: `T_i_j`. A block of an `.info` holds
a 6 x 6 information matrix of the same pair instead.
"""

from pathlib import Path

import numpy as np

from jaxreg._core.checks import check_rigid
from jaxreg.graph.edge_checks import EdgeError
from jaxreg.graph.pose_graph import PoseGraph, check_graph
from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import InputError
from jaxreg.io.rows import ids, numbers, read_lines


def read_log(path: str | Path) -> PoseGraph:
    """Reads the motions of a `.log` file; frames keep their numbers 0 to n - 1.

    Raises:
        InputError: for a file that cannot be read, a block that makes no sense or is
            cut off, which the message names by its line.
    """
    lines, pairs, T_i_j, num = _blocks(path, 4)
    try:
        return PoseGraph.from_edges(pairs, T_i_j, num)
    except EdgeError as err:
        raise InputError(f"{path}, line {lines[err.edge]}: {err}") from err


def read_info(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads an `.info` file.

    Returns:
        `(e, 2)` pairs i, j and `(e, 6, 6)` information matrices in float64, translation
        first, then the vector part of the quaternion (half the angle), as in the file.

    Raises:
        InputError: as `read_log`.
    """
    _, pairs, information, _ = _blocks(path, 6)
    return pairs, information


def write_log(path: str | Path, graph: PoseGraph) -> None:
    """Writes the motions of a 3D graph; the file appears whole or not at all.

    Masked edges are left out, as are weights and information.

    Raises:
        ValueError: for a 2D graph.
        InputError: if the folder cannot be written.
    """
    check_graph(graph, "graph")
    if graph.dim != 3:
        raise ValueError(f"graph: wanted 3D, found {graph.dim}D.")
    keep = np.asarray(graph.mask)
    edges = np.asarray(graph.edges)[keep]
    T_i_j = np.asarray(graph.T_i_j, dtype=np.float64)[keep]
    check_rigid(T_i_j, "graph: T_i_j")
    with atomic_write(path) as file:
        for (i, j), T in zip(edges.tolist(), T_i_j, strict=True):
            file.write(f"{i}\t{j}\t{graph.num_poses}\n")
            file.writelines(" ".join(f"{x:.17g}" for x in row) + "\n" for row in T)


def _blocks(
    path: str | Path, size: int
) -> tuple[list[int], np.ndarray, np.ndarray, int]:
    """First lines, pairs, matrices and number of fragments."""
    lines = read_lines(path)
    if not lines:
        raise InputError(f"{path}: holds no pairs.")
    starts, heads, matrices = [], [], []
    for at in range(0, len(lines), size + 1):
        first, block = lines[at], lines[at + 1 : at + 1 + size]
        if len(first[1]) != 3:
            raise InputError(
                f"{path}, line {first[0]}: a pair wants 3 numbers `i j n`, found "
                f"{len(first[1])}."
            )
        i, j, num = ids(path, first, 3)
        if num != (heads[0][2] if heads else num) or max(i, j) >= num:
            raise InputError(
                f"{path}, line {first[0]}: wanted i and j below n, and the same n "
                f"throughout, found {i} {j} {num}."
            )
        if len(block) < size:
            raise InputError(
                f"{path}, line {first[0]}: the file ends within this matrix."
            )
        starts.append(first[0])
        heads.append((i, j, num))
        matrices.append([numbers(path, row, size, "a row") for row in block])
    table = np.array(heads)
    return starts, table[:, :2], np.array(matrices), int(table[0, 2])
