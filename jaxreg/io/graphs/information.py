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

    Negative eigenvalues become zero, or rather a millionth of the largest one (Higham,
    1988: nearest in the Frobenius norm). Matrices without a positive eigenvalue stay
    as they are: no graph takes them.

    Args:
        information: `(e, k, k)` symmetric and finite.
        path: for the warning that counts them.
    """
    largest = np.abs(information).max(axis=(1, 2), initial=0)
    values = np.linalg.eigvalsh(information)
    bad = (values[:, 0] < -_ROUNDING * largest) & (values[:, -1] > 0)
    if not bad.any():
        return information
    values, vectors = np.linalg.eigh(information[bad])
    raised = np.maximum(values, _LEAST * values[:, -1:])
    out = information.copy()
    out[bad] = vectors * raised[:, None, :] @ np.swapaxes(vectors, 1, 2)
    warnings.warn(
        f"{path}: {bad.sum()} of {len(bad)} edges have an indefinite information "
        "matrix; the nearest positive semidefinite one is taken.",
        stacklevel=3,
    )
    return out
