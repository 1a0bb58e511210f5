import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from jaxreg.linear.laplacian import DENSE_LIMIT, solve_flow


solve = jax.jit(solve_flow, static_argnums=3)


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
