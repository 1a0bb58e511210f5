"""The filter, its preset and its rival, on small problems."""

from typing import ClassVar

import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move, pose_error
from jaxtyping import Array
from scipy.spatial import KDTree

from jaxreg import Status
from jaxreg._core.arrays import cast_floats, traced
from jaxreg.cloud import PointCloud
from jaxreg.local import LocalOptimiser
from jaxreg.matching import Problem, match
from jaxreg.neighbours import BruteForce
from jaxreg.particle import (
    AbsoluteEnergy,
    AbstractDynamics,
    BoundedEnergy,
    ConstantVelocity,
    EnsembleSpread,
    GaussianPrior,
    GivenParticles,
    MeasuredSpread,
    Multinomial,
    MultiStart,
    NoDynamics,
    ParticleFilter,
    PathSpread,
    Residual,
    SquaredEnergy,
    StochasticDynamics,
    Stratified,
    Systematic,
    base,
    sandhu2010,
)
from jaxreg.particle.candidates import Candidates
from jaxreg.particle.conclude import conclude
from jaxreg.particle.draw import SETTLE_STEPS
from jaxreg.particle.energies import AbstractEnergy
from jaxreg.particle.pair import Pair
from jaxreg.registration import register
from jaxreg.robust import L2


N, P = 96, 24
KEY = jax.random.key(0)
STARTS = np.stack([motion(i, 2, shift=0.3) for i in range(P)])


