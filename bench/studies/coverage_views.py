"""How often the true poses of many scans lie in the regions of `scan_covariances`.

    python -m bench.studies.coverage_views --views 12 48 --seeds 6

Views of the sculpture; of each seed all poses relative to the first.
"""

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import jaxreg
from jaxreg.datasets import sculpture_scans


_POINTS = 3_000


class Views(NamedTuple):
    """Of the poses of one set of views but the first.

    Attributes:
        error: `(p, 6)` shift of the centroid, then turn, in the axes of the scan.
        covariance: `(p, 6, 6)` of it.
    """

    error: np.ndarray
    covariance: np.ndarray

    @property
    def inside(self) -> np.ndarray:
        """`(p,)` whether each true pose lies in its region of 95 %."""
        half = np.linalg.solve(self.covariance, self.error[..., None])[..., 0]
        return np.sum(self.error * half, axis=-1) < chi2.ppf(0.95, 6)


def views(num: int, seed: int) -> Views:
    """Registered without a guess."""
    scans, T_true = sculpture_scans(num, seed=seed, points_per_scan=_POINTS)
    found = jaxreg.reconstruct(scans, key=jax.random.key(seed))
    C = np.asarray(jaxreg.scan_covariances(scans, found), np.float64)
    T = np.asarray(found.T_world_i, np.float64)
    T, T_true = (np.linalg.inv(x[0]) @ x for x in (T, T_true))
    placed = np.flatnonzero(np.isfinite(C).all(axis=(1, 2)))[1:]
    middle = np.array([scans[k].mean(axis=0) for k in placed])
    return Views(_errors(T[placed], T_true[placed], middle), C[placed])


def _errors(T: np.ndarray, T_true: np.ndarray, middle: np.ndarray) -> np.ndarray:
    off = np.linalg.inv(T) @ T_true
    turn = Rotation.from_matrix(off[:, :3, :3]).as_rotvec()
    moved = np.einsum("pab,pb->pa", off[:, :3, :3], middle) + off[:, :3, 3]
    return np.concatenate([moved - middle, turn], axis=1)


def _told(some: list[Views]) -> Iterator[str]:
    inside = np.concatenate([x.inside for x in some])
    worst = min(float(x.inside.mean()) for x in some)
    yield f"{inside.mean():.1%} of {len(inside)} inside, {worst:.0%} at the worst seed"
    error, C = (np.concatenate(x) for x in zip(*some, strict=True))
    variance = np.diagonal(C, axis1=1, axis2=2)
    size = np.sqrt(variance.mean(axis=0) / np.mean(error**2, axis=0))
    shift, turn = size[:3].mean(), size[3:].mean()
    yield f"deviation over error: shift {shift:.2f}, turn {turn:.2f}"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--views", type=int, nargs="+", default=[12, 48])
    parser.add_argument("--seeds", type=int, default=6)
    args = parser.parse_args()
    for num in args.views:
        some = [views(num, seed) for seed in range(args.seeds)]
        print(f"{num} views: {'; '.join(_told(some))}", flush=True)


if __name__ == "__main__":
    main()
