"""What methods of `register` and of `average` promise alike."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.testing.promises import (
    promise,
    promise_dtypes,
    promise_equal,
    promise_round_trips,
    promise_same,
    promise_traced_numbers,
)


# A power of two: only the unit changes, nothing is rounded.
UNIT = 1024.0
# Half of the difference of two arguments of a central difference.
_STEP = 2e-6

Problem = tuple[np.ndarray, ...]
#: A change of the first two arrays of a problem.
Change = tuple[np.ndarray, np.ndarray]
#: Gives the poses and the whole solution of a problem.
Solve = Callable[..., tuple[jax.Array, Any]]


@dataclass(frozen=True)
class Answer:
    """Of one problem: a weighted sum of the pose, the solution, the slopes of the sum.

    The slopes are by the first two arrays of the problem and, where `solve` takes a
    method, by its numbers; or None.
    """

    value: float
    solution: Any
    slopes: tuple[np.ndarray, np.ndarray] | None
    by_numbers: Any = None


def promise_method(
    method: eqx.Module,
    kind: type,
    solve: Solve,
    problems: Mapping[str, Problem],
    *,
    gradients: str | None,
    changes: Sequence[Change] = (),
    with_numbers: bool = False,
) -> tuple[dict[str, Answer], Any]:
    """Requires of a method what does not depend on what it solves.

    Numbers that are traced; the same answers alone and by one compiled program; dtypes
    of the data; solutions that can be stored; gradients as said.

    Args:
        method: whose name is told.
        kind: class of its solutions.
        solve: the poses and the whole solution of a problem.
        problems: by name, arrays of the same shapes; among them "plain" and "other".
        gradients: by the first two arrays: "refused" where asking for them raises a
            TypeError, None where nothing is promised, else those of central differences
            along `changes`.
        changes: of "plain".
        with_numbers: whether `solve` takes a method after the arrays, by the numbers of
            which it is differentiated, too.

    Returns:
        The answers by the name of their problem, and the solution of "plain" alone.
    """
    promise_traced_numbers(method)
    name, plain = type(method).__name__, problems["plain"]
    with jax.enable_x64(True):
        together = {**problems, **_changed(plain, changes)}
        differentiate = gradients not in (None, "refused")
        numbers = method if with_numbers else None
        answers = _side_by_side(solve, together, differentiate, numbers)
        if gradients == "refused":
            _promise_refusal(name, solve, plain)
        for which in ("other", "plain"):
            alone = solve(*map(jax.device_put, problems[which]))[1]
            promise_dtypes(alone, float, name)
            promise_same(name, kind, answers[which].solution, alone)
        promise_round_trips(method, alone)
        single = [x.astype(np.float32) if x.dtype != bool else x for x in plain]
        # The third trace of `solve`: a tracer that an earlier one left behind raises.
        out = jax.eval_shape(solve, *map(jnp.asarray, single))
        promise_dtypes(out, np.float32, name)
    if changes:
        _promise_slopes(name, answers, changes)
    return answers, alone


def promise_unit(name: str, scaled: np.ndarray, T: np.ndarray) -> None:
    """Requires poses in another unit of length to be `T` in that unit."""
    back = scaled.copy()
    back[..., :-1, -1] /= UNIT
    what = f"{name}: another unit of length changes the answer"
    promise_equal(back, T, what, atol=1e-6)


def _weighed(out: jax.Array) -> jax.Array:
    """A number that every entry of the poses has an influence on."""
    weight = jnp.cos(jnp.arange(out.size, dtype=out.dtype)).reshape(out.shape)
    return jnp.sum(weight * out)


def _side_by_side(
    solve: Solve,
    problems: Mapping[str, Problem],
    differentiate: bool,
    method: eqx.Module | None,
) -> dict[str, Answer]:
    """The answers to all problems by one program, `jit(vmap(solve))`."""
    numbers, rest = eqx.partition(method, eqx.is_inexact_array)

    def answer(changed: tuple, *arrays: jax.Array) -> tuple[jax.Array, Any]:
        first, second, numbers = changed
        given = () if method is None else (eqx.combine(numbers, rest),)
        out, solution = solve(first, second, *arrays, *given)
        return _weighed(out), solution

    one = jax.value_and_grad(answer, has_aux=True) if differentiate else answer
    columns = [
        jax.device_put(np.stack(x)) for x in zip(*problems.values(), strict=True)
    ]
    run = jax.jit(jax.vmap(lambda a, b, *x: one((a, b, numbers), *x)))
    out = jax.device_get(run(*columns))
    (value, solutions), slopes = out if differentiate else (out, None)

    def of_lane(tree: Any, lane: int) -> Any:
        return jax.tree.map(lambda x: x[lane], tree)

    return {
        name: Answer(
            float(value[lane]),
            of_lane(solutions, lane),
            None if slopes is None else of_lane(slopes[:2], lane),
            None if slopes is None else of_lane(slopes[2], lane),
        )
        for lane, name in enumerate(problems)
    }


def _changed(problem: Problem, changes: Sequence[Change]) -> dict[str, Problem]:
    """The problem a little to both sides along each change."""
    first, second, *others = problem
    return {
        f"change {number} {sign:+d}": (
            first + sign * _STEP * a,
            second + sign * _STEP * b,
            *others,
        )
        for number, (a, b) in enumerate(changes)
        for sign in (1, -1)
    }


def _promise_slopes(
    name: str, answers: Mapping[str, Answer], changes: Sequence[Change]
) -> None:
    """Requires the gradient of "plain" to be that of central differences."""
    slopes = answers["plain"].slopes
    assert slopes is not None
    numeric, exact = [], []
    for number, change in enumerate(changes):
        ends = [answers[f"change {number} {sign:+d}"].value for sign in (1, -1)]
        numeric.append((ends[0] - ends[1]) / (2 * _STEP))
        parts = zip(slopes, change, strict=True)
        exact.append(sum(float(np.sum(g * c)) for g, c in parts))
    largest = float(np.max(np.abs(numeric)))
    promise(largest > 1e-2, f"{name}: its answer does not follow the data.")
    promise_equal(
        np.array(exact),
        np.array(numeric),
        f"{name}: gradients {exact} are not the differences {numeric}",
        rtol=1e-5,
        atol=1e-5 * largest,
    )


def _promise_refusal(name: str, solve: Solve, problem: Problem) -> None:
    """Requires a TypeError where a gradient is asked for."""

    def value(first: jax.Array, *others: jax.Array) -> jax.Array:
        return _weighed(solve(first, *others)[0])

    try:
        jax.eval_shape(jax.grad(value), *map(jax.device_put, problem))
    except TypeError:
        return
    raise AssertionError(f"{name}: asked for a gradient it gives one, without a word.")
