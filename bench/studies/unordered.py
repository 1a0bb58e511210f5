"""Many scans in no order: are those that look alike near, and what do they join?

    python -m bench.studies.unordered --streets 30

Of simulated streets 30 scans each, shuffled and turned at random. First which of the
scans most alike to each lie near it; then which scans come together where what the
search says of a pair is drawn from the truth, with what is known of likeness and
without.
"""

import argparse
import dataclasses
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from bench.studies.streets import street_drive
from bench.workloads.many_scans import Replayed, in_radii
from jaxreg import ReconstructionSolution, ScanSet, reconstruct
from jaxreg.multiview.similar_scans import most_alike


# Scans of a street, the frames that they are one of two of, and how far apart streets
# are told to be.
_SCANS, _EVERY, _APART = 30, 2, 1000.0
# Scans so far apart share nothing that the search finds, in metres.
_NEAR = 12.0
# The most alike that are looked at.
_RANKS = (1, 2, 5, 24)


class Streets(NamedTuple):
    """Shuffled scans.

    Attributes:
        scans: `(n, 3)` float32 each.
        T_world_i: `(v, 4, 4)`, of a world in which streets are far apart.
        street: `(v,)` the street of each.
    """

    scans: list[np.ndarray]
    T_world_i: np.ndarray
    street: np.ndarray

    @classmethod
    def drawn(cls, num: int, seed: int) -> "Streets":
        """So many streets."""
        scans, poses = [], []
        for street in range(num):
            seen, T = street_drive(2000 + 100 * seed + street, _EVERY * _SCANS)
            T[:, 0, 3] += _APART * street
            scans += seen[::_EVERY]
            poses += list(T[::_EVERY])
        rng = np.random.default_rng(seed)
        order, T = rng.permutation(len(scans)), np.stack(poses)
        turn = np.tile(np.eye(4), (len(scans), 1, 1))
        turn[:, :3, :3] = Rotation.random(len(scans), rng=rng).as_matrix()
        turned = [
            (x @ R.T).astype(np.float32)
            for x, R in zip(scans, turn[:, :3, :3], strict=True)
        ]
        T = T @ np.linalg.inv(turn)
        return cls([turned[i] for i in order], T[order], order // _SCANS)

    @property
    def place(self) -> np.ndarray:
        """`(v, 2)` where the scanner stood."""
        return self.T_world_i[:, :2, 3]

    @property
    def near(self) -> np.ndarray:
        """`(v, v)` which two others share something."""
        apart = np.linalg.norm(self.place[:, None] - self.place, axis=-1)
        return (apart < _NEAR) & ~np.eye(len(apart), dtype=bool)


def joined(streets: Streets, ready: ScanSet) -> ReconstructionSolution:
    """What comes together where the search finds what is near, and that alone."""
    mean, radius = np.asarray(ready.scans.mean), float(ready.scans.radius)
    T = in_radii(streets.T_world_i, mean[: len(ready)], radius)
    # At `_NEAR` the search finds a pair in the replay: three tenths.
    told = T, streets.place, lambda apart: np.clip(1 - 0.7 * apart / _NEAR, 0, 1)
    with Replayed(*told) as executor:
        return reconstruct(ready, key=jax.random.key(0), executor=executor)


def _parts(streets: Streets, found: ReconstructionSolution) -> str:
    part = np.asarray(found.component)
    size = np.bincount(part[part >= 0], minlength=1)
    pure = all(len(np.unique(streets.street[part == k])) == 1 for k in range(len(size)))
    return (
        f"{np.mean(part >= 0):.1%} of the scans in {len(size)} parts of {size.min()} "
        f"to {size.max()}{'' if pure else ', some of several streets'}; "
        f"{len(found.overlap) / len(part):.1f} pairs a scan"
    )


def main() -> None:
    """Prints both."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--streets", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    streets = Streets.drawn(args.streets, args.seed)
    ready, near = ScanSet.of(streets.scans), streets.near
    assert ready.words is not None
    best = most_alike(ready.words.used, max(_RANKS))
    hit = np.take_along_axis(near, best, axis=1)
    print(f"{len(ready)} scans, each near {near.sum(axis=1).mean():.1f} others")
    for rank in _RANKS:
        print(f"of the {rank} most alike near: {hit[:, :rank].mean():.1%}")
    print("by likeness:", _parts(streets, joined(streets, ready)))
    blind = dataclasses.replace(ready, words=None)
    print("without:", _parts(streets, joined(streets, blind)))


if __name__ == "__main__":
    main()
