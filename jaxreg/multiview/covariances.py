"""How far the poses of scans may err: a sandwich over the cells of all surfaces.

The error of a pair's motion is what the pulls of its points add up to, over their
answer (`jaxreg.local.covariance`); poses follow the motions as averaging weighs them.
The motions are those that were measured last, from poses that others hold: so where the
surfaces of a pair say little of it, its motion says what the poses said.
What a cell of the surfaces contributes to all pairs that match there, and through them
to every pose, is one term, as the pairs of a scan share its errors: motions that agree
with each other may be wrong together.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import full_matmul
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import ArrayLike
from jaxreg.batching.padding import rounded_up
from jaxreg.geometry import lie
from jaxreg.linear.small import product
from jaxreg.local.covariance import after_steps, answer
from jaxreg.matching.problem import match
from jaxreg.multiview.follow_motions import follow_motions
from jaxreg.multiview.given_scans import GivenScans
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.refine import NUM_STEPS, WIDTH_END, optimiser_of
from jaxreg.multiview.scan_set import ScanSet
from jaxreg.multiview.solution import ReconstructionSolution
from jaxreg.particle import AbstractSearch, ParticleFilter


# Edge of a cell in sample spacings: some five points of a scan. With three as many
# poses are inside, and of 48 views fewer together (bench/studies/coverage.md).
_CELL = 2.0
# Sums that cells are kept in. Variances from so many have errors of sqrt(2 / number):
# a fiftieth from the most, a tenth from the fewest. In between as many as have room,
# which is counted in sums times scans.
_MOST, _LEAST, _ROOM = 4096, 256, 2**22
_PRIMES = (73_856_093, 19_349_663, 83_492_791)  # Teschner et al. 2003
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
    out = _covariances(prepared, T, *told)[: len(held)]
    out = jnp.where(jnp.asarray(held)[:, None, None], out, jnp.nan)
    return out.at[relative_to].set(0)


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
    out = _joint_covariances(prepared, T, *told)[: len(held), : len(held)]
    both = jnp.asarray(held[:, None] & held)
    out = jnp.where(both[:, :, None, None], out, jnp.nan)
    return out.at[relative_to].set(0).at[:, relative_to].set(0)


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
    T = jnp.asarray(np.linalg.inv(T[relative_to]) @ T, given.dtype)
    edges, weight = _pairs(moved, relative_to)
    held = np.zeros(v, bool)
    held[edges[weight > 0].ravel()] = True
    weight = jnp.asarray(weight, given.dtype)
    return prepared, T, (jnp.asarray(relative_to), jnp.asarray(edges), weight), held


def _pairs(
    solution: ReconstructionSolution, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """Averaged pairs of a scan's component, and weights; padded so that few compile."""
    component, edges = solution.component, np.asarray(solution.averaged.pairs)
    weight = np.asarray(solution.averaged.weight)
    held = (np.asarray(component)[edges] == int(component[first])).all(axis=1)
    used = held & (weight > 0) & (edges[:, 0] != edges[:, 1])
    weight = weight[used]
    more = rounded_up(len(weight), 8) - len(weight)
    pad = np.full((more, 2), first, edges.dtype)
    return np.concatenate([edges[used], pad]), np.append(weight, np.zeros(more))


class _Surfaces(eqx.Module):
    """What the surfaces of pairs say of their motions.

    Attributes:
        scans: prepared scans.
        T: `(v, d+1, d+1)` poses of the centred frames, in radii.
    """

    scans: PreparedScans
    T: Float[Array, "v D D"]

    @property
    def to_own_axes(self) -> Float[Array, "v k k"]:
        """From the axes of the world to those of each pose."""
        R = jnp.swapaxes(lie.rotation(self.T), -1, -2)
        return lie.adjoint(lie.compose(R, jnp.zeros_like(R[:, 0])))

    def errors(
        self, i: Array, j: Array, around: Float[Array, "r v k"], num: int
    ) -> tuple[Float[Array, "r k c"], Float[Array, "k k"]]:
        """What the cells of each sum add to the motion of a pair, at frame j.

        And how far the motion does not follow the poses that it is measured from. In
        the axes of the world, at poses moved by some tangents. A cell is in one of
        `num` sums, with a sign drawn at random: then products of two that meet there
        are as often below 0 as above. For each of the tangents cells lie elsewhere: of
        many scans there are fewer of them than errors are told in directions.
        """
        optimiser, problem = optimiser_of(self.T), self.scans.problem(i, j, exact=True)
        width = WIDTH_END * jnp.max(self.scans.spacing)
        ends, places = jnp.stack([i, j]), jnp.arange(len(around)) / len(around)

        def at(told: tuple[Array, Array]) -> tuple[Array, Array, Array]:
            move, place = told
            column, sign = self._cells(i, place, num)
            T_i, T_j = product(self.T[ends], lie.exp(move[ends]))
            T_i_j = lie.between(T_i, T_j)
            found = match(problem, T_i_j)
            weight = optimiser.weights(found, width)
            H, _ = optimiser.residual.normal_equations(found, weight)
            A = answer(optimiser, problem, T_i_j, found, width, weight, H)
            signed = weight * sign[found.row]
            pulls = (optimiser.residual.descents(found) * signed).T
            return A, H, jax.ops.segment_sum(pulls, column[found.row], num)

        A, H, pulls = lax.map(at, (around, places.astype(around.dtype)))
        A, H, turn = jnp.mean(A, axis=0), jnp.mean(H, axis=0), self.to_own_axes[i].T
        gain, share = (full_matmul(turn, x) for x in after_steps(A, H, NUM_STEPS))
        return jnp.einsum("ab,rcb->rac", gain, pulls), full_matmul(share, turn.T)

    def _cells(
        self, i: Array, corner: Array, num: int
    ) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        """Of the cell of the world that each point of a scan lies in: sum and sign.

        `corner` is the part of a cell by which all are moved.
        """
        size = _CELL * jnp.max(self.scans.spacing)
        place = lie.act(self.T[i], self.scans.cloud(i).points)
        place = jnp.floor(place / size + corner).astype(jnp.int32)
        primes = jnp.asarray(_PRIMES[: place.shape[1]], jnp.int32)
        code = jnp.sum(place * primes, axis=1)
        sign = 1 - 2 * ((code // _MOST) % 2).astype(self.T.dtype)
        return code % num, sign


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
    surfaces = _Surfaces(scans, T)
    (v, d), turn = scans.mean.shape, surfaces.to_own_axes
    k, num = lie.tangent_dim(d), _num_sums(v)

    def velocities(around: Float[Array, "r v k"]) -> Float[Array, "r v k c"]:
        def errors(i: Array, j: Array) -> tuple[Array, Array]:
            return surfaces.errors(i, j, around, num)

        return follow_motions(edges, weight, T, first, errors, (len(around), num))

    (at_rest,) = velocities(jnp.zeros((1, v, k), T.dtype))
    # Cells that go either way make poses as far off as the truth is.
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_AROUND, num))
    around = jnp.einsum("rc,vbc,vab->rva", jnp.asarray(signs, T.dtype), at_rest, turn)
    unit = jnp.where(jnp.arange(k) < d, scans.radius, 1)
    return velocities(around), unit[:, None] * turn


def _num_sums(num_scans: int) -> int:
    """How many sums of cells are kept; of very many scans fewer."""
    return max(min(_MOST, 2 ** int(math.log2(_ROOM / num_scans))), _LEAST)
