"""Solvers of graph Laplacians, in the contract of lineax.

All take a `GraphLaplacian` and right-hand sides `(v, k, c)`. Frames that no weight
holds get zero: the solution of least norm.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from jaxreg.linear.krylov import conjugate_gradients
from jaxreg.linear.multigrid import Multigrid, multigrid, ridged_factor
from jaxreg.linear.operator import GraphLaplacian


_State = TypeVar("_State")


class AbstractSymmetricSolver(lx.AbstractLinearSolver[_State]):
    """A solver whose matrix is its own transpose and conjugate."""

    def transpose(
        self, state: _State, options: dict[str, Any]
    ) -> tuple[_State, dict[str, Any]]:
        """The same."""
        return state, options

    def conj(
        self, state: _State, options: dict[str, Any]
    ) -> tuple[_State, dict[str, Any]]:
        """The same: it is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Frames may hang on nothing."""
        return False


class LeastSquares(AbstractSymmetricSolver[Array]):
    """`jnp.linalg.lstsq` of the dense matrix: for few frames, and of any rank."""

    def init(
        self, operator: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> Array:
        """The dense matrix."""
        return _laplacian(operator).dense()

    def compute(
        self, state: Array, vector: Float[Array, "v k c"], options: dict[str, Any]
    ) -> tuple[Float[Array, "v k c"], lx.RESULTS, dict[str, Any]]:
        """Solves by singular values."""
        x = jnp.linalg.lstsq(state, vector.reshape(state.shape[0], -1))[0]
        return x.reshape(vector.shape), lx.RESULTS.successful, {}


class RidgedCholesky(AbstractSymmetricSolver[tuple[Array, Array]]):
    """Factors of the dense matrix under a ridge of rounding, for many solves."""

    def init(
        self, operator: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[Array, Array]:
        """The factor and the scale of each row."""
        return ridged_factor(_laplacian(operator).dense())

    def compute(
        self,
        state: tuple[Array, Array],
        vector: Float[Array, "v k c"],
        options: dict[str, Any],
    ) -> tuple[Float[Array, "v k c"], lx.RESULTS, dict[str, Any]]:
        """Two triangular systems.

        Not by an inverse: with many right-hand sides BLAS starts threads, which take
        longer to meet than to work.
        """
        factor, root = state
        half = root[:, None] * vector.reshape(len(root), -1)
        x = root[:, None] * jax.scipy.linalg.cho_solve((factor, True), half)
        return x.reshape(vector.shape), lx.RESULTS.successful, {}


class MultigridCG(AbstractSymmetricSolver[tuple[GraphLaplacian, Multigrid]]):
    """Conjugate gradients on the edges, preconditioned by a multigrid cycle.

    Attributes:
        rtol: the residual, in the norm of the preconditioner, ends below this share of
            its first value, at best that of the dtype.
        max_steps: at most; stats have `num_steps`.

    Options: `preconditioner`, a `Multigrid` of a similar matrix; `energy`, which the
    solution may lack.
    """

    rtol: float
    max_steps: int = 500

    def init(
        self, operator: lx.AbstractLinearOperator, options: dict[str, Any]
    ) -> tuple[GraphLaplacian, Multigrid]:
        """The cycle of the matrix, unless one is given."""
        matrix, inverse = _laplacian(operator), options.get("preconditioner")
        return matrix, multigrid(matrix) if inverse is None else inverse

    def compute(
        self,
        state: tuple[GraphLaplacian, Multigrid],
        vector: Float[Array, "v k c"],
        options: dict[str, Any],
    ) -> tuple[Float[Array, "v k c"], lx.RESULTS, dict[str, Any]]:
        """Solves for right-hand sides in the range of the matrix."""
        operator, inverse = state
        least = 3 * float(jnp.finfo(vector.dtype).eps)
        x, num_steps = conjugate_gradients(
            operator.mv,
            inverse,
            vector,
            tolerance=max(self.rtol, least),
            max_steps=self.max_steps,
            energy=options.get("energy", 0.0),
        )
        result = lx.RESULTS.where(
            num_steps < self.max_steps,
            lx.RESULTS.successful,
            lx.RESULTS.max_steps_reached,
        )
        return x, result, {"num_steps": num_steps}


def _laplacian(operator: lx.AbstractLinearOperator) -> GraphLaplacian:
    if not isinstance(operator, GraphLaplacian):
        found = type(operator).__name__
        raise TypeError(f"operator: wanted a GraphLaplacian, found {found}.")
    return operator
