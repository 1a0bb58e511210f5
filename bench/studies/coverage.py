"""How often the true pose lies in the region of 95 % that `ICP` gives.

    python -m bench.studies.coverage generated --num 96
    python -m bench.studies.coverage real --data ../shared/data

Of generated pairs the even ones were chosen on, and the odd ones check. Of real scans
the true pose is the one that `reconstruct` finds for all scans together, so that the
shares there hold its errors, too. Answers more than 0.3 rad from the truth are another
matter, a descent that failed; they are counted apart.
"""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import jaxreg
from bench.studies.coverage_pairs import KINDS, CoveragePair, generated, real


_FAILED = 0.3
_REAL = ("bunny", "dragon", "newer01", "kitti07_dump", "kitchen")


class Coverage(NamedTuple):
    """Of some pairs.

    Attributes:
        found: share of the answers near the truth.
        inside: share of these whose region of 95 % holds it.
        middle: the middle squared error in deviations, over what it should be.
        size: the middle deviation along an axis, over the root mean square error.
    """

    found: float
    inside: float
    middle: float
    size: float

    def __str__(self) -> str:
        return (
            f"found {self.found:4.0%}, inside {self.inside:5.1%}, middle "
            f"{self.middle:.2f}, deviation over error {self.size:.2f}"
        )


def coverage(pairs: Sequence[CoveragePair]) -> Coverage:
    """By `ICP` from the guesses; pairs of one size are one batch."""
    solve = jax.jit(lambda s, t, g: _told(jaxreg.register(s, t, jaxreg.ICP(), g)))
    squares, errors, sizes = [], [], []
    for pair in pairs:
        guess = jnp.asarray(pair.init, jnp.float32)
        clouds = (jnp.asarray(x, jnp.float32) for x in (pair.source, pair.target))
        T, C = (np.asarray(x, np.float64) for x in solve(*clouds, guess))
        e = _error(pair, T)
        errors.append(e)
        squares.append(e @ np.linalg.solve(C, e))
        sizes.append(np.sqrt(np.diagonal(C)))
    e, q, k = np.array(errors), np.array(squares), len(errors[0])
    ok = np.linalg.norm(e[:, 3 if k == 6 else 2 :], axis=1) < _FAILED
    spread = np.median(np.array(sizes)[ok], axis=0) / np.sqrt(np.mean(e[ok] ** 2, 0))
    return Coverage(
        float(np.mean(ok)),
        float(np.mean(q[ok] < chi2.ppf(0.95, k))),
        float(np.median(q[ok]) / chi2.ppf(0.5, k)),
        float(np.median(spread)),
    )


def _told(sol: jaxreg.RegistrationSolution) -> tuple[jax.Array, jax.Array]:
    return sol.T_target_source, sol.covariance


def _error(pair: CoveragePair, T: np.ndarray) -> np.ndarray:
    """In the tangent of the covariance, at the source's centroid."""
    true, d = pair.T_target_source, len(T) - 1
    turn = np.eye(3)
    turn[:d, :d] = true[:d, :d] @ np.linalg.inv(T[:d, :d])
    w = Rotation.from_matrix(turn).as_rotvec()
    shift = (true - T)[:d, :d] @ pair.source.mean(axis=0) + (true - T)[:d, d]
    return np.append(shift, w if d == 3 else w[2:])


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("generated", "real"))
    parser.add_argument("--num", type=int, default=96, help="pairs of each half")
    parser.add_argument("--only", nargs="+", help="kinds, or sets of scans")
    default = Path(os.environ.get("JAXREG_DATA", "../shared/data"))
    parser.add_argument("--data", type=Path, default=default)
    args = parser.parse_args()
    if args.what == "real":
        for name in args.only or _REAL:
            print(f"{name}: {coverage(list(real(name, args.data)))}", flush=True)
        return
    for name in args.only or KINDS:
        pairs = list(generated(KINDS[name], 2 * args.num, 0))
        for half, title in enumerate(("chosen on", "checked")):
            print(f"{name}, {title}: {coverage(pairs[half::2])}", flush=True)


if __name__ == "__main__":
    main()
