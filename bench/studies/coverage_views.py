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
        covariance: `(p, p, 6, 6)` of these and those of each other pose.
    """

    error: np.ndarray
    covariance: np.ndarray

    @property
    def own(self) -> np.ndarray:
        """`(p, 6, 6)` of each by itself."""
        return np.einsum("ppab->pab", self.covariance)

    @property
    def inside(self) -> np.ndarray:
        """`(p,)` whether each true pose lies in its region of 95 %."""
        half = np.linalg.solve(self.own, self.error[..., None])[..., 0]
        return np.sum(self.error * half, axis=-1) < chi2.ppf(0.95, 6)

    @property
    def jointly(self) -> float:
        """Squared error of all over what it should be; 1 in the mean."""
        whole, error = np.swapaxes(self.covariance, 1, 2), self.error.ravel()
        whole = whole.reshape(len(error), len(error))
        scale = np.sqrt(np.diag(whole))
        half = np.linalg.solve(whole / np.outer(scale, scale), error / scale)
        return float(half @ (error / scale)) / len(error)


def views(num: int, seed: int, noise: float = 2e-4) -> Views:
    """Registered without a guess; noise in metres, of points some 3 mm apart."""
    told = {"seed": seed, "noise": noise, "points_per_scan": _POINTS}
    scans, T_true = sculpture_scans(num, **told)
    found = jaxreg.reconstruct(scans, key=jax.random.key(seed))
    C = np.asarray(jaxreg.joint_scan_covariances(scans, found), np.float64)
    T = np.asarray(found.T_world_i, np.float64)
    T, T_true = (np.linalg.inv(x[0]) @ x for x in (T, T_true))
    placed = np.flatnonzero(np.isfinite(C[0]).all(axis=(1, 2)))[1:]
    middle = np.array([scans[k].mean(axis=0) for k in placed])
    C = C[np.ix_(placed, placed)]
    return Views(_errors(T[placed], T_true[placed], middle), C)


def _errors(T: np.ndarray, T_true: np.ndarray, middle: np.ndarray) -> np.ndarray:
    off = np.linalg.inv(T) @ T_true
    turn = Rotation.from_matrix(off[:, :3, :3]).as_rotvec()
    moved = np.einsum("pab,pb->pa", off[:, :3, :3], middle) + off[:, :3, 3]
    return np.concatenate([moved - middle, turn], axis=1)


def _told(some: list[Views]) -> Iterator[str]:
    inside = np.concatenate([x.inside for x in some])
    worst = min(float(x.inside.mean()) for x in some)
    yield f"{inside.mean():.1%} of {len(inside)} inside, {worst:.0%} at the worst seed"
    error = np.concatenate([x.error for x in some])
    variance = np.concatenate([np.diagonal(x.own, axis1=1, axis2=2) for x in some])
    size = np.sqrt(variance.mean(axis=0) / np.mean(error**2, axis=0))
    shift, turn = size[:3].mean(), size[3:].mean()
    yield f"deviation over error: shift {shift:.2f}, turn {turn:.2f}"
    joint = np.array([x.jointly for x in some])
    most = np.array([chi2.ppf(0.95, x.error.size) / x.error.size for x in some])
    yield (
        f"jointly {np.sum(joint < most)} of {len(some)} inside, squared error "
        f"{joint.mean():.2f} of what it should be"
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--views", type=int, nargs="+", default=[12, 48])
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first", type=int, default=0, help="seed")
    parser.add_argument("--noise", type=float, default=2e-4, help="in metres")
    args = parser.parse_args()
    for num in args.views:
        seeds = range(args.first, args.first + args.seeds)
        some = [views(num, seed, args.noise) for seed in seeds]
        print(f"{num} views: {'; '.join(_told(some))}", flush=True)


if __name__ == "__main__":
    main()