def _cloud(points: np.ndarray) -> PointCloud:
    near = points[KDTree(points).query(points, 6)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.svd(near)[2][:, -1]  # of least spread
    return PointCloud(
        jnp.asarray(points), jnp.asarray(normals), jnp.ones(len(points), bool)
    )


def _pair(d: int, T: np.ndarray | None = None) -> Pair:
    T = np.eye(d + 1) if T is None else T
    points = blob(2 * N, d) - blob(2 * N, d).mean(0)
    source, target = _cloud(move(np.linalg.inv(T), points[:N])), _cloud(points)
    return Pair.of(source, target, BruteForce.build(target.points))


@eqx.filter_jit
def _search(method, problem):
    return method.search(KEY, problem, None)


@eqx.filter_jit
def _conclude(pair, found):
    return conclude(
        pair,
        Candidates.of(found, 2),
        kernel=L2(),
        num_modes=2,
        refine_steps=0,
        min_log_evidence=0.0,
    )


def _diffusion(spread) -> StochasticDynamics:
    return StochasticDynamics(spread=spread)


def _small(**parts) -> ParticleFilter:
    settings = {
        "num_prior": P,
        "num_particles": P,
        "num_times": 3,
        "prior_steps": 2,
        "inner_steps": 2,
        "prior": GivenParticles(STARTS),
        "num_agreeing": 0,
        "width_end": 0.3,
        "batch_size": 10,
    }
    return ParticleFilter(**{**settings, **parts})


def test_multi_start_keeps_every_single_descent():
    method = MultiStart(
        num_starts=P, num_steps=8, prior=GivenParticles(STARTS), batch_size=10
    )
    problem = _pair(2).problem
    found = _search(method, problem).particles
    optimiser = LocalOptimiser(method.residual, method.kernel, method.step)
    widths = jnp.asarray((0.3 * 0.2 ** np.linspace(0, 1, 8)).astype(np.float32))

    @jax.jit
    def descend(T):
        end = optimiser.repeat(problem, T, widths)
        return end, BoundedEnergy()(match(problem, end), widths[-1])

    ends = np.asarray(found.T_target_source)
    for i, T in enumerate(STARTS[:12]):
        end, value = descend(T.astype(np.float32))
        np.testing.assert_allclose(ends[i], end, atol=1e-4)
        assert float(found.energy[i]) == pytest.approx(float(value), abs=1e-4)
    np.testing.assert_allclose(np.exp(found.log_weight), 1 / P, rtol=1e-5)
    best = ends[np.argmin(found.energy)]
    np.testing.assert_array_equal(found.measurement, best)


def test_without_dynamics_and_resampling_the_filter_is_multi_start():
    # Then a particle is one descent of 2 + 3 * 2 steps, and Eq. 9 a product.
    problem = _pair(2).problem
    still = _small(dynamics=NoDynamics(), resampler=Systematic(0.0), tolerance=0.0)
    found = _search(still, problem)
    rival = MultiStart(
        num_starts=P,
        num_steps=8,
        prior=GivenParticles(STARTS),
        width_end=0.3,
        batch_size=10,
    )
    ends = _search(rival, problem).particles
    np.testing.assert_allclose(
        found.particles.T_target_source, ends.T_target_source, atol=1e-4
    )
    np.testing.assert_allclose(found.particles.energy, ends.energy, atol=1e-4)
    assert int(found.num_steps) == 8
    # The weight of a particle that fits better at every time grows with time.
    once = _search(_small(dynamics=NoDynamics(), tolerance=0.0), problem).particles
    assert np.ptp(found.particles.log_weight) > np.ptp(once.log_weight)
    assert np.sum(np.exp(found.particles.log_weight)) == pytest.approx(1, abs=1e-4)


def test_draws_end_when_several_agree_and_not_on_a_symmetric_object():
    method = ParticleFilter(num_prior=128, num_particles=16, batch_size=8)
    points = blob(2 * N, 2) - blob(2 * N, 2).mean(0)
    half = points[:N]
    T = motion(5, 2, angle=2.0, shift=0.1)
    ends = {}
    for name, target in (
        ("one", points),
        ("alike from two sides", np.concatenate([half, -half])),
    ):
        source = _cloud(move(np.linalg.inv(T), target))
        cloud = _cloud(target)
        problem = Problem.of(source, cloud, BruteForce.build(cloud.points))
        ends[name] = _search(method, problem)
    sure, torn = ends["one"], ends["alike from two sides"]
    drawn = method.prior_steps + SETTLE_STEPS
    assert int(sure.num_steps) == drawn
    assert bool(sure.finished)
    angle, shift = pose_error(sure.particles.measurement, T)
    assert angle < 0.05
    assert shift < 0.05
    # None of the 16 that the filter would have carried on, behind 32 settled ones.
    assert not np.isfinite(sure.particles.energy[32:]).any()
    assert int(sure.trace.num_rows) == 1
    assert int(sure.trace.num_measured[0]) < 128
    assert int(torn.num_steps) > drawn
    trace, num = torn.trace, int(torn.trace.num_rows)
    assert num > 1
    np.testing.assert_array_equal(trace.num_measured[:num], [128] + (num - 1) * [16])
    assert (trace.least_energy < trace.median_energy)[:num].all()
    assert (trace.effective_size[:num] <= trace.num_measured[:num] + 0.01).all()
    assert (np.diff(trace.kernel_width[:num]) < 0).all()
    assert not np.any(trace.least_energy[num:])
    assert np.isfinite(torn.particles.energy).all()


def _paper(d: int, dynamics: AbstractDynamics, num_times: int) -> ParticleFilter:
    prior = GaussianPrior(0.5, 0.5)
    starts = jax.jit(lambda: prior.draw(KEY, P, d, None, jnp.float32))()
    prior = GivenParticles(starts)
    return sandhu2010(d, P, dynamics, prior=prior, num_times=num_times)


@pytest.mark.parametrize(
    ("d", "dynamics"),
    [(2, StochasticDynamics(spread=PathSpread())), (3, StochasticDynamics())],
)
def test_the_papers_filter_solves_an_easy_case(d, dynamics):
    T = motion(4, d, angle=0.6, shift=0.1)
    pair = _pair(d, T)
    found = _search(_paper(d, dynamics, 12), pair.problem)
    solution = _conclude(pair, found)
    angle, shift = pose_error(solution.T_target_source, T)
    assert angle < 0.02
    assert shift < 0.02
    # Without refinement the answer is the particle of least energy.
    np.testing.assert_allclose(
        solution.T_target_source, found.particles.measurement, atol=1e-5
    )
    rested = bool(found.finished)
    expected = Status.CONVERGED if rested else Status.MAX_STEPS
    assert int(solution.status) == expected


def test_the_filter_stops_when_the_motion_errors_are_small():
    problem = _pair(2).problem
    method = _paper(2, StochasticDynamics(spread=PathSpread()), 12)
    at = eqx.tree_at(lambda m: m.tolerance, method, jnp.asarray(10.0))
    found = _search(at, problem)
    assert int(found.num_steps) == 7 + 7  # t = 0 and t = 1
    assert bool(found.finished)
    at = eqx.tree_at(lambda m: m.tolerance, method, jnp.asarray(-1.0))
    found = _search(at, problem)  # never
    assert int(found.num_steps) == 7 + 12 * 7
    assert not bool(found.finished)
    # At rest from the beginning: the truth is a fixed point.
    rest = GivenParticles(np.broadcast_to(np.eye(3), (P, 3, 3)))
    found = _search(eqx.tree_at(lambda m: m.prior, method, rest), problem)
    assert int(found.num_steps) == 7 + 7
    assert bool(found.finished)


def test_the_papers_settings():
    flat, solid = sandhu2010(2), sandhu2010(3, 40, ConstantVelocity())
    assert (flat.inner_steps, solid.inner_steps) == (7, 3)
    assert (flat.num_prior, solid.num_prior) == (200, 40)
    assert type(flat.step).__name__ == "GradientDescent"
    assert type(solid.step).__name__ == "GaussNewton"
    assert isinstance(solid.dynamics, ConstantVelocity)
    assert isinstance(flat.energy, SquaredEnergy)
    assert flat.refine_steps == 0
    assert isinstance(flat.dynamics, StochasticDynamics)
    assert isinstance(flat.dynamics.spread, MeasuredSpread)
    with pytest.raises(ValueError, match="d must be 2 or 3, found 4"):
        sandhu2010(4)


@pytest.mark.parametrize("d", [2, 3])
def test_the_papers_settings_are_for_points_of_their_dimension(d):
    points, other = blob(N, d), 5 - d
    with pytest.raises(ValueError, match=f"of dimension {other}, found .* {d}"):
        register(points, points, sandhu2010(other), key=KEY)
    with pytest.raises(ValueError, match=f"of dimension {other}, found .* {d}"):
        sandhu2010(other).iteration(points, points, key=KEY)


@pytest.mark.parametrize("d", [2, 3])
def test_the_papers_settings_say_that_too_few_points_tell_no_rotation(d):
    few = np.arange(N)[:, None] < d
    points = np.where(few, blob(N, d), 0)
    paper = sandhu2010(d, 8, num_times=1)
    found = register(points, points, paper, key=KEY, source_mask=few[:, 0])
    assert found.status == Status.TOO_FEW_POINTS
    np.testing.assert_array_equal(found.T_target_source, np.eye(d + 1))


class _Constant(AbstractEnergy):
    resolution: ClassVar[float] = 0.0
    value: Array | float = traced(0.5)

    def __call__(self, found, width):
        return jnp.asarray(self.value, width.dtype)


@pytest.mark.parametrize("value", [np.inf, np.nan, 0.5])
def test_energies_that_tell_nothing_leave_uniform_weights(value):
    pair = _pair(2)
    method = _small(energy=_Constant(value), resampler=Systematic(0.5))
    found = _search(method, pair.problem)
    np.testing.assert_allclose(np.exp(found.particles.log_weight), 1 / P, rtol=1e-5)
    solution = _conclude(pair, found)
    chex.assert_tree_all_finite(solution)
    if not np.isfinite(value):
        assert int(solution.status) == Status.NON_FINITE
        np.testing.assert_array_equal(solution.T_target_source, np.eye(3))


def test_poses_are_judged_by_the_same_points_whatever_number_finds_them(monkeypatch):
    # Bits are those of one program for each number; step by step, there are hundreds.
    thinned = jax.jit(base.thin, static_argnums=(2, 3))
    spaced = jax.jit(PointCloud.with_spacing)
    monkeypatch.setattr(base, "thin", thinned)
    monkeypatch.setattr(base, "without_noise", jax.jit(base.without_noise))
    monkeypatch.setattr(PointCloud, "with_spacing", spaced)
    points, mask = jnp.asarray(blob(9000, 3)), jnp.asarray(np.ones(9000, bool))
    usual = spaced(ParticleFilter().prepare(points, mask))
    assert usual.judged is None
    for num in (1024, 6000, 9000):
        cloud = ParticleFilter(max_points=num).prepare(points, mask)
        assert len(cloud.mask) == num
        for name in ("points", "normals", "mask", "spacing"):
            found = getattr(cloud.as_judged, name)
            np.testing.assert_array_equal(found, getattr(usual, name))


def test_given_particles_are_in_the_frames_of_the_input():
    # Far from the origin and in a small unit; one start is the truth.
    d = 2
    T = motion(5, d, shift=300.0)
    target = 100 * blob(N, d) + np.float32(500)
    source = move(np.linalg.inv(T), target)
    starts = np.stack([motion(i, d, shift=300.0) for i in range(4)] + [T])
    method = MultiStart(
        num_starts=5, num_steps=1, prior=GivenParticles(starts), refine_steps=0
    )
    solution = register(source, target, method, key=KEY)
    angle, shift = pose_error(solution.T_target_source, T)
    assert angle < 1e-2
    assert shift < 2
    with pytest.raises(ValueError, match="dimension 3"):
        register(np.ones((5, 3)), np.ones((5, 3)), method, key=KEY)
    pair = _pair(2)
    with pytest.raises(ValueError, match="one key"):
        method.solve(pair.source, pair.target, None, jax.random.split(KEY, 2))
    with pytest.raises(TypeError, match="float"):
        method.solve(pair.source, pair.target, None, jnp.ones(2))


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (ParticleFilter, "num_particles", 0),
        (ParticleFilter, "num_particles", 1),
        (ParticleFilter, "num_particles", 4096),
        (ParticleFilter, "inner_steps", 0),
        (ParticleFilter, "num_times", 0),
        (ParticleFilter, "refine_steps", -1),
        (ParticleFilter, "sample_share", 0.0),
        (ParticleFilter, "sample_share", 1.5),
        (ParticleFilter, "width_end", 0.0),
        (MultiStart, "num_starts", 0),
        (MultiStart, "num_steps", 0),
        (MultiStart, "width_start", -1.0),
    ],
)
def test_settings_that_leave_nothing_to_do_are_refused(kind, field, value):
    with pytest.raises(ValueError, match=f"{kind.__name__}: {field}.*{value}"):
        kind(**{field: value})


