"""`register`: what its users call."""

from collections.abc import Sequence
from typing import overload

import jax.numpy as jnp
import numpy as np
from jax.sharding import AbstractMesh, Mesh
from jaxtyping import Array, Float

from jaxreg._core.checks import (
    as_float_array,
    check_callable,
    check_count,
    check_key,
    check_method,
    check_motion,
    check_pair,
    check_rigid,
)
from jaxreg._core.log import log_solution
from jaxreg._core.typing import ArrayLike, Key, Progress
from jaxreg.batching.devices import chosen_devices
from jaxreg.batching.padding import check_lists, is_list_of_clouds
from jaxreg.local import ICP
from jaxreg.particle import AbstractSearch, ParticleFilter
from jaxreg.registrar import AbstractRegistrar, GivenPair, RegistrationSolution
from jaxreg.registration.alone import register_alone
from jaxreg.registration.far import (
    check_prior_fits,
    moved_back,
    moved_guess,
    near_origin,
)
from jaxreg.registration.many import register_batch, register_lists
from jaxreg.registration.viewpoints import checked_viewpoints


# Lists come first: they are objects, too.
@overload
def register(  # pyright: ignore[reportOverlappingOverload]
    source: Sequence[Array | np.ndarray],
    target: Sequence[Array | np.ndarray],
    method: AbstractRegistrar | None = None,
    init: ArrayLike | None = None,
    key: Key | None = None,
    *,
    source_mask: ArrayLike | None = None,
    target_mask: ArrayLike | None = None,
    viewpoints: Sequence[ArrayLike | None] | None = None,
    batch_size: int | None = None,
    progress: Progress | None = None,
    mesh: Mesh | AbstractMesh | None = None,
) -> list[RegistrationSolution]: ...


@overload
def register(
    source: ArrayLike,
    target: ArrayLike,
    method: AbstractRegistrar | None = None,
    init: ArrayLike | None = None,
    key: Key | None = None,
    *,
    source_mask: ArrayLike | None = None,
    target_mask: ArrayLike | None = None,
    viewpoints: Sequence[ArrayLike | None] | None = None,
    batch_size: int | None = None,
    progress: Progress | None = None,
    mesh: Mesh | AbstractMesh | None = None,
) -> RegistrationSolution: ...


