"""What all checks share: sentences, comparisons, problems side by side, slopes."""

import dataclasses
import pickle
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.status import Status


#: Half of the difference of two arguments of a central difference.
STEP = 2e-6

Problem = tuple[np.ndarray, ...]
#: A change of the first two arrays of a problem.
Change = tuple[np.ndarray, np.ndarray]


def promise(kept: Any, sentence: str) -> None:
    """Raises an AssertionError with the sentence unless the promise is kept."""
    if not bool(np.all(kept)):
        raise AssertionError(sentence)


def promise_equal(
    found: Any, wanted: Any, sentence: str, *, rtol: float = 1e-6, atol: float = 1e-8
) -> None:
    """Requires floating leaves to be close, and the others equal."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    for mine, other in pairs:
        a, b = np.asarray(mine), np.asarray(other)
        promise(a.shape == b.shape, f"{sentence}: shapes {a.shape} and {b.shape}.")
        if a.dtype.kind == "f":
            a, b = np.where(a == b, 0, a), np.where(a == b, 0, b)  # also infinities
            close = np.allclose(a, b, rtol=rtol, atol=atol, equal_nan=True)
            gap = np.max(np.abs(a - b), initial=0)
            promise(close, f"{sentence} (they differ by {gap:.3g}).")
        else:
            promise(np.array_equal(a, b), f"{sentence}.")


def promise_dtypes(tree: Any, dtype: Any, name: str) -> None:
    """Requires floats of that dtype, and integers of 32 bits."""
    for leaf in jax.tree.leaves(tree):
        if leaf.dtype.kind in "fiu":
            wanted = np.dtype(dtype) if leaf.dtype.kind == "f" else np.dtype(np.int32)
            promise(
                leaf.dtype == wanted,
                f"{name}: data of {np.dtype(dtype).name} give {leaf.dtype.name} "
                f"of shape {leaf.shape}; wanted {wanted.name}.",
            )


def promise_rigid(name: str, problem: str, T: np.ndarray) -> None:
    """Requires homogeneous matrices `(..., d+1, d+1)` of rigid motions."""
    d = T.shape[-1] - 1
    R = T[..., :d, :d]
    rigid = np.allclose(R @ R.swapaxes(-1, -2), np.eye(d), atol=1e-9)
    rigid = rigid and np.all(np.linalg.det(R) > 0)
    rigid = rigid and np.all(T[..., d, :] == np.eye(d + 1)[d])
    promise(rigid, f"{name}: a pose of the problem '{problem}' is not rigid.")


def promise_known_status(name: str, status: Any) -> None:
    """Requires a value of `Status`."""
    known = {int(one) for one in Status}
    promise(int(status) in known, f"{name}: {int(status)} is no Status.")


def promise_same(name: str, kind: type, found: Any, alone: Any) -> None:
    """Requires two solutions of a kind to agree.

    But for the number of steps, and of rows of the trace: a matter of rounding.
    """
    promise(
        isinstance(alone, kind),
        f"{name}: wanted a solution of type {kind.__name__}, found "
        f"{type(alone).__name__}.",
    )

    def compared(one: Any) -> dict[str, Any]:
        fields = {k: v for k, v in vars(one).items() if k != "num_steps"}
        first = jax.tree.map(lambda x: x[:1] if np.ndim(x) else 0 * x, fields["trace"])
        return {**fields, "trace": first}

    what = f"{name}: alone and side by side do not give the same"
    promise_equal(compared(found), compared(alone), what)


def promise_round_trips(method: eqx.Module, solution: Any) -> None:
    """Requires both to survive pickling, and the solution to be a pytree of arrays."""
    name = type(method).__name__
    again = pickle.loads(pickle.dumps(method))
    promise(eqx.tree_equal(again, method), f"{name}: pickling changes it.")
    leaves, structure = jax.tree.flatten(solution)
    promise(
        all(isinstance(x, jax.Array) for x in leaves),
        f"{name}: its solution holds more than arrays.",
    )
    same = eqx.tree_equal(jax.tree.unflatten(structure, leaves), solution)
    promise(same, f"{name}: flattening changes its solution.")
    back = pickle.loads(pickle.dumps(jax.device_get(solution)))
    same = eqx.tree_equal(jax.tree.map(jnp.asarray, back), solution)
    promise(same, f"{name}: pickling changes its solution.")
    promise(repr(solution), f"{name}: its solution prints as nothing.")


def promise_traced_numbers(part: eqx.Module) -> None:
    """Requires numbers but counts to be arrays: changing one compiles nothing."""
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if isinstance(value, eqx.Module):
            promise_traced_numbers(value)
        promise(
            not isinstance(value, float),
            f"{type(part).__name__}.{field.name} is a Python float, so that another "
            "value compiles again; make it an array with a converter.",
        )


@dataclasses.dataclass(frozen=True)
class Answer:
    """Of one problem: a weighted sum of the pose, the solution, the slopes of the sum.

    The slopes are by the first two arrays of the problem, or None.
    """

    value: float
    solution: Any
    slopes: tuple[np.ndarray, np.ndarray] | None


def run_side_by_side(
    solve: Callable[..., tuple[jax.Array, Any]],
    problems: Mapping[str, Problem],
    differentiate: bool,
) -> dict[str, Answer]:
    """The answers to all problems by one program, `jit(vmap(solve))`.

    Args:
        solve: gives the poses and the whole solution.
        problems: by name, arrays of the same shapes.
        differentiate: by the first two arrays.
    """

    def answer(*arrays: jax.Array) -> tuple[jax.Array, Any]:
        out, solution = solve(*arrays)
        weight = jnp.cos(jnp.arange(out.size, dtype=out.dtype)).reshape(out.shape)
        return jnp.sum(weight * out), solution

    one = jax.value_and_grad(answer, (0, 1), has_aux=True) if differentiate else answer
    columns = [
        jax.device_put(np.stack(x)) for x in zip(*problems.values(), strict=True)
    ]
    out = jax.device_get(jax.jit(jax.vmap(one))(*columns))
    (value, solutions), slopes = out if differentiate else (out, None)
    return {
        name: Answer(
            float(value[lane]),
            jax.tree.map(lambda x, lane=lane: x[lane], solutions),
            None if slopes is None else tuple(x[lane] for x in slopes),
        )
        for lane, name in enumerate(problems)
    }


def changed(problem: Problem, changes: Sequence[Change]) -> dict[str, Problem]:
    """The problem a little to both sides along each change."""
    first, second, *others = problem
    return {
        f"change {number} {sign:+d}": (
            first + sign * STEP * a,
            second + sign * STEP * b,
            *others,
        )
        for number, (a, b) in enumerate(changes)
        for sign in (1, -1)
    }


def promise_slopes(
    name: str, answers: Mapping[str, Answer], changes: Sequence[Change]
) -> None:
    """Requires the gradient of "plain" to be that of central differences."""
    slopes = answers["plain"].slopes
    assert slopes is not None
    numeric, exact = [], []
    for number, change in enumerate(changes):
        ends = [answers[f"change {number} {sign:+d}"].value for sign in (1, -1)]
        numeric.append((ends[0] - ends[1]) / (2 * STEP))
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


def promise_no_slopes(name: str, answers: Mapping[str, Answer]) -> None:
    """Requires a gradient of zero."""
    slopes = answers["plain"].slopes
    assert slopes is not None
    zero = not any(np.any(x) for x in slopes)
    promise(zero, f"{name}: its gradient is not zero, though it was said to be.")
