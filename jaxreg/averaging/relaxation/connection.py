"""The connection Laplacian of a graph, its multipliers, and a minimum nearby.

SE-Sync's objective is F = tr(X M X') for X = [T_world_0, ..., T_world_v] without the
last rows, and M the connection Laplacian of the measured motions. On the host and in
float64, whatever the precision of JAX: a certificate needs the digits.

Reference: Rosen, Carlone, Bandeira, Leonard, SE-Sync, IJRR 2019; Briales and
Gonzalez-Jimenez 2017 (translations kept as unknowns).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from jaxreg.linear.sparse import (
    Blocks,
    Factor,
    definite_factor,
    fill_reducing_order,
    from_blocks,
    kept_unknowns,
)


_NEWTON_STEPS, _HALVINGS = 40, 12
# Share of F that a step takes below which the next ones use its factor again.
_NEAR = 1e-8


@dataclass(frozen=True)
class Connection:
    """Motions between frames that are all joined, in float64.

    Attributes:
        edges: `(e, 2)`.
        T_i_j: `(e, d+1, d+1)`.
        precision: `(e, d+1)` kappa d times, and tau.
        num: number of frames.
    """

    edges: np.ndarray
    T_i_j: np.ndarray
    precision: np.ndarray
    num: int

    @classmethod
    def of(
        cls,
        edges: np.ndarray,
        T_i_j: np.ndarray,
        weights: tuple[np.ndarray, np.ndarray],
        num: int,
    ) -> "Connection":
        """From kappa `(e,)` and tau `(e,)`, all above 0."""
        kappa, tau = (np.asarray(w, np.float64)[:, None] for w in weights)
        d = T_i_j.shape[-1] - 1
        precision = np.concatenate([np.repeat(kappa, d, axis=1), tau], axis=1)
        return cls(edges, np.asarray(T_i_j, np.float64), precision, num)

    @property
    def dim(self) -> int:
        """The dimension d of space."""
        return self.T_i_j.shape[-1] - 1

    @cached_property
    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """`(v, d+1, d+1)` of the diagonal of M, and `(e, d+1, d+1)` of (i, j)."""
        i, j = self.edges.T
        D = self.dim + 1
        beside = -self.T_i_j * self.precision[:, None, :]
        own = np.zeros((self.num, D, D))
        np.add.at(own, i, -beside @ self.T_i_j.swapaxes(1, 2))
        np.add.at(own, j, self.precision[:, :, None] * np.eye(D))
        return own, beside

    @cached_property
    def matrix(self) -> sp.csc_array:
        """M, `(d+1) v` squared."""
        return self.with_multipliers(np.zeros((self.num, self.dim, self.dim)))

    @cached_property
    def order(self) -> np.ndarray:
        """Of frames, for factors."""
        return fill_reducing_order(self.edges, self.num)

    def with_multipliers(self, multipliers: np.ndarray) -> sp.csc_array:
        """The certificate matrix S: M less `(v, d, d)` on the rotations."""
        own, beside = self.blocks
        d, every = self.dim, np.arange(self.num)
        own = own.copy()
        own[:, :d, :d] -= multipliers
        return from_blocks(
            [(every, every, own), *self._symmetric(beside)], self.num, d + 1
        )

    def objective(self, T_world_i: np.ndarray) -> float:
        """F of poses `(v, d+1, d+1)`."""
        return self.cost(lifted(T_world_i))

    def pull(self, V: np.ndarray) -> np.ndarray:
        """The product with M of lifted poses `(v, d+1, r)`."""
        return (self.matrix @ V.reshape(-1, V.shape[-1])).reshape(V.shape)

    def cost(self, V: np.ndarray) -> float:
        """F of lifted poses `(v, d+1, r)`."""
        i, j = self.edges.T
        gap = V[j] - self.T_i_j.swapaxes(1, 2) @ V[i]
        return float(np.sum(self.precision[:, :, None] * gap**2))

    def multipliers(self, V: np.ndarray) -> np.ndarray:
        """`(v, d, d)` symmetric: at stationary lifted poses, X S = 0."""
        d = self.dim
        product = self.pull(V)[:, :d] @ V[:, :d].swapaxes(1, 2)
        return (product + product.swapaxes(1, 2)) / 2

    def nearby_minimum(self, T_world_i: np.ndarray) -> np.ndarray:
        """The poses where Newton's steps from these come to rest; frame 0 stays."""
        T, cost, factor = T_world_i, self.objective(T_world_i), None
        last = np.inf
        for _ in range(_NEWTON_STEPS):
            slope = self._slope(T)
            if factor is None or last > _NEAR * cost:
                factor = self._curvature(T)
            if factor is None:
                break
            step = -factor.solve(slope)
            decrement = float(-slope @ step)
            if decrement <= 0 or (last <= _NEAR * cost and decrement > last / 4):
                break  # rounding is all that is left
            moved, lower = self._searched(T, step, cost, decrement)
            if moved is None:
                break
            T, cost, last = moved, lower, decrement
        return T

    def _searched(
        self, T: np.ndarray, step: np.ndarray, cost: float, decrement: float
    ) -> tuple[np.ndarray | None, float]:
        """The poses after as much of a step as lowers F, and F; else None."""
        tangent = np.zeros(self.num * self._num_tangents)
        tangent[self._free] = step
        tangent = tangent.reshape(self.num, -1)
        share = 1.0
        for _ in range(_HALVINGS):
            moved = _moved(T, share * tangent)
            lower = self.objective(moved)
            rounding = 1e-12 * cost
            if lower <= cost - 1e-4 * share * decrement + rounding:
                return moved, lower
            share /= 2
        return None, cost

    @property
    def _num_tangents(self) -> int:
        return 3 * self.dim - 3

    @cached_property
    def _free(self) -> np.ndarray:
        """All tangents but those of frame 0."""
        k = self._num_tangents
        return kept_unknowns(self.order, k, np.arange(k))

    def _slope(self, T: np.ndarray) -> np.ndarray:
        slope = 2 * np.einsum("vard,vdr->va", _basis(T), self.pull(lifted(T)))
        return slope.ravel()[self._free]

    def _curvature(self, T: np.ndarray) -> Factor | None:
        """Factor of the Hessian where F is convex, else without the multipliers."""
        d, k = self.dim, self._num_tangents
        i, j = self.edges.T
        every = np.arange(self.num)
        half = _basis(T).reshape(self.num, k * d, d + 1)
        own, beside = self.blocks
        parts = self._symmetric(_reduced(half[i], beside, half[j], k))
        for multipliers in (self.multipliers(lifted(T)), np.zeros((self.num, d, d))):
            less = own.copy()
            less[:, :d, :d] -= multipliers
            whole = [(every, every, _reduced(half, less, half, k)), *parts]
            hessian = 2 * from_blocks(whole, self.num, k)[self._free][:, self._free]
            factor = definite_factor(sp.csc_array(hessian))
            if factor is not None:
                return factor
        return None

    def _symmetric(self, block: np.ndarray) -> list[Blocks]:
        i, j = self.edges.T
        return [(i, j, block), (j, i, block.swapaxes(1, 2))]


