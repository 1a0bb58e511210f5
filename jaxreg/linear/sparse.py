"""Sparse symmetric matrices of blocks on the host, in float64, by factors.

A factor says for sure whether a matrix is positive definite, which an iteration that
has not found a negative direction does not. SciPy's SuperLU without pivots is L D L'.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sla


#: Rows, columns and values of some blocks.
Blocks = tuple[np.ndarray, np.ndarray, np.ndarray]


class Factor:
    """Of a symmetric positive definite matrix."""

    def __init__(self, lu: Any) -> None:
        self._lu = lu

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """`(n,)` or `(n, c)`."""
        return self._lu.solve(rhs)


def fill_reducing_order(edges: np.ndarray, num: int) -> np.ndarray:
    """Frames in an order in which factors stay sparse (minimum degree).

    Args:
        edges: `(e, 2)` frames whose blocks are not zero.
        num: number of frames.
    """
    return order_and_fill(edges, num)[0]


def order_and_fill(edges: np.ndarray, num: int) -> tuple[np.ndarray, int]:
    """That order, and how many blocks both triangular factors have in it."""
    i, j = edges.T
    apart = i != j
    i, j = i[apart], j[apart]
    ones = np.full(len(i), -1.0)
    links = sp.csc_array((np.r_[ones, ones], (np.r_[i, j], np.r_[j, i])), (num, num))
    dominant = sp.csc_array(sp.diags_array(1 - links.sum(axis=0)) + links)
    lu = _lu(dominant, "MMD_AT_PLUS_A")
    return np.argsort(lu.perm_c), lu.nnz


def from_blocks(parts: Sequence[Blocks], num: int, size: int) -> sp.csc_array:
    """The matrix that sums blocks `(m, size, size)` at frames `(m,)`, `(m,)`."""
    inner = np.arange(size)
    rows, columns, values = [], [], []
    for row, column, block in parts:
        shape = block.shape
        rows.append(np.broadcast_to(_places(row, inner)[:, :, None], shape).ravel())
        columns.append(
            np.broadcast_to(_places(column, inner)[:, None, :], shape).ravel()
        )
        values.append(block.ravel())
    where = np.concatenate(rows), np.concatenate(columns)
    full = sp.csc_array((np.concatenate(values), where), (num * size, num * size))
    full.eliminate_zeros()
    return full


def kept_unknowns(order: np.ndarray, size: int, dropped: np.ndarray) -> np.ndarray:
    """Numbers of the unknowns, `size` a frame, in that order of frames.

    Args:
        order: of frames.
        size: unknowns of each.
        dropped: numbers of unknowns to leave out.
    """
    every = _places(order, np.arange(size)).ravel()
    return every[~np.isin(every, dropped)]


def definite_factor(matrix: sp.csc_array) -> Factor | None:
    """The factor of a symmetric matrix if it is positive definite, else None."""
    try:
        factor = _lu(matrix, "NATURAL")
    except RuntimeError:  # a pivot of zero
        return None
    pivots = factor.U.diagonal()
    in_place = np.array_equal(factor.perm_r, np.arange(len(pivots)))
    return Factor(factor) if in_place and np.all(pivots > 0) else None


def _places(frame: np.ndarray, inner: np.ndarray) -> np.ndarray:
    return frame[:, None] * len(inner) + inner


def _lu(matrix: sp.csc_array, order: str) -> Any:
    return sla.splu(
        sp.csc_matrix(matrix),
        permc_spec=order,
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
