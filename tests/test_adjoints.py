"""Derivatives of converged and of truncated solves: right, finite, and small."""

import functools
from collections.abc import Iterator

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move, switched_on
from protocols import graph, measured

import jaxreg as jr
from jaxreg.averaging.steps.implicit import DENSE_UNKNOWNS
from jaxreg.cloud import PointCloud, estimate_normals
from jaxreg.robust import L2, Cauchy, Tukey


N = 48
STEP = 1e-6
POINTS = jr.PointToPoint()


@pytest.fixture(autouse=True, scope="module")
def _double() -> Iterator[None]:
    with switched_on("jax_enable_x64"):
        yield


def _clouds(d: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Source, target, and a guess some degrees off."""
    rng = np.random.default_rng(0)
    source = blob(N, d).astype(float)
    source = source - source.mean(0)
    noisy = source + 0.05 * rng.standard_normal(source.shape)
    target = move(motion(3, d, angle=0.1, shift=0.05), noisy)
    guess = motion(5, d, angle=0.15, shift=0.02)
    return jnp.asarray(source), jnp.asarray(target), jnp.asarray(guess)


def _solve(method, source, target, guess, normals=None):
    """In the frames of `solve`: normals are given, so they can be held."""
    every, points = jnp.ones(N, bool), (source, target)
    if normals is None:
        normals = jnp.zeros_like(source), jnp.zeros_like(target)
    clouds = (PointCloud(x, n, every) for x, n in zip(points, normals, strict=True))
    return method.solve(*clouds, guess)


def _answer(sol) -> jax.Array:
    T = sol.T_target_source
    return jnp.sum(jnp.cos(jnp.arange(T.size, dtype=T.dtype)).reshape(T.shape) * T)


def _check_slopes(value, num: int, step: float = STEP):
    """Against central differences in each of so many arguments."""
    sides = step * np.concatenate([np.eye(num), -np.eye(num)])
    at = np.concatenate([np.zeros((1, num)), sides])
    each = map(jax.jit(jax.value_and_grad(value)), at)
    found, slopes = (np.array(x) for x in zip(*each, strict=True))
    numeric = (found[1 : num + 1] - found[num + 1 :]) / (2 * step)
    assert np.all(np.abs(numeric) > 1e-4)
    np.testing.assert_allclose(slopes[0], numeric, rtol=1e-5)


normals_of = jax.jit(estimate_normals)


def test_pose_and_scale_follow_clouds_and_width_by_the_balance_of_pulls():
    source, target, guess = _clouds(3)
    normals = tuple(normals_of(x, np.ones(N, bool)) for x in (source, target))
    rng = np.random.default_rng(1)
    apart, turn = rng.standard_normal((N, 3)), rng.standard_normal((3, 3))
    carried = np.asarray(target) @ (turn - turn.T) + rng.standard_normal(3)

    def value(x):
        method = jr.ICP(
            jr.PlaneToPlane(0.01),
            Tukey(),
            width_end=1.0 + x[2],
            tolerance=1e-13,
            max_steps=300,
            with_scale=True,
        )
        moved = source + x[0] * apart, target + x[1] * carried
        return _answer(_solve(method, *moved, guess, normals))

    _check_slopes(value, 3)


def test_a_truncated_descent_follows_its_guess_and_every_step():
    source, target, guess = _clouds(2)
    rng = np.random.default_rng(1)
    apart, carried = rng.standard_normal((2, N, 2))
    method = jr.ICP(
        POINTS,
        Cauchy(),
        max_steps=2,
        width_end=3.0,
        adjoint=jr.RecursiveCheckpointAdjoint(),
    )

    def value(x):
        start = guess.at[0, 2].add(x[1])
        moved = source + x[0] * apart, target + x[2] * carried
        return _answer(_solve(method, *moved, start))

    _check_slopes(value, 3)


def test_both_adjoints_agree_where_the_descent_has_converged():
    """In the frames of `register`, whose radius is the target's."""
    source, target, guess = _clouds(2)

    def slope(adjoint):
        method = jr.ICP(POINTS, Cauchy(), max_steps=60, tolerance=0.0, adjoint=adjoint)
        by = lambda x, y: _answer(jr.register(x, y, method, guess))  # noqa: E731
        return jax.jit(jax.grad(by, argnums=(0, 1)))(source, target)

    implicit = slope(jr.ImplicitAdjoint())
    through = slope(jr.RecursiveCheckpointAdjoint())
    chex.assert_trees_all_close(through, implicit, rtol=1e-5, atol=1e-7)


def _axes() -> np.ndarray:
    """Points along the axes: all singular values of their covariance coincide."""
    radius = np.linspace(0.5, 1, N // 6)[:, None, None]
    both = np.concatenate([np.eye(3), -np.eye(3)])
    return (radius * both).reshape(-1, 3)


HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


def test_registration_has_finite_gradients_where_formulas_are_singular():
    """At the identity, a half turn, coinciding singular values, and zero residual."""
    method = jr.ICP(POINTS, L2(), jr.ClosedForm())
    source = _clouds(3)[0]
    source = np.stack([source, source, _axes(), _axes()])
    T = np.stack([np.eye(4), HALF_TURN, np.eye(4), HALF_TURN])
    target = source @ np.swapaxes(T[:, :3, :3], 1, 2)

    def value(source, target, T):
        sol = _solve(method, source, target, T)
        return _answer(sol), sol

    slopes = jax.jit(jax.vmap(jax.grad(value, (0, 1), has_aux=True)))
    (by_source, by_target), sol = jax.tree.map(np.asarray, slopes(source, target, T))
    np.testing.assert_allclose(sol.T_target_source, T, atol=1e-12)
    assert np.isfinite(by_source).all()
    # Moving both points of every pair moves the answer as far as one of them did.
    carried = np.einsum("bij,bnj->bni", T[:, :3, :3], by_source)
    np.testing.assert_allclose(
        np.sum(by_target, 1) @ np.ones(3),
        np.sum(np.cos([3.0, 7.0, 11.0])) * np.ones(4),
        atol=1e-9,
    )
    assert np.abs(carried).max() > 1e-3


@jax.jit
@functools.partial(jax.grad, argnums=(0, 1))
def slopes_of_averaging(T: jax.Array, weight: jax.Array) -> jax.Array:
    sol = jr.average(graph(T, weight), jr.MotionAveraging())
    return jnp.sum(jnp.cos(jnp.arange(80.0)).reshape(5, 4, 4) * sol.T_world_i)


@pytest.mark.parametrize("name", ["exact", "half turns"])
def test_averaging_has_finite_gradients_where_formulas_are_singular(name):
    """Without any residual: at identities, and at half turns between all frames."""
    _, weight = measured(3, float)
    motion = np.eye(4) if name == "exact" else HALF_TURN
    i, j = np.triu_indices(5, 1)
    turned = ((i + j) % 2 == 1)[:, None, None]
    by_T, by_weight = slopes_of_averaging(np.where(turned, motion, np.eye(4)), weight)
    assert np.isfinite(by_T).all()
    assert np.isfinite(by_weight).all()
    assert np.abs(by_T).max() > 1e-3


def test_arguments_of_no_influence_have_no_slope():
    """Plain averaging knows no weights, and least squares no kernel width."""
    T, weight = measured(3, float)
    source, target, guess = _clouds(2)

    def averaged(weight):
        sol = jr.average(graph(T, weight), jr.MotionAveraging())
        return jnp.sum(sol.T_world_i[1])

    def registered(width):
        method = jr.ICP(POINTS, L2(), width_end=width)
        return _answer(_solve(method, source, target, guess))

    assert np.all(jax.jit(jax.grad(averaged))(weight) == 0)
    assert jax.jit(jax.grad(registered))(1.0) == 0


def test_graphs_too_large_for_a_dense_matrix_have_exact_gradients():
    """134 poses in the plane: 402 unknowns, so by GMRES."""
    num, rng = 134, np.random.default_rng(0)
    assert 3 * num > DENSE_UNKNOWNS
    row = np.arange(num)
    near = np.stack([row[:-1], row[1:]], 1)
    edges = np.concatenate([near, np.stack([row[:-9:3], row[9::3]], 1)])
    X = np.stack([motion(k, 2) for k in range(num)])
    noise = [motion(k, 2, angle=0.05, shift=0.05) for k in range(len(edges))]
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ np.stack(noise)
    shift, change = np.zeros_like(T), rng.standard_normal(len(edges))
    shift[:, :2, 2] = rng.standard_normal((len(edges), 2))
    method = jr.PoseGraphLM(tolerance=1e-15)
    probe = jnp.asarray(rng.standard_normal(X.shape))

    def value(x):
        moved = jr.PoseGraph.from_edges(edges, T + x[0] * shift, num, 1 + x[1] * change)
        return jnp.sum(probe * jr.average(moved, method, X).T_world_i)

    # Steps end when the sum of squares stands still, so where poses move by 1e-8.
    _check_slopes(value, 2, step=1e-3)


def _bytes(value, *args) -> int:
    program = jax.jit(jax.grad(value)).lower(*args).compile()
    found = program.memory_analysis()
    assert found is not None
    return found.temp_size_in_bytes


def test_memory_of_a_gradient_does_not_grow_with_the_steps():
    source, target, guess = _clouds(2)
    T, weight = measured(2, float)

    def registered(steps):
        method = jr.ICP(POINTS, L2(), tolerance=0.0, max_steps=steps)
        return lambda x: _answer(_solve(method, x, target, guess))

    def averaged(steps):
        method = jr.MCC(tolerance=0.0, max_steps=steps, initialiser=jr.SpanningTree())
        return lambda x: jnp.sum(jr.average(graph(x, weight), method).T_world_i[1])

    for value, x in ((registered, source), (averaged, T)):
        assert _bytes(value(1000), x) <= _bytes(value(10), x)


def test_forward_mode_passes_through_batches_of_compiled_registrations():
    source, target, guess = _clouds(2)
    method = jr.ICP(POINTS, L2(), jr.ClosedForm())

    @jax.jit
    def shifted(x, shift):
        return _answer(_solve(method, source + shift * x, target, guess))

    def batch(x):
        return jax.vmap(shifted, (None, 0))(x, jnp.asarray([0.01, 0.02]))

    x = jnp.ones(2)
    out = jax.eval_shape(jax.jacfwd(batch), x)
    assert out.shape == (2, 2)