def lifted(T_world_i: np.ndarray) -> np.ndarray:
    """The transposed rows of poses, `(v, d+1, d)`, to which columns may be added."""
    return np.ascontiguousarray(T_world_i[:, :-1].swapaxes(1, 2))


def _generators(d: int) -> np.ndarray:
    """`(1, 2, 2)` or `(3, 3, 3)`, of rotations."""
    if d == 2:
        return np.array([[[0.0, -1.0], [1.0, 0.0]]])
    return np.cross(np.eye(3)[:, None], np.eye(3)).swapaxes(1, 2)


def _basis(T: np.ndarray) -> np.ndarray:
    """`(v, k, d, d+1)`: how X changes with turns on the right and shifts."""
    d = T.shape[-1] - 1
    G = _generators(d)
    basis = np.zeros((len(T), len(G) + d, d, d + 1))
    basis[:, : len(G), :, :d] = T[:, None, :d, :d] @ G
    basis[:, len(G) :, :, d] = np.eye(d)
    return basis


def _reduced(left: np.ndarray, S: np.ndarray, right: np.ndarray, k: int) -> np.ndarray:
    """Blocks `(m, k, k)` of a quadratic form, summed over the rows of X."""
    shape = len(S), k, -1
    return (left @ S).reshape(shape) @ right.reshape(shape).swapaxes(1, 2)


def _moved(T: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    d = T.shape[-1] - 1
    G = _generators(d)
    turn = np.eye(d) + np.einsum("va,aij->vij", tangent[:, : len(G)], G)
    moved = T.copy()
    moved[:, :d, :d] = nearest_rotations(T[:, :d, :d] @ turn)
    moved[:, :d, d] += tangent[:, len(G) :]
    return moved


def nearest_rotations(A: np.ndarray) -> np.ndarray:
    """Of each `(d, d)` matrix."""
    U, _, Vt = np.linalg.svd(A)
    U[..., -1] *= np.linalg.det(U @ Vt)[..., None]
    return U @ Vt


def rigid(T: np.ndarray) -> np.ndarray:
    """Poses in float64 whose rotations are rotations up to its rounding."""
    exact = np.asarray(T, np.float64).copy()
    exact[:, :-1, :-1] = nearest_rotations(exact[:, :-1, :-1])
    return exact


def joined(edges: np.ndarray, num: int) -> np.ndarray:
    """`(v,)` the frames that edges join to frame 0."""
    links = sp.coo_array((np.ones(len(edges)), tuple(edges.T)), (num, num))
    label = connected_components(links, directed=False)[1]
    return label == label[0]