def test_as_many_given_particles_as_the_method_starts_with():
    with pytest.raises(ValueError, match="num_prior = 1536 poses, found 24"):
        ParticleFilter(prior=GivenParticles(STARTS))
    with pytest.raises(ValueError, match="num_starts = 672 poses, found 24"):
        MultiStart(prior=GivenParticles(STARTS))


@pytest.mark.parametrize(
    ("method", "concludes"),
    # What follows a search is the same for all: with and without refinement.
    [
        (_small(prior=None, resampler=Residual(0.5), energy=AbsoluteEnergy()), True),
        (_small(dynamics=_diffusion(EnsembleSpread()), resampler=Stratified()), False),
        (_small(dynamics=_diffusion(PathSpread()), resampler=Multinomial()), False),
        (MultiStart(num_starts=P, num_steps=2, refine_steps=0), True),
        (sandhu2010(2, P, ConstantVelocity()), False),
    ],
    ids=["residual", "ensemble", "path", "multi-start", "paper"],
)
def test_parts_go_together_and_keep_the_dtype(method, concludes):
    with jax.enable_x64(True):
        for dtype in (jnp.float32, jnp.float64):
            pair = jax.tree.map(
                lambda x: x.astype(dtype) if x.dtype.kind == "f" else x,  # noqa: B023
                _pair(2),
            )
            clouds = pair.source, pair.target, pair.target_index
            if concludes:
                out = eqx.filter_eval_shape(method.solve_indexed, *clouds, None, KEY)
            else:
                # As `solve_indexed` has its numbers cast before.
                cast = cast_floats(method, dtype)
                out = eqx.filter_eval_shape(cast.search, KEY, pair.problem, None)
                assert out.finished.dtype == out.sure.dtype == bool
                out = out.particles, out.num_steps, out.trace
            kinds = {x.dtype for x in jax.tree.leaves(out)}
            assert kinds == {jnp.dtype(dtype), jnp.dtype(jnp.int32)}


