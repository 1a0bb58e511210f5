"""Scans that do not all belong together, or are half noise: the right stays right."""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Options
from bench.motion_scans import SETS, load_scans
from bench.peers.multiview import Multiway
from bench.records import Metric, error
from bench.workloads.multiview import PEER, own_method, peer_method
from jaxreg import reconstruct
from jaxreg.metrics import rotation_errors, translation_errors
from tests.helpers import half_noise


# A scan is right within these of its object's first scan.
_DEGREES, _MM = 5.0, 5.0


class Mixture(NamedTuple):
    """Scans in metres of one object or more.

    `thing` `(v,)` is the number of each scan's object, `T_world_i` `(v, 4, 4)` its pose
    in a frame of that object, `noisy` whether points are noise. Open3D keeps pairs from
    the overlap `least` on.
    """

    name: str
    scans: list[np.ndarray]
    thing: np.ndarray
    T_world_i: np.ndarray
    noisy: bool = False
    least: float = 0.5

    def right(self, component: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, ...]:
        """`(v,)` which scans are where they belong, and their errors in rad and mm.

        A scan alone of its object belongs nowhere. Of the others, the component that
        holds most scans of an object is that object's.
        """
        right = np.zeros(len(self.thing), bool)
        e_R, e_t = (np.full(len(self.thing), np.nan) for _ in range(2))
        for thing in np.unique(self.thing):
            ids = np.flatnonzero(self.thing == thing)
            if len(ids) == 1:
                right[ids] = component[ids] < 0
                continue
            found = component[ids][component[ids] >= 0]
            if not len(found):
                continue
            ids = ids[component[ids] == np.bincount(found).argmax()]
            e_R[ids], e_t[ids] = _errors(T[ids], self.T_world_i[ids])
            right[ids] = (e_R[ids] < np.deg2rad(_DEGREES)) & (e_t[ids] < _MM)
        return right, e_R, e_t


def cases(options: Options) -> Iterator[Case]:
    """A case per way to spoil scans, on real ones where they lie."""
    for mixture in _mixtures(options):
        clean = Multiway(0.0025, 0.001, mixture.least)
        # With the noise a pair takes it the better part of a minute: its user drops it.
        peer = clean._replace(crowd=(4, 0.002)) if mixture.noisy else clean
        yield Case(
            name=mixture.name,
            data=f"{len(mixture.scans)} scans",
            methods=[own_method(_own), peer_method(peer, partial(_theirs, peer))],
            trials=[(mixture.scans, seed) for seed in range(3)],
            long=True,
            judge=partial(judge, mixture),
            reference=PEER,
        )


def _mixtures(options: Options) -> Iterator[Mixture]:
    bunny, dragon = (load_scans(name, options.data) for name in SETS)
    if not all(title.startswith("Stanford") for title, _, _ in (bunny, dragon)):
        return  # stand-ins are one and the same object
    (_, b, T_b), (_, d, T_d) = bunny, dragon
    zeros = np.zeros(len(b), int)
    intruder = np.append(zeros, 1)
    yield Mixture(
        "a Dragon scan among the Bunny's",
        [*b, d[0]],
        intruder,
        np.concatenate([T_b, T_d[:1]]),
    )
    yield Mixture(
        "a Bunny scan twice",
        [*b, b[3].copy()],
        np.append(zeros, 0),
        np.concatenate([T_b, T_b[3:4]]),
    )
    yield Mixture(
        "Bunny and half of the Dragon",
        [*b, *d[:7]],
        np.append(zeros, np.ones(7, int)),
        np.concatenate([T_b, T_d[:7]]),
        # It places what hangs together with scan 0: from 0.5 on the Bunny alone.
        least=0.3,
    )
    half = [half_noise(scan, seed) for seed, scan in enumerate(b)]
    yield Mixture("Bunny, half of the points noise", half, zeros, T_b, noisy=True)
    half = [half_noise(scan, seed) for seed, scan in enumerate(d)]
    zeros = np.zeros(len(d), int)
    yield Mixture("Dragon, half of the points noise", half, zeros, T_d, noisy=True)


def _own(scans: list[np.ndarray], seed: int) -> tuple[np.ndarray, np.ndarray]:
    found = reconstruct(scans, key=jax.random.key(seed))
    return np.asarray(found.component), np.asarray(found.T_world_i)


def _theirs(
    peer: Multiway, scans: list[np.ndarray], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    T = peer.solve(scans, seed)
    return np.where(np.isnan(T[:, 0, 0]), -1, 0), T


def judge(mixture: Mixture, answers: list[Any]) -> Judged:
    """Scans right and wrongly placed, mean errors of the right; worst over the runs."""
    rights, wrongs, turns, shifts = [], [], [], []
    for component, T in answers:
        right, e_R, e_t = mixture.right(component, T)
        use = right & ~np.isnan(e_R)
        rights.append(100 * right.mean())
        wrongs.append(float(np.sum((component >= 0) & ~right)))
        turns.append(e_R[use].mean() if use.any() else np.inf)
        shifts.append(e_t[use].mean() if use.any() else np.inf)
    return Judged(
        [
            Metric("right", float(np.min(rights)), "%", "up", 1.0),
            Metric("wrong", float(np.max(wrongs)), "scans", "down"),
            error("e_R", float(np.median(turns)), "rad", 2e-4),
            error("e_t", float(np.median(shifts)), "mm", 0.02),
        ],
        {"e_R": [float(x) for x in turns]},
    )


def _errors(T: np.ndarray, T_true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radians and millimetres, the first scan being the common frame."""
    found, true = jnp.asarray(T, jnp.float32), jnp.asarray(T_true, jnp.float32)
    shift = np.asarray(translation_errors(found, true))
    return np.asarray(rotation_errors(found, true)), 1e3 * shift
