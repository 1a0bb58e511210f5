"""Solvers of optimistix and of lineax as parts of methods.

Their numbers, which are Python floats there, are traced: another tolerance compiles
nothing. optimistix is imported by whoever hands over one of its solvers, and here once
there is one: all others need not wait for it.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, TypeVar

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


class AbstractParted(eqx.Module):
    """A solver, its numbers apart from what is static, such as its norm.

    Attributes:
        numbers: the solver with nothing but its numbers, as arrays.
        rest: the solver without them (static).
    """

    numbers: Any
    rest: Any = eqx.field(static=True)

    def whole(self, dtype: Any) -> Any:
        """The solver, with numbers of that dtype."""
        return eqx.combine(cast_floats(self.numbers, dtype), self.rest)

    def __repr__(self) -> str:
        fields = vars(self.numbers).items()
        shown = [f"{k}={v:.6g}" for k, v in fields if eqx.is_array(v) and not v.ndim]
        return f"{type(self.rest).__name__}({', '.join(shown)})"


Kind = TypeVar("Kind", bound=AbstractParted)


def _parted(kind: type[Kind], solver: object) -> Kind:
    """Takes a solver apart."""
    traced = jax.tree.map(
        lambda x: jnp.asarray(x, float) if type(x) is float else x, solver
    )
    return kind(*eqx.partition(traced, eqx.is_array))


class LinearSolver(AbstractParted):
    """A solver of lineax."""

    described: ClassVar[str] = "a solver of lineax such as lineax.Cholesky()"

    @classmethod
    def of(cls, solver: object, name: str) -> "LinearSolver":
        """Takes a solver of lineax apart, if it is not yet; else raises a TypeError."""
        if isinstance(solver, cls):
            return solver
        import lineax

        if not isinstance(solver, lineax.AbstractLinearSolver):
            raise TypeError(
                f"{name}: wanted {cls.described}, found "
                f"{told(solver, lineax.AbstractLinearSolver)}."
            )
        return _parted(cls, solver)


class Solver(AbstractParted):
    """A minimiser or a least-squares solver of optimistix."""

    described: ClassVar[str] = (
        "a minimiser or a least-squares solver of optimistix such as "
        "optimistix.BFGS(rtol=1e-6, atol=1e-6)"
    )

    @classmethod
    def of(cls, solver: object, name: str) -> "Solver":
        """Takes a solver apart, if it is not yet.

        Args:
            solver: of optimistix.
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
                f"{name}: wanted {cls.described}, found "
                f"{told(solver, optimistix.AbstractIterativeSolver)}."
            )
        return _parted(cls, solver)

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

        The functions are pytrees of the arrays that they use, such as `eqx.Partial` and
        methods of modules: optimistix keeps what it has compiled by them.

        Args:
            energy: for minimisers.
            rows: of which `energy` is half the sum of squares, for least squares.
            start: where to start.
            max_steps: evaluations at most, of which the first is that of the start.
        """
        import optimistix

        # Some of its states are of the default dtype, whatever that of the unknowns.
        wide, dtype = jnp.result_type(float), start.dtype
        run: Any = optimistix.least_squares if self.takes_rows else optimistix.minimise
        small = rows if self.takes_rows else energy
        with jax.transfer_guard("allow"):  # it makes a flag on the device when traced
            found = run(
                _Widened(small, dtype),
                self.whole(wide),
                start.astype(wide),
                max_steps=max_steps,
                throw=False,
            )
        return Lowered(
            jax.lax.stop_gradient(found.value).astype(dtype),
            found.result == optimistix.RESULTS.successful,
            jnp.asarray(found.stats["num_steps"], jnp.int32),
        )


class _Widened(eqx.Module):
    """A function of unknowns of a dtype, for those of another."""

    function: Callable[[Array], Array]
    dtype: Any = eqx.field(static=True)

    def __call__(self, x: Array, args: None) -> Array:
        return self.function(x.astype(self.dtype)).astype(x.dtype)
