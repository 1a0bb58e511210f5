"""The last digits of a believed pose, from all points or four times as many."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import cast_floats, on_both
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import levelled, median_spacing
from jaxreg.geometry import lie
from jaxreg.local import (
    AbstractRest,
    Curvature,
    GaussNewton,
    LocalOptimiser,
    Rest,
    settled,
)
from jaxreg.matching import Problem, Symmetric, match
from jaxreg.neighbours import index_within
from jaxreg.particle.pair import Pair
from jaxreg.robust import AbstractKernel


# Of every fourth point first: while the kernel's width falls, and until a step is
# smaller, in radians and radii, than poses by a fourth and by all are apart (2e-4 to
# 5e-4 of four pairs of scanners).
_STRIDE, _FALLING, _COARSE_STEPS, _COARSE_TOLERANCE = 4, 4, 12, 1e-4
# Then of all, to so many roundings: in float32 2e-5, a quarter of the error on
# generated streets; in float64 whoever takes differences of answers needs more digits.
_STEPS, _ROUNDINGS = 8, 170
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
    fall = (end / width) ** (1 / _FALLING)

    few = problem.every(_STRIDE)
    T = settled(
        lambda T, number: optimiser(few, T, jnp.maximum(width * fall**number, end)),
        T_target_source,
        least=_FALLING,
        most=_COARSE_STEPS,
        tolerance=_COARSE_TOLERANCE,
    )
    T = settled(
        lambda T, _: optimiser(problem, T, end),
        T,
        least=1,
        most=_STEPS,
        tolerance=_ROUNDINGS * float(jnp.finfo(T.dtype).eps),
    )
    T = lie.straightened(T)
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
    source, target = levelled(pair.source.finest, pair.target.finest)
    spacing = on_both(lambda c: median_spacing(c.points, c.mask), source, target)
    index = index_within(target.points, target.mask, spacing[1])
    problem = Problem.of(source, target, index)
    optimiser = LocalOptimiser(Symmetric(), kernel, GaussNewton())
    end = jnp.minimum(_WIDTH * jnp.maximum(*spacing), width)
    return cast_floats(optimiser, width.dtype), problem, end
