"""The promises of a method of `register`."""

from collections.abc import Collection
from typing import Literal

import jax
import numpy as np

from jaxreg._core.status import Status
from jaxreg.registrar import AbstractRegistrar, RegistrationSolution
from jaxreg.registration import register
from jaxreg.testing.methods import (
    UNIT,
    Answer,
    Change,
    Problem,
    promise_method,
    promise_unit,
)
from jaxreg.testing.problems import motion, move, pair, skew
from jaxreg.testing.promises import (
    promise,
    promise_equal,
    promise_known_status,
    promise_rigid,
)


_JUNK = 3


def check_registrar(
    method: AbstractRegistrar,
    *,
    d: int = 3,
    gradients: Literal["exact", "refused"] | None = None,
    by: Collection[str] = (),
    draws: bool = False,
    lengths: bool = False,
) -> RegistrationSolution:
    """Registers two noisy samples of a surface from the identity, 0.15 rad away.

    Promised are: the same answer alone, compiled, and side by side with others; dtypes
    of the data; poses that are rigid; masked rows and rows that are not finite count
    for nothing; TOO_FEW_POINTS and the identity for fewer than d + 1 points; that the
    pose follows both clouds when they are moved, and another unit of length; gradients
    as said, finite also of clouds that leave directions free, share nothing or lie in
    one place.

    Args:
        method: with a small budget, as compiling is what this costs; for exact
            gradients converged to about 1e-13.
        d: dimension of the points, 2 or 3.
        gradients: "exact" where those of the pose by both clouds are those of central
            differences, "refused" where asking for them raises a TypeError; None
            promises nothing.
        by: the numbers of the method that the pose depends on, by their paths, as
            "width_end" or "kernel.share": it has a slope by these and no others.
        draws: whether it draws poses, which do not turn with the clouds; then these
            are only shifted.
        lengths: whether settings are lengths in the unit of the input; then the unit
            stays.

    Returns:
        The solution of the first problem.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    key = jax.random.key(0)

    def solve(
        source: jax.Array,
        target: jax.Array,
        init: jax.Array,
        source_mask: jax.Array,
        target_mask: jax.Array,
        method: AbstractRegistrar = method,
    ) -> tuple[jax.Array, RegistrationSolution]:
        solution = register(
            *(source, target, method, init, key),
            source_mask=source_mask,
            target_mask=target_mask,
        )
        return solution.T_target_source, solution

    name = type(method).__name__
    answers, alone = promise_method(
        *(method, RegistrationSolution, solve, _problems(d, draws)),
        gradients=gradients,
        changes=_changes(d) if gradients == "exact" else (),
        with_numbers=True,
    )
    if gradients == "exact":
        _promise_finite_slopes(name, answers)
        _promise_influence(name, answers, frozenset(by))
    _promise_statuses(name, answers, d)
    _promise_equivariance(name, answers, d, draws, lengths)
    return alone


def _problem(d: int, seed: int = 0) -> Problem:
    """Clouds, a guess and masks, with masked rows behind the points."""
    clouds = [np.concatenate([x, np.zeros((_JUNK, d))]) for x in pair(d, seed)]
    mask = np.arange(len(clouds[0])) < len(clouds[0]) - _JUNK
    return *clouds, np.eye(d + 1), mask, mask


def _frames(d: int, draws: bool) -> list[np.ndarray]:
    """How the source and the target are moved."""
    moves = [motion(d, 0.7, 1.0, seed) for seed in (1, 2)]
    for T in moves if draws else []:
        T[:d, :d] = np.eye(d)
    return moves


def _problems(d: int, draws: bool) -> dict[str, Problem]:
    source, target, still, source_mask, target_mask = plain = _problem(d)

    def behind(value: float) -> np.ndarray:
        return np.where(source_mask[:, None], source, value)

    everyone, few = np.ones_like(source_mask), np.arange(len(source)) < d
    frames = _frames(d, draws)
    moved = [
        np.where(source_mask[:, None], move(T, x), 0)
        for T, x in zip(frames, (source, target), strict=True)
    ]
    guess = frames[1] @ np.linalg.inv(frames[0])
    masks = source_mask, target_mask
    return {
        "plain": plain,
        "other": _problem(d, 1),
        "junk": (behind(7.0), target, still, *masks),
        "not finite": (behind(np.nan), target, still, everyone, target_mask),
        "few": (source, target, still, few, target_mask),
        "flat": (_flat(source), _flat(target), still, *masks),
        "round": (_round(source), _round(target), still, *masks),
        "one place": (0 * source + 1, target, still, *masks),
        "apart": (source, target**3 + 9 * source, still, *masks),
        "moved": (*moved, guess, *masks),
        "unit": (UNIT * source, UNIT * target, still, *masks),
    }


def _flat(points: np.ndarray) -> np.ndarray:
    """In a plane; on a line in 2D."""
    return points * (np.arange(points.shape[1]) > 0)


def _round(points: np.ndarray) -> np.ndarray:
    """On a sphere, a circle in 2D; what lies at the origin stays."""
    length = np.linalg.norm(points, axis=1, keepdims=True)
    return points / np.where(length > 0, length, 1)


def _changes(d: int) -> list[Change]:
    """Each source point its own way; the target as a whole, which keeps its spacing."""
    rng = np.random.default_rng(1)
    source, target, _, mask, _ = _problem(d)
    carried = target @ skew(rng, 1, d)[0] + rng.standard_normal(d)
    apart = rng.standard_normal(source.shape)
    rows = mask[:, None]
    return [(rows * apart, 0 * target), (0 * source, rows * carried)]


def _promise_finite_slopes(name: str, answers: dict[str, Answer]) -> None:
    for which, answer in answers.items():
        slopes = jax.tree.leaves((answer.slopes, answer.by_numbers))
        finite = all(np.isfinite(x).all() for x in slopes)
        promise(finite, f"{name}: slopes of the problem '{which}' are not finite.")


def _promise_influence(
    name: str, answers: dict[str, Answer], by: frozenset[str]
) -> None:
    found = jax.tree_util.tree_leaves_with_path(answers["plain"].by_numbers)
    moving = {jax.tree_util.keystr(path)[1:] for path, x in found if np.any(x)}
    promise(
        moving == by,
        f"{name}: its pose has slopes by {sorted(moving)}, promised {sorted(by)}.",
    )


def _promise_statuses(name: str, answers: dict[str, Answer], d: int) -> None:
    for which, answer in answers.items():
        sol = answer.solution
        promise_rigid(name, which, sol.T_target_source)
        promise_known_status(name, sol.status)
        for share in (sol.fitness, sol.overlap):
            promise(0 <= share <= 1 + 1e-9, f"{name}: a share of {share}.")
    few = answers["few"].solution
    promise(
        few.status == Status.TOO_FEW_POINTS
        and np.array_equal(few.T_target_source, np.eye(d + 1)),
        f"{name}: {d} points of dimension {d}: wanted TOO_FEW_POINTS and the identity.",
    )
    for which, what in (
        ("junk", "masked rows change the answer"),
        ("not finite", "rows that are not finite change the answer"),
    ):
        found, wanted = answers[which].solution, answers["plain"].solution
        promise_equal(found.T_target_source, wanted.T_target_source, f"{name}: {what}")
        promise(found.status == wanted.status, f"{name}: {what}: its status.")


def _promise_equivariance(
    name: str, answers: dict[str, Answer], d: int, draws: bool, lengths: bool
) -> None:
    T = answers["plain"].solution.T_target_source
    A, B = _frames(d, draws)
    promise_equal(
        answers["moved"].solution.T_target_source,
        B @ T @ np.linalg.inv(A),
        f"{name}: the pose does not follow the clouds",
        atol=1e-6,
    )
    if not lengths:
        promise_unit(name, answers["unit"].solution.T_target_source, T)
