"""Ways to spoil an argument, each from a generator of random numbers."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxreg as jr
from jaxreg import robust


#: A bad value, and in words how it came about.
Spoiled = tuple[str, Any]


class Unrelated:
    """An object of the caller's own."""


# What nobody asks for, whatever is wanted.
_ODD: list[Any] = [
    *("word", "", b"bytes", 1j, float("nan"), -1, {}, {"a": 1}, object(), Unrelated),
    *(Unrelated(), robust.Huber, robust.Huber(), jr.ICP, jr.ICP(), jr.SpanningTree()),
    *(
        jr.Correntropy,
        range(3),
        iter([1]),
        slice(3),
        len,
        [],
        (),
        [None],
        [[1], [2, 3]],
    ),
    *(np.array("word"), np.array([None, 1], object), np.datetime64("2020-01-01")),
    *(jax.random.key(1), np.zeros((0, 3)), np.zeros((2, 0)), jr.Status.CONVERGED),
]
_COUNTS: list[Any] = [
    *(0, -1, -(2**31), 2**31, 2**40, 10**30, True, 2.5, 3.0, "3", None),
    *(float("nan"), float("inf"), np.array([1, 2]), 1j, np.float32(2), [4]),
]
_NUMBERS: list[Any] = [
    *(float("nan"), float("inf"), -float("inf"), -1.0, 0.0, 1e300, 1e-300, -1e-30),
    *("1.0", None, True, 1j, [1.0, 2.0], [1.0], (), np.array([1.0, 2.0]), 10**400),
    *(np.array(np.nan, np.float32), jnp.array([1.0, 2.0]), np.array([None]), 10**30),
]
_FLAGS: list[Any] = [
    None,
    "no",
    2,
    0.5,
    float("nan"),
    [],
    [True],
    np.array([True, False]),
]
_WORDS: list[Any] = ["", "word", "ANY", None, 3, ["any"], b"any"]
_KEYS: list[Any] = [
    *(0, 1, None, -1, 2.5, "0", np.zeros(2, np.float32), np.zeros(2, np.uint32)),
    *(np.int64(3), jnp.zeros(3, jnp.uint32), jnp.zeros((2, 2), jnp.uint32), [0, 1]),
    *(jax.random.split(jax.random.key(0), 2), jax.random.key),
]


def _array(rng: np.random.Generator, good: np.ndarray) -> Spoiled:
    """An array of another shape or dtype, or of other numbers."""
    ways: list[Callable[[], Any]] = [
        *(lambda: good[..., :-1], lambda: good[..., :1], lambda: good[:-1]),
        *(
            lambda: good[:0],
            lambda: good[:1],
            lambda: good[None],
            lambda: good[..., None],
        ),
        *(lambda: good.T, lambda: good.ravel(), lambda: good[0], lambda: good.flat[0]),
        *(lambda: np.concatenate([good, good[..., :1]], -1), lambda: good[..., :0]),
        *(lambda: np.concatenate([good, good[:1]]), lambda: np.stack([good] * 2)),
        *(lambda: good.astype(object), lambda: good.astype(bool), lambda: good + 1j),
        *(lambda: good.astype(str), lambda: good.astype(np.float16)),
        *(lambda: good.astype(np.int64), lambda: good.astype(np.uint8)),
        *(lambda: good.astype(np.float64), lambda: good.astype(np.longdouble)),
        *(lambda: good.tolist(), lambda: [*good.tolist(), []], lambda: good.tobytes()),
        *(lambda: np.ma.masked_array(good, good == good), lambda: jnp.asarray(good)),
        *(lambda: [None] * len(good), lambda: {0: good}, lambda: (x for x in good)),
        *(
            lambda: np.asfortranarray(good)[::-1],
            lambda: np.broadcast_to(1, good.shape),
        ),
    ]
    if good.dtype.kind == "f":
        factor = rng.choice([0, -1, 1e-45, 1e-30, 1e18, 1e30, 1e38, 1e300, 1e4])
        value = rng.choice([np.nan, np.inf, -np.inf, 1e38, 1e300])
        share = rng.random() ** 2
        numbers: list[Callable[[], Any]] = [
            lambda: good.astype(np.float64) * factor,
            lambda: (good.astype(np.float64) * factor).astype(np.float32),
            lambda: np.where(rng.random(good.shape) < share, value, good),
            lambda: np.where(rng.random(len(good)) < 0.5, value, good.T).T,
            lambda: np.full_like(good, value),
            lambda: good + np.asarray(factor, good.dtype),
            lambda: np.broadcast_to(good[:1], good.shape),
            lambda: good * (np.arange(good.shape[-1]) < 1),
        ]
        ways += 3 * numbers
    if good.dtype.kind in "iu":
        ways += [lambda: good - 1, lambda: good + 2**40, lambda: good * 0]
    if good.dtype.kind == "b":
        ways += [lambda: ~good, lambda: np.arange(good.size).reshape(good.shape) < 2]
    k = rng.integers(len(ways))
    with np.errstate(all="ignore"):
        try:
            return f"way {k} to spoil an array", ways[k]()
        except (TypeError, ValueError):
            return "no array", None


