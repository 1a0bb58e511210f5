"""Inverses by chains against dense ones."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.linear import chains as rooms
from jaxreg.linear.chains import Chained, chains, near_inverse
from jaxreg.linear.multigrid import Multigrid
from jaxreg.linear.operator import GraphLaplacian


NUM, ROOM = 90, 14
CLOSURES = [[3, 20], [40, 11], [50, 20], [50, 70]]
exact = eqx.filter_jit(lambda matrix, r: chains(matrix, ROOM)(r))
fitting = eqx.filter_jit(lambda matrix: chains(matrix, ROOM).order.fits)


def laplacian(d: int, anchored: bool = True, edges=None) -> GraphLaplacian:
    """A path with closures, some edges turned around; steps far from alike."""
    rng = np.random.default_rng(d)
    if edges is None:
        steps = np.stack([np.arange(NUM - 1), np.arange(1, NUM)], axis=1)
        edges = np.concatenate([steps, CLOSURES])
        edges[::3] = edges[::3, ::-1]
    k = d * (d + 1) // 2
    A = rng.normal(size=(len(edges), k, k))
    W = A @ np.swapaxes(A, 1, 2) + 0.5 * np.eye(k)
    origin = jnp.asarray(3 * rng.normal(size=(NUM, d))) if anchored else None
    args = jnp.asarray(edges), jnp.asarray(W), NUM, 0.0, origin
    return GraphLaplacian.anchored(*args)


def expected(matrix: GraphLaplacian, r: np.ndarray) -> np.ndarray:
    inverse = np.linalg.pinv(np.asarray(matrix.dense()), rcond=1e-13)
    return (inverse @ r.reshape(len(inverse), -1)).reshape(r.shape)


@pytest.mark.parametrize(("d", "anchored"), [(2, True), (3, True), (3, False)])
def test_chains_are_solved_exactly(d: int, anchored: bool):
    with jax.enable_x64(True):
        matrix = laplacian(d, anchored)
        r = np.random.default_rng(0).normal(size=(NUM, d * (d + 1) // 2, 2))
        assert fitting(matrix)
        x, wanted = np.asarray(exact(matrix, jnp.asarray(r))), expected(matrix, r)
    np.testing.assert_allclose(x, wanted, atol=1e-6 * np.abs(wanted).max())


def test_tied_frames_gaps_and_absent_ones_are_no_inner_frames():
    with jax.enable_x64(True):
        matrix = laplacian(3)
        # Frame 30 is tied to the ground, no step leads to 60, and none from 80 on.
        low = np.asarray(matrix.edges).min(axis=1)
        gone = (low == 59) | (low >= 80)
        weight = jnp.where(jnp.asarray(gone)[:, None, None], 0, matrix.weight)
        own = matrix.own.at[30].add(2 * jnp.eye(6))
        matrix = dataclasses.replace(matrix, weight=weight, own=own)
        r = np.random.default_rng(1).normal(size=(NUM, 6, 1))
        r[81:] = 0
        assert fitting(matrix)
        x, wanted = np.asarray(exact(matrix, jnp.asarray(r))), expected(matrix, r)
    np.testing.assert_allclose(x, wanted, atol=1e-6 * np.abs(wanted).max())
    np.testing.assert_array_equal(x[81:], 0)


def test_single_precision_bears_long_chains():
    matrix = laplacian(3)
    r = np.random.default_rng(2).normal(size=(NUM, 6, 1)).astype(np.float32)
    x = np.asarray(exact(matrix, jnp.asarray(r)), float)
    wanted = expected(matrix, r.astype(float))
    error = x - wanted
    # In the norm of the matrix, as conjugate gradients see it.
    H = np.asarray(matrix.dense(), float)
    size = [float(v.ravel() @ H @ v.ravel()) for v in (error, wanted)]
    assert size[0] < 1e-2 * size[1]


@pytest.mark.parametrize("change", ["as it is", "damped", "renumbered"])
def test_what_is_no_chain_gets_the_cycle_of_the_whole(change: str, monkeypatch):
    monkeypatch.setattr(rooms, "_LONG", NUM)
    monkeypatch.setattr(rooms, "_WORTH", 1)
    monkeypatch.setattr(rooms, "_GAPS", 2)
    matrix = laplacian(3)
    if change == "damped":
        matrix = dataclasses.replace(matrix, own=matrix.own + 0.1 * matrix.blocks())
    elif change == "renumbered":
        order = np.random.default_rng(3).permutation(NUM)
        edges = jnp.asarray(order)[matrix.edges]
        matrix = laplacian(3, edges=np.asarray(edges))
    found = eqx.filter_jit(near_inverse)(matrix)
    assert isinstance(found, Chained)
    assert bool(found.chains.order.fits) == (change == "as it is")
    r = jnp.asarray(np.random.default_rng(0).normal(size=(NUM, 6, 1)), jnp.float32)
    x = eqx.filter_jit(lambda f, r: f(r))(found, r)
    H, b = np.asarray(matrix.dense(), float), np.asarray(r, float).ravel()
    # An inverse pulls in the right direction, at a length that is about right.
    energy, work = x.ravel() @ H @ x.ravel(), b @ np.asarray(x, float).ravel()
    assert 0.2 < work / energy < 5


def test_graphs_of_many_closures_and_short_ones_have_a_cycle():
    assert isinstance(eqx.filter_jit(near_inverse)(laplacian(2)), Multigrid)
