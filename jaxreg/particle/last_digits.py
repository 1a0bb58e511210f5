"""The last digits of a believed pose, from all points or four times as many."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import cast_floats
from jaxreg._core.typing import Motion, Scalar
from jaxreg.geometry import lie
from jaxreg.local import (
    AbstractRest,
    Curvature,
    GaussNewton,
    LocalOptimiser,
    Rest,
)
from jaxreg.matching import Problem, Symmetric, match
from jaxreg.particle.pair import Pair
from jaxreg.robust import AbstractKernel


_STEPS = 12
# The final width in sample spacings: moving objects and strays are farther off.
_WIDTH = 0.5


def last_digits(
    pair: Pair, kernel: AbstractKernel, T_target_source: Motion, width: Scalar
) -> tuple[Motion, Curvature]:
    """The pose after a few steps on the finest clouds, and the curvature there.

    Points are thinned to cells, so that surfaces count by their area and not by how
    densely they were sampled. The symmetric objective has no metric to be chosen: on
    eleven lidar pairs, Bunny and Dragon it is as accurate as the better one of
    `PointToPlane` and `PlaneToPlane`, of which each is worse by a third somewhere.

    Args:
        pair: what was searched.
        kernel: of the residuals.
        T_target_source: the pose.
        width: of the kernel in the first step.
    """
    optimiser, problem, end = _last(pair, kernel, width)
    fall = jnp.geomspace(width, end, _STEPS // 3, dtype=width.dtype)
    widths = jnp.concatenate([fall, jnp.full(_STEPS - len(fall), end)])
    T = lie.orthonormalise(optimiser.repeat(problem, T_target_source, widths))
    found = match(problem, T)
    return T, Curvature.of(optimiser, problem, T, found, end)


class LastRest(AbstractRest):
    """Where `last_digits` of a pair came to rest; for `at_rest`."""

    pair: Pair
    kernel: AbstractKernel
    width: Scalar
    T: Motion
    scale: Scalar | None = None

    def ready(self) -> Rest:
        """With the finest clouds and their indexes."""
        optimiser, problem, width = _last(self.pair, self.kernel, self.width)
        rest = Rest(optimiser=optimiser, problem=problem, width=width, T=self.T)
        return rest.ready()

    def pulls(self, x: Float[Array, " k"]) -> Float[Array, " k"]:
        """Those of `ready`."""
        return self.ready().pulls(x)

    def solve(self, x: Float[Array, " k"], b: Float[Array, " k"]) -> Float[Array, " k"]:
        """That of `ready`."""
        return self.ready().solve(x, b)


def _last(
    pair: Pair, kernel: AbstractKernel, width: Scalar
) -> tuple[LocalOptimiser, Problem, Scalar]:
    """What the last steps are by, on what, and how wide the kernel ends."""
    fine = pair.fine
    optimiser = LocalOptimiser(Symmetric(), kernel, GaussNewton())
    end = jnp.minimum(_WIDTH * fine.spacing, width)
    return cast_floats(optimiser, width.dtype), fine.problem, end
