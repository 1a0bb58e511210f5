"""The certificate matrix S of SE-Sync and its least eigenvalue.

S is M less the multipliers of the rotations. Its eigenvalues are those over rotations,
which is what the multipliers are about, translations being eliminated; but these stay
unknowns, so that S is as sparse as the graph.

A factor of S + m diag(I, 0) proves that none is below -m, up to rounding of float64,
where the Ritz values of Lanczos or LOBPCG are above the least eigenvalue.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sla

from jaxreg.averaging.relaxation.connection import Connection
from jaxreg.linear.sparse import Factor, definite_factor, kept_unknowns


# Rounding of a factor, in eps times the largest entry.
_ROUNDING = 20


class Least(NamedTuple):
    """The least eigenvalue of S.

    Attributes:
        value: as Lanczos finds it.
        vector: `(v, d+1)`, translations included.
        above: minus a number that none is below.
        proved: whether that is next to nothing: S is positive semidefinite.
    """

    value: float
    vector: np.ndarray
    above: float
    proved: bool


class CertificateMatrix:
    """S with translation 0 held.

    Attributes:
        trace: of the multipliers; a lower bound of the objective where S is positive
            semidefinite.
        count: d v, which a shift of all eigenvalues costs the bound.
    """

    def __init__(self, connection: Connection, multipliers: np.ndarray) -> None:
        size = connection.dim + 1
        self.shape = connection.num, size
        self.count = connection.num * connection.dim
        self.trace = float(np.trace(multipliers, axis1=1, axis2=2).sum())
        S = connection.with_multipliers(multipliers)
        self._free = kept_unknowns(connection.order, size, np.array([connection.dim]))
        self._matrix = sp.csc_array(S[self._free][:, self._free])
        self._turns = (self._free % size != connection.dim).astype(float)
        largest = float(np.abs(self._matrix.data).max(initial=0))
        self._rounding = _ROUNDING * np.finfo(float).eps * largest
        # M has no negative eigenvalue.
        self._safe = float(np.linalg.eigvalsh(multipliers).max(initial=0))
        self._safe += self._rounding

    @classmethod
    def of(cls, connection: Connection, V: np.ndarray) -> "CertificateMatrix":
        """At lifted poses `(v, d+1, r)`."""
        return cls(connection, connection.multipliers(V))

    def is_semidefinite(self, total: float) -> bool:
        """What `least` calls proved, by one factor."""
        return self.shape[0] == 1 or self._factor(self._shift(total)) is not None

    def _shift(self, total: float) -> float:
        return max(total / self.count, self._rounding)

    def least(self, total: float) -> Least:
        """The least eigenvalue.

        Args:
            total: what the bound may lose: S counts as positive semidefinite if no
                eigenvalue is below minus this over `count`, or below minus rounding.
        """
        if self.shape[0] == 1:
            return Least(0.0, np.zeros(self.shape), 0.0, True)
        shift = self._shift(total)
        factor = self._factor(shift)
        if factor is not None:
            return Least(*self._eigenpair(factor, shift), shift, True)
        safe = self._safe
        for guess in (10 * shift, 100 * shift, self._safe):
            factor = self._factor(guess) if guess <= self._safe else None
            if factor is not None:
                safe = guess
                break
        while factor is None:  # by rounding alone
            safe *= 2
            factor = self._factor(safe)
        value, vector = self._eigenpair(factor, safe)
        for excess in (1e-6, 1e-3, 1e-1):
            near = -value * (1 + excess) + shift
            if near < safe and self._factor(near) is not None:
                return Least(value, vector, near, False)
        return Least(value, vector, safe, False)

    def _factor(self, shift: float) -> Factor | None:
        shifted = self._matrix + sp.diags_array(shift * self._turns)
        return definite_factor(sp.csc_array(shifted))

    def _eigenpair(self, factor: Factor, shift: float) -> tuple[float, np.ndarray]:
        """By Lanczos on the inverse of S + m diag(I, 0), over rotations."""
        turning = np.flatnonzero(self._turns)
        wide = np.zeros(len(self._turns))

        def inverse(y: np.ndarray) -> np.ndarray:
            wide[turning] = y.ravel()
            return factor.solve(wide)[turning]

        num = len(turning)
        start = np.random.default_rng(0).normal(size=num)
        lib: Any = sla
        operator = lib.LinearOperator((num, num), matvec=inverse, dtype=float)
        try:
            values, vectors = lib.eigsh(operator, 1, v0=start, tol=1e-4, maxiter=10)
        except sla.ArpackNoConvergence as stopped:
            values, vectors = stopped.eigenvalues, stopped.eigenvectors
        if len(values) == 0:
            value = float(start @ start / (start @ inverse(start)))
            vectors = inverse(start)[:, None]
            vectors /= np.linalg.norm(vectors)
            values = np.array([1 / value])
        wide[turning] = vectors[:, 0]
        full = np.zeros(self.shape[0] * self.shape[1])
        full[self._free] = factor.solve(wide) / values[0]
        return 1 / float(values[0]) - shift, full.reshape(self.shape)
