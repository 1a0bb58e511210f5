"""How far the poses of scans may err: a sandwich over the cells of all surfaces.

The error of a pair's motion is what the pulls of its points add up to, over their
answer (`jaxreg.local.covariance`); poses follow the motions as averaging weighs them.
The motions are those that were measured last, from poses that others hold: so where the
surfaces of a pair say little of it, its motion says what the poses said.
What a cell of the surfaces contributes to all pairs that match there, and through them
to every pose, is one term, as the pairs of a scan share its errors: motions that agree
with each other may be wrong together. Wide cells tell whether neighbours err alike.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxreg._core.programs import kept_program
from jaxreg._core.typing import ArrayLike
from jaxreg.batching.padding import rounded_up
from jaxreg.geometry import lie
from jaxreg.linear.small import product
from jaxreg.multiview.follow_motions import follow_motions
from jaxreg.multiview.given_scans import GivenScans
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.scan_set import ScanSet
from jaxreg.multiview.solution import ReconstructionSolution
from jaxreg.multiview.surface_errors import (
    CELL,
    WIDE_CELL,
    SurfaceErrors,
    num_sums,
)
from jaxreg.particle import AbstractSearch, ParticleFilter


# Poses around the answer at which pulls and answers are taken.
_AROUND = 4


def scan_covariances(
    scans: ArrayLike | ScanSet,
    solution: ReconstructionSolution,
    *,
    relative_to: int = 0,
    mask: ArrayLike | None = None,
) -> Float[Array, "v k k"]:
    """The covariance of each scan's pose relative to one of them.

    Of the error in the frame of the scan moved to its centroid: R -> R exp(w), and the
    centroid by R v; (v, w), lengths in the unit of the input. Nothing is assumed about
    the size of the noise: see `pose_covariance` in `jaxreg.local.covariance`, whose
    sandwich this is over all trusted pairs at once.

    Args:
        scans: as `reconstruct` got them, or their `ScanSet` if it is for a search.
        solution: what it found.
        relative_to: the scan that is taken as known exactly.
        mask: as there.

    Returns:
        `(v, k, k)`; 0 for the scan itself, NaN for scans of other components and those
        that no pair holds. How often the truth is inside: bench/studies/coverage.md.

    Raises:
        ValueError: for a solution of other scans, and a scan that there is not.

    Gradients: none (cut).

    Reference: Huber 1967; Conley 1999 (errors that neighbours share).
    """
    prepared, T, told, held = _asked(scans, solution, relative_to, mask)
    # The rest on the host: there no program is compiled for each number.
    out = np.array(_covariances(prepared, T, *told))[: len(held)]
    out[~held], out[relative_to] = np.nan, 0
    return jax.device_put(out)


def joint_scan_covariances(
    scans: ArrayLike | ScanSet,
    solution: ReconstructionSolution,
    *,
    relative_to: int = 0,
    mask: ArrayLike | None = None,
) -> Float[Array, "v v k k"]:
    """The covariances of the poses of every two scans relative to one of them.

    Such as for how two scans lie to each other: neighbours err alike. A block for every
    two scans, so it is for some hundreds of them.

    Args:
        scans: as in `scan_covariances`.
        solution: likewise.
        relative_to: likewise.
        mask: likewise.

    Returns:
        `(v, v, k, k)`, with `scan_covariances` where both are one; 0 and NaN likewise.

    Raises:
        ValueError: likewise.

    Gradients: none (cut).

    Reference: see `scan_covariances`.
    """
    prepared, T, told, held = _asked(scans, solution, relative_to, mask)
    out = np.array(_joint_covariances(prepared, T, *told))[: len(held), : len(held)]
    out[~held], out[:, ~held] = np.nan, np.nan
    out[relative_to], out[:, relative_to] = 0, 0
    return jax.device_put(out)


def _asked(
    scans: ArrayLike | ScanSet,
    solution: ReconstructionSolution,
    relative_to: int,
    mask: ArrayLike | None,
) -> tuple[PreparedScans, Float[Array, "p D D"], tuple[Array, ...], np.ndarray]:
    """What covariances are computed from, and which scans are held by pairs.

    Scans, some of them padding, and their poses relative to one; that one, edges,
    weights.
    """
    if isinstance(scans, ScanSet):
        scans.check_usable(None, mask, None)
        if not isinstance(scans.method, AbstractSearch):
            raise ValueError(
                "scans: wanted a ScanSet for a search such as ParticleFilter(), found "
                f"one for {type(scans.method).__name__}: give the scans themselves."
            )
    given = scans if isinstance(scans, ScanSet) else GivenScans.of(scans, mask, None)
    v, d = given.shape
    moved = given.far.previous(solution)
    num = moved.num_scans if isinstance(moved, ReconstructionSolution) else None
    if not isinstance(moved, ReconstructionSolution) or num != v:
        raise ValueError(f"solution: wanted one of {v} scans, found {num}.")
    if not 0 <= relative_to < v:
        raise ValueError(f"relative_to: wanted a scan below {v}, found {relative_to}.")
    prepared, _ = given.prepared(ParticleFilter(), None, to_search=False)
    T = np.tile(np.eye(d + 1), (prepared.num_scans, 1, 1))
    T[:v] = np.asarray(moved.T_world_i, np.float64)
    T = (np.linalg.inv(T[relative_to]) @ T).astype(given.dtype)
    edges, weight = _pairs(moved, relative_to)
    held = np.zeros(v, bool)
    held[edges[weight > 0].ravel()] = True
    told = np.int32(relative_to), edges, weight.astype(given.dtype)
    return prepared, *jax.device_put((T, told)), held


def _pairs(
    solution: ReconstructionSolution, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """Averaged pairs of a scan's component, and weights; padded so that few compile."""
    averaged, component = solution.averaged, np.asarray(solution.component)
    edges, weight = np.asarray(averaged.pairs), np.asarray(averaged.weight)
    held = (component[edges] == component[first]).all(axis=1)
    used = held & (weight > 0) & (edges[:, 0] != edges[:, 1])
    weight = weight[used]
    more = rounded_up(len(weight), 8) - len(weight)
    pad = np.full((more, 2), first, edges.dtype)
    return np.concatenate([edges[used], pad]), np.append(weight, np.zeros(more))


