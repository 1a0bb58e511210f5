"""How far the poses that trials end in are from the truth."""

from typing import NamedTuple

import numpy as np

from bench.workloads.filter_data import Trials


class Outcome(NamedTuple):
    """What a method did on the trials.

    `T_target_source` is `(b, d+1, d+1)`, `degrees` and `shift` `(b,)` the errors,
    `success` and `aligned` `(b,)` whether they are within the tolerance, the latter up
    to the symmetries of the shape.
    """

    T_target_source: np.ndarray
    degrees: np.ndarray
    shift: np.ndarray
    success: np.ndarray
    aligned: np.ndarray


def outcome(T: np.ndarray, trials: Trials) -> Outcome:
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
    aligned = np.any(within, axis=0, keepdims=True)[0]
    return Outcome(T, degrees[0], shift[0], within[0], aligned)


def shift_of_model(found: Outcome, trials: Trials) -> np.ndarray:
    """By how much the model's middle is put wrong in the source's frame, `(b,)`."""
    gap = np.linalg.inv(found.T_target_source) - np.linalg.inv(trials.T_target_source)
    return np.linalg.norm(gap[:, :3, 3], axis=1)


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
