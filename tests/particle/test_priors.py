"""Priors: moments of many draws, and frames of given particles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion, pose_error

from jaxreg.local import decoupled_error
from jaxreg.particle import GaussianPrior, GivenParticles, UniformPrior
from jaxreg.registrar import Frames


NUM = 4000
KEY = jax.random.key(0)


def test_gaussian_prior_keeps_the_guess_and_spreads_around_it():
    T = jnp.asarray(motion(2, 3), jnp.float32)
    drawn = GaussianPrior(0.2, 0.1).draw(KEY, NUM, 3, T, jnp.float32)
    assert pose_error(drawn[0], T)[0] < 1e-3
    tangent = np.asarray(jax.vmap(decoupled_error, (0, None))(drawn, T))
    np.testing.assert_allclose(tangent.std(0), [0.2] * 3 + [0.1] * 3, rtol=0.1)
    alone = GaussianPrior(0.2, 0.1).draw(KEY, 8, 3, None, jnp.float32)
    np.testing.assert_allclose(alone[0], np.eye(4), atol=1e-6)


@pytest.mark.parametrize("d", [2, 3])
def test_uniform_prior_has_no_preferred_rotation(d):
    drawn = np.asarray(UniformPrior(0.4).draw(KEY, NUM, d, None, jnp.float32))
    R, t = drawn[:, :d, :d], drawn[:, :d, d]
    np.testing.assert_allclose(R.mean(0), 0, atol=0.05)
    np.testing.assert_allclose(
        np.einsum("nij,nkj->nik", R, R) - np.eye(d), 0, atol=1e-5
    )
    # E[R_ij^2] = 1 / d over all of SO(d).
    np.testing.assert_allclose((R**2).mean(0), 1 / d, atol=0.03)
    np.testing.assert_allclose(t.std(0), 0.4, rtol=0.05)
    init = jnp.eye(d + 1).at[0, d].set(5)
    around = UniformPrior(0.4).draw(KEY, NUM, d, init, jnp.float32)
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


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: UniformPrior(-1.0), ValueError, "translation_spread.*-1"),
        (lambda: GaussianPrior(0.1, -0.2), ValueError, "rotation_spread.*-0.2"),
        (lambda: GaussianPrior(0.0, 0.0), ValueError, "both 0"),
        (lambda: GaussianPrior(float("nan"), 1.0), ValueError, "nan"),
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
    T = GaussianPrior(0.3, 0.0).draw(KEY, 50, 2, None, jnp.float32)
    np.testing.assert_allclose(T[:, :2, :2] - np.eye(2), 0, atol=1e-6)
    assert float(T[:, :2, 2].std()) > 0.2
