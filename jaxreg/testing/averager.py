"""The promises of a method of `average`."""

from typing import Literal

import jax
import numpy as np

from jaxreg._core.status import Status
from jaxreg.averaging import AbstractAverager, AveragingSolution, average
from jaxreg.graph import PoseGraph
from jaxreg.testing.methods import (
    UNIT,
    Answer,
    Change,
    Problem,
    promise_method,
    promise_unit,
)
from jaxreg.testing.problems import (
    EDGES,
    NUM_POSES,
    motion,
    poses,
    relative_motions,
    skew,
)
from jaxreg.testing.promises import (
    promise,
    promise_equal,
    promise_known_status,
    promise_rigid,
)


_NOISE = 0.035


def check_averager(
    method: AbstractAverager,
    *,
    d: int = 3,
    gradients: Literal["exact", "refused"] | None = None,
    turns: bool = True,
    lengths: bool = False,
) -> AveragingSolution:
    """Averages all ten motions between five poses, 0.035 rad and 0.02 of noise.

    Promised are: the same answer alone, compiled, and side by side with others; dtypes
    of the motions; poses that are rigid; trust in [0, 1]; the true poses where the
    motions are exact; masked edges count for nothing; NON_FINITE for an edge that is
    not finite, which counts for nothing either; DISCONNECTED for a frame that no edge
    of positive weight joins; that poses follow turns of the frames, and another unit of
    length; gradients as said.

    Args:
        method: with a small budget, as compiling is what this costs; for exact
            gradients converged to about 1e-13.
        d: dimension of space, 2 or 3.
        gradients: "exact" where those of the poses by motions and weights are those of
            central differences, "refused" where asking for them raises a TypeError;
            None promises nothing.
        turns: whether poses follow turns of the frames, though motions are noisy.
        lengths: whether a radian counts as one unit of length; then the unit stays.

    Returns:
        The solution of the first problem.

    Raises:
        AssertionError: naming the promise that is broken.
    """

    def solve(
        T_i_j: jax.Array, weight: jax.Array, mask: jax.Array
    ) -> tuple[jax.Array, AveragingSolution]:
        graph = PoseGraph.from_edges(EDGES, T_i_j, NUM_POSES, weight, mask=mask)
        solution = average(graph, method, key=jax.random.key(0))
        return solution.T_world_i, solution

    name = type(method).__name__
    answers, alone = promise_method(
        *(method, AveragingSolution, solve, _problems(d)),
        gradients=gradients,
        changes=_changes(d, gradients),
    )
    _promise_poses(name, answers, d)
    _promise_statuses(name, answers)
    _promise_equivariance(name, answers, d, turns, lengths)
    return alone


def _problem(d: int, seed: int = 0) -> Problem:
    """Motions, weights and a mask, of which the last edge is masked."""
    weight = np.random.default_rng(seed).uniform(0.5, 1.5, len(EDGES))
    mask = np.arange(len(EDGES)) < len(EDGES) - 1
    return relative_motions(d, _NOISE, seed), weight, mask


def _problems(d: int) -> dict[str, Problem]:
    T, weight, mask = plain = _problem(d)

    def last(value: np.ndarray | float) -> np.ndarray:
        return np.where(mask[:, None, None], T, value)

    apart = np.any(EDGES == NUM_POSES - 1, axis=1)
    turns, unit = _turns(d), T.copy()
    unit[:, :d, d] *= UNIT
    i, j = EDGES.T
    turned = np.linalg.inv(turns[i]) @ T @ turns[j]
    return {
        "plain": plain,
        "other": _problem(d, 1),
        "exact": (relative_motions(d, 0.0), weight, mask),
        "masked": (last(motion(d, 2.0, 3.0)), weight, mask),
        "not finite": (last(np.nan), weight, np.ones_like(mask)),
        "apart": (T, np.where(apart, 0, weight), mask),
        "turned": (turned, weight, mask),
        "unit": (unit, weight, mask),
    }


def _turns(d: int) -> np.ndarray:
    """A rotation of each frame."""
    return np.stack([motion(d, 0.5 + i, 0.0, i) for i in range(NUM_POSES)])


def _changes(d: int, gradients: str | None) -> list[Change]:
    rng = np.random.default_rng(1)
    T, weight, mask = _problem(d)
    change = np.zeros_like(T)
    if gradients == "exact":  # of motions, keeping their lengths; of weights
        turn = skew(rng, len(EDGES), d)
        change[:, :d, :d] = T[:, :d, :d] @ turn
        change[:, :d, d] = np.einsum("eij,ej->ei", turn, T[:, :d, d])
        change *= mask[:, None, None]
        pull = 5 * mask * rng.standard_normal(len(EDGES))
        return [(change, 0 * weight), (0 * T, pull)]
    return []


def _promise_poses(name: str, answers: dict[str, Answer], d: int) -> None:
    for which, answer in answers.items():
        sol, T = answer.solution, answer.solution.T_world_i
        promise_rigid(name, which, T)
        promise_equal(T[0], np.eye(d + 1), f"{name}: frame 0 is not at the identity")
        promise_known_status(name, sol.status)
        trust = sol.edge_weight
        within = np.all((trust >= 0) & (trust <= 1 + 1e-9))
        promise(within, f"{name}: an edge_weight is not in [0, 1].")
        hidden = which == "not finite" or trust[-1] == 0
        promise(hidden, f"{name}: a masked edge has an edge_weight.")
    promise_equal(
        answers["exact"].solution.T_world_i,
        poses(d),
        f"{name}: exact motions do not give the true poses",
        atol=1e-6,
    )


def _promise_statuses(name: str, answers: dict[str, Answer]) -> None:
    plain = answers["plain"].solution
    for which, what in (
        ("masked", "a masked edge changes the answer"),
        ("not finite", "an edge that is not finite changes the poses"),
    ):
        found = answers[which].solution.T_world_i
        promise_equal(found, plain.T_world_i, f"{name}: {what}")
    broken, apart = answers["not finite"].solution, answers["apart"].solution
    promise(
        broken.status == Status.NON_FINITE,
        f"{name}: an edge that is not finite: wanted the status NON_FINITE.",
    )
    promise(
        apart.status == Status.DISCONNECTED and not apart.placed[-1],
        f"{name}: a frame that no edge joins: wanted DISCONNECTED, and not `placed`.",
    )
    promise(
        np.array_equal(apart.T_world_i[-1], np.eye(apart.T_world_i.shape[-1])),
        f"{name}: a frame that no edge joins is not at the identity.",
    )


def _promise_equivariance(
    name: str, answers: dict[str, Answer], d: int, turns: bool, lengths: bool
) -> None:
    T = answers["plain"].solution.T_world_i
    if not lengths:
        promise_unit(name, answers["unit"].solution.T_world_i, T)
    if turns:
        R = _turns(d)
        promise_equal(
            answers["turned"].solution.T_world_i,
            np.linalg.inv(R[0]) @ T @ R,
            f"{name}: the poses do not follow turns of the frames",
            atol=1e-6,
        )
