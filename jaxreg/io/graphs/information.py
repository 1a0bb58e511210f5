"""Information matrices of public files, of which some are indefinite."""

import warnings
from pathlib import Path

import numpy as np


# Below it an eigenvalue is negative by more than the rounding of printed digits.
_ROUNDING = 1e-5
# Least eigenvalue of what is taken instead: its inverse is finite in float32, too.
_LEAST = 1e-6


def nearest_semidefinite(information: np.ndarray, path: str | Path) -> np.ndarray:
    """The same matrices, indefinite ones replaced by the nearest that are not.

    The blocks of translation and rotation stay where they are definite, so that the
    precisions tau and kappa are those that SE-Sync takes from the file: what couples
    them is made smaller, by the least in the norm of the two blocks. A block that is
    indefinite itself is replaced by the nearest in the Frobenius norm (Higham, 1988).
    Matrices without a positive eigenvalue stay as they are: no graph takes them.

    Args:
        information: `(e, k, k)` symmetric and finite.
        path: for the warning that counts them.
    """
    largest = np.abs(information).max(axis=(1, 2), initial=0)
    values = np.linalg.eigvalsh(information)
    bad = (values[:, 0] < -_ROUNDING * largest) & (values[:, -1] > 0)
    if not bad.any():
        return information
    out = information.copy()
    out[bad] = _mended(information[bad])
    warnings.warn(
        f"{path}: {bad.sum()} of {len(bad)} edges have an indefinite information "
        "matrix; the nearest positive semidefinite one is taken.",
        stacklevel=3,
    )
    return out


def _mended(information: np.ndarray) -> np.ndarray:
    """Definite blocks, and a coupling that leaves the whole definite.

    With both blocks whitened the matrix is [[1, K], [K', 1]]: it is semidefinite where
    no singular value of K is above one, and clipping them is the least change of K.
    """
    d = 2 if information.shape[-1] == 3 else 3
    moves, move_root, move_inverse = _rooted(information[:, :d, :d])
    turns, turn_root, turn_inverse = _rooted(information[:, d:, d:])
    K = move_inverse @ information[:, :d, d:] @ turn_inverse
    U, size, Vt = np.linalg.svd(K, full_matrices=False)
    K = U * np.minimum(size, 1 - _LEAST)[:, None, :] @ Vt
    coupling = move_root @ K @ turn_root
    upper = np.concatenate([moves, coupling], axis=2)
    lower = np.concatenate([np.swapaxes(coupling, 1, 2), turns], axis=2)
    return np.concatenate([upper, lower], axis=1)


def _rooted(block: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest semidefinite blocks, their square roots, and inverses of these."""
    values, vectors = np.linalg.eigh(block)
    indefinite = values[:, 0] <= 0
    least = np.maximum(_LEAST * values[:, -1:], 0)
    values = np.where(indefinite[:, None], np.maximum(values, least), values)
    over = np.where(values > 0, values, np.inf)

    def of(x: np.ndarray) -> np.ndarray:
        return vectors * x[:, None, :] @ np.swapaxes(vectors, 1, 2)

    nearest = np.where(indefinite[:, None, None], of(values), block)
    return nearest, of(np.sqrt(values)), of(1 / np.sqrt(over))
