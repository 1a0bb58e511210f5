"""Steps by solvers of optimistix against ours."""

import dataclasses

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
import pytest
from matches import found_at, noisy_problem
from test_steps import N

import jaxreg as jr
from jaxreg.linear.condensed import condensed
from jaxreg.local import LocalOptimiser
from jaxreg.local.steps.optimistix_step import _Held
from jaxreg.robust import Huber
from jaxreg.testing.problems import pair


SOLVERS = [
    optimistix.GaussNewton(1e-9, 1e-9),
    optimistix.LevenbergMarquardt(1e-9, 1e-9),
    optimistix.BFGS(1e-9, 1e-9),
]


@eqx.filter_jit
def _stepped(step, *arguments):
    return step(*arguments)


@pytest.mark.parametrize("d", [2, 3])
def test_one_step_of_gauss_newton_is_ours(d):
    with jax.enable_x64(True):
        problem, T, weight = noisy_problem(d, np.float64)
        found = found_at(problem, T)
        solver = optimistix.GaussNewton(1e-9, 1e-9)
        for residual in (jr.PointToPoint(), jr.Symmetric()):
            step = jr.OptimistixStep(solver, max_steps=2)
            theirs = _stepped(step, T, found, weight, residual)
            ours = _stepped(jr.GaussNewton(), T, found, weight, residual)
            assert np.abs(ours - T).max() > 1e-2
            np.testing.assert_allclose(theirs, ours, atol=1e-13)


def test_few_rows_have_the_value_and_slopes_of_all():
    with jax.enable_x64(True):
        problem, T, weight = noisy_problem(3, np.float64)
        found = found_at(problem, T)
        energy = _Held.of(T, found, weight, jr.PointToPoint(), 1e-5)
        x = np.array([0.1, -0.2, 0.3, 0.9, -0.5, 0.7])

        def all_rows(x):
            residual = energy._moved(x).residual * jnp.sqrt(energy.scale * weight)
            return jnp.append(residual.ravel(), jnp.sqrt(energy.damping) * x)

        @jax.jit
        def both(x):
            few = lambda x: condensed(energy, x)  # noqa: E731
            return [(of(x), jax.jacfwd(of)(x)) for of in (few, all_rows)]

        (rows, slopes), (full, J) = jax.device_get(both(x))
        assert len(full) == 3 * N + 6
        assert len(rows) == 7
        np.testing.assert_allclose(rows @ rows, full @ full, rtol=1e-12)
        np.testing.assert_allclose(slopes.T @ rows, J.T @ full, atol=1e-12)
        np.testing.assert_allclose(slopes.T @ slopes, J.T @ J, atol=1e-12)


def test_every_solver_comes_to_rest_where_ours_does():
    with jax.enable_x64(True):
        problem, T, weight = noisy_problem(2, np.float64)
        widths = jnp.full(40, 1.0)

        @eqx.filter_jit
        def rest(step):
            optimiser = LocalOptimiser(jr.PointToPoint(), Huber(), step)
            return optimiser.repeat(problem, T, widths)

        T_ours = rest(jr.GaussNewton())
        assert np.abs(T_ours - T).max() > 1e-2
        for solver in SOLVERS:
            chex.assert_trees_all_close(
                rest(jr.OptimistixStep(solver)), T_ours, atol=1e-7
            )


def test_icp_has_the_gradient_of_its_rest_whatever_the_solver():
    with jax.enable_x64(True):
        source, target = map(jnp.asarray, pair(2, 0))
        push = jnp.sin(jnp.arange(source.size, dtype=float)).reshape(source.shape)

        @eqx.filter_jit
        def pose_and_slope(method):
            return jax.jvp(
                lambda x: jr.register(x, target, method).T_target_source,
                *((source,), (push,)),
            )

        method = jr.ICP(jr.PointToPoint(), tolerance=1e-9, width_end=3.0)
        other = dataclasses.replace(method, step=jr.OptimistixStep(SOLVERS[-1]))
        ours = pose_and_slope(method)
        assert np.abs(ours[1]).max() > 1e-3
        chex.assert_trees_all_close(pose_and_slope(other), ours, atol=1e-6)


def test_another_tolerance_compiles_nothing():
    problem, T, weight = noisy_problem(2, np.float32)
    found = found_at(problem, T)

    @eqx.filter_jit
    @chex.assert_max_traces(n=1)
    def step(step):
        return step(T, found, weight, jr.PointToPoint())

    for tolerance in (1e-1, 1e-4):
        solver = optimistix.LevenbergMarquardt(tolerance, tolerance)
        chex.assert_tree_all_finite(step(jr.OptimistixStep(solver)))


def test_a_step_that_does_not_lower_the_energy_leaves_the_pose():
    problem, T, weight = noisy_problem(2, np.float32)
    found = found_at(problem, T)
    # Longer than the valley is wide, once.
    leap = jr.OptimistixStep(optimistix.GradientDescent(50.0, 1e-4, 1e-4), max_steps=2)
    same = _stepped(leap, T, found, weight, jr.PointToPoint())
    np.testing.assert_array_equal(same, T)
    broken = eqx.tree_at(
        lambda m: m.residual, found, found.residual.at[0, 0].set(jnp.nan)
    )
    step = jr.OptimistixStep(SOLVERS[0])
    same = _stepped(step, T, broken, weight, jr.PointToPoint())
    np.testing.assert_array_equal(same, T)


def test_gradients_of_a_step_are_those_of_the_minimum():
    with jax.enable_x64(True):
        problem, T, weight = noisy_problem(2, np.float64)
        found = found_at(problem, T)
        push = jnp.sin(jnp.arange(found.residual.size)).reshape(found.residual.shape)

        def moved_pose(s, step):
            near = eqx.tree_at(lambda m: m.residual, found, found.residual + s * push)
            return step(T, near, weight, jr.PointToPoint())

        step = jr.OptimistixStep(optimistix.BFGS(1e-12, 1e-12), damping=1e-12)

        @jax.jit
        def slopes(s):
            both = jax.jacfwd(moved_pose)(s, step), jax.jacrev(moved_pose)(s, step)
            return jax.jacfwd(moved_pose)(s, jr.ClosedForm()), both

        closed, (forward, backward) = slopes(0.0)
        assert np.abs(closed).max() > 1e-3
        np.testing.assert_allclose(forward, closed, atol=1e-7)
        np.testing.assert_allclose(backward, closed, atol=1e-7)


def test_what_is_no_solver_of_optimistix_is_refused():
    for wrong in (
        optimistix.Newton(1e-6, 1e-6),
        lineax.CG(1e-6, 1e-6),
        jr.GaussNewton(),
    ):
        with pytest.raises(TypeError, match="least-squares solver of optimistix"):
            jr.OptimistixStep(wrong)
    with pytest.raises(TypeError, match="BFGS; add \\(\\)"):
        jr.OptimistixStep(optimistix.BFGS)
    with pytest.raises(ValueError, match="damping"):
        jr.OptimistixStep(SOLVERS[0], damping=0.0)
    step = jr.OptimistixStep(SOLVERS[0])
    assert repr(step) == "OptimistixStep(solver=GaussNewton(rtol=1e-09, atol=1e-09))"
    assert dataclasses.replace(step, max_steps=3).solver is step.solver
