"""Resampling: numbers of copies, weights after, and when to resample."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion

from jaxreg.particle import (
    Multinomial,
    Particles,
    Residual,
    Soft,
    Stratified,
    Systematic,
    Transport,
)


P, NUM, DRAWS = 12, 8, 6000
ALL = [Systematic, Stratified, Multinomial, Residual]
# Two rows without weight: rows out of use.
WEIGHT = np.array([0.3, 0.2, 0.15, 0.1, 0.08, 0.07, 0.05, 0.03, 0.015, 0.005, 0, 0])


@functools.cache
def _copies(kind) -> np.ndarray:
    """`(draws, p)` copies of each row among the first NUM of a draw."""
    keys = jax.random.split(jax.random.key(0), DRAWS)
    weight = jnp.asarray(WEIGHT, jnp.float32)
    rows = jax.jit(jax.vmap(lambda k: kind().draw(k, weight, jnp.asarray(NUM))))(keys)
    return np.stack([np.sum(np.asarray(rows)[:, :NUM] == i, 1) for i in range(P)], 1)


@pytest.mark.parametrize("kind", ALL)
def test_copies_are_unbiased(kind):
    copies = _copies(kind)
    np.testing.assert_array_equal(copies.sum(1), NUM)
    error = np.sqrt(NUM * WEIGHT * (1 - WEIGHT) / DRAWS)
    assert np.all(np.abs(copies.mean(0) - NUM * WEIGHT) <= 5 * error + 1e-6)
    assert np.all(copies[:, WEIGHT == 0] == 0)


def test_variances_of_the_copies_are_those_of_the_definitions():
    share = NUM * WEIGHT
    whole = np.floor(share)
    part, left = share - whole, NUM - whole.sum()
    expected = {
        # Between floor and ceiling with the mean right: a Bernoulli number.
        Systematic: part * (1 - part),
        Multinomial: share * (1 - WEIGHT),
        Residual: part * (1 - part / left),
    }
    for kind, variance in expected.items():
        np.testing.assert_allclose(_copies(kind).var(0), variance, atol=0.06)
    stratified = _copies(Stratified)
    assert np.all(np.abs(stratified - share) < 2)
    assert np.all(_copies(Residual) >= whole)
    assert stratified.var(0).sum() < _copies(Multinomial).var(0).sum()


def _particles(weight: np.ndarray, seed: int = 0) -> Particles:
    """Random poses in space, with motion errors and normalised weights."""
    p = len(weight)
    T = np.stack([motion(seed + i, 3, angle=0.5, shift=1.0) for i in range(p)])
    error = np.random.default_rng(seed).normal(size=(p, 6))
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight / np.sum(weight))
    return Particles(*map(jnp.asarray, (T, error, np.ones(p), log_weight)))


@pytest.mark.parametrize("kind", ALL)
def test_resampling_takes_place_below_the_threshold_only(kind):
    particles = _particles(WEIGHT)
    share = 1 / np.sum(WEIGHT**2) / 10
    place = np.arange(P)
    for threshold, may_keep, kept in [
        (share - 0.01, True, True),
        (share + 0.01, True, False),
        (share - 0.01, False, False),
        (0.0, True, True),
        (1.0, True, False),
    ]:
        after, rows = kind(threshold)(
            jax.random.key(1), particles, 10, jnp.asarray(may_keep)
        )
        assert np.array_equal(rows[:10], place[:10]) == kept
        equal = np.where(place < 10, -np.log(10), -np.inf)
        expected = particles.log_weight if kept else equal
        np.testing.assert_allclose(after.log_weight, expected, rtol=1e-6)
        np.testing.assert_array_equal(
            after.T_target_source[:10], particles.T_target_source[rows[:10]]
        )
    # One or more is always, also where all weights are equal.
    particles = _particles(place < 10)
    after, _ = kind(1.0)(jax.random.key(1), particles, 10, True)
    np.testing.assert_allclose(after.log_weight, particles.log_weight, rtol=1e-6)


def test_soft_copies_weigh_what_their_share_was_short_of():
    with jax.enable_x64(True):
        particles = _particles(WEIGHT)
        share = 0.25 * WEIGHT + 0.75 * (WEIGHT > 0) / 10
        keys = jax.random.split(jax.random.key(0), 2000)
        soft = Soft(0.25, draws=Multinomial())
        draw = jax.jit(jax.vmap(lambda key: soft.replace(key, particles, NUM)))
        after, rows = jax.device_get(draw(keys))
        rows = rows[:, :NUM]
        copies = np.bincount(rows.ravel(), minlength=P) / rows.size
        np.testing.assert_allclose(copies, share, atol=5 * 0.5 / rows.size**0.5)
        wanted = (WEIGHT / np.where(share > 0, share, 1))[rows]
        wanted /= wanted.sum(1, keepdims=True)
        np.testing.assert_allclose(np.exp(after.log_weight)[:, :NUM], wanted)
        # With no share that is alike, as its draws do.
        hard = Soft(1.0).replace(keys[0], particles, NUM)
        plain = Systematic().replace(keys[0], particles, NUM)
        np.testing.assert_array_equal(hard[1][:NUM], plain[1][:NUM])
        np.testing.assert_allclose(hard[0].log_weight, plain[0].log_weight, rtol=1e-12)


def _sinkhorn(cost: np.ndarray, weight: np.ndarray, epsilon: float) -> np.ndarray:
    """The plan by thousands of steps of scaling rows and columns."""
    K = weight[:, None] * np.exp(-cost / epsilon)
    u, v = weight, np.ones(cost.shape[1])
    for _ in range(5000):
        u = weight / (K @ v)
        v = 1 / len(v) / (K.T @ u)
    return u[:, None] * K * v


def test_transport_is_that_of_an_oracle_and_means_are_those_of_least_cost():
    weight = np.append(np.random.default_rng(1).uniform(0.2, 1, 9), [0, 0])
    weight /= weight.sum()
    with jax.enable_x64(True):
        particles = _particles(weight)
        replace = eqx.filter_jit(Transport(0.3, num_steps=400).replace)
        after, rows = replace(jax.random.key(0), particles, 6)
    T = np.asarray(particles.T_target_source)[:9]
    places = T[np.arange(6) * 9 // 6]
    gap = T[:, None] - places
    cost = (
        np.sum(gap[..., :3, 3] ** 2, -1) + np.sum(gap[..., :3, :3] ** 2, (-1, -2)) / 2
    )
    plan = _sinkhorn(cost, weight[:9], 0.3 * weight[:9] @ cost.mean(1))
    share = plan / plan.sum(0)
    np.testing.assert_array_equal(rows[:6], share.argmax(0))
    np.testing.assert_allclose(
        after.T_target_source[:6, :3, 3], share.T @ T[:, :3, 3], rtol=1e-6
    )
    np.testing.assert_allclose(
        after.motion_error[:6], share.T @ np.asarray(particles.motion_error)[:9]
    )
    U, _, Vt = np.linalg.svd(np.einsum("ij,iab->jab", share, T[:, :3, :3]))
    flip = np.ones((6, 3))
    flip[:, 2] = np.linalg.det(U @ Vt)
    np.testing.assert_allclose(
        after.T_target_source[:6, :3, :3], (U * flip[:, None]) @ Vt, atol=1e-6
    )


def test_transport_of_equal_weights_with_little_entropy_leaves_all_where_they_are():
    with jax.enable_x64(True):
        particles = _particles(np.ones(8))
        replace = eqx.filter_jit(Transport(1e-3).replace)
        after, rows = replace(jax.random.key(0), particles, 8)
    np.testing.assert_array_equal(rows, np.arange(8))
    np.testing.assert_allclose(
        after.T_target_source, particles.T_target_source, atol=1e-6
    )


@pytest.mark.parametrize("resampler", [Soft(0.3), Transport(0.2)], ids=repr)
def test_gradients_are_those_of_differences(resampler):
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        particles = _particles(WEIGHT)
        change = jnp.asarray(rng.normal(size=P))
        to_read = jnp.asarray(rng.normal(size=(NUM, 4, 4)))

        def value(h):
            level = particles.log_weight + h * change
            level = level - jax.nn.logsumexp(level)
            moved = particles.T_target_source.at[:, 0, 3].add(h * change)
            before = eqx.tree_at(
                lambda p: (p.T_target_source, p.log_weight), particles, (moved, level)
            )
            after, _ = resampler.replace(jax.random.key(0), before, NUM)
            weight = jnp.exp(after.log_weight[:NUM])
            return jnp.einsum("p,pij,pij", weight, after.T_target_source[:NUM], to_read)

        both = jax.jit(jax.value_and_grad(value))
        ends = [float(both(h)[0]) for h in (1e-5, -1e-5)]
        assert float(both(0.0)[1]) == pytest.approx((ends[0] - ends[1]) / 2e-5, 1e-7)
        forward = jax.jit(jax.jacfwd(value))(0.0)
        assert float(both(0.0)[1]) == pytest.approx(float(forward), 1e-10)


def test_a_negative_threshold_is_refused():
    with pytest.raises(ValueError, match=r"Residual.*threshold.*-0\.5"):
        Residual(-0.5)


def test_shares_and_entropies_that_are_none_are_refused():
    with pytest.raises(ValueError, match=r"Soft.*alpha.*0"):
        Soft(0.0)
    with pytest.raises(ValueError, match=r"Transport.*epsilon.*0"):
        Transport(0.0)
    with pytest.raises(TypeError, match="draws"):
        Soft(draws=Transport())  # pyright: ignore[reportArgumentType]
