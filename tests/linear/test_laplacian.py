from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from jaxreg.linear.krylov import conjugate_gradients
from jaxreg.linear.laplacian import DENSE_LIMIT, solve_flow, solve_laplacian
from jaxreg.linear.multigrid import _coarser, multigrid
from jaxreg.linear.operator import GraphLaplacian


solve = jax.jit(solve_flow, static_argnums=3)
anchored: Any = eqx.filter_jit(GraphLaplacian.anchored)
product: Any = eqx.filter_jit(GraphLaplacian.mv)


def system(num: int, seed: int, spread: float):
    """A trajectory with loop closures, and weights spread over decades."""
    rng = np.random.default_rng(seed)
    chain = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1)
    i = rng.integers(0, num - 1, num)
    loops = np.stack([i, np.minimum(i + rng.integers(1, 40, num), num - 1)], axis=1)
    loops = loops[loops[:, 0] != loops[:, 1]]
    loops = loops[: num // 2]
    edges = np.concatenate([chain, loops]).astype(np.int32)
    weight = 10 ** rng.uniform(-spread, 0, len(edges))
    return edges, weight, rng.normal(size=(len(edges), 6))


def oracle(edges: np.ndarray, weight: np.ndarray, flow: np.ndarray, num: int):
    e = np.arange(len(edges))
    B = sp.coo_matrix(
        (
            np.concatenate([-np.ones(len(e)), np.ones(len(e))]),
            (np.concatenate([e, e]), edges.T.ravel()),
        ),
        (len(e), num),
    ).tocsr()[:, 1:]
    W = sp.diags(weight)
    x = np.asarray(spsolve((B.T @ W @ B).tocsc(), B.T @ W @ flow))
    return np.concatenate([np.zeros((1, 6)), x])


@pytest.mark.parametrize("num", [40, 700])
@pytest.mark.parametrize("spread", [0.0, 5.0])
def test_agrees_with_a_sparse_direct_solve(num, spread):
    assert 40 <= DENSE_LIMIT < 700
    edges, weight, flow = system(num, 0, spread)
    expected = oracle(edges, weight, flow, num)
    with jax.enable_x64(True):
        x = solve(jnp.asarray(edges), jnp.asarray(weight), jnp.asarray(flow), num)
        np.testing.assert_allclose(x, expected, atol=1e-6 * np.abs(expected).max())


def test_single_precision_and_any_numbering():
    num = 700
    edges, weight, flow = system(num, 1, 1.0)
    order = np.concatenate([[0], 1 + np.random.default_rng(0).permutation(num - 1)])
    expected = oracle(edges, weight, flow, num)
    x = solve(
        jnp.asarray(order[edges], jnp.int32),
        jnp.float32(weight),
        jnp.float32(flow),
        num,
    )
    np.testing.assert_allclose(x[order], expected, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize("num", [40, 700])
def test_frames_that_nothing_holds_stay(num):
    edges, weight, flow = system(num, 2, 0.0)
    last = (edges == num - 1).any(axis=1)
    weight[last] = 0
    with jax.enable_x64(True):
        x = solve(jnp.asarray(edges), jnp.asarray(weight), jnp.asarray(flow), num)
    np.testing.assert_allclose(x[-1], 0, atol=1e-12)
    keep = ~last
    expected = oracle(edges[keep], weight[keep], flow[keep], num - 1)
    np.testing.assert_allclose(x[:-1], expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("num", [40, 700])
def test_what_arrives_need_not_leave_but_at_frame_0(num):
    edges, weight, rhs = system(num, 3, 1.0)
    rhs = rhs[:num]
    L = dense(edges, weight, num)
    expected = np.linalg.solve(L[1:, 1:], rhs[1:])
    with jax.enable_x64(True):
        arrays = map(jnp.asarray, (edges, weight, rhs))
        x = jax.jit(solve_laplacian)(*arrays)
    np.testing.assert_array_equal(x[0], 0)
    np.testing.assert_allclose(x[1:], expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("num", [40, 700])
def test_the_unit_of_the_weights_does_not_matter(num):
    edges, weight, flow = system(num, 1, 1.0)
    arrays = jnp.asarray(edges), jnp.float32(weight), jnp.float32(flow)
    x = solve(*arrays, num)
    for unit in (1e-30, 1e30):
        again = solve(arrays[0], arrays[1] * jnp.float32(unit), arrays[2], num)
        np.testing.assert_allclose(again, x, atol=2e-3 * np.abs(x).max())


def dense(edges: np.ndarray, weight: np.ndarray, num: int) -> np.ndarray:
    """The Laplacian, edge by edge."""
    L = np.zeros((num, num))
    for (i, j), w in zip(edges, weight, strict=True):
        L[[i, j], [i, j]] += w
        L[[i, j], [j, i]] -= w
    return L


def _formed(matrix: GraphLaplacian) -> np.ndarray:
    """Applied to all unit vectors."""
    unit = np.eye(matrix.own.shape[0], dtype=matrix.own.dtype)
    return np.asarray(product(matrix, unit[:, None]))[:, 0]


def test_a_coarser_level_is_about_as_stiff_as_frames_that_move_as_one():
    # So many edges between aggregates that some find no room.
    rng, num = np.random.default_rng(0), 800
    i = rng.integers(0, num, 4000)
    edges = np.stack([i, (i + rng.integers(1, num, 4000)) % num], axis=1)
    weight = 10 ** rng.uniform(-3, 0, 4000)
    with jax.enable_x64(True):
        matrix = anchored(edges, weight[:, None, None], num)
        own = np.diag(np.asarray(matrix.own)[:, 0, 0])
        np.testing.assert_allclose(_formed(matrix), dense(edges, weight, num) + own)
        level, coarser = jax.jit(_coarser)(matrix)
        P = np.eye(coarser.own.shape[0])[np.asarray(level.parent)]
        expected = P.T @ _formed(matrix) @ P
        found = _formed(coarser)
    diagonal = np.diag(expected)
    np.testing.assert_allclose(np.diag(found), diagonal, rtol=1e-9)
    # (x - y)^2 is at most twice x^2 + y^2, by which an edge without room counts.
    root = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
    least = np.linalg.eigvalsh((2 * found - expected) * root[:, None] * root)[0]
    assert least > -1e-9
    assert np.abs(found - expected).max() > 1e-3  # some were lost


def test_cycles_leave_little_to_the_search():
    edges, weight, flow = system(3000, 0, 2.0)
    matrix = anchored(edges, weight.astype(np.float32)[:, None, None], 3000)
    rhs = np.zeros((3000, 1, 1), np.float32)
    np.add.at(rhs[:, 0, 0], edges[:, 1], flow[:, 0])
    np.add.at(rhs[:, 0, 0], edges[:, 0], -flow[:, 0])

    @jax.jit
    def rounds(matrix, rhs):
        inverse = multigrid(matrix)
        return conjugate_gradients(
            matrix.mv, inverse, rhs, tolerance=1e-3, max_steps=200
        )

    x, num = rounds(matrix, jnp.asarray(rhs))
    left = np.asarray(product(matrix, x)) - rhs
    assert np.linalg.norm(left) < 1e-2 * np.linalg.norm(rhs)
    assert int(num) <= 30


def test_far_from_the_origin_single_precision_still_holds():
    # A strip of 2 x 3000 frames: turns at one end shift the other by kilometres.
    long, k = 3000, 3
    near = np.arange(2 * long).reshape(long, 2)
    pairs = (
        [near[:-1], near[1:]],
        [near[:, :1], near[:, 1:]],
        [near[:-1], near[1:, ::-1]],
    )
    edges = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in pairs])
    origin = np.stack(np.divmod(np.arange(2 * long), 2), axis=1).astype(float)
    weight = np.tile(np.diag([2500.0, 2500.0, 400.0]), (len(edges), 1, 1))
    strain = 0.02 * np.random.default_rng(0).normal(size=(len(edges), k, 1))

    @jax.jit
    def solved(weight, origin, strain):
        args = jnp.asarray(edges, jnp.int32), weight, 2 * long, 0.0, origin
        matrix = GraphLaplacian.anchored(*args)
        rhs = matrix.divergence(weight @ strain)
        x, num = conjugate_gradients(
            matrix.mv, multigrid(matrix), rhs, tolerance=1e-2, max_steps=300
        )
        return num, jnp.sum(rhs * x)

    with jax.enable_x64(True):
        best = solved(*map(jnp.asarray, (weight, origin, strain)))
    single = solved(*map(jnp.float32, (weight, origin, strain)))
    assert int(single[0]) <= 1.5 * int(best[0])
    # The energy of the solution: with all tangents at one origin 14,157 for 15,885.
    np.testing.assert_allclose(single[1], best[1], rtol=3e-3)


_dense = eqx.filter_jit(lambda matrix: matrix.dense())
_prolonged = eqx.filter_jit(lambda level, x: level.prolonged(x))
_restricted = eqx.filter_jit(lambda level, x, num: level.restricted(x, num))


def test_a_coarser_level_of_frames_at_points_is_as_stiff_as_bodies():
    num, k = 120, 3
    rng = np.random.default_rng(0)
    edges = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1)
    edges = np.where(rng.random((num - 1, 1)) < 0.5, edges, edges[:, ::-1])
    root = rng.normal(size=(num - 1, k, k))
    with jax.enable_x64(True):
        place = np.cumsum(rng.normal(size=(num, 2)), axis=0)
        weight = root @ root.swapaxes(1, 2)
        matrix = anchored(edges.astype(np.int32), weight, num, 0.1, place)
        level, coarser = jax.jit(_coarser)(matrix)
        count = coarser.own.shape[0]
        unit = np.eye(count * k).reshape(count, k, count * k)
        P = np.asarray(_prolonged(level, unit)).reshape(num * k, count * k)
        expected = P.T @ np.asarray(_dense(matrix)) @ P
        np.testing.assert_allclose(_dense(coarser), expected, atol=1e-9)
        back = _restricted(level, np.eye(num * k).reshape(num, k, num * k), count)
    np.testing.assert_allclose(np.asarray(back).reshape(count * k, -1), P.T, atol=1e-12)