@kept_program
def _covariances(*of: Any) -> Float[Array, "v k k"]:
    """Of each scan, with the arguments of `_moves`."""
    moves, own = _moves(*of)
    total = jnp.einsum("rvac,rvbc->vab", moves, moves) / _AROUND
    return product(product(own, total), jnp.swapaxes(own, -1, -2))


@kept_program
def _joint_covariances(*of: Any) -> Float[Array, "v v k k"]:
    """Of every two."""
    moves, own = _moves(*of)
    total = jnp.einsum("rvac,rwbc->vwab", moves, moves) / _AROUND
    return product(product(own[:, None], total), jnp.swapaxes(own, -1, -2))


def _moves(
    scans: PreparedScans,
    T_first_i: Float[Array, "v D D"],
    first: Array,
    edges: Int[Array, "e 2"],
    weight: Float[Array, " e"],
) -> tuple[Float[Array, "r v k c"], Float[Array, "v k k"]]:
    """How cells move the poses relative to the first, from poses around the answer.

    In the axes of the world, and how these become the unit of the input in the axes of
    each scan.
    """
    R = lie.rotation(T_first_i)
    moved = lie.translation(T_first_i) + jnp.sum(R * scans.mean[:, None], axis=-1)
    T = lie.compose(R, (moved - moved[first]) / scans.radius)
    surfaces = SurfaceErrors(scans, T)
    (v, d), turn = scans.mean.shape, surfaces.to_own_axes
    k, num = lie.tangent_dim(d), num_sums(v)

    def velocities(
        around: Float[Array, "r v k"], *sizes: float
    ) -> Float[Array, "r v k c"]:
        def errors(i: Array, j: Array) -> tuple[Array, Array]:
            return surfaces.errors(i, j, around, jnp.asarray(sizes, T.dtype), num)

        return follow_motions(edges, weight, T, first, errors, (len(around), num))

    at_rest, wide = velocities(jnp.zeros((2, v, k), T.dtype), CELL, WIDE_CELL)
    # Cells that go either way make poses as far off as the truth is.
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_AROUND, num))
    around = jnp.einsum("rc,vbc,vab->rva", jnp.asarray(signs, T.dtype), at_rest, turn)
    unit = jnp.where(jnp.arange(k) < d, scans.radius, 1)
    longer = jnp.sqrt(_growth(at_rest, wide))
    return longer * velocities(around, *[CELL] * _AROUND), unit[:, None] * turn


def _growth(
    cells: Float[Array, "v k c"], wide: Float[Array, "v k c"]
) -> Float[Array, ""]:
    """Of variances by wide cells: in the mean over all poses and axes, one at least.

    Errors may have one sign over more than a cell, as those of planes through samples
    of curved surfaces, and of scans that are warped.
    """
    cells, wide = (jnp.sum(x**2, axis=-1) for x in (cells, wide))
    told = cells > 0
    growth = jnp.where(told, wide / jnp.where(told, cells, 1), 0)
    return jnp.maximum(jnp.sum(growth) / jnp.maximum(jnp.sum(told), 1), 1)
