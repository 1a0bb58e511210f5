"""One pair: cleaned, centred and scaled, prepared, solved, and back."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.status import Status
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import PointCloud, centroid, rms_radius
from jaxreg.geometry import lie
from jaxreg.local import (
    AbstractRegistrar,
    Curvature,
    Modes,
    RegistrationSolution,
    tangent_unit,
)


def register_pair(
    method: AbstractRegistrar,
    pair: tuple[Array, ...],
    init: Array | None,
    key: Array | None,
) -> RegistrationSolution:
    """Of sources, targets and their masks; traced."""
    source, target, source_mask, target_mask = pair
    source, source_mask = _finite(source, source_mask)
    target, target_mask = _finite(target, target_mask)
    enough = _distinct_enough(source, source_mask) & _distinct_enough(
        target, target_mask
    )
    frames = _Frames.of(source, source_mask, target, target_mask)
    method = method.in_unit(frames.radius).in_frames(frames.enter, source.shape[1])
    clouds = _prepared(
        method,
        ((source - frames.source_mean) / frames.radius, source_mask),
        ((target - frames.target_mean) / frames.radius, target_mask),
    )
    init = None if init is None else frames.enter(init)
    return frames.leave(method.solve(*clouds, init, key), enough)


class _Frames(eqx.Module):
    """Frames of the input, and those of `solve` about the centroids of the clouds.

    Attributes:
        source_mean, target_mean: the centroids.
        radius: the unit in the latter.
    """

    source_mean: Float[Array, " d"]
    target_mean: Float[Array, " d"]
    radius: Scalar

    @classmethod
    def of(
        cls, source: Array, source_mask: Array, target: Array, target_mask: Array
    ) -> "_Frames":
        radius = rms_radius(target, target_mask)
        radius = jnp.where(radius > 0, radius, 1)
        means = centroid(source, source_mask), centroid(target, target_mask)
        return lax.stop_gradient(cls(*means, radius))

    def enter(self, T: Motion) -> Motion:
        """A pose in the frames of `solve`."""
        R = lie.rotation(T).astype(self.radius.dtype)
        t = lie.translation(T).astype(self.radius.dtype)
        shift = R @ self.source_mean + t - self.target_mean
        return lie.compose(R, shift / self.radius)

    def leave(self, solution: RegistrationSolution, enough: Array):
        """A solution in the frames and unit of the input; none if not `enough`."""

        def back(T: Motion) -> Motion:
            R = lie.rotation(T)
            t = self.radius * lie.translation(T) + self.target_mean
            T = lie.compose(R, t - R @ self.source_mean)
            return jnp.where(enough, T, jnp.eye(len(T), dtype=T.dtype))

        status = jnp.where(enough, solution.status, Status.TOO_FEW_POINTS)
        curvature = Curvature(
            solution.H, solution.b, solution.error, solution.covariance
        ).scaled(self.radius)
        modes = solution.modes
        unit = tangent_unit(self.radius, modes.covariance.shape[-1])
        return RegistrationSolution(
            T_target_source=back(solution.T_target_source),
            status=status.astype(jnp.int32),
            fitness=jnp.where(enough, solution.fitness, 0),
            inlier_rmse=self.radius * solution.inlier_rmse,
            num_inliers=jnp.where(enough, solution.num_inliers, 0),
            overlap=jnp.where(enough, solution.overlap, 0),
            num_steps=solution.num_steps,
            H=curvature.H,
            b=curvature.b,
            error=curvature.error,
            covariance=curvature.covariance,
            modes=Modes(
                jax.vmap(back)(modes.T_target_source),
                modes.weight,
                modes.fitness,
                modes.covariance * jnp.outer(unit, unit),
            ),
        )


def _prepared(
    method: AbstractRegistrar, source: tuple[Array, Array], target: tuple[Array, Array]
) -> tuple[PointCloud, PointCloud]:
    """Both clouds as the method wants them."""
    if source[0].shape != target[0].shape:
        return method.prepare(*source), method.prepare(*target)
    # Clouds of one size share a loop, which compiles the preparation once.
    both = jax.tree.map(lambda *x: jnp.stack(x), source, target)
    prepared = lax.map(lambda cloud: method.prepare(*cloud), both)
    source_cloud, target_cloud = (
        jax.tree.map(lambda x, at=at: x[at], prepared) for at in (0, 1)
    )
    return source_cloud, target_cloud


def _finite(points: Array, mask: Array) -> tuple[Array, Array]:
    """Masks rows that are not finite; masked rows become a valid row or zero."""
    mask = mask & jnp.all(jnp.isfinite(points), axis=1)
    return jnp.where(mask[:, None], points, 0), mask


def _distinct_enough(points: Array, mask: Array) -> Array:
    """Whether at least d + 1 distinct points are valid."""
    new, num = mask, jnp.zeros((), jnp.int32)
    for _ in range(points.shape[1] + 1):
        num = num + jnp.any(new)
        new = new & jnp.any(points != points[jnp.argmax(new)], axis=1)
    return num > points.shape[1]
