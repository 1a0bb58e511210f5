"""Steps against Kabsch, each other, and data that leave directions free."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move, pose_error
from matches import N, found_at, noisy_problem, normals_of, problem_of

from jaxreg.geometry.kabsch import kabsch
from jaxreg.linear.small import solve_semidefinite
from jaxreg.local import (
    ClosedForm,
    GaussNewton,
    GradientDescent,
    LevenbergMarquardt,
    LocalOptimiser,
    condition,
    decoupled_error,
    gyration_radius,
    turn_and_shift,
)
from jaxreg.matching import (
    PlaneToPlane,
    PointToPlane,
    PointToPoint,
    Symmetric,
    match,
    moved,
)
from jaxreg.neighbours import BruteForce
from jaxreg.robust import L2, GemanMcClure, Huber


RESIDUALS = [PointToPoint(), PointToPlane(), PlaneToPlane(), Symmetric()]
ITERATIVE = [GaussNewton(), GradientDescent(), LevenbergMarquardt()]
by_residual = pytest.mark.parametrize(
    "residual", RESIDUALS, ids=lambda r: type(r).__name__
)
in_2d_and_3d = pytest.mark.parametrize("d", [2, 3])
by_step = pytest.mark.parametrize("step", ITERATIVE, ids=lambda s: type(s).__name__)


@eqx.filter_jit
def _step(step, residual, T, found, weight):
    return step(T, found, weight, residual)


@eqx.filter_jit
def _energy(residual, found, weight, T_before, T_after):
    return residual.energy(moved(found, T_before, T_after), weight)


@in_2d_and_3d
def test_steps_find_the_closed_form_with_matches_held(d):
    problem, start, weight = noisy_problem(d, np.float32)
    expected = kabsch(problem.source.T, problem.target[:d].T, weight)
    for step in [ClosedForm(), *ITERATIVE]:
        T = start
        for _ in range(1 if isinstance(step, ClosedForm) else 12):
            T = _step(step, PointToPoint(), T, found_at(problem, T), weight)
        atol = 1e-4 if isinstance(step, GradientDescent) else 1e-5
        np.testing.assert_allclose(T, expected, atol=atol)


def test_zero_weights_leave_the_pose():
    problem, T, weight = noisy_problem(3, np.float32)
    found = found_at(problem, T)
    for step in [ClosedForm(), *ITERATIVE]:
        T_new = _step(step, PointToPoint(), T, found, 0 * weight)
        np.testing.assert_allclose(T_new, T, atol=1e-6)


@by_step
def test_units_do_not_matter(step):
    problem, T, weight = noisy_problem(3, np.float32)
    mm = eqx.tree_at(
        lambda p: (p.source, p.target),
        problem,
        (
            1000 * problem.source,
            problem.target * np.repeat([[1000], [1]], 3, axis=0).astype(np.float32),
        ),
    )
    T_mm = T.at[:3, 3].multiply(1000)
    T_new = _step(step, Symmetric(), T, found_at(problem, T), weight)
    T_mm = _step(step, Symmetric(), T_mm, found_at(mm, T_mm), weight)
    np.testing.assert_allclose(T_mm.at[:3, 3].divide(1000), T_new, atol=1e-4)


def test_a_width_that_is_no_number_is_no_step_without_a_word():
    problem, T, _ = noisy_problem(3, np.float32)
    optimiser = LocalOptimiser(PointToPlane(), GemanMcClure(), GaussNewton())
    after = eqx.filter_jit(optimiser)(problem, T, jnp.asarray(np.nan, jnp.float32))
    assert not np.any(np.isfinite(after[:3]))


@by_residual
def test_levenberg_marquardt_never_raises_the_held_energy(residual):
    points, weight = blob(N, 3), jnp.ones(N, jnp.float32)
    points -= points.mean(axis=0)
    normals = normals_of(points)
    problem = problem_of(points, normals, points, normals)
    worse = 0
    for seed in range(20):
        T = jnp.asarray(motion(seed, 3), jnp.float32)
        found = found_at(problem, T)
        before = float(_energy(residual, found, weight, T, T))
        T_new = _step(LevenbergMarquardt(), residual, T, found, weight)
        assert float(_energy(residual, found, weight, T, T_new)) <= before * (1 + 1e-5)
        T_plain = _step(GaussNewton(), residual, T, found, weight)
        worse += float(_energy(residual, found, weight, T, T_plain)) > before
    if isinstance(residual, Symmetric):  # Gauss-Newton alone does, half a turn away
        assert worse > 0


def test_levenberg_marquardt_stays_at_the_minimum_and_keeps_the_gradient():
    problem, _, weight = noisy_problem(2, np.float32)
    T = kabsch(problem.source.T, problem.target[:2].T, weight)
    found = found_at(problem, T)
    push = jnp.ones_like(found.residual).at[1].set(jnp.arange(N) / N)

    def turned(residual, step):
        near = eqx.tree_at(lambda m: m.residual, found, residual)
        return step(T, near, weight, PointToPoint())[0, 1]

    @eqx.filter_jit
    def slope(step):
        return jax.jvp(lambda r: turned(r, step), (found.residual,), (push,))

    value, mine = slope(LevenbergMarquardt())
    np.testing.assert_allclose(value, T[0, 1], atol=1e-6)
    np.testing.assert_allclose(mine, slope(GaussNewton())[1], atol=1e-6)
    assert abs(float(mine)) > 1e-2
    backward = jax.eval_shape(jax.grad(turned), found.residual, LevenbergMarquardt())
    assert backward.shape == push.shape


def _flat(problem):
    """The problem with both clouds in the plane z = 0, 0.1 apart, normals along z."""
    up = jnp.zeros_like(problem.source_normals).at[2].set(1)
    target = jnp.concatenate([problem.source.at[2].set(0.1), up])
    return eqx.tree_at(
        lambda p: (p.source, p.source_normals, p.target),
        problem,
        (problem.source.at[2].set(0), up, target),
    )


@by_step
def test_directions_that_parallel_normals_leave_free_stay(step):
    problem, _, weight = noisy_problem(3, np.float32)
    T = jnp.eye(4, dtype=jnp.float32)
    # Slid and turned within the plane: nothing along z says so.
    slid = jnp.asarray(motion(0, 2, angle=0.3, shift=0.2), jnp.float32)
    T = T.at[:2, :2].set(slid[:2, :2]).at[:2, 3].set(slid[:2, 2])
    found = found_at(_flat(problem), T)
    for residual in (PointToPlane(0.0), Symmetric()):
        T_new = _step(step, residual, T, found, weight)
        v_x, v_y, v_z, _, _, w_z = decoupled_error(T_new, T)
        assert max(abs(v_x), abs(v_y), abs(w_z)) < 1e-5
        assert float(v_z) == pytest.approx(0.1, abs=0.02)


@by_step
def test_one_point_and_a_line_give_finite_steps_that_fit(step):
    problem, T, weight = noisy_problem(3, np.float32)
    one = jnp.zeros_like(weight).at[5].set(1)
    line = jnp.outer(jnp.asarray([1.0, 2.0, -0.5]), jnp.linspace(-1, 1, N))
    collinear = eqx.tree_at(
        lambda p: (p.source, p.target),
        problem,
        (line, problem.target.at[:3].set(line + 0.1)),
    )
    for posed, chosen in ((problem, one), (collinear, weight)):
        found = found_at(posed, T)
        for residual in (PointToPoint(), PointToPlane(0.0)):
            T_new = _step(step, residual, T, found, chosen)
            # No leap: a step of the order of the residuals.
            assert np.all(np.abs(decoupled_error(T_new, T)) < 3)
            before = _energy(residual, found, chosen, T, T)
            assert float(_energy(residual, found, chosen, T, T_new)) <= float(before)
    # A turn about the line is free, and left alone.
    w = decoupled_error(_step(step, PointToPoint(), T, found, weight), T)[3:]
    along = T[:3, :3] @ line[:, -1] / jnp.linalg.norm(line[:, -1])
    assert abs(float(w @ along)) < 1e-3


@in_2d_and_3d
def test_motion_error_undoes_the_update(d):
    with jax.enable_x64(True):
        T = jnp.asarray(motion(3, d))
        tangent = 0.1 * jnp.arange(1.0, 4.0 if d == 2 else 7.0)
        error = decoupled_error(turn_and_shift(T, tangent), T)
        np.testing.assert_allclose(error, tangent, atol=1e-12)


def test_closed_form_refuses_a_residual_that_it_does_not_solve():
    problem, T, weight = noisy_problem(3, np.float32)
    found = found_at(problem, T)
    for residual in RESIDUALS[1:]:
        name = type(residual).__name__
        with pytest.raises(TypeError, match=f"GaussNewton for {name}"):
            jax.eval_shape(ClosedForm(), T, found, weight, residual)


@in_2d_and_3d
def test_the_radius_of_gyration_is_that_of_the_moments_of_inertia(d):
    problem, T, weight = noisy_problem(d, np.float32)
    found = found_at(problem, T)
    x, w = np.asarray(found.rotated, float), np.asarray(weight, float)
    spread = np.einsum("n,in,jn->ij", w, x, x) / w.sum()
    inertia = np.trace(spread) * np.eye(3 if d == 3 else 1)
    if d == 3:
        inertia -= spread
    expected = np.sqrt(np.mean(np.diag(inertia)))
    radius = gyration_radius(found, weight)
    np.testing.assert_allclose(radius, expected, rtol=1e-5)


def test_condition_tells_what_the_data_leave_free():
    problem, _, weight = noisy_problem(3, np.float32)
    T = jnp.eye(4, dtype=jnp.float32)

    @jax.jit
    def conditions(found):
        radius = gyration_radius(found, weight)
        plane, _ = PointToPlane(0.0).normal_equations(found, weight)
        points, _ = PointToPoint().normal_equations(found, weight)
        return condition(points, radius), condition(plane, radius)

    def of(points):
        target = jnp.concatenate([points.T, normals_of(points).T])
        posed = eqx.tree_at(lambda p: (p.source, p.target), problem, (points.T, target))
        return [float(x) for x in conditions(found_at(posed, T))]

    shape = blob(N, 3)
    shape -= np.average(shape, axis=0, weights=weight)
    points, plane = of(shape)
    assert points > 0.3
    assert plane > 1e-3
    same = np.array(of(1000 * shape))
    np.testing.assert_allclose(same, [points, plane], rtol=1e-2)
    flat_points, flat_plane = of(shape * np.array([1, 1, 0], np.float32))
    assert flat_points > 0.1
    assert flat_plane < 1e-6
    assert of(shape * np.array([1, 0, 0], np.float32))[0] < 1e-6
    ball = shape / np.linalg.norm(shape, axis=1, keepdims=True)
    posed = problem_of(ball, ball, ball, ball)
    assert float(conditions(found_at(posed, T))[1]) < 1e-6
    assert float(condition(jnp.zeros((6, 6)))) == 0
    assert float(condition(jnp.full((3, 3), jnp.nan))) == 0


def _five_degrees_off(d):
    """A pair, the pose to find, and a pose five degrees from it."""
    target = blob(N if d == 2 else 200, d)
    normals = normals_of(target)
    centre = target[:N].mean(axis=0)
    T_true = motion(5, d, angle=np.deg2rad(5), shift=0.02)
    inverse = np.linalg.inv(T_true)
    T_true[:d, d] += centre
    source = move(inverse, target[:N] - centre)
    turned = (normals[:N] @ inverse[:d, :d].T).astype(np.float32)
    problem = problem_of(source, turned, target, normals, BruteForce)
    start = jnp.eye(d + 1, dtype=jnp.float32).at[:d, d].set(centre)
    return problem, T_true, start


@in_2d_and_3d
def test_every_residual_and_step_converge_from_five_degrees(d):
    problem, T_true, start = _five_degrees_off(d)
    pairs = [(r, s) for r in RESIDUALS for s in ITERATIVE]
    for residual, step in [(PointToPoint(), ClosedForm()), *pairs]:
        optimiser = LocalOptimiser(residual, L2(), step)
        T, width = start, jnp.ones((), jnp.float32)
        for _ in range(40):
            found = found_at(problem, T)
            T = _step(step, residual, T, found, optimiser.weights(found, width))
        angle, shift = pose_error(T, T_true)
        assert angle < 2e-3, (residual, step)
        assert shift < 2e-3, (residual, step)


def test_repeated_steps_are_one_compiled_loop_over_a_batch_of_poses():
    problem, T_true, start = _five_degrees_off(3)
    optimiser = LocalOptimiser(Symmetric(), Huber(), LevenbergMarquardt())
    widths = jnp.full(20, 0.1, jnp.float32)
    starts = jnp.stack([start, start.at[0, 3].add(0.05)])
    for T in jax.jit(jax.vmap(lambda T: optimiser.repeat(problem, T, widths)))(starts):
        angle, shift = pose_error(T, T_true)
        assert angle < 1e-3
        assert shift < 1e-3


@pytest.mark.parametrize("rank", [6, 4, 0])
def test_tiny_systems_are_solved_and_free_directions_get_nothing(rank):
    rng = np.random.default_rng(rank)
    rows = rng.integers(-4, 5, (rank, 6)).astype(np.float32)
    A, b = rows.T @ rows, rows.T @ rng.standard_normal(rank).astype(np.float32)
    x = np.asarray(_solve(jnp.asarray(A), jnp.asarray(b)))
    np.testing.assert_allclose(A @ x, b, atol=1e-3)
    assert np.sum(x != 0) == rank


_solve = jax.jit(solve_semidefinite)


@in_2d_and_3d
def test_dtype_is_that_of_the_pose(d):
    with jax.enable_x64(True):
        for dtype in (np.float32, np.float64):
            problem, T, weight = noisy_problem(d, dtype)
            found = jax.eval_shape(match, problem, T)
            for step in ITERATIVE:
                out = jax.eval_shape(step, T, found, weight, Symmetric())
                assert out.dtype == dtype
            out = jax.eval_shape(ClosedForm(), T, found, weight, PointToPoint())
            assert out.dtype == dtype
