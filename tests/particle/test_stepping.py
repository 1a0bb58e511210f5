"""A filter stepped by hand: what the search does, and what a step tells."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move, pose_error
from jaxtyping import Array

import jaxreg as jr
from jaxreg import particle
from jaxreg._core.arrays import traced
from jaxreg.local import LocalOptimiser
from jaxreg.neighbours import IndexOptions
from jaxreg.particle import (
    AbstractHardResampler,
    GivenParticles,
    NoDynamics,
    ParticleFilter,
    ParticleState,
)


N, P, D = 96, 24, 2
KEY = jax.random.key(0)
# Far from the origin and in a small unit; the last start is near the truth.
TRUTH = motion(5, D, shift=300.0)
TARGET = 100 * blob(N, D) + np.float32(500)
SOURCE = move(np.linalg.inv(TRUTH), TARGET)
NEAR = TRUTH @ motion(7, D, angle=0.05, shift=1.0)
STARTS = np.stack([motion(i, D, shift=300.0) for i in range(P - 1)] + [NEAR])


class _Shifted(AbstractHardResampler):
    """The ancestor of row i is row 5 i + 3."""

    threshold: Array | float = traced(1.0)

    def draw(self, key, weight, num):
        return ((5 * jnp.arange(len(weight)) + 3) % P).astype(jnp.int32)


METHOD = ParticleFilter(
    num_prior=P,
    num_particles=P,
    num_times=3,
    prior_steps=2,
    inner_steps=2,
    num_agreeing=0,
    batch_size=P,
    prior=GivenParticles(STARTS),
    resampler=_Shifted(),
    dynamics=NoDynamics(),
    tolerance=0.0,
)


@pytest.fixture(scope="module")
def filtering():
    return METHOD.iteration(SOURCE, TARGET, key=KEY)


@pytest.fixture(scope="module")
def history(filtering):
    """States at t = 0, 1, 2, 3, and what was told of the last three."""
    init, step = eqx.filter_jit(filtering.init), eqx.filter_jit(filtering.step)
    key_init, key_steps = jax.random.split(KEY)
    states, infos = [init(key_init)], []
    for t in range(1, METHOD.num_times + 1):
        assert not filtering.terminate(states[-1])
        state, info = step(jax.random.fold_in(key_steps, t), states[-1])
        states.append(state)
        infos.append(info)
    return states, infos


def test_the_search_takes_these_steps(filtering, history):
    search = eqx.filter_jit(lambda problem: METHOD.search(KEY, problem, None))
    found, end = search(filtering.problem), history[0][-1]
    np.testing.assert_allclose(
        found.particles.T_target_source, end.T_target_source, atol=1e-4
    )
    np.testing.assert_allclose(found.particles.log_weight, end.log_weight, atol=1e-2)
    assert int(found.num_steps) == 2 + 3 * 2
    assert found.trace is not None
    sizes = [info.effective_sample_size for info in history[1]]
    np.testing.assert_allclose(found.trace.effective_size[1:], sizes, rtol=1e-3)


def test_ancestors_are_the_rows_that_particles_were_copied_from(filtering, history):
    states, infos = history
    optimiser = LocalOptimiser(METHOD.residual, METHOD.kernel, METHOD.step)
    descend = jax.jit(
        jax.vmap(lambda T, w: optimiser.repeat(filtering.problem, T, w), (0, None))
    )
    for before, after, info in zip(states[:-1], states[1:], infos, strict=True):
        np.testing.assert_array_equal(info.ancestors, (5 * np.arange(P) + 3) % P)
        widths = jnp.full(2, filtering.width(after.num_steps))
        moved = descend(before.T_target_source[info.ancestors], widths)
        np.testing.assert_allclose(after.T_target_source, moved, atol=1e-4)
        error = np.abs(after.particles.motion_error).max()
        assert float(info.moved) == pytest.approx(error)


def test_evidence_is_the_mean_likelihood_of_each_time(history):
    states, infos = history
    total = float(states[0].log_evidence)
    for state, info in zip(states[1:], infos, strict=True):
        # All were resampled: weights before are equal, after they are likelihoods.
        energy = np.asarray(state.particles.energy, np.float64)
        log_weight = np.asarray(state.log_weight, np.float64)
        slope = np.polyfit(energy, log_weight, 1)[0]
        expected = np.log(np.mean(np.exp(slope * energy)))
        assert float(info.log_evidence) == pytest.approx(expected, abs=0.02)
        size = 1 / np.sum(np.exp(2 * log_weight))
        assert float(info.effective_sample_size) == pytest.approx(size, rel=1e-3)
        total += expected
    assert float(states[-1].log_evidence) == pytest.approx(total, abs=0.05)


def test_poses_leave_for_the_frames_of_the_input(filtering, history):
    frames = filtering.problem.frames
    first, last = history[0][0], history[0][-1]
    angle, shift = pose_error(frames.leave(last.particles.measurement), TRUTH)
    assert angle < 0.02
    assert shift < 2
    # Given starts, two small steps before, were in those frames, too.
    near = frames.leave(first.T_target_source[-1])
    assert pose_error(near, TRUTH)[0] < 0.1
    np.testing.assert_allclose(frames.enter(frames.leave(near)), near, atol=1e-2)


def test_a_filter_that_is_sure_terminates_at_once():
    method = jr.ParticleFilter(num_prior=64, num_particles=8, batch_size=8)
    filtering = method.iteration(SOURCE, TARGET, key=KEY)
    state = eqx.filter_jit(filtering.init)(KEY)
    assert isinstance(state, ParticleState)
    assert bool(filtering.terminate(state))
    assert state.settled is not None
    assert filtering.problem.frames is not None
    T = filtering.problem.frames.leave(state.settled.measurement)
    angle, shift = pose_error(T, TRUTH)
    assert angle < 0.05
    assert shift < 5
    with pytest.raises(ValueError, match="source: wanted shape"):
        method.iteration(SOURCE[None], TARGET[None], key=KEY)


def test_a_filter_takes_any_index_with_options():
    options = IndexOptions(jr.VoxelTable, resolution=64, candidates=4)
    method = jr.ParticleFilter(index=options)
    index = method.iteration(SOURCE, TARGET, key=KEY).problem.index
    assert isinstance(index, jr.VoxelTable)
    assert (index.resolution, index.candidates) == (64, 4)
    # Equal ones are one static field: nothing compiles again.
    again = IndexOptions(jr.VoxelTable, candidates=4, resolution=64)
    assert hash(again) == hash(options)
    assert again == options != IndexOptions(jr.VoxelTable)
    assert repr(again) == "IndexOptions(VoxelTable, candidates=4, resolution=64)"
    with pytest.raises(TypeError, match=r"VoxelTable has the options .* found 'cells'"):
        IndexOptions(jr.VoxelTable, cells=4)


def _settings(x: Array, resampler: particle.AbstractResampler) -> jr.ParticleFilter:
    """Numbers of the filter and of its parts, changed by factors of exp(x)."""
    factor = jnp.exp(x)
    return jr.ParticleFilter(
        num_prior=P,
        num_particles=P // 2,
        num_times=2,
        prior_steps=2,
        inner_steps=2,
        batch_size=P // 2,
        prior=particle.GaussianPrior(0.3 * factor[0], 0.5 * factor[1]),
        dynamics=particle.StochasticDynamics(factor[2]),
        energy=particle.BoundedEnergy(0.3 * factor[3]),
        resampler=resampler,
        sample_share=0.8 * factor[4],
        width_start=0.3 * factor[5],
        width_end=0.1 * factor[6],
    )


@pytest.mark.parametrize(
    "resampler", [particle.Soft(0.5), particle.Transport(0.1)], ids=repr
)
def test_the_evidence_of_a_scan_has_the_slopes_of_differences(resampler):
    with jax.enable_x64(True):
        noise = np.random.default_rng(0).normal(size=(N, D))
        source, target = SOURCE.astype(float), TARGET.astype(float)
        source = move(np.linalg.inv(motion(7, D, 0.3)) @ TRUTH, source) + 2 * noise

        def value(x):
            """By seven settings, a range bias, a point of either cloud."""
            off = source - source.mean(0)
            moving = source + 1e-3 * x[7] * np.linalg.norm(off, axis=1)[:, None] * off
            moving = moving.at[3, 0].add(x[8])
            fixed = jnp.asarray(target).at[5, 1].add(x[9])
            method = _settings(x[:7], resampler)
            filtering = method.iteration(moving, fixed, key=KEY)
            return filtering.scan(KEY)[0].log_evidence

        # One program has values and slopes: compiling is what this costs.
        along = jax.jit(jax.vmap(lambda x, e: jax.jvp(value, (x,), (e,)), (0, 0)))
        zero, every = jnp.zeros((10, 10)), jnp.eye(10)
        slopes = np.asarray(along(zero, every)[1])
        ends = [np.asarray(along(s * 1e-7 * every, every)[0]) for s in (1, -1)]
    differences = (ends[0] - ends[1]) / 2e-7
    assert np.all(np.abs(differences) > 1e-3)
    np.testing.assert_allclose(slopes, differences, rtol=1e-4)


def test_a_scan_takes_the_steps_of_the_search_and_is_followed_backwards(
    filtering, history
):
    @jax.jit
    def both(scale):
        def value(scale):
            method = eqx.tree_at(
                lambda m: m.width_start, filtering.method, scale * METHOD.width_start
            )
            state, info = particle.Filtering(method, filtering.problem).scan(KEY)
            return state.log_evidence, (state, info)

        slope, out = jax.grad(value, has_aux=True)(scale)
        return jax.jvp(lambda x: value(x)[0], (scale,), (1.0,))[1], slope, out

    forward, backward, (state, info) = both(1.0)
    states, infos = history
    np.testing.assert_allclose(
        state.T_target_source, states[-1].T_target_source, atol=1e-4
    )
    np.testing.assert_array_equal(info.ancestors, [x.ancestors for x in infos])
    assert float(state.log_evidence) == pytest.approx(
        float(states[-1].log_evidence), abs=1e-2
    )
    assert float(backward) == pytest.approx(float(forward), rel=1e-3)
