"""How far the poses of scans may err: a sandwich over the cells of all surfaces.

The error of a pair's motion is what the pulls of its points add up to, over their
answer (`jaxreg.local.covariance`); poses follow the motions as averaging weighs them.
What a cell of the surfaces contributes to all pairs that match there, and through them
to every pose, is one term, as the pairs of a scan share its errors: motions that agree
with each other may be wrong together.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import cast_floats, full_matmul
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import ArrayLike
from jaxreg.batching.padding import rounded_up
from jaxreg.geometry import lie
from jaxreg.linear.small import product
from jaxreg.local.covariance import answer, inverse_within
from jaxreg.matching.problem import match
from jaxreg.multiview.follow_motions import follow_motions
from jaxreg.multiview.given_scans import GivenScans
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.refine import WIDTH_END, optimiser_of
from jaxreg.multiview.scan_set import ScanSet
from jaxreg.multiview.solution import ReconstructionSolution
from jaxreg.particle import AbstractSearch, ParticleFilter


# Edge of a cell in sample spacings: some ten points of a scan.
_CELL = 3.0
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
        that no trusted pair holds.

    Raises:
        ValueError: for a solution of other scans, and a scan that there is not.

    Gradients: none (cut).

    Reference: Huber 1967; Conley 1999 (errors that neighbours share).
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
    edges, weight = _trusted(moved, relative_to)
    held = np.zeros(len(T), bool)
    held[edges[weight > 0].ravel()] = True
    first, told = jnp.asarray(relative_to), (jnp.asarray(edges), jnp.asarray(weight))
    out = _covariances(prepared, T, first, *cast_floats(told, given.dtype))
    out = jnp.where(jnp.asarray(held)[:, None, None], out, jnp.nan)
    return out.at[relative_to].set(0)[:v]


def _trusted(
    solution: ReconstructionSolution, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a scan's component and their weights, padded so that few compile."""
    component, edges = np.asarray(solution.component), np.asarray(solution.graph.edges)
    trust = np.asarray(solution.edge_weight)
    same = (component[edges] == component[first]).all(axis=1)
    used = same & (trust > 0.5) & (edges[:, 0] != edges[:, 1])
    weight = (np.asarray(solution.graph.weight) * trust)[used]
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
    ) -> Float[Array, "r k c"]:
        """What the cells of each sum add to the motion of a pair, at frame j.

        In the axes of the world, at poses moved by some tangents. A cell is in one of
        `num` sums, with a sign drawn at random: then products of two that meet there
        are as often below 0 as above.
        """
        optimiser, problem = optimiser_of(self.T), self.scans.problem(i, j, exact=True)
        width = WIDTH_END * jnp.max(self.scans.spacing)
        (column, sign), ends = self._cells(i, num), jnp.stack([i, j])

        def at(move: Float[Array, "v k"]) -> tuple[Array, Array, Array]:
            T_i, T_j = product(self.T[ends], lie.exp(move[ends]))
            T_i_j = lie.between(T_i, T_j)
            found = match(problem, T_i_j)
            weight = optimiser.weights(found, width)
            A = answer(optimiser, problem, T_i_j, found, width, weight)
            H, _ = optimiser.residual.normal_equations(found, weight)
            signed = weight * sign[found.row]
            pulls = (optimiser.residual.descents(found) * signed).T
            return A, H, jax.ops.segment_sum(pulls, column[found.row], num)

        A, H, pulls = lax.map(at, around)
        each = inverse_within(jnp.mean(A, axis=0), jnp.mean(H, axis=0))
        each = full_matmul(self.to_own_axes[i].T, each)
        return jnp.einsum("ab,rcb->rac", each, pulls)

    def _cells(self, i: Array, num: int) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        """Of the cell of the world that each point of a scan lies in: sum and sign."""
        size = _CELL * jnp.max(self.scans.spacing)
        place = lie.act(self.T[i], self.scans.cloud(i).points)
        place = jnp.floor(place / size).astype(jnp.int32)
        primes = jnp.asarray(_PRIMES[: place.shape[1]], jnp.int32)
        code = jnp.sum(place * primes, axis=1)
        sign = 1 - 2 * ((code // _MOST) % 2).astype(self.T.dtype)
        return code % num, sign


@kept_program
def _covariances(
    scans: PreparedScans,
    T_first_i: Float[Array, "v D D"],
    first: Array,
    edges: Int[Array, "e 2"],
    weight: Float[Array, " e"],
) -> Float[Array, "v k k"]:
    """Relative to the first, in the unit of the input."""
    R = lie.rotation(T_first_i)
    moved = lie.translation(T_first_i) + jnp.sum(R * scans.mean[:, None], axis=-1)
    T = lie.compose(R, (moved - moved[first]) / scans.radius)
    surfaces = _Surfaces(scans, T)
    (v, d), turn = scans.mean.shape, surfaces.to_own_axes
    k, num = lie.tangent_dim(d), _num_sums(v)

    def velocities(around: Float[Array, "r v k"]) -> Float[Array, "r v k c"]:
        def errors(i: Array, j: Array) -> Float[Array, "r k c"]:
            return surfaces.errors(i, j, around, num)

        return follow_motions(edges, weight, T, first, errors, (len(around), num))

    (at_rest,) = velocities(jnp.zeros((1, v, k), T.dtype))
    # Cells that go either way make poses as far off as the truth is.
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_AROUND, num))
    around = jnp.einsum("rc,vbc,vab->rva", jnp.asarray(signs, T.dtype), at_rest, turn)
    moves = velocities(around)
    total = jnp.einsum("rvac,rvbc->vab", moves, moves) / _AROUND
    total = product(product(turn, total), jnp.swapaxes(turn, -1, -2))
    unit = jnp.where(jnp.arange(k) < d, scans.radius, 1)
    return total * jnp.outer(unit, unit)


def _num_sums(num_scans: int) -> int:
    """How many sums of cells are kept; of very many scans fewer."""
    return max(min(_MOST, 2 ** int(math.log2(_ROOM / num_scans))), _LEAST)
