"""Solvers of graph Laplacians under lineax's own driver."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

from jaxreg.linear.operator import GraphLaplacian
from jaxreg.linear.solvers import LeastSquares, MultigridCG, RidgedCholesky


NUM, K, COLUMNS = 150, 3, 2
anchored: Any = eqx.filter_jit(GraphLaplacian.anchored)
product: Any = eqx.filter_jit(GraphLaplacian.mv)


@eqx.filter_jit
def matrices(operator: GraphLaplacian) -> tuple[jax.Array, ...]:
    """The dense one, that of all columns, its diagonal, and the blocks on it."""
    dense, columns = operator.dense(), operator.as_matrix()
    return dense, columns, lx.diagonal(operator), operator.blocks()


@pytest.fixture(scope="module", autouse=True)
def _in_float64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def system() -> tuple[GraphLaplacian, np.ndarray]:
    """A chain with closures and block weights, and right-hand sides it can meet."""
    rng = np.random.default_rng(0)
    chain = np.stack([np.arange(NUM - 1), np.arange(1, NUM)], axis=1)
    loops = np.sort(rng.integers(0, NUM, (80, 2)), axis=1)
    edges = np.concatenate([chain, loops[loops[:, 0] != loops[:, 1]]])
    root = rng.normal(size=(len(edges), K, K + 2))
    weight = root @ root.swapaxes(1, 2)
    operator = anchored(edges.astype(np.int32), weight, NUM, columns=COLUMNS)
    rhs = rng.normal(size=(NUM, K, COLUMNS))
    return operator, rhs - rhs.mean(axis=0)


def test_products_are_those_of_the_matrix(system):
    operator, x = system
    dense, columns, diagonal, _ = map(np.asarray, matrices(operator))
    found = np.asarray(product(operator, x)).reshape(-1)
    np.testing.assert_allclose(found, columns @ x.ravel(), atol=1e-9)
    np.testing.assert_allclose(diagonal, np.diagonal(columns))
    np.testing.assert_allclose(dense, dense.T, atol=1e-12)
    # Motions that all frames share cost what ties frame 0, and nothing else.
    shared = np.tile(np.eye(K), (NUM, 1))
    np.testing.assert_allclose(dense[K:] @ shared, 0, atol=1e-9)


@pytest.mark.parametrize(
    ("solver", "tol"),
    [(LeastSquares(), 1e-9), (RidgedCholesky(), 1e-9), (MultigridCG(1e-12), 1e-7)],
)
def test_solves_under_the_driver_of_lineax(system, solver, tol):
    operator, rhs = system
    dense = np.asarray(matrices(operator)[0])
    expected = np.linalg.solve(dense, rhs.reshape(NUM * K, -1))

    @jax.jit
    def solved(operator, rhs):
        return lx.linear_solve(operator, rhs, solver).value

    x = np.asarray(solved(operator, rhs))
    np.testing.assert_allclose(x.reshape(NUM * K, -1), expected, atol=tol)
    # lineax's derivative: d(x . y) / d rhs is the solution for y.
    slope = jax.jit(jax.grad(lambda r: jnp.sum(solved(operator, r) * rhs)))(rhs)
    np.testing.assert_allclose(slope, x, atol=10 * tol)


def test_steps_that_run_out_are_told(system):
    operator, rhs = system
    solver = MultigridCG(1e-12, max_steps=2)
    found = eqx.filter_jit(lx.linear_solve)(operator, rhs, solver, throw=False)
    assert found.result == lx.RESULTS.max_steps_reached
    assert int(found.stats["num_steps"]) == 2


@pytest.mark.parametrize("d", [2, 3])
def test_velocities_may_be_taken_at_other_points(d):
    rng, num, k = np.random.default_rng(1), 40, 3 * d - 3
    edges = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1)
    far = rng.integers(0, num, 30)
    far = np.stack([far, (far + rng.integers(1, num, 30)) % num], axis=1)
    edges = np.concatenate([edges, far])
    root = rng.normal(size=(len(edges), k, k))
    origin = rng.normal(size=(num, d))
    # x at the origin of the world, as the points of the frames move by it.
    carry = np.stack([_carrying(p) for p in origin])
    away = np.linalg.inv(carry)[edges[:, 1]]
    W = root @ root.swapaxes(1, 2)
    at_j = away.swapaxes(1, 2) @ W @ away
    world = np.asarray(matrices(anchored(edges, W, num, 0.1))[0])
    local = anchored(edges, at_j, num, 0.1, origin)
    dense, _, _, blocks = map(np.asarray, matrices(local))
    C = np.zeros((num, k, num, k))
    C[np.arange(num), :, np.arange(num)] = carry
    C = C.reshape(num * k, num * k)
    np.testing.assert_allclose(C.T @ dense @ C, world, atol=1e-9)
    x = rng.normal(size=(num, k, 2))
    found = np.asarray(product(local, x))
    expected = dense @ x.reshape(num * k, 2)
    np.testing.assert_allclose(found.reshape(num * k, 2), expected, atol=1e-9)
    own = dense.reshape(num, k, num, k)[range(num), :, range(num)]
    np.testing.assert_allclose(blocks, own, atol=1e-9)


def _carrying(point: np.ndarray) -> np.ndarray:
    """The velocity at a point and the turn, from those at 0."""
    d = len(point)
    C = np.eye(3 * d - 3)
    for row, turn in enumerate(np.eye(3) if d == 3 else [[0, 0, 1.0]]):
        C[:d, d + row] = np.cross(turn, np.pad(point, (0, 3 - d)))[:d]
    return C
