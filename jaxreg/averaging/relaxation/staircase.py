"""The Riemannian staircase: out of local minima through more dimensions.

Where the certificate matrix S of poses has a negative eigenvalue, a further row of
X = [T_world_0, ...] along its eigenvector lowers tr(X M X'). Rotations then are points
of a Stiefel manifold, r x d with orthonormal columns. Descending there by a Riemannian
trust region, and adding rows as long as S is indefinite, ends at the minimum of the
semidefinite relaxation; where the noise is not extreme, it has d rows after all.

On the host: an exact factor of M preconditions every step.

Reference: Rosen, Carlone, Bandeira, Leonard, SE-Sync, IJRR 2019; Boumal 2015; Absil,
Baker, Gallivan 2007 (trust region).
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from jaxreg.averaging.relaxation.certificate_matrix import CertificateMatrix
from jaxreg.averaging.relaxation.connection import Connection, lifted, nearest_rotations
from jaxreg.linear.sparse import Factor, definite_factor, kept_unknowns


_STEPS, _INNER = 200, 100
# Of the gradient, in the norm of the preconditioner, what a step leaves at most; and
# the share of the objective that the next step may promise at the end.
_LEFT, _STILL = 0.1, 1e-12
# Of the largest precision, what is added to M so that it has a factor.
_RIDGE = 1e-7


class Climbed(NamedTuple):
    """Where the staircase ended.

    Attributes:
        T_world_i: `(v, d+1, d+1)`, frame 0 at the identity.
        rank: rows of X at the last stair; d where none was needed.
        relaxed: the objective there.
        optimal: whether S of the poses is positive semidefinite: a global minimum. Else
            the rows ran out, or the noise is so large that the relaxation is not tight.
        num_steps: of the trust regions.
    """

    T_world_i: np.ndarray
    rank: int
    relaxed: float
    optimal: bool
    num_steps: int


def climb(
    connection: Connection, T_start: np.ndarray, share: float, max_rank: int
) -> Climbed:
    """Descends from any poses, and adds rows until S is positive semidefinite.

    Args:
        connection: the motions.
        T_start: `(v, d+1, d+1)`, best near a minimum.
        share: of the objective that the bound may lose to a least eigenvalue below 0.
        max_rank: largest number of rows.
    """
    d = connection.dim
    for T in (T_start, connection.nearby_minimum(T_start)):
        if _is_optimal(connection, lifted(T), share):
            return Climbed(T, d, connection.objective(T), True, 0)
    descent = _Descent(connection)
    V, num_steps = lifted(T), 0
    while True:
        V, taken = descent.minimise(V)
        num_steps += taken
        rank = V.shape[-1]
        if _is_optimal(connection, V, share) or rank >= max_rank:
            break
        least = CertificateMatrix.of(connection, V).least(share * connection.cost(V))
        V = _escaped(connection, V, least.vector)
    T_near = connection.nearby_minimum(_rounded(V))
    # Rounding a point of many rows may lose what a minimum of d rows had.
    T = min((T_near, T), key=connection.objective)
    T = np.linalg.inv(T[0]) @ T
    optimal = _is_optimal(connection, lifted(T), share)
    return Climbed(T, rank, connection.cost(V), optimal, num_steps)


def _is_optimal(connection: Connection, V: np.ndarray, share: float) -> bool:
    matrix = CertificateMatrix.of(connection, V)
    return matrix.is_semidefinite(share * connection.cost(V))


def _escaped(connection: Connection, V: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """With a further row that lowers the objective."""
    rows = np.pad(V, ((0, 0), (0, 0), (0, 1)))
    size = np.linalg.norm(vector[:, :-1], axis=1).max()
    change = np.zeros_like(rows)
    change[..., -1] = vector / size
    tried = [_retracted(rows, change / 2**k) for k in range(20)]
    return min(tried, key=connection.cost)


class _Descent:
    """A Riemannian trust region on lifted poses."""

    def __init__(self, connection: Connection) -> None:
        size = connection.dim + 1
        self.connection = connection
        self.free = kept_unknowns(connection.order, size, np.array([connection.dim]))
        ridge = _RIDGE * connection.precision.max(initial=0)
        M = connection.matrix[self.free][:, self.free]
        self.factor = _certain_factor(M, ridge)

    def minimise(self, V: np.ndarray) -> tuple[np.ndarray, int]:
        """Lifted poses where the gradient promises nothing, and the number of steps."""
        cost = self.connection.cost(V)
        radius = np.sqrt(cost)
        for step in range(_STEPS):
            x, model, border, force = self._within(V, cost, radius)
            if force <= _STILL * cost or radius**2 <= _STILL * cost:
                return V, step
            moved = _retracted(V, x)
            lower = self.connection.cost(moved)
            rounding = 1e-14 * cost
            ratio = (cost - lower + rounding) / (model + rounding)
            if ratio < 0.25:
                radius = min(radius, self._size(x)) / 4
            elif ratio > 0.75 and border:
                radius *= 2
            if ratio > 0.1:
                V, cost = moved, lower
        return V, _STEPS

    def _size(self, x: np.ndarray) -> float:
        return float(np.sqrt(np.sum(x * self._pull(x))))

    def _pull(self, V: np.ndarray) -> np.ndarray:
        return self.connection.pull(V)

    def _inverse(self, r: np.ndarray) -> np.ndarray:
        """The preconditioner: M^-1 with translation 0 held."""
        flat = r.reshape(-1, r.shape[-1])
        x = np.zeros_like(flat)
        x[self.free] = self.factor.solve(flat[self.free])
        return x.reshape(r.shape)

    def _within(
        self, V: np.ndarray, cost: float, radius: float
    ) -> tuple[np.ndarray, float, bool, float]:
        """Conjugate gradients up to the radius (Steihaug 1983).

        Returns:
            The step, by how much its model falls, whether it ends at the radius, and
            the preconditioned gradient squared.
        """
        d = V.shape[1] - 1
        pull = self._pull(V)
        multipliers = self.connection.multipliers(V)

        def hessian(p: np.ndarray) -> np.ndarray:
            Hp = self._pull(p)
            Hp[:, :d] -= multipliers @ p[:, :d]
            return _held(_tangent(V, Hp))

        gradient = _held(_tangent(V, pull))
        x, r, Hx = np.zeros_like(V), -gradient, np.zeros_like(V)
        z = _tangent(V, self._inverse(r))
        p, rz = z, float(np.sum(r * z))
        force, goal = rz, min(_LEFT, np.sqrt(max(rz, 0) / max(cost, 1e-300))) ** 2 * rz
        xPx, xPp, pPp = 0.0, 0.0, rz
        border = False
        for _ in range(_INNER):
            if rz <= goal * (x.any()) or rz <= 0:
                break
            Hp = hessian(p)
            curvature = float(np.sum(p * Hp))
            alpha = rz / curvature if curvature > 0 else np.inf
            if not xPx + 2 * alpha * xPp + alpha**2 * pPp < radius**2:
                room = max(radius**2 - xPx, 0.0)
                alpha, border = (-xPp + np.sqrt(xPp**2 + pPp * room)) / pPp, True
            x, Hx, r = x + alpha * p, Hx + alpha * Hp, r - alpha * Hp
            if border:
                break
            z = _tangent(V, self._inverse(r))
            last, rz = rz, float(np.sum(r * z))
            beta = rz / last
            xPx += 2 * alpha * xPp + alpha**2 * pPp
            xPp, pPp = beta * (xPp + alpha * pPp), rz + beta**2 * pPp
            p = z + beta * p
        model = -float(np.sum(x * (2 * gradient + Hx)))
        return x, model, border, force


def _certain_factor(M: sp.csc_array, ridge: float) -> Factor:
    eye = sp.eye_array(len(M.indptr) - 1)
    while True:
        factor = definite_factor(sp.csc_array(M + ridge * eye))
        if factor is not None:
            return factor
        ridge *= 10


def _held(change: np.ndarray) -> np.ndarray:
    """With translation 0 at rest."""
    change[0, -1] = 0
    return change


def _tangent(V: np.ndarray, change: np.ndarray) -> np.ndarray:
    """What of a change keeps the rows of rotations orthonormal."""
    d = V.shape[1] - 1
    across = change[:, :d] @ V[:, :d].swapaxes(1, 2)
    out = change.copy()
    out[:, :d] -= (across + across.swapaxes(1, 2)) / 2 @ V[:, :d]
    return out


def _retracted(V: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Lifted poses after a change: rows made orthonormal."""
    d = V.shape[1] - 1
    moved = V + change
    rows = moved[:, :d]
    L = np.linalg.cholesky(rows @ rows.swapaxes(1, 2))
    moved[:, :d] = np.linalg.solve(L, rows)
    return moved


def _rounded(V: np.ndarray) -> np.ndarray:
    """Poses `(v, d+1, d+1)` near lifted ones."""
    d = V.shape[1] - 1
    rows = V[:, :d].reshape(-1, V.shape[-1])
    main = np.linalg.eigh(rows.T @ rows)[1][:, -d:]
    near = (V @ main).swapaxes(1, 2)
    if np.sum(np.sign(np.linalg.det(near[:, :, :d]))) < 0:  # mirrored
        near[:, 0] *= -1
    T = np.tile(np.eye(d + 1), (len(V), 1, 1))
    T[:, :d, :d] = nearest_rotations(near[:, :, :d])
    T[:, :d, d] = near[:, :, d]
    return T
