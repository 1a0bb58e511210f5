"""Priors: moments of many draws, and frames of given particles."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion, pose_error

from jaxreg.geometry import lie
from jaxreg.local import decoupled_error
from jaxreg.particle import GaussianPrior, GivenParticles, PartialPose, UniformPrior
from jaxreg.registrar import Frames


NUM = 4000
KEY = jax.random.key(0)
FRAMES = Frames(jnp.array([1.0, 2, 3]), jnp.array([0, -5.0, 0]), jnp.asarray(2.0))


@eqx.filter_jit
def _draw(prior, num, d, init=None):
    return prior.draw(KEY, num, d, init, jnp.float32)


@jax.jit
def _tangents(T_drawn, T):
    return jax.vmap(decoupled_error, (0, None))(T_drawn, T)


def test_gaussian_prior_keeps_the_guess_and_spreads_around_it():
    T = jnp.asarray(motion(2, 3), jnp.float32)
    drawn = _draw(GaussianPrior(0.2, 0.1), NUM, 3, T)
    assert pose_error(drawn[0], T)[0] < 1e-3
    tangent = np.asarray(_tangents(drawn, T))
    np.testing.assert_allclose(tangent.std(0), [0.2] * 3 + [0.1] * 3, rtol=0.1)
    alone = _draw(GaussianPrior(0.2, 0.1), 8, 3)
    np.testing.assert_allclose(alone[0], np.eye(4), atol=1e-6)


@pytest.mark.parametrize("d", [2, 3])
def test_uniform_prior_has_no_preferred_rotation(d):
    drawn = np.asarray(_draw(UniformPrior(0.4), NUM, d))
    R, t = drawn[:, :d, :d], drawn[:, :d, d]
    np.testing.assert_allclose(R.mean(0), 0, atol=0.05)
    np.testing.assert_allclose(
        np.einsum("nij,nkj->nik", R, R) - np.eye(d), 0, atol=1e-5
    )
    # E[R_ij^2] = 1 / d over all of SO(d).
    np.testing.assert_allclose((R**2).mean(0), 1 / d, atol=0.03)
    np.testing.assert_allclose(t.std(0), 0.4, rtol=0.05)
    init = np.eye(d + 1, dtype=np.float32)
    init[0, d] = 5
    around = np.asarray(_draw(UniformPrior(0.4), NUM, d, jnp.asarray(init)))
    assert float(around[:, 0, d].mean()) == pytest.approx(5, abs=0.05)


def test_given_particles_are_taken_as_they_are_and_follow_the_frames():
    T = np.stack([motion(i, 3) for i in range(5)])
    prior = GivenParticles(T)
    np.testing.assert_allclose(prior.draw(KEY, 5, 3, None, jnp.float32), T, atol=1e-6)
    source_mean, target_mean = jnp.asarray([1.0, 0, 2]), jnp.asarray([0, 3.0, 0])
    frames = Frames(source_mean, target_mean, jnp.asarray(2.0))
    moved = np.asarray(prior.in_frames(frames).T_target_source)
    image = (T[:, :3, :3] @ source_mean + T[:, :3, 3] - target_mean) / 2
    np.testing.assert_allclose(moved[:, :3, 3], image, atol=1e-5)
    np.testing.assert_allclose(moved[:, :3, :3], T[:, :3, :3], atol=1e-6)
    back = jax.vmap(frames.leave)(jnp.asarray(moved))
    np.testing.assert_allclose(back, T, atol=1e-5)


def test_level_scanners_turn_about_the_vertical_and_hardly_tilt():
    prior = PartialPose(up=(0, 3, 4), tilt=0.05)
    R = np.asarray(_draw(prior, NUM, 3))[:, :3, :3]
    up = np.array([0, 0.6, 0.8])
    tilt = np.linalg.norm(R @ up - up, axis=1)
    # The root mean square over two horizontal axes.
    assert np.sqrt(np.mean(tilt**2)) == pytest.approx(0.05 * np.sqrt(2), rel=0.05)
    turned = R @ [1.0, 0, 0]
    np.testing.assert_allclose(turned.mean(0), 0, atol=0.05)
    np.testing.assert_allclose((turned[:, 0] ** 2).mean(), 0.5, atol=0.03)


SCANNERS = {"source_scanner": (0.5, 0, 1), "target_scanner": (-2, 1, 0)}


def _offset(T):
    """From the target's scanner to the source's."""
    T = np.asarray(T)
    return T[..., :3, :3] @ [0.5, 0, 1] + T[..., :3, 3] - [-2, 1, 0]


def test_positions_are_those_of_the_scanners():
    known = np.array([3.0, 4, 2])
    prior = PartialPose(position=known, deviation=0.1, **SCANNERS)
    for drawn in (
        _draw(prior, NUM, 3),
        jax.jit(jax.vmap(FRAMES.leave))(_draw(prior.in_frames(FRAMES), NUM, 3)),
    ):
        found = _offset(drawn)
        np.testing.assert_allclose(found.mean(0), known, atol=0.01)
        np.testing.assert_allclose(found.std(0), 0.1, rtol=0.05)


def test_positions_of_unknown_heading_have_a_length_and_a_height():
    known = {"position": (3.0, 4, 2), "deviation": 0.1, "oriented": False}
    anyhow = _draw(PartialPose(**known, **SCANNERS), NUM, 3)
    found = _offset(anyhow)
    length = np.sqrt(29.0)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1).mean(), length, rtol=0.01)
    np.testing.assert_allclose(found.mean(0), 0, atol=0.2)
    level = PartialPose(up=(0, 0, 1), **known, **SCANNERS)
    found = _offset(_draw(level, NUM, 3))
    flat = np.linalg.norm(found[:, :2], axis=1)
    # A tilt of 0.035 moves the height by that share of the length, too.
    np.testing.assert_allclose([flat.mean(), found[:, 2].mean()], [5, 2], atol=0.03)
    np.testing.assert_allclose(found[:, 2].std(), np.hypot(0.1, 0.035 * 5), rtol=0.1)


def test_what_is_known_is_held_against_poses_that_differ():
    T = jnp.asarray(motion(4, 3), jnp.float32)
    offset = _offset(T)
    prior = PartialPose(position=offset, deviation=0.1, **SCANNERS)
    assert float(prior.log_density(T)) == 0
    away = T.at[:3, 3].add(jnp.array([0.3, 0, 0.4]))
    assert float(prior.log_density(away)) == pytest.approx((3 - 25) / 2, rel=1e-3)
    lengths = PartialPose(position=offset[::-1], oriented=False, **SCANNERS)
    assert float(lengths.log_density(T)) == 0
    up = np.array([0, 0.6, 0.8])
    tilted = jnp.eye(4).at[:3, :3].set(lie.rotation_exp(jnp.array([0.15, 0, 0])))
    level = PartialPose(up=up, tilt=0.05)
    assert float(level.log_density(tilted)) == pytest.approx((2 - 9) / 2, rel=1e-3)
    about = jnp.eye(4).at[:3, :3].set(lie.rotation_exp(2 * jnp.asarray(up)))
    assert float(level.log_density(about)) == 0


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: UniformPrior(-1.0), ValueError, "translation_spread.*-1"),
        (lambda: GaussianPrior(0.1, -0.2), ValueError, "rotation_spread.*-0.2"),
        (lambda: GaussianPrior(0.0, 0.0), ValueError, "both 0"),
        (lambda: GaussianPrior(float("nan"), 1.0), ValueError, "nan"),
        (PartialPose, ValueError, "wanted up, position or both"),
        (lambda: PartialPose(up=(0, 0, 0)), ValueError, "up: wanted a direction"),
        (lambda: PartialPose(position=(0, np.nan)), ValueError, "position: .*finite"),
        (lambda: PartialPose(up=(0, 0, 1), tilt=0.0), ValueError, "tilt: .*positive"),
        (
            lambda: PartialPose(position=(0, 0)).in_frames(FRAMES),
            ValueError,
            r"position: wanted shape \(3,\)",
        ),
        (lambda: GivenParticles(np.eye(4)), ValueError, r"\(4, 4\)"),
        (lambda: GivenParticles([["a"]]), TypeError, "numbers"),
        (
            lambda: GivenParticles(np.eye(3)[None]).draw(KEY, 1, 3, None, float),
            ValueError,
            r"\(p, 4, 4\).*dimension 3",
        ),
        (
            lambda: GivenParticles(np.eye(4)[None]).draw(KEY, 7, 3, None, float),
            ValueError,
            "7 poses, found 1",
        ),
    ],
)
def test_spreads_and_poses_that_make_no_sense_are_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_one_spread_may_be_zero():
    T = np.asarray(_draw(GaussianPrior(0.3, 0.0), 50, 2))
    np.testing.assert_allclose(T[:, :2, :2] - np.eye(2), 0, atol=1e-6)
    assert float(T[:, :2, 2].std()) > 0.2
