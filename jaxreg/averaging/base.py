"""The contract of every averaging method, and its solution."""

import abc
import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.adjoint import refusing
from jaxreg._core.brief import BriefModule
from jaxreg._core.checks import is_concrete
from jaxreg._core.loop import status_of
from jaxreg._core.status import Status, counted
from jaxreg._core.typing import Key, StatusArray
from jaxreg.averaging.likelihood import Likelihood
from jaxreg.averaging.measures import frobenius, weighted_mean
from jaxreg.averaging.trace import AveragingTrace
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph


class AveragingSolution(eqx.Module):
    """One pose per frame. Arrays only: it passes through jit, vmap and pickling.

    Attributes:
        T_world_i: `(v, d+1, d+1)` poses; frame 0 at `init[0]`, else the identity. Poses
            of frames that are not placed are the identity and mean nothing.
        edge_weight: `(e,)` how much the method trusts each edge, from 0 to 1, without
            the prior weight; 0 where masked.
        agreement: the share, by prior weight, of the edges that the method trusts by
            more than a half, among those that are joined to frame 0.
        status: int32, see `jaxreg.Status`.
        placed: `(v,)` True for frames joined to frame 0 by edges of positive weight.
        component: `(v,)` int32, the smallest frame of the component of each frame.
        kernel_width: `(2,)` final width of the correntropy kernel for translation
            (unit of the input) and rotation (radians); inf for methods without one.
        num_steps: int32, steps taken.
        residual: mean over the edges, by prior weight, of the Frobenius norm of
            `T_i_j - inv(T_world_i) T_world_j` with lengths in `length_scale`
            (MCC paper, Eq. 22).
        log_evidence: the logarithm of how much likelier the motions are if the edges
            that agree with the poses are right than if every one is wrong on its own,
            at unknown noise and share of right edges, less what fitting the poses is
            worth (`jaxreg.averaging.likelihood`). At most 0: nothing agrees beyond
            what a tree agrees with by itself; poses of one graph compare by it.
        length_scale: the length that stands for one radian; see `PoseGraph`.
        trace: how the method came to rest, or None if it takes no steps of its own.
        prior_weight: `(p,)` how much each prior is trusted, then each control point,
            then each level, from 0 to 1; 0 for priors of frames that are fixed. None
            without any.
    """

    T_world_i: Float[Array, "v D D"]
    edge_weight: Float[Array, " e"]
    agreement: Float[Array, ""]
    status: StatusArray
    placed: Bool[Array, " v"]
    component: Int[Array, " v"]
    kernel_width: Float[Array, "2"]
    num_steps: Int[Array, ""]
    residual: Float[Array, ""]
    log_evidence: Float[Array, ""]
    length_scale: Float[Array, ""]
    trace: AveragingTrace | None = None
    prior_weight: Float[Array, " p"] | None = None

    def in_unit(self, length: Float[Array, ""]) -> "AveragingSolution":
        """In another unit of length, which is `1 / length`."""
        T, width = self.T_world_i, self.kernel_width
        return dataclasses.replace(
            self,
            T_world_i=lie.compose(lie.rotation(T), lie.translation(T) * length),
            kernel_width=width * jnp.stack([length, jnp.ones_like(length)]),
            length_scale=self.length_scale * length,
            trace=None if self.trace is None else self.trace.in_unit(length),
        )

    def __repr__(self) -> str:
        if not is_concrete(self.status):
            return f"AveragingSolution(T_world_i {self.T_world_i.shape})"
        if self.status.ndim:
            batch = f"batch={self.status.shape}, {counted(self.status)}"
            return f"AveragingSolution({batch})"
        status = Status(int(self.status)).name
        trusted = int(jnp.sum(self.edge_weight > 0.5))
        parts = int(jnp.unique(self.component).shape[0])
        apart = f" ({parts} components)" if parts > 1 else ""
        return (
            f"AveragingSolution({status}: {int(jnp.sum(self.placed))} of "
            f"{self.placed.shape[0]} poses placed{apart}, {trusted} of "
            f"{self.edge_weight.shape[0]} edges trusted,\n"
            f"    residual {float(self.residual):.4g}, {int(self.num_steps)} steps)"
        )


