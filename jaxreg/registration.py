"""`register`: the pose of one point set in the frame of another."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxreg._core.checks import (
    as_float_array,
    check_key,
    check_mask,
    check_motion,
    check_points,
    is_concrete,
)
from jaxreg._core.status import Status
from jaxreg._core.threads import map_in_threads, num_cores
from jaxreg._core.typing import Key
from jaxreg.cloud import PointCloud, centroid, rms_radius
from jaxreg.geometry import lie
from jaxreg.local import (
    AbstractRegistrar,
    Curvature,
    Modes,
    RegistrationSolution,
    tangent_unit,
)
from jaxreg.particle import ParticleFilter


# Sources, targets, masks of both, and initial poses.
_Pairs = tuple[Array, Array, Array, Array, Array | None]


def register(
    source: object,
    target: object,
    method: AbstractRegistrar | None = None,
    init: object = None,
    key: Key | None = None,
    *,
    source_mask: object = None,
    target_mask: object = None,
) -> RegistrationSolution:
    """Registers a source point set to a target.

    Args:
        source: `(n, d)` points, d = 2 or 3, or a batch of pairs `(..., n, d)`; what
            `numpy.asarray` or DLPack takes.
        target: `(m, d)` points, or a batch with the same leading axes.
        method: `ParticleFilter()` by default, which needs no initial guess; `ICP()`
            for a local search.
        init: `T_target_source` to start from, `(d+1, d+1)` or one per pair, or None.
        key: a `jax.random.key`; needed by methods that draw random numbers. A batch of
            pairs gets one key each by splitting.
        source_mask: `(n,)` True for valid points; rows that are not finite are masked
            in any case.
        target_mask: `(m,)` likewise.

    Returns:
        A `RegistrationSolution`, with leading axes for a batch.

    Raises:
        ValueError, TypeError: while tracing, for shapes, dtypes and keys that do not
            fit, naming the argument.

    Fails:
        With the statuses of the method; TOO_FEW_POINTS where a cloud has fewer than
        d + 1 distinct valid points, and then the pose is the identity.

    Gradients:
        As the method says.
    """
    method = ParticleFilter() if method is None else method
    if not isinstance(method, AbstractRegistrar):
        raise TypeError(
            "method: wanted a registration method such as jaxreg.ParticleFilter() or "
            f"jaxreg.ICP(), found {type(method).__name__}."
        )
    source = as_float_array(source, "source")
    target = as_float_array(target, "target")
    d = check_points(source, "source")
    if check_points(target, "target") != d:
        raise ValueError(
            f"target: wanted points of dimension {d} like source, found shape "
            f"{target.shape}."
        )
    if target.dtype != source.dtype:
        raise TypeError(
            f"target: wanted dtype {source.dtype} like source, found {target.dtype}."
        )
    batch = source.shape[:-2]
    if target.shape[:-2] != batch:
        raise ValueError(
            f"target: wanted leading axes {batch} like source, found "
            f"{target.shape[:-2]}."
        )
    source_mask = check_mask(source_mask, source.shape[:-1], "source_mask")
    target_mask = check_mask(target_mask, target.shape[:-1], "target_mask")
    if init is not None:
        init = as_float_array(init, "init").astype(source.dtype)
        check_motion(init, d, "init")
        init = jnp.broadcast_to(init, (*batch, d + 1, d + 1))
    if key is not None:
        key = check_key(key)
    pairs = (source, target, source_mask, target_mask, init)
    if not batch:
        return _register_one(method, pairs, key)
    num = math.prod(batch)
    flat = jax.tree.map(lambda x: x.reshape(num, *x.shape[len(batch) :]), pairs)
    keys = None if key is None else jax.random.split(key, num)
    every = (method, flat, keys)
    threads = all(map(is_concrete, jax.tree.leaves(every)))
    threads = threads and num > 0 and jax.default_backend() == "cpu"
    solution = _in_threads(*every) if threads else _register_rows(*every, num, 0)
    return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), solution)


@eqx.filter_jit
def _register_one(
    method: AbstractRegistrar, pair: _Pairs, key: Array | None
) -> RegistrationSolution:
    return _register_pair(method, *pair, key)


@eqx.filter_jit
def _register_rows(
    method: AbstractRegistrar,
    pairs: _Pairs,
    keys: Array | None,
    num: int,
    start: Array | int,
) -> RegistrationSolution:
    """Of `num` pairs from `start` on, one after another: memory stays bounded."""

    def one(args: tuple[_Pairs, Array | None]) -> RegistrationSolution:
        return _register_pair(method, *args[0], args[1])

    rows = start + jnp.arange(num)
    return lax.map(one, jax.tree.map(lambda x: x[rows], (pairs, keys)))


def _in_threads(
    method: AbstractRegistrar, pairs: _Pairs, keys: Array | None
) -> RegistrationSolution:
    """Chunks of a batch, as many at a time as there are cores."""
    num, cores = pairs[0].shape[0], num_cores()
    chunk = num if cores == 1 else max(num // (4 * cores), 1)

    def run(start: int) -> RegistrationSolution:
        first = min(start, num - chunk)
        found = _register_rows(method, pairs, keys, chunk, jnp.asarray(first))
        return jax.tree.map(lambda x: np.asarray(x)[start - first :], found)

    parts = map_in_threads(run, range(0, num, chunk), cores)
    return jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x)), *parts)


def _register_pair(
    method: AbstractRegistrar,
    source: Array,
    target: Array,
    source_mask: Array,
    target_mask: Array,
    init: Array | None,
    key: Array | None,
) -> RegistrationSolution:
    source, source_mask = _finite(source, source_mask)
    target, target_mask = _finite(target, target_mask)
    enough = _distinct_enough(source, source_mask) & _distinct_enough(
        target, target_mask
    )
    source_mean = lax.stop_gradient(centroid(source, source_mask))
    target_mean = lax.stop_gradient(centroid(target, target_mask))
    radius = lax.stop_gradient(rms_radius(target, target_mask))
    radius = jnp.where(radius > 0, radius, 1)
    d = source.shape[1]
    eye = jnp.eye(d, dtype=source.dtype)

    def centred(T: Array) -> Array:
        """From the frames of the input to the centred and scaled ones."""
        R = lie.rotation(T).astype(source.dtype)
        shift = R @ source_mean + lie.translation(T).astype(source.dtype) - target_mean
        return lie.compose(R, shift / radius)

    method = method.in_unit(radius).in_frames(centred, d)
    init = None if init is None else centred(init)
    clouds = _prepared(
        method,
        ((source - source_mean) / radius, source_mask),
        ((target - target_mean) / radius, target_mask),
    )
    solution = method.solve(*clouds, init, key)

    def back(T: Array) -> Array:
        """From the centred and scaled frames to those of the input."""
        R = lie.rotation(T)
        t = radius * lie.translation(T) + target_mean - R @ source_mean
        T = lie.compose(R, t)
        return jnp.where(enough, T, lie.compose(eye, jnp.zeros_like(t)))

    status = jnp.where(enough, solution.status, Status.TOO_FEW_POINTS)
    curvature = Curvature(
        solution.H, solution.b, solution.error, solution.covariance
    ).scaled(radius)
    modes = solution.modes
    unit = tangent_unit(radius, modes.covariance.shape[-1])
    return RegistrationSolution(
        T_target_source=back(solution.T_target_source),
        status=status.astype(jnp.int32),
        fitness=jnp.where(enough, solution.fitness, 0),
        inlier_rmse=radius * solution.inlier_rmse,
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
