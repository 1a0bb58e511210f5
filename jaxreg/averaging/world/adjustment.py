"""Poses adjusted to all that is known of them: one least squares, robust by trust.

Edges keep the trust that averaging gave them. Priors, control points and levels are
trusted by how far they are off, in standard deviations: by a Welsch kernel that a
hundredth of the right ones leave. They are believed at their word, unless the middle
one of three and more shows that their deviations are too small.

Of two ways to an answer the one that explains more is taken: from where most of what is
known fits the parts as they are, and, as drift may be larger than a wrong prior, from a
kernel that takes all in and narrows (graduated non-convexity; Yang et al. 2020).

Reference: Triggs et al. 2000, "Bundle adjustment: a modern synthesis" (gauge by control
points).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core import control
from jaxreg._core.quantile import nearest_rank
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar, StatusArray
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.gauge import average_graph, follow_graph
from jaxreg.averaging.measures import deviations
from jaxreg.averaging.methods.pose_graph_lm import PoseGraphLM
from jaxreg.averaging.world.levels import Levels
from jaxreg.averaging.world.points import ControlPoints
from jaxreg.averaging.world.rigid_fit import FARTHEST, MEDIAN
from jaxreg.geometry import lie
from jaxreg.graph.anchored import KnownPoses, anchored, joined_priors
from jaxreg.graph.pose_graph import PoseGraph


#: Adjustments, each with the trust that the one before leaves.
_ROUNDS = 5
# Rows from which on their middle misfit says more than their own deviations.
_ENOUGH = 3
# Deviations are told too small by some factor of one digit, where receivers and people
# are sure of themselves; where the middle one is off by more, a row is a mistake.
_MISTAKEN = 10.0


class _Minimum(NamedTuple):
    T_world_i: Float[Array, "v D D"]
    status: StatusArray
    trust: Float[Array, " n"]  # in edges and all that is known, that it is by


class _Rows(NamedTuple):
    off: Float[Array, " n"]  # over the middle one of right rows
    free: int  # components of each
    told: bool  # whether their deviations are; else they are off in lengths


class _Problem(NamedTuple):
    """Least squares whose frame 0 is the world."""

    graph: PoseGraph
    T_start: Float[Array, "v+1 D D"]
    moved: Bool[Array, " v+1"]  # by it, and the world

    @classmethod
    def of(
        cls, graph: PoseGraph, known: KnownPoses, trust: Array, T: Array, joined: Array
    ) -> "_Problem":
        whole = anchored(graph, known)
        whole = eqx.tree_at(lambda g: g.weight, whole, whole.weight * trust)
        start = jnp.concatenate([jnp.eye(graph.dim + 1, dtype=T.dtype)[None], T])
        return cls(whole, start, jnp.append(True, joined & ~known.fixed))

    def poses(self, end: AveragingSolution) -> Float[Array, "v D D"]:
        """Of the answer; those that no trusted edge holds stay."""
        reached = (self.moved & end.placed)[:, None, None]
        return jnp.where(reached, end.T_world_i, self.T_start)[1:]


class Adjustment(eqx.Module):
    """Edges and what is known as one graph, by the trust that poses give them.

    Attributes:
        graph: the relative motions.
        poses: priors and fixed frames.
        points: control points, or None without any.
        levels: tilts, or None without any.
        edge_weight: `(e,)` trust in the edges, held.
        joined: `(v,)` frames that lie in the world.
    """

    graph: PoseGraph
    poses: KnownPoses
    points: ControlPoints | None
    levels: Levels | None
    edge_weight: Float[Array, " e"]
    joined: Bool[Array, " v"]

    def solve(
        self, T_start: Float[Array, "v D D"]
    ) -> tuple[Float[Array, "v D D"], StatusArray, Float[Array, " k"]]:
        """Poses, a status, and the trust in each prior, then each point, then level.

        Gradients: by the graph and by what is known, trust held.
        """
        fixed, T_start = jax.lax.stop_gradient((self, T_start))
        # The noise of edges is what they show before anything bends them.
        fixed = eqx.tree_at(lambda a: a.graph, fixed, fixed._informed(T_start))
        widest = jnp.maximum(fixed._widest(T_start), 1)
        rounds = jnp.arange(_ROUNDS, dtype=widest.dtype)
        narrowing = widest ** jnp.maximum(1 - rounds / (_ROUNDS - 2), 0)
        widths = jnp.stack([jnp.ones_like(narrowing), narrowing])

        def one(widths: Array) -> tuple[_Minimum, tuple[Array, ...]]:
            def again(before: _Minimum, width: Array) -> tuple[_Minimum, None]:
                return fixed._minimum(before.T_world_i, width), None

            end, _ = control.scan(again, fixed._start(T_start), widths)
            return end, fixed._sizes(end.T_world_i)

        ends, sizes = jax.lax.map(one, widths)
        least = jax.tree.map(lambda x: jnp.min(x, axis=0), sizes)
        costs = jax.lax.map(lambda T: fixed._cost(T, least), ends.T_world_i)
        best = jax.tree.map(lambda x: x[jnp.argmin(costs)], ends)
        T = self._with_gradients(fixed.graph, best)
        return T, best.status, best.trust[self.graph.num_edges :]

    def whole(
        self, T: Float[Array, "v D D"], width: Scalar | float = 1.0
    ) -> tuple[PoseGraph, KnownPoses, Float[Array, " n"]]:
        """The graph with information, all that is known as priors, and the trust.

        Args:
            T: poses.
            width: of the kernel, over the usual.
        """
        graph, T = self._informed(T), jax.lax.stop_gradient(T)
        sizes = self._sizes(T)
        known = self._priors(graph)
        if self.points is not None:
            known = joined_priors(known, self.points.as_poses(T, sizes[1]))
        if self.levels is not None:
            known = joined_priors(known, self.levels.as_poses(T))
        trust = jnp.exp(-(self._ratios(T, sizes) ** 2) / (2 * width**2))
        trust = jnp.where(self.usable, trust, 0)
        return graph, known, jnp.concatenate([self._edge_trust(), trust])

    def _start(self, T: Float[Array, "v D D"]) -> _Minimum:
        num = self.graph.num_edges + len(self.usable)
        status = jnp.asarray(Status.CONVERGED, jnp.int32)
        return _Minimum(T, status, jnp.zeros(num, T.dtype))

    def _minimum(self, T: Float[Array, "v D D"], width: Scalar) -> _Minimum:
        """By the trust that the poses before give."""
        graph, known, trust = self.whole(T, width)
        problem = _Problem.of(graph, known, trust, T, self.joined)
        end = average_graph(
            problem.graph, PoseGraphLM(), problem.T_start, None, problem.moved
        )
        return _Minimum(problem.poses(end), end.status, trust)

    def _with_gradients(self, informed: PoseGraph, at: _Minimum) -> Array:
        """The same poses, with derivatives where the trust is held."""
        graph = eqx.tree_at(lambda g: g.information, self.graph, informed.information)
        moving = eqx.tree_at(lambda a: a.graph, self, graph)
        _, known, _ = moving.whole(at.T_world_i)
        problem = _Problem.of(graph, known, at.trust, at.T_world_i, self.joined)
        end = follow_graph(problem.graph, problem.T_start, problem.moved)
        return problem.poses(end)

    def is_mistaken(self, T: Float[Array, "v D D"]) -> Bool[Array, ""]:
        """Whether all bends to rows that contradict each other or the edges.

        Of three points one that is wrong shares its misfit with the others. Priors
        without deviations may be off by any number of those of the edges.
        """
        if len(self.poses.frame) and self.poses.information is None:
            return jnp.zeros((), bool)
        pairs = zip(self._rows(T), self._sizes(T), strict=True)
        told = [size for row, size in pairs if row.told]
        return jnp.max(jnp.stack(told)) > _MISTAKEN

    def _edge_trust(self) -> Float[Array, " e"]:
        """What is left of wrong edges would widen the noise."""
        return jnp.where(self.edge_weight > 0.5, self.edge_weight, 0)

    def _informed(self, T: Array) -> PoseGraph:
        graph = self.graph
        if graph.information is not None:
            return graph
        info = shown_information(graph, jax.lax.stop_gradient(T), self._edge_trust())
        return eqx.tree_at(
            lambda g: g.information, graph, info, is_leaf=lambda x: x is None
        )

    def _priors(self, graph: PoseGraph) -> KnownPoses:
        """As good as an edge where nothing else is known of them."""
        if self.poses.information is not None:
            return self.poses
        assert graph.information is not None
        shape = (len(self.poses.frame), *graph.information.shape[1:])
        usual = jnp.broadcast_to(graph.information[0], shape)
        return eqx.tree_at(
            lambda k: k.information, self.poses, usual, is_leaf=lambda x: x is None
        )

    @property
    def usable(self) -> Bool[Array, " k"]:
        """Rows that can count: of frames in the world, of priors of free ones."""
        free = self.joined & ~self.poses.fixed
        each = [self.poses.mask & free[self.poses.frame]]
        each += [
            some.mask & self.joined[some.frame]
            for some in (self.points, self.levels)
            if some is not None
        ]
        return jnp.concatenate(each)

    def _rows(self, T: Array) -> list[_Rows]:
        """How far priors, points and levels are off."""
        known = self._priors(self._informed(T))
        gap = lie.between(known.T_world_prior, T[known.frame])
        error = lie.log(gap)
        assert known.information is not None
        turned = jnp.sum(known.information * error[:, None], axis=-1)
        sq = jnp.maximum(jnp.sum(error * turned, axis=-1), 0)
        each = [(jnp.sqrt(sq), error.shape[-1], True)]
        if self.points is not None:
            told = self.points.information is not None
            each.append((self.points.misfit(T), self.graph.dim, told))
        if self.levels is not None:
            each.append((self.levels.misfit(T), 2, True))
        return [_Rows(off / MEDIAN[free], free, told) for off, free, told in each]

    def _sizes(self, T: Array) -> tuple[Array, ...]:
        """Deviations of each kind: over those that are known, or in lengths."""
        rows, usable = self._rows(T), self.usable
        count = jnp.asarray([len(row.off) for row in rows])
        kind = jnp.repeat(jnp.arange(len(rows)), count, total_repeat_length=len(usable))
        off = jnp.concatenate([row.off for row in rows])
        told = jnp.asarray([row.told for row in rows])[kind]
        of_told = _at_least_one(off, usable & told)
        if self.points is None or rows[1].told:
            return tuple(of_told for _ in rows)
        extent = jnp.max(jnp.abs(self.points.in_world - self.points.in_world[:1]))
        least = jnp.maximum(1e-6 * extent, jnp.finfo(T.dtype).tiny ** 0.5)
        of_points = jnp.maximum(_lower_median(off, usable & ~told), least)
        return tuple(of_told if row.told else of_points for row in rows)

    def _ratios(self, T: Array, sizes: tuple[Array, ...]) -> Float[Array, " k"]:
        """Misfits over those that a hundredth of right ones exceed."""
        return jnp.concatenate(
            [
                row.off / size * (MEDIAN[row.free] / FARTHEST[row.free])
                for row, size in zip(self._rows(T), sizes, strict=True)
            ]
        )

    def _widest(self, T: Array) -> Float[Array, ""]:
        """The width that takes all in."""
        ratios = jnp.where(self.usable, self._ratios(T, self._sizes(T)), 0)
        return jnp.max(ratios, initial=0)

    def _cost(self, T: Array, sizes: tuple[Array, ...]) -> Float[Array, ""]:
        """Half of chi-square, of what is known as far as the kernel counts it."""
        graph = self._informed(T)
        i, j = graph.edges[:, 0], graph.edges[:, 1]
        error = graph.tangent_errors(T)
        assert graph.information is not None
        turned = jnp.sum(graph.information * error[:, None], axis=-1)
        present = graph.mask & self.joined[i] & self.joined[j]
        weight = jnp.where(present, graph.weight * self._edge_trust(), 0)
        edges = jnp.sum(weight * jnp.sum(error * turned, axis=-1)) / 2
        kernel = 1 - jnp.exp(-(self._ratios(T, sizes) ** 2) / 2)
        most = jnp.concatenate(
            [jnp.full_like(row.off, FARTHEST[row.free] ** 2) for row in self._rows(T)]
        )
        return edges + jnp.sum(jnp.where(self.usable, most * kernel, 0))


def shown_information(graph: PoseGraph, T: Array, trust: Array) -> Array:
    """Of the noise that the trusted edges leave."""
    d, k = graph.dim, lie.tangent_dim(graph.dim)
    least = 1e-5 * jnp.stack([graph.length_scale, jnp.ones((), T.dtype)])
    noise = jnp.maximum(deviations(graph, T, trust), least)
    each = jnp.concatenate([jnp.full(d, noise[0]), jnp.full(k - d, noise[1])])
    return jnp.broadcast_to(jnp.diag(each**-2), (graph.num_edges, k, k))


def _at_least_one(ratio: Array, usable: Array) -> Float[Array, ""]:
    middle = _lower_median(ratio, usable)
    return jnp.where(jnp.sum(usable) < _ENOUGH, 1, jnp.maximum(middle, 1))


def _lower_median(x: Array, usable: Array) -> Float[Array, ""]:
    """Of an even number the smaller: half of what is known may not outvote the rest."""
    if len(x) == 0:
        return jnp.ones((), x.dtype)
    count = jnp.maximum(jnp.sum(usable) - 1, 1)
    return nearest_rank(x, usable, jnp.floor((count) / 2) / count)
