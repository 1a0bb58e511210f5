"""Poses moved to surveyed points: a robust fit, then one adjustment of all.

A control point seen from frame i at u lies at q in the world. Its misfit
a = R_i' (T_world_i u - q) changes with the right tangent of the pose by [I, -[u]x]. So
it is an edge from the world to (R_i, q - R_i u), whose error is (a, 0), of information
J' W J with J = [I, -[u + a / 2]x] (the half: the logarithm of a motion turns its
translation back by half of its turn). It says nothing of what one point leaves free.

Reference: Triggs et al. 2000, "Bundle adjustment: a modern synthesis" (gauge by control
points).
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.status import Status
from jaxreg._core.typing import StatusArray
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.control_fit import DEVIATIONS, likeliest_place, spans
from jaxreg.averaging.gauge import average_graph
from jaxreg.averaging.measures import deviations, length_scale, nearest_rank
from jaxreg.averaging.methods.pose_graph_lm import PoseGraphLM
from jaxreg.geometry import lie
from jaxreg.graph.anchored import KnownPoses, anchored
from jaxreg.graph.pose_graph import PoseGraph, product


#: Adjustments, each with the trust that the one before leaves.
_ROUNDS = 4
#: The median length of a vector of d normal numbers.
_MEDIAN_LENGTH = {2: math.sqrt(1.3863), 3: math.sqrt(2.3660)}


class ControlPoints(eqx.Module):
    """Points that frames see and that are known in the world.

    Attributes:
        frame: `(c,)` the frame that sees each.
        in_frame: `(c, d)` where it sees it.
        in_world: `(c, d)` where it lies.
        information: `(c, d, d)` of that position, in the axes of the world, or None:
            all alike, as good as the fit shows.
    """

    frame: Int[Array, " c"]
    in_frame: Float[Array, "c d"]
    in_world: Float[Array, "c d"]
    information: Float[Array, "c d d"] | None


def fitted(
    graph: PoseGraph,
    poses: KnownPoses | None,
    points: ControlPoints,
    found: AveragingSolution,
) -> AveragingSolution:
    """The solution with poses that the points hold, too, and how far they are trusted.

    Args:
        graph: the relative motions.
        poses: what else is known, or None: then all poses are moved to the points
            before, and there must be three that are on no line (two in 2D).
        points: control points; those of frames that are not placed count for nothing.
        found: averaged without the points.
    """
    held, points_held = jax.lax.stop_gradient((found, points))
    T = held.T_world_i
    if poses is None:
        usable = held.placed[points.frame]
        seen = _moved(points_held, T)
        T = product(likeliest_place(seen, points_held.in_world, usable), T)
    problem = Adjustment(graph, poses, points, found)
    fixed = jax.lax.stop_gradient(problem)

    def again(_: Array, T: Array) -> Array:
        return fixed.minimum(T)[0]

    T = jax.lax.stop_gradient(control.fori_loop(0, _ROUNDS - 1, again, T))
    T_world_i, ended, trust = problem.minimum(T)
    trust = trust[-len(points.frame) :]
    before = found.prior_weight
    # Frames that no trusted edge holds stay where they were, as placed as before.
    failed = (ended == Status.MAX_STEPS) | (ended == Status.NON_FINITE)
    status = jnp.where(failed & (found.status == Status.CONVERGED), ended, found.status)
    if poses is None:
        status = jnp.where(spans(points.in_world, trust), status, Status.DEGENERATE)
    return eqx.tree_at(
        lambda s: (s.T_world_i, s.prior_weight, s.status),
        found,
        (
            T_world_i,
            trust if before is None else jnp.concatenate([before, trust]),
            status.astype(jnp.int32),
        ),
        is_leaf=lambda x: x is None,
    )


class Adjustment(eqx.Module):
    """Edges, priors and points as one graph, by the trust that poses give them."""

    graph: PoseGraph
    poses: KnownPoses | None
    points: ControlPoints
    found: AveragingSolution

    def minimum(self, T: Float[Array, "v D D"]) -> tuple[Array, StatusArray, Array]:
        """The poses, from those before, a status, and the trust that they are by."""
        graph, known, trust = self.whole(T)
        whole = anchored(graph, known)
        whole = eqx.tree_at(lambda g: g.weight, whole, whole.weight * trust)
        start = jnp.concatenate([jnp.eye(graph.dim + 1, dtype=T.dtype)[None], T])
        moved = self.found.placed & ~known.fixed
        present = jnp.append(True, moved)
        end = average_graph(whole, PoseGraphLM(), start, None, present)
        reached = (moved & end.placed[1:])[:, None, None]
        return jnp.where(reached, end.T_world_i[1:], T), end.status, trust

    def whole(
        self, T: Float[Array, "v D D"]
    ) -> tuple[PoseGraph, KnownPoses, Float[Array, " n"]]:
        """The graph with information, all that is known as priors, and the trust."""
        graph, found = self.graph, jax.lax.stop_gradient(self.found)
        # What is left of wrong edges would widen the noise.
        trust = jnp.where(found.edge_weight > 0.5, found.edge_weight, 0)
        if graph.information is None:
            info = _shown_information(graph, jax.lax.stop_gradient(T), trust)
            graph = eqx.tree_at(
                lambda g: g.information, graph, info, is_leaf=lambda x: x is None
            )
        known, weight = self._known(graph, T)
        return graph, known, jnp.concatenate([trust, weight])

    def _known(self, graph: PoseGraph, T: Array) -> tuple[KnownPoses, Array]:
        """Priors and control points as priors, and their weights."""
        points, v, dtype = self.points, graph.num_poses, T.dtype
        trust, size = _trust(jax.lax.stop_gradient(points), T, self.found.placed)
        R = lie.rotation(T[points.frame])
        t = points.in_world - _turned(R, points.in_frame)
        off = _turned(jnp.swapaxes(R, -1, -2), _moved(points, T) - points.in_world)
        J = _by_tangent(points.in_frame + jax.lax.stop_gradient(off) / 2)
        W = points.information
        if W is None:
            W = jnp.eye(graph.dim, dtype=dtype) / size**2
            W = jnp.broadcast_to(W, (*t.shape, graph.dim))
        W = product(product(jnp.swapaxes(R, -1, -2), W), R)
        info = product(product(jnp.swapaxes(J, -1, -2), W), J)
        alone = KnownPoses(
            frame=points.frame,
            T_world_prior=lie.compose(R, t),
            information=info,
            fixed=jnp.zeros(v, bool),
            T_world_fixed=jnp.broadcast_to(
                jnp.eye(graph.dim + 1, dtype=dtype), T.shape
            ),
        )
        if self.poses is None:
            return alone, trust
        p = self.poses
        usual = _usual_information(graph, p.information, len(p.frame))
        both = KnownPoses(
            frame=jnp.concatenate([p.frame, alone.frame]),
            T_world_prior=jnp.concatenate([p.T_world_prior, alone.T_world_prior]),
            information=jnp.concatenate([usual, info]),
            fixed=p.fixed,
            T_world_fixed=p.T_world_fixed,
        )
        before = self.found.prior_weight
        assert before is not None
        return both, jnp.concatenate([jax.lax.stop_gradient(before), trust])


def _shown_information(graph: PoseGraph, T: Array, trust: Array) -> Array:
    """Of the noise that the trusted edges leave."""
    d, k = graph.dim, lie.tangent_dim(graph.dim)
    least = 1e-5 * jnp.stack([length_scale(graph), jnp.ones((), T.dtype)])
    noise = jnp.maximum(deviations(graph, T, trust), least)
    each = jnp.concatenate([jnp.full(d, noise[0]), jnp.full(k - d, noise[1])])
    return jnp.broadcast_to(jnp.diag(each**-2), (graph.num_edges, k, k))


def _usual_information(graph: PoseGraph, given: Array | None, num: int) -> Array:
    if given is not None:
        return given
    assert graph.information is not None
    return jnp.broadcast_to(graph.information[0], (num, *graph.information.shape[1:]))


def _turned(R: Float[Array, "c d d"], x: Float[Array, "c d"]) -> Float[Array, "c d"]:
    return jnp.sum(R * x[:, None, :], axis=-1)


def _moved(points: ControlPoints, T: Float[Array, "v D D"]) -> Float[Array, "c d"]:
    """By the poses of their frames."""
    at = T[points.frame]
    return _turned(lie.rotation(at), points.in_frame) + lie.translation(at)


def _by_tangent(u: Float[Array, "c d"]) -> Float[Array, "c d k"]:
    """[I, -[u]x]: a point of a frame, by the right tangent of its pose."""
    num, d = u.shape
    eye = jnp.broadcast_to(jnp.eye(d, dtype=u.dtype), (num, d, d))
    if d == 2:
        turn = jnp.stack([-u[:, 1], u[:, 0]], axis=-1)[..., None]
    else:
        x, y, z = u.T
        o = jnp.zeros_like(x)
        turn = jnp.stack(
            [jnp.stack(row, -1) for row in ((o, z, -y), (-z, o, x), (y, -x, o))], -2
        )
    return jnp.concatenate([eye, turn], axis=-1)


def _misfit(points: ControlPoints, T: Float[Array, "v D D"]) -> Float[Array, " c"]:
    """In standard deviations, or in lengths if none are known."""
    off = _moved(points, T) - points.in_world
    if points.information is None:
        return jnp.linalg.norm(off, axis=-1)
    sq = jnp.sum(off * _turned(points.information, off), axis=-1)
    return jnp.sqrt(jnp.maximum(sq, 0))


def _trust(
    points: ControlPoints, T: Float[Array, "v D D"], placed: Array
) -> tuple[Float[Array, " c"], Float[Array, ""]]:
    """By a Welsch kernel as wide as the middle misfit asks, and that deviation."""
    points, T = jax.lax.stop_gradient((points, T))
    usable, off = placed[points.frame], _misfit(points, T)
    d = points.in_frame.shape[-1]
    size = nearest_rank(off, usable, 0.5) / _MEDIAN_LENGTH[d]
    lengths = jnp.max(jnp.abs(points.in_world - points.in_world[:1]))
    least = 1e-6 * lengths if points.information is None else jnp.ones_like(size)
    size = jnp.maximum(size, jnp.maximum(least, jnp.finfo(size.dtype).tiny ** 0.5))
    trust = jnp.exp(-((off / (DEVIATIONS * size)) ** 2) / 2)
    return jnp.where(usable, trust, 0), size
