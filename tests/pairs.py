"""Pairs of clouds, and methods that several tests of `register` share."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import blob, motion, move

import jaxreg as jr
from jaxreg.cloud import PointCloud
from jaxreg.registrar import AbstractRegistrar, Modes, RegistrationSolution
from jaxreg.robust import L2


N, M = 500, 800
FILTER = jr.ParticleFilter(
    num_prior=256, num_particles=32, num_times=4, num_points=128, num_modes=2
)
BESL_MCKAY = jr.ICP(jr.PointToPoint(), L2(), jr.ClosedForm(), max_steps=200)


def pair(d: int, seed: int = 0, **kwargs):
    T = motion(seed, d, **kwargs)
    return move(np.linalg.inv(T), blob(N, d, seed=1)), blob(M, d, seed=2), T


class Centroids(AbstractRegistrar):
    """Puts centroid on centroid: compiles in no time."""

    def in_frames(self, frames):
        return self

    def prepare(self, points, mask):
        return PointCloud(points, jnp.zeros_like(points), mask)

    def solve(self, source, target, init, key=None):
        zero, d = jnp.zeros((), source.points.dtype), source.points.shape[1]
        H = jnp.zeros((3 * d - 3, 3 * d - 3), zero.dtype)
        count = jnp.zeros((), jnp.int32)
        T = jnp.eye(d + 1, dtype=zero.dtype)
        if key is not None:
            jax.random.split(key)  # a key that methods can use
        return RegistrationSolution(
            T_target_source=T,
            status=count,
            fitness=zero,
            inlier_rmse=zero,
            num_inliers=jnp.sum(source.mask, dtype=jnp.int32),
            overlap=zero,
            log_evidence=zero,
            num_steps=count,
            H=H,
            b=H[0],
            error=zero,
            covariance=H,
            modes=Modes.alone(T, zero, zero, zero, zero, H),
        )
