"""Least squares over a graph by a solver of optimistix.

The solver works on one tangent space for all poses, T_world_i <- exp(x_i) T_world_i,
around those that it starts from.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.loop import iterate
from jaxreg._core.restarts import MAX_STARTS, AbstractRestarts
from jaxreg._core.solver import Lowered, Solver
from jaxreg._core.typing import Scalar
from jaxreg.averaging.steps.edge_problem import Problem
from jaxreg.geometry import lie
from jaxreg.linear.small import product, root_semidefinite


class Minimum(NamedTuple):
    """Where the solver stopped."""

    T: Float[Array, "v D D"]
    converged: Bool[Array, ""]
    step: Int[Array, ""]


def minimise_by(
    solver: Solver,
    problem: Problem,
    T_start: Float[Array, "v D D"],
    max_steps: int,
    tolerance: Array | float,
) -> Minimum:
    """Starts a solver until a start lowers the cost by at most `tolerance` of it.

    Args:
        solver: a minimiser or a least-squares solver.
        problem: what is made small.
        T_start: poses to start from.
        max_steps: of the solver from each start.
        tolerance: share of the cost.
    """
    limit = jnp.maximum(tolerance, 4 * jnp.finfo(T_start.dtype).eps)
    charts = _Charts(
        solver=solver,
        problem=problem,
        whitening=_whitening(problem),
        limit=limit,
        max_steps=max_steps,
    )
    ended = iterate(charts, charts.init(T_start), max_steps=MAX_STARTS)
    return Minimum(ended.state.T, ended.converged, ended.state.taken)


class _Charts(AbstractRestarts):
    solver: Solver
    problem: Problem
    whitening: Float[Array, "e m m"]
    limit: Scalar
    max_steps: int

    def cost(self, T: Array) -> Array:
        return self.problem.cost(T)

    def lowered(self, T: Array) -> tuple[Array, Lowered]:
        k = lie.tangent_dim(self.problem.graph.dim)
        zero = jnp.zeros(((len(T) - 1) * k,), T.dtype)
        energy, rows = (eqx.Partial(f, T) for f in (self._energy, self._rows))
        found = self.solver.lower(energy, rows, zero, self.max_steps)
        return lie.straightened(self._moved(T, found.x)), found

    def _moved(self, T: Array, x: Array) -> Array:
        """The poses at tangents of all but pose 0; those that no edge holds stay."""
        tangents = jnp.where(self._held, x.reshape(len(T) - 1, -1), 0)
        none = jnp.zeros_like(tangents[:1])
        return product(lie.exp(jnp.concatenate([none, tangents])), T)

    def _rows(self, T: Array, x: Array) -> Array:
        """Half the sum of their squares is half the cost."""
        r = self.problem.errors(self._moved(T, x))
        white = jnp.sum(self.whitening * r[:, None, :], axis=-1)
        s = jnp.sum(white**2, axis=-1)
        some = s > 0
        share = jnp.where(some, self.problem.loss(s) / jnp.where(some, s, 1), 1)
        white = jnp.sqrt(share)[:, None] * white
        # Columns of zeros have no factors.
        free = jnp.where(self._held, 0, x.reshape(len(T) - 1, -1))
        return jnp.concatenate([white.ravel(), free.ravel()])

    def _energy(self, T: Array, x: Array) -> Array:
        return jnp.sum(self._rows(T, x) ** 2) / 2

    @property
    def _held(self) -> Bool[Array, "u 1"]:
        """Which poses but the first an edge of positive weight holds."""
        graph = self.problem.graph
        touched = jnp.zeros((graph.num_poses,), bool)
        for end in (0, 1):
            touched = touched.at[graph.edges[:, end]].max(graph.weight > 0)
        return touched[1:, None]


def _whitening(problem: Problem) -> Float[Array, "e m m"]:
    """R with R^T R = Omega."""
    Omega = problem.precision
    if Omega.ndim == 2:
        return jnp.sqrt(Omega)[..., None] * jnp.eye(Omega.shape[-1], dtype=Omega.dtype)
    return root_semidefinite(Omega, jnp.zeros_like(Omega[..., 0]))[0]
