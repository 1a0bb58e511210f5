"""`reconstruct` by any method of `register`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move, pose_error
from protocols import NUM_POINTS

import jaxreg as jr
from jaxreg.cloud import PointCloud, estimate_normals
from jaxreg.geometry import lie
from jaxreg.geometry.kabsch import kabsch
from jaxreg.registrar import AbstractRegistrar, Modes, RegistrationSolution


KEY = jax.random.key(0)
TRUTH = np.stack([motion(i, 2, angle=2.0, shift=3.0) for i in range(3)])
# Each scan is of the same points in its own frame, in a unit of its own.
SCANS = np.stack([40 * move(np.linalg.inv(T), blob(NUM_POINTS, 2)) for T in TRUTH])


class _RowByRow(AbstractRegistrar):
    """A registrar of somebody else: row k of the source is row k of the target."""

    def in_frames(self, frames):
        return self

    def prepare(self, points, mask):
        return PointCloud(points, estimate_normals(points, mask), mask)

    def solve(self, source, target, init, key):
        T = kabsch(source.points, target.points, source.mask.astype(jnp.float32))
        one, zero = jnp.ones(()), jnp.zeros(())
        none = jnp.zeros((), jnp.int32)
        return RegistrationSolution(
            T_target_source=T,
            status=none,
            fitness=one,
            inlier_rmse=zero,
            num_inliers=none,
            overlap=one,
            log_evidence=9 * one,
            num_steps=none,
            H=jnp.eye(3),
            b=jnp.zeros(3),
            error=zero,
            covariance=jnp.eye(3),
            modes=Modes.alone(T, one, one, zero, 9 * one, jnp.eye(3)),
        )


METHODS = {
    "of somebody else": _RowByRow(),
    "MultiStart": jr.MultiStart(
        num_starts=32, num_steps=10, num_modes=1, batch_size=16, index=jr.BruteForce
    ),
}


@pytest.mark.parametrize("name", ["of somebody else", "MultiStart"])
def test_any_registrar_reconstructs(name):
    sol = jr.reconstruct(SCANS, key=KEY, method=METHODS[name])
    assert np.all(sol.placed)
    assert sol.motions.num_modes == 1
    for T, T_true in zip(sol.T_world_i, TRUTH, strict=True):
        T_true = np.linalg.inv(TRUTH[0]) @ T_true
        angle, _ = pose_error(T, T_true)
        assert angle < 0.02
        np.testing.assert_allclose(lie.translation(T), 40 * T_true[:2, 2], atol=1)
