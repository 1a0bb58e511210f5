"""Methods run on trials: success rates, errors, and what they cost."""

from typing import NamedTuple

import jax
import numpy as np

from bench.particle_data import Trials
from bench.timing import timed
from jaxreg import KernelCorrelation, register
from jaxreg.local import ICP, AbstractRegistrar
from jaxreg.particle import MultiStart, ParticleFilter


class Method(NamedTuple):
    """A way to register the trials.

    `from_identity` hands over the identity as the guess, around which the paper's
    particles are drawn; else there is none and the clouds are centred.
    """

    name: str
    registrar: AbstractRegistrar
    from_identity: bool = True


class Outcome(NamedTuple):
    """What a method did on the trials.

    `T_target_source` is `(b, d+1, d+1)`, `degrees` and `shift` `(b,)` the errors,
    `success` and `aligned` `(b,)` whether they are within the tolerance, the latter up
    to the symmetries of the shape; `cpu_ms` a trial.
    """

    T_target_source: np.ndarray
    degrees: np.ndarray
    shift: np.ndarray
    success: np.ndarray
    aligned: np.ndarray
    status: np.ndarray
    cpu_ms: float


def run(method: Method, trials: Trials, seed: int = 0) -> Outcome:
    """Trials in calls of up to ten, compiled before the time is taken."""
    b, d = len(trials.source), trials.source.shape[2]
    some = max(k for k in range(1, 11) if b % k == 0)
    target = np.broadcast_to(trials.target, (some, *trials.target.shape))
    init = np.eye(d + 1, dtype=np.float32) if method.from_identity else None

    def call(first: int) -> tuple[np.ndarray, np.ndarray]:
        key = jax.random.fold_in(jax.random.key(seed), first)
        source = trials.source[first : first + some]
        found = register(source, target, method.registrar, init, key)
        return np.asarray(found.T_target_source, float), np.asarray(found.status)

    call(0)
    took = timed(lambda: [call(first) for first in range(0, b, some)])
    T, status = (np.concatenate(x) for x in zip(*took.value, strict=True))
    return outcome(T, status, trials, 1000 * took.cpu / b)


def outcome(
    T: np.ndarray, status: np.ndarray, trials: Trials, cpu_ms: float = 0.0
) -> Outcome:
    """The errors of `(b, d+1, d+1)` poses."""
    turns = trials.shape_turns
    d = turns.shape[-1]
    # The truth first, then the poses that look the same: (s, b, d+1, d+1).
    same = np.zeros((len(turns), d + 1, d + 1))
    same[:, :d, :d], same[:, d, d] = turns, 1
    same = sorted(same, key=lambda S: -np.trace(S))
    truths = np.einsum("sij,bjk->sbik", np.array(same), trials.T_target_source)
    degrees, shift = _errors(T, truths, trials.source)
    within = (degrees <= trials.degrees) & (shift <= trials.shift)
    return Outcome(
        T,
        degrees[0],
        shift[0],
        within[0],
        np.any(within, axis=0, keepdims=True)[0],
        status,
        cpu_ms,
    )


def _errors(
    T: np.ndarray, truth: np.ndarray, source: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Angle in degrees and shift of the source's centroid."""
    d = T.shape[-1] - 1
    centre = source.mean(axis=1)
    gap = np.einsum("...ij,...j->...i", (T - truth)[..., :d, :d], centre)
    gap = gap + (T - truth)[..., :d, d]
    turn = np.einsum("...ji,...jk->...ik", truth[..., :d, :d], T[..., :d, :d])
    # From the chord: exact for small angles too.
    chord = np.linalg.norm(turn - np.eye(d), axis=(-2, -1)) / np.sqrt(8)
    angle = 2 * np.arcsin(np.minimum(chord, 1))
    return np.rad2deg(angle), np.linalg.norm(gap, axis=-1)


def look_ups(registrar: AbstractRegistrar, trials: Trials) -> int:
    """Closest points (pairs, for kernel correlation) of a search on one trial at most.

    Without those of the refinement and of the scores.
    """
    n, m = trials.source.shape[1], len(trials.target)
    if isinstance(registrar, KernelCorrelation):
        return registrar.max_steps * n * m
    if isinstance(registrar, ICP):
        return registrar.max_steps * n
    if isinstance(registrar, MultiStart):
        each = registrar.num_starts * (registrar.num_steps + 1)
    else:
        assert isinstance(registrar, ParticleFilter)
        each = registrar.most_look_ups
    return each * min(n, registrar.num_points)