def register(
    source: ArrayLike,
    target: ArrayLike,
    method: AbstractRegistrar | None = None,
    init: ArrayLike | None = None,
    key: Key | None = None,
    *,
    source_mask: ArrayLike | None = None,
    target_mask: ArrayLike | None = None,
    viewpoints: Sequence[ArrayLike | None] | None = None,
    batch_size: int | None = None,
    progress: Progress | None = None,
    mesh: Mesh | AbstractMesh | None = None,
) -> RegistrationSolution | list[RegistrationSolution]:
    """Registers a source point set to a target, or many pairs of them.

        >>> import jaxreg as jr
        >>> target = [[0, 0], [3, 0], [3, 1], [1, 1], [1, 2], [0, 2]]
        >>> source = [[x - 0.1, y + 0.2] for x, y in target]
        >>> method = jr.ICP(jr.PointToPoint(), kernel=jr.robust.L2())
        >>> sol = jr.register(source, target, method)
        >>> sol.T_target_source[:2, 2].round(3)  # where the origin went
        Array([ 0.1, -0.2], dtype=float32)
        >>> jr.Status(int(sol.status)).name
        'CONVERGED'

    Without an initial guess, by the default method: `register(a, b, key=key)`.

    Args:
        source: `(n, d)` points, d = 2 or 3; a batch of pairs `(..., n, d)`; or a list
            of `(n_i, d)` points of any sizes, also none. Arrays are what
            `numpy.asarray` or DLPack takes, or a cloud or mesh of Open3D or trimesh.
        target: `(m, d)` points, a batch with the same leading axes, or a list of the
            same length.
        method: `ParticleFilter()` by default, which needs no initial guess; `ICP()`
            for a local search.
        init: `T_target_source` to start from, `(d+1, d+1)` or one per pair, or None.
        key: a `jax.random.key`; needed by methods that draw random numbers. Many pairs
            get one key each by splitting.
        source_mask: `(n,)` True for valid points, for a list a list of masks or None;
            rows that are not finite are masked in any case.
        target_mask: `(m,)` likewise.
        viewpoints: where the scanners of source and target stood, each `(d,)` in its
            own cloud's frame, one for all pairs or with leading axes like theirs, or
            None where that is not known. What a scanner saw through is free: poses
            that put points of the other cloud there are believed less. Of scans in
            sensors' frames they are zeros; indoors and in the plane they tell rooms
            apart. Only of scans taken from one place each, of what did not move.
        batch_size: of many pairs, those that a core or an accelerator registers side by
            side; memory grows with it. By default one after another on a CPU, where
            that is quickest, and a million points at a time on an accelerator.
        progress: called as `progress(stage, done, total)` as some of many pairs are
            done, on an accelerator all of a size; not for one pair, not under `jit`.
        mesh: a mesh of devices with an axis "pair", over which many pairs are spread,
            with an axis "particle", over which the particles of each pair are, or with
            both; only a search, such as `ParticleFilter`, has particles. Without a mesh
            pairs stay where the batch is, by the sharding of its leading axis, or are
            spread over the mesh around the call (`jax.set_mesh`) if that has such an
            axis. Under `jit` with automatic axes name it.

    Returns:
        A `RegistrationSolution`, with leading axes for a batch; for lists a list of
        them, one for each pair. Of NumPy arrays of float64 that lie a hundred radii
        from their origins, as map coordinates do, poses are NumPy arrays of float64,
        also where JAX computes in float32: clouds are moved to their middles first.

    Raises:
        ValueError, TypeError: while tracing, for shapes, dtypes and keys that do not
            fit, naming the argument.

    Fails:
        With the statuses of the method; TOO_FEW_POINTS where a cloud has fewer than
        d + 1 distinct valid points, and then the pose is the identity; UNIT_DIFFERS
        where one that is not believed has 50 times the radius of the other.

    Gradients:
        As the method says.

    Compilation:
        Outside of a transformation clouds are padded to sizes rounded up
        (`jaxreg.batching.padding.rounded_up`), two an octave, both to one where theirs
        are next to each other; those of a list to the one that holds the largest. That
        changes an answer by rounding only, and similar sizes share a program. Where a
        list would get more than 2^24 rows more, each pair of sizes compiles once. A
        process on Linux holds some twenty searches of different sizes; before it is
        full all programs are dropped (`jaxreg._core.program_room`), which is logged.

    Devices:
        Along "pair" each registers its own pairs and hears of no other. Bits are the
        same on any number of devices that get several pairs each; on one device, and
        with one pair each, XLA rounds some sums otherwise. A number of pairs that is no
        multiple of the devices is filled up, which costs a copy. `register` also works
        inside `jax.shard_map`, where it spreads nothing further; with its checks
        (`check_vma`) both branches of a condition are computed.

        Along "particle" all hold the pair: each measures its share of every block of
        `batch_size` particles, refines and judges its share of the modes, and gathers
        those of the others; random numbers, resampling and choices all compute alike.
        So the answer does not depend on the number of devices, but for rounding, as
        above. Shares that do not come out even are filled up. Not shared are the
        preparation of clouds and indexes, poses of local features and the last digits
        of the best pose.

    Memory:
        Groups of `batch_size` pairs are registered one after another on each core. On a
        CPU that takes, beyond the inputs, one copy of them and about 10 MB + 900 (n +
        m) bytes a core and pair of the group, where n and m are the padded sizes
        (`ICP`, float32; programs of clouds of 2,000 points take 0.8, 6.1 and 24 MB for
        groups of 1, 8 and 32). Under `jit` and on an accelerator a list becomes padded
        arrays of 4 d + 1 bytes a row.
    """
    method = ParticleFilter() if method is None else method
    check_method(method, AbstractRegistrar)
    if batch_size is not None:
        check_count(batch_size, "batch_size")
    check_callable(progress, "progress")
    key = None if key is None else check_key(key)
    particles = isinstance(method, AbstractSearch)
    devices = chosen_devices(mesh, source, particles=particles)
    how = batch_size, progress, devices
    masks = source_mask, target_mask
    scaled = isinstance(method, ICP) and method.with_scale
    here = near_origin(source, source_mask, "source")
    there = near_origin(target, target_mask, "target")
    check_prior_fits(method, here, there)
    init = moved_guess(init, here, there)
    if scaled and viewpoints is not None:
        raise ValueError("viewpoints: not with ICP(with_scale=True).")
    if is_list_of_clouds(source) or is_list_of_clouds(target):
        lists = check_lists(here.points, there.points, *masks)
        batch = (len(lists[0]),)
        init = _check_init(init, batch, lists[0][0], scaled)
        eyes = checked_viewpoints(viewpoints, (here, there), lists, batch)
        found = register_lists(method, lists, eyes, init, key, *how)
        return [moved_back(sol, here.at(i), there.at(i)) for i, sol in enumerate(found)]
    clouds = check_pair(here.points, there.points, *masks)
    batch = clouds[0].shape[:-2]
    init = _check_init(init, batch, clouds[0], scaled)
    eyes = checked_viewpoints(viewpoints, (here, there), clouds, batch)
    pair = GivenPair(*clouds, eyes)
    if batch:
        sol = register_batch(method, batch, pair, init, key, *how)
    else:
        sol = register_alone(method, pair, init, key, devices)
    sol = moved_back(sol, here, there)
    log_solution("register", sol)
    return sol


def _check_init(
    init: object, batch: tuple[int, ...], points: Array, scaled: bool
) -> Float[Array, "*b D D"] | None:
    """Initial poses with the leading axes `batch`."""
    if init is None:
        return None
    found, d = as_float_array(init, "init").astype(points.dtype), points.shape[-1]
    check_motion(found, d, "init")
    check_rigid(found, "init", scaled)
    try:
        return jnp.broadcast_to(found, (*batch, d + 1, d + 1))
    except ValueError as err:
        raise ValueError(
            f"init: wanted one motion or leading axes {batch} like source, found "
            f"shape {found.shape}."
        ) from err
