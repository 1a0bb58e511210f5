"""How far the poses of scans may err: a sandwich over the cells of all surfaces.

The error of a pair's motion is what the pulls of its points add up to, over their
answer (`jaxreg.local.covariance`); poses follow the motions as averaging weighs them.
What a cell of the surfaces contributes to all pairs that match there, and through them
to every pose, is one term, as the pairs of a scan share its errors: motions that agree
with each other may be wrong together.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import cast_floats, full_matmul
from jaxreg._core.typing import ArrayLike
from jaxreg.batching.padding import rounded_up
from jaxreg.geometry import lie
from jaxreg.linear.small import product
from jaxreg.local.covariance import answer, inverse_within
from jaxreg.matching.problem import match
from jaxreg.multiview.given_scans import GivenScans
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.refine import WIDTH_END, optimiser_of
from jaxreg.multiview.scan_set import ScanSet
from jaxreg.multiview.solution import ReconstructionSolution
from jaxreg.particle import AbstractSearch, ParticleFilter


# Edge of a cell in sample spacings: some ten points of a scan.
_CELL = 3.0
# Cells that are told apart; two that are not are taken as one, which does no harm.
_MOST = 4096
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


class _Graph(eqx.Module):
    """Trusted pairs of centred frames, averaged by least squares.

    Attributes:
        scans: prepared scans.
        edges: `(e, 2)` scans i and j.
        weight: `(e,)` of each.
        T: `(v, d+1, d+1)` poses of the centred frames, in radii.
    """

    scans: PreparedScans
    edges: Int[Array, "e 2"]
    weight: Float[Array, " e"]
    T: Float[Array, "v D D"]

    def solver(self, first: Array) -> Float[Array, "n n"]:
        """Maps pulls on the tangents of poses to these, with one scan held."""
        v, k = len(self.T), lie.tangent_dim(self.T.shape[-1] - 1)
        eye = jnp.eye(k, dtype=self.T.dtype)

        def add(N: Array, edge: tuple[Array, Array]) -> tuple[Array, None]:
            (i, j), w = edge
            ends = ((i, self._by_first(i, j)), (j, eye))
            for a, of_a in ends:
                for b, of_b in ends:
                    N = N.at[a, :, b].add(w * full_matmul(of_a.T, of_b))
            return N, None

        N = jnp.zeros((v, k, v, k), self.T.dtype)
        N, _ = lax.scan(add, N, (self.edges, self.weight))
        free = jnp.zeros(v, bool).at[self.edges].set(True).at[first].set(False)
        free = jnp.repeat(free, k)
        both = free[:, None] & free
        N = jnp.where(both, N.reshape(v * k, v * k), jnp.eye(v * k, dtype=N.dtype))
        return jnp.where(both, jnp.linalg.inv(N), 0)

    def terms(
        self, around: Float[Array, "r v k"], solver: Float[Array, "n n"]
    ) -> Float[Array, "r c n"]:
        """What each cell contributes to each pose, at poses moved by some tangents."""
        v, k = around.shape[1:]

        def add(total: Array, edge: tuple[Array, Array]) -> tuple[Array, None]:
            (i, j), w = edge
            y = w * self._errors(i, j, around)
            by_first = jnp.einsum("rca,ab->rcb", y, self._by_first(i, j))
            return total.at[:, :, i].add(by_first).at[:, :, j].add(y), None

        total = jnp.zeros((len(around), _MOST, v, k), self.T.dtype)
        total, _ = lax.scan(add, total, (self.edges, self.weight))
        return total.reshape(len(around), _MOST, v * k) @ solver

    def _by_first(self, i: Array, j: Array) -> Float[Array, "k k"]:
        """The error of a motion by the tangent of its first frame."""
        return -lie.adjoint(lie.between(self.T[j], self.T[i]))

    def _errors(
        self, i: Array, j: Array, around: Float[Array, "r v k"]
    ) -> Float[Array, "r c k"]:
        """What each cell adds to the right tangent of `T_i_j`."""
        optimiser, problem = optimiser_of(self.T), self.scans.problem(i, j, exact=True)
        width = WIDTH_END * jnp.max(self.scans.spacing)
        cell, ends = self._cells(i), jnp.stack([i, j])

        def at(move: Float[Array, "v k"]) -> tuple[Array, Array, Array]:
            T_i, T_j = product(self.T[ends], lie.exp(move[ends]))
            T_i_j = lie.between(T_i, T_j)
            found = match(problem, T_i_j)
            weight = optimiser.weights(found, width)
            A = answer(optimiser, problem, T_i_j, found, width, weight)
            H, _ = optimiser.residual.normal_equations(found, weight)
            pulls = (optimiser.residual.descents(found) * weight).T
            return A, H, jax.ops.segment_sum(pulls, cell[found.row], _MOST)

        A, H, pulls = lax.map(at, around)
        each = inverse_within(jnp.mean(A, axis=0), jnp.mean(H, axis=0))
        # From the axes of frame i to those of frame j.
        R = lie.rotation(lie.between(self.T[i], self.T[j]))
        turn = lie.adjoint(lie.compose(R, jnp.zeros_like(R[0])))
        return jnp.einsum("rca,ab->rcb", pulls, full_matmul(each, turn))

    def _cells(self, i: Array) -> Int[Array, " n"]:
        """Of each point of a scan the cell of the world that it lies in."""
        size = _CELL * jnp.max(self.scans.spacing)
        place = lie.act(self.T[i], self.scans.cloud(i).points)
        place = jnp.floor(place / size).astype(jnp.int32)
        primes = jnp.asarray(_PRIMES[: place.shape[1]], jnp.int32)
        return jnp.sum(place * primes, axis=1) % _MOST


@eqx.filter_jit
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
    graph = _Graph(scans, edges, weight, T)
    v, d = scans.mean.shape
    k = lie.tangent_dim(d)
    solver = graph.solver(first)
    at_rest = graph.terms(jnp.zeros((1, v, k), T.dtype), solver)[0]
    # Cells that go either way make poses as far off as the truth is.
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (_AROUND, _MOST))
    around = jnp.asarray(signs, T.dtype) @ at_rest
    terms = graph.terms(around.reshape(_AROUND, v, k), solver)
    terms = terms.reshape(_AROUND * _MOST, v, k)
    unit = jnp.where(jnp.arange(k) < d, scans.radius, 1)
    return jnp.einsum("nva,nvb->vab", terms, terms) / _AROUND * jnp.outer(unit, unit)