def _lump(n: int, kind: int, seed: int) -> np.ndarray:
    """`(n, 3)` random points of a smooth closed surface, one for each kind."""
    rng = np.random.default_rng(1000 + kind)
    waves, height = 1.8 * rng.normal(size=(5, 3)), 0.15 * rng.normal(size=5)
    phase = rng.uniform(0, 2 * np.pi, 5)
    x = np.random.default_rng(seed).normal(size=(n, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return (1 + np.sin(x @ waves.T + phase) @ height)[:, None] * x


def _three_quarters(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    order = np.argsort(points @ normal)
    return points[order[: 3 * len(points) // 4]]


def test_pieces_of_smooth_surfaces_are_found_without_a_guess():
    # At a wide width some wrong poses fit such pieces better than the true one.
    sources, targets, truth = [], [], []
    for k in (0, 1, 2, 3, 5, 6, 7, 8):  # the fourth is nearly a surface of revolution
        rng = np.random.default_rng(k)
        T, normals = motion(k, 3), np.linalg.qr(rng.normal(size=(3, 3)))[0]
        sources.append(_three_quarters(_lump(800, k, 2 * k), normals[0]))
        other = _three_quarters(_lump(800, k, 2 * k + 1), normals[1])
        targets.append(move(T, other))
        truth.append(T)
    source = np.stack(sources).astype(np.float32)
    target = np.stack(targets).astype(np.float32)
    sol = register(source, target, key=KEY)
    for k, T in enumerate(truth):
        angle, _ = pose_error(sol.T_target_source[k], T)
        assert angle < 0.05
    sure = np.asarray(sol.status) == Status.CONVERGED
    assert np.all(sure | (np.asarray(sol.status) == Status.AMBIGUOUS))
    assert np.sum(sure) >= 7  # one fits itself nearly as well in some other turns
    assert np.all(np.asarray(sol.modes.margin)[sure] > 1 / 3)
    assert np.all(np.asarray(sol.modes.effective_size)[sure] < 3)
    np.testing.assert_array_equal(sol.modes.covariance[:, 0], sol.covariance)
