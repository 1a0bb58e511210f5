"""Solvers of optimistix as parts of methods.

optimistix is imported by whoever hands over one of its solvers, and here once there is
one: all others need not wait for it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import cast_floats
from jaxreg._core.checks import told


class Lowered(NamedTuple):
    """Where a solver ended, whether by its own tolerances, and after how many steps."""

    x: Array
    converged: Bool[Array, ""]
    num_steps: Int[Array, ""]


class Solver(eqx.Module):
    """A minimiser or a least-squares solver of optimistix.

    Its numbers, which are Python floats there, are traced: another tolerance compiles
    nothing. All else, such as the norm that it ends by, is static.

    Attributes:
        numbers: the solver with nothing but its numbers, as arrays.
        rest: the solver without them (static).
    """

    numbers: Any
    rest: Any = eqx.field(static=True)

    @classmethod
    def of(cls, solver: object, name: str) -> "Solver":
        """Takes a solver apart.

        Args:
            solver: of optimistix, or one that was taken apart.
            name: how error messages call it.

        Raises:
            TypeError: for anything else, such as a root finder.
        """
        if isinstance(solver, cls):
            return solver
        import optimistix

        kinds = optimistix.AbstractMinimiser, optimistix.AbstractLeastSquaresSolver
        if not isinstance(solver, kinds):
            raise TypeError(
                f"{name}: wanted a minimiser or a least-squares solver of optimistix "
                "such as optimistix.LevenbergMarquardt(rtol=1e-6, atol=1e-6), found "
                f"{told(solver, optimistix.AbstractIterativeSolver)}."
            )
        traced = jax.tree.map(
            lambda x: jnp.asarray(x, float) if type(x) is float else x, solver
        )
        return cls(*eqx.partition(traced, eqx.is_array))

    @property
    def takes_rows(self) -> bool:
        """Whether it makes a vector of residuals small, not a single number."""
        import optimistix

        return isinstance(self.rest, optimistix.AbstractLeastSquaresSolver)

    def lower(
        self,
        energy: Callable[[Array], Float[Array, ""]],
        rows: Callable[[Array], Array],
        start: Array,
        max_steps: int,
    ) -> Lowered:
        """Makes an energy small; no derivative passes, and no failure raises.

        Args:
            energy: for minimisers.
            rows: of which `energy` is half the sum of squares, for least squares.
            start: where to start.
            max_steps: evaluations at most, of which the first is that of the start.
        """
        import optimistix

        # Some of its states are of the default dtype, whatever that of the unknowns.
        wide, dtype = jnp.result_type(float), start.dtype
        solver = eqx.combine(cast_floats(self.numbers, wide), self.rest)
        run: Any = optimistix.least_squares if self.takes_rows else optimistix.minimise
        small = rows if self.takes_rows else energy
        found = run(
            lambda x, _: small(x.astype(dtype)).astype(wide),
            solver,
            start.astype(wide),
            max_steps=max_steps,
            throw=False,
        )
        return Lowered(
            jax.lax.stop_gradient(found.value).astype(dtype),
            found.result == optimistix.RESULTS.successful,
            jnp.asarray(found.stats["num_steps"], jnp.int32),
        )

    def __repr__(self) -> str:
        fields = vars(self.numbers).items()
        shown = [f"{k}={v:.6g}" for k, v in fields if eqx.is_array(v) and not v.ndim]
        return f"{type(self.rest).__name__}({', '.join(shown)})"
