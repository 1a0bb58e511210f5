"""The global minimum of SE-Sync's objective, certified."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.arrays import traced
from jaxreg._core.checks import check_counts, check_not_negative, check_parts
from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Key
from jaxreg.averaging.base import AbstractAverager, AveragingSolution, starting_poses
from jaxreg.averaging.methods.motion_averaging import MotionAveraging
from jaxreg.averaging.methods.pose_graph_lm import PoseGraphLM
from jaxreg.averaging.relaxation.connection import Connection, joined, rigid
from jaxreg.averaging.relaxation.staircase import Climbed, climb
from jaxreg.averaging.steps.edge_errors import ChordalError
from jaxreg.averaging.steps.levenberg_marquardt import minimise
from jaxreg.graph.chordal import chordal_weights
from jaxreg.graph.pose_graph import PoseGraph


# Of the objective, what the bound of `certify` may lose to rounding.
_SHARE = 2.5e-7


class RiemannianStaircase(AbstractAverager):
    """Least squares to the global minimum: SE-Sync's objective, certified.

    The minimum of `PoseGraphLM(ChordalError())` is checked by the certificate of
    `jaxreg.certify`. Where it is a local one, the poses get further dimensions, where
    the way down goes on; the minimum found there is the global one, unless noise is
    extreme. It costs about as much again as `PoseGraphLM` where that was right.

    All edges count: wrong ones pull the answer away, certified or not. Average by
    `Correntropy()` first, and keep the edges that it trusts.

    Attributes:
        max_rank: largest dimension of the rotations' rows (static).
        max_steps: largest number of steps of Levenberg-Marquardt (static).
        tolerance: those stop when the next step would lower the objective by less than
            this share; the certificate needs it small.
        initialiser: finds a start from the motions alone.

    Starts from `init` if its objective is lower than that of the initialiser's poses.

    Status UNCERTIFIED: the rank ran out, or the noise is so large that no certificate
    exists; the poses are the best that were found. `num_steps` are those of
    Levenberg-Marquardt and of the staircase.

    The certificate and the staircase run on the host in float64 (`jax.pure_callback`;
    under `vmap` one after another), on factors of sparse matrices: meant for graphs up
    to some ten thousand poses.

    Gradients: implicit at the minimum with respect to `T_i_j`, `weight` and
    `information`; the start is cut.

    Reference: Rosen, Carlone, Bandeira, Leonard, SE-Sync, IJRR 2019; Boumal 2015.
    """

    max_rank: int = eqx.field(static=True, default=10)
    max_steps: int = eqx.field(static=True, default=50)
    tolerance: Array | float = traced(1e-13)
    initialiser: AbstractAverager = eqx.field(
        default_factory=lambda: MotionAveraging(max_steps=3)
    )

    def __check_init__(self) -> None:
        """Refuses parts, counts and numbers that it cannot use."""
        check_parts(self, initialiser=AbstractAverager)
        check_counts(self, max_steps=1, max_rank=2)
        check_not_negative(self, "tolerance")

    @kept_program
    def solve(
        self,
        graph: PoseGraph,
        init: Float[Array, "v D D"] | None,
        key: Key | None,
    ) -> AveragingSolution:
        """Minimises the objective of a prepared graph, and checks the minimum."""
        local = PoseGraphLM(
            ChordalError(), max_steps=self.max_steps, initialiser=self.initialiser
        )
        fixed, held = jax.lax.stop_gradient((graph, self))
        problem = local.problem(fixed)
        T_start = starting_poses(held.initialiser, fixed, None, key)
        if init is not None:
            given = jax.lax.stop_gradient(init)
            better = problem.cost(given) < problem.cost(T_start)
            T_start = jnp.where(better, given, T_start)
        end = minimise(problem, T_start, self.max_steps, held.tolerance)
        T, optimal, climbed = _highest(fixed, end.T, self.max_rank)
        steps = end.step + climbed
        found = local.solution_at(graph, T, jnp.asarray(True), steps, end.trace)
        agreed = found.status == Status.CONVERGED
        status = jnp.where(agreed & ~optimal, Status.UNCERTIFIED, found.status)
        return dataclasses.replace(found, status=status.astype(jnp.int32))


def _highest(graph: PoseGraph, T: Array, max_rank: int) -> tuple[Array, Array, Array]:
    """Poses at the top of the staircase, whether they are optimal, and its steps."""
    kappa, tau = chordal_weights(graph)
    floats = graph.T_i_j, kappa, tau, T
    dtype = np.dtype(T.dtype)
    # As bits: the thread of a callback does not know that float64 is enabled where a
    # context manager does that.
    bits = [jax.lax.bitcast_convert_type(x, jnp.int32) for x in floats]
    shapes = (
        jax.ShapeDtypeStruct(bits[-1].shape, jnp.int32),
        jax.ShapeDtypeStruct((2,), jnp.int32),
    )

    def on_host(edges: Any, *arrays: Any) -> tuple[np.ndarray, np.ndarray]:
        T_i_j, kappa, tau, T = (
            np.array(x).view(dtype).reshape(like.shape)
            for x, like in zip(arrays, floats, strict=True)
        )
        found = _climbed(np.asarray(edges), T_i_j, (kappa, tau), T, max_rank)
        told = np.array([found.optimal, found.num_steps], np.int32)
        poses = np.ascontiguousarray(found.T_world_i.astype(dtype))
        return poses.view(np.int32).reshape(shapes[0].shape), told

    poses, told = jax.pure_callback(
        on_host, shapes, graph.edges, *bits, vmap_method="sequential"
    )
    return jax.lax.bitcast_convert_type(poses, T.dtype), told[0] > 0, told[1]


def _climbed(
    edges: np.ndarray,
    T_i_j: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray],
    T: np.ndarray,
    max_rank: int,
) -> Climbed:
    keep = (weights[0] > 0) & (weights[1] > 0)
    covered = joined(edges[keep], len(T))
    if not keep.any() or not np.all(np.isfinite(T)):
        return Climbed(T, T.shape[-1] - 1, 0.0, not keep.any(), 0)
    number = np.cumsum(covered) - 1
    kept = weights[0][keep], weights[1][keep]
    connection = Connection.of(
        number[edges[keep]], rigid(T_i_j[keep]), kept, int(covered.sum())
    )
    found = climb(connection, rigid(T[covered]), _SHARE, max_rank)
    poses = np.array(T)
    poses[covered] = found.T_world_i
    return found._replace(T_world_i=poses)