class AbstractAverager(BriefModule):
    """A method of motion averaging: settings only, frozen.

    Methods are called by `jaxreg.average`, which has checked the graph, reduced it to
    what frame 0 reaches, and fixed the gauge: they leave frame 0 at the identity, and
    edges outside the component of frame 0 have weight 0.
    """

    described: ClassVar[str] = "an averaging method such as Correntropy()"

    @abc.abstractmethod
    def solve(
        self, graph: PoseGraph, init: Float[Array, "v D D"] | None, key: Key | None
    ) -> AveragingSolution:
        """Averages a prepared graph; `init` has frame 0 at the identity, or is None."""


class AbstractStart(AbstractAverager):
    """A method that others start from: they want its poses and no solution."""

    @abc.abstractmethod
    def poses(self, graph: PoseGraph, key: Key | None) -> Float[Array, "v D D"]:
        """Those of `solve` for a prepared graph."""


def solution(
    graph: PoseGraph,
    T_world_i: Float[Array, "v D D"],
    *,
    edge_weight: Array | None = None,
    converged: Array | None = None,
    kernel_width: Array | None = None,
    num_steps: Array | int = 0,
    trace: AveragingTrace | None = None,
    likelihood: Likelihood | None = None,
    evidence: Float[Array, ""] | None = None,
) -> AveragingSolution:
    """Fills in what is the same for every method; the last two where they are known.

    Whether anything agrees at all is judged by `average`, after the method.
    """
    dtype = T_world_i.dtype
    likelihood = Likelihood.of(graph) if likelihood is None else likelihood
    scale = likelihood.scale
    trust = jnp.ones(graph.weight.shape, dtype) if edge_weight is None else edge_weight
    done = jnp.asarray(True) if converged is None else converged
    width = jnp.full((2,), jnp.inf, dtype) if kernel_width is None else kernel_width
    trust = jnp.where(graph.mask & (graph.weight > 0), trust, 0)
    evidence = likelihood.log_evidence(T_world_i) if evidence is None else evidence
    return AveragingSolution(
        T_world_i=T_world_i,
        edge_weight=trust,
        agreement=weighted_mean((trust > 0.5).astype(dtype), graph.weight),
        status=status_of(done),
        placed=jnp.ones(T_world_i.shape[:1], dtype=bool),
        component=jnp.zeros(T_world_i.shape[:1], dtype=jnp.int32),
        kernel_width=width,
        num_steps=jnp.asarray(num_steps, jnp.int32),
        residual=weighted_mean(frobenius(graph, T_world_i, scale), graph.weight),
        log_evidence=evidence,
        length_scale=scale,
        trace=trace,
    )


def of_start(
    method: AbstractAverager, graph: PoseGraph, found: AveragingSolution
) -> AveragingSolution:
    """A solution at which nothing balances: asking for its derivatives is an error."""
    name = type(method).__name__
    told = (
        f"{name} finds a start, which no equation holds: it has no derivative. Average "
        f"from it, as by Correntropy(initialiser={name}()), or hold the graph by "
        "jax.lax.stop_gradient."
    )
    poses = refusing(found.T_world_i, (method, graph), told)
    return dataclasses.replace(found, T_world_i=poses)


def starting_poses(
    initialiser: AbstractAverager,
    graph: PoseGraph,
    init: Float[Array, "v D D"] | None,
    key: Key | None,
) -> Float[Array, "v D D"]:
    """The poses to start from: `init`, or what the initialiser finds; held."""
    if init is not None:
        return init
    held = jax.lax.stop_gradient(graph)
    if isinstance(initialiser, AbstractStart):
        return initialiser.poses(held, key)
    return initialiser.solve(held, None, key).T_world_i
