"""What all checks share: promises in sentences, and comparisons."""

import dataclasses
import pickle
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.status import Status


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


def promise_rigid(
    name: str, problem: str, T: np.ndarray, *, atol: float = 1e-9
) -> None:
    """Requires homogeneous matrices `(..., d+1, d+1)` of rigid motions."""
    d = T.shape[-1] - 1
    R = T[..., :d, :d]
    rigid = np.allclose(R @ R.swapaxes(-1, -2), np.eye(d), atol=atol)
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