def _list(rng: np.random.Generator, good: list) -> Spoiled:
    k = rng.integers(len(good))
    how, item = spoiled(rng, "", good[k])
    new = list(good)
    new[k] = item
    ways = [new, new, new, good[:-1], [], tuple(good), [*good, good[0]], {0: good}]
    return f"{how} in a list", ways[rng.integers(len(ways))]


def _choice(rng: np.random.Generator, values: list[Any]) -> Spoiled:
    value = values[rng.integers(len(values))]
    return repr(value)[:60], value


def _graph(rng: np.random.Generator, good: jr.PoseGraph) -> Spoiled:
    """One that was not made by `from_edges`: with numbers that are not finite."""
    value = rng.choice([np.nan, np.inf, 0, 1e30, 1e38, -1])
    ways: list[Callable[[], Any]] = [
        lambda: eqx.tree_at(lambda g: g.T_i_j, good, good.T_i_j.at[0].set(value)),
        lambda: eqx.tree_at(lambda g: g.weight, good, good.weight.at[0].set(value)),
        lambda: eqx.tree_at(lambda g: g.weight, good, good.weight * value),
        lambda: eqx.tree_at(lambda g: g.mask, good, good.mask & False),
        lambda: jax.tree.map(lambda x: jnp.stack([x, x]), good),
        lambda: jax.tree.map(np.asarray, good),
        lambda: [good],
        lambda: [],
        lambda: (good.edges, good.T_i_j),
        lambda: jr.PoseGraph,
    ]
    k = rng.integers(len(ways))
    return f"way {k} to spoil a graph with {value}", ways[k]()


def spoiled(rng: np.random.Generator, name: str, good: Any) -> Spoiled:
    """A bad value in place of a good one."""
    if name in ("progress", "on_pairs"):  # what is called may raise what it likes
        return _choice(rng, [x for x in _ODD if not callable(x)])
    if name == "key":
        return _choice(rng, _KEYS)
    if rng.random() < 0.25:
        return _choice(rng, _ODD)
    if isinstance(good, bool):
        return _choice(rng, _FLAGS)
    if isinstance(good, int):
        return _choice(rng, _COUNTS)
    if isinstance(good, float) or (isinstance(good, jax.Array) and good.ndim == 0):
        return _choice(rng, _NUMBERS)
    if isinstance(good, np.ndarray):
        return _array(rng, good)
    if isinstance(good, list | tuple) and len(good):
        return _list(rng, list(good))
    if isinstance(good, jr.PoseGraph):
        return _graph(rng, good)
    if isinstance(good, str):
        return _choice(rng, _WORDS)
    return _choice(rng, _ODD)
