"""One pair: cleaned, centred and scaled, prepared, solved, and back."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxreg._core.arrays import on_both
from jaxreg._core.status import Status
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import centroid, rms_radius
from jaxreg.local import Curvature, tangent_unit
from jaxreg.registrar import AbstractRegistrar, Frames, Modes, RegistrationSolution


# Clouds are padded to one size where the larger is at most so many times as large.
_MAX_PADDING = 2


def register_pair(
    method: AbstractRegistrar,
    pair: tuple[Array, ...],
    init: Array | None,
    key: Array | None,
) -> RegistrationSolution:
    """Of sources, targets and their masks; traced."""
    source, target, *masks = pair
    sides = on_both(_Side.of, *_levelled((source, masks[0]), (target, masks[1])))
    frames = Frames(sides[0].mean, sides[1].mean, sides[1].radius)
    method = method.in_frames(frames)
    source_cloud, target_cloud = on_both(
        lambda cloud: method.prepare(*cloud),
        *(((side.points - side.mean) / frames.radius, side.mask) for side in sides),
    )
    init = None if init is None else frames.enter(init)
    solution = method.solve(
        source_cloud.first(len(source)), target_cloud.first(len(target)), init, key
    )
    return _leave(frames, solution, sides[0].enough & sides[1].enough)


class _Side(eqx.Module):
    """A cloud as given, cleaned.

    Attributes:
        points, mask: zero and masked where not finite.
        mean: the centroid.
        radius: the root mean square distance from it; one where that is zero.
        enough: whether at least d + 1 distinct points are valid.
    """

    points: Float[Array, "n d"]
    mask: Bool[Array, " n"]
    mean: Float[Array, " d"]
    radius: Scalar
    enough: Bool[Array, ""]

    @classmethod
    def of(cls, cloud: tuple[Array, Array]) -> "_Side":
        points, mask = cloud
        mask = mask & jnp.all(jnp.isfinite(points), axis=1)
        points = jnp.where(mask[:, None], points, 0)
        frozen = lax.stop_gradient(points)
        radius = rms_radius(frozen, mask)
        radius = jnp.where(radius > 0, radius, 1)
        enough = _distinct_enough(frozen, mask)
        return cls(points, mask, centroid(frozen, mask), radius, enough)


def _leave(
    frames: Frames, solution: RegistrationSolution, enough: Array
) -> RegistrationSolution:
    """A solution in the frames and unit of the input; none if not `enough`."""

    def back(T: Motion) -> Motion:
        T = frames.leave(T)
        return jnp.where(enough, T, jnp.eye(len(T), dtype=T.dtype))

    status = jnp.where(enough, solution.status, Status.TOO_FEW_POINTS)
    curvature = Curvature(
        solution.H, solution.b, solution.error, solution.covariance
    ).scaled(frames.radius)
    modes = solution.modes
    trace = solution.trace
    if trace is not None:
        width = frames.radius * trace.kernel_width
        trace = dataclasses.replace(trace, kernel_width=width)
    unit = tangent_unit(frames.radius, modes.covariance.shape[-1])
    return RegistrationSolution(
        T_target_source=back(solution.T_target_source),
        status=status.astype(jnp.int32),
        fitness=jnp.where(enough, solution.fitness, 0),
        inlier_rmse=frames.radius * solution.inlier_rmse,
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
            modes.overlap,
            frames.radius * modes.inlier_rmse,
            modes.covariance * jnp.outer(unit, unit),
        ),
        trace=trace,
    )


def _levelled(
    a: tuple[Array, Array], b: tuple[Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Points and masks with rows added to the fewer, if they are not many.

    Clouds of one size share what is compiled for them.
    """
    num = max(len(a[1]), len(b[1]))
    if num > _MAX_PADDING * min(len(a[1]), len(b[1])):
        return a, b

    def padded(points: Array, mask: Array) -> tuple[Array, Array]:
        rows = (0, num - len(mask))
        return jnp.pad(points, (rows, (0, 0))), jnp.pad(mask, rows)

    return padded(*a), padded(*b)


def _distinct_enough(points: Array, mask: Array) -> Array:
    """Whether at least d + 1 distinct points are valid."""
    new, num = mask, jnp.zeros((), jnp.int32)
    for _ in range(points.shape[1] + 1):
        num = num + jnp.any(new)
        new = new & jnp.any(points != points[jnp.argmax(new)], axis=1)
    return num > points.shape[1]
