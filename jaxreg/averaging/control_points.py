"""Poses moved to surveyed points: a robust fit, then one adjustment of all.

A control point seen from frame i at u lies at q in the world. Its misfit
R_i' (T_world_i u - q) is linear in the right tangent of the pose, J = [I, -[u]x], so
that it is an edge from the world to (R_i, q - R_i u) of information J' W J, which says
nothing of what one point leaves free.

Reference: Triggs et al. 2000, "Bundle adjustment: a modern synthesis" (gauge by control
points).
"""

import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxreg._core import control
from jaxreg._core.status import Status
from jaxreg._core.typing import StatusArray
from jaxreg.averaging.base import AveragingSolution
from jaxreg.averaging.covariance import deviations
from jaxreg.averaging.gauge import average_graph
from jaxreg.averaging.measures import length_scale, nearest_rank
from jaxreg.averaging.methods.pose_graph_lm import PoseGraphLM
from jaxreg.geometry import lie
from jaxreg.geometry.kabsch import kabsch
from jaxreg.graph.anchored import KnownPoses, anchored
from jaxreg.graph.pose_graph import PoseGraph, product


#: Choices of points for the robust fit: half of the points may be wrong, then one of
#: eight choices of three is right, and none of 256 with a chance of 1e-15.
_CHOICES = 256
#: Adjustments, each with the trust that the one before leaves.
_ROUNDS = 4
#: Deviations that a right point may be off: those of a hundredth of right ones are
#: larger (chi-square of three components).
_DEVIATIONS = 3.4
#: Deviations of right points that are tried, as shares of their extent.
_LADDER = tuple(0.3 / 2 ** (n / 2) for n in range(32))
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
        T = product(_T_world_0(points_held, T, held.placed[points.frame]), T)
    problem = _Adjustment(graph, poses, points, found)
    fixed = jax.lax.stop_gradient(problem)

    def again(_: Array, T: Array) -> Array:
        return fixed.minimum(T)[0]

    T = jax.lax.stop_gradient(control.fori_loop(0, _ROUNDS - 1, again, T))
    T_world_i, ended = problem.minimum(T)
    trust = _trust(points, T_world_i, found.placed)[0]
    before = found.prior_weight
    status = jnp.where(found.status == Status.CONVERGED, ended, found.status)
    if poses is None:
        status = jnp.where(_spans(points, trust), status, Status.DEGENERATE)
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


class _Adjustment(eqx.Module):
    """Edges, priors and points as one graph, by the trust that poses give them."""

    graph: PoseGraph
    poses: KnownPoses | None
    points: ControlPoints
    found: AveragingSolution

    def minimum(self, T: Float[Array, "v D D"]) -> tuple[Array, StatusArray]:
        """The poses, from those before, and a status."""
        graph, found = self.graph, jax.lax.stop_gradient(self.found)
        # What is left of wrong edges would widen the noise.
        trust = jnp.where(found.edge_weight > 0.5, found.edge_weight, 0)
        if graph.information is None:
            noise = jax.lax.stop_gradient(deviations(graph, T, trust))
            least = 1e-5 * jnp.stack([length_scale(graph), jnp.ones_like(noise[0])])
            noise = jnp.maximum(noise, least)
            d, k = graph.dim, lie.tangent_dim(graph.dim)
            W = jnp.diag(
                jnp.repeat(noise**-2, np.array([d, k - d]), total_repeat_length=k)
            )
            info = jnp.broadcast_to(W, (graph.num_edges, k, k))
            graph = eqx.tree_at(
                lambda g: g.information, graph, info, is_leaf=lambda x: x is None
            )
        known, weight = self._known(graph, T)
        whole = anchored(graph, known)
        trusted = jnp.concatenate([trust, weight])
        whole = eqx.tree_at(lambda g: g.weight, whole, whole.weight * trusted)
        start = jnp.concatenate([jnp.eye(graph.dim + 1, dtype=T.dtype)[None], T])
        present = jnp.append(True, found.placed & ~known.fixed)
        end = average_graph(whole, PoseGraphLM(), start, None, present)
        moved = present[1:, None, None]
        return jnp.where(moved, end.T_world_i[1:], T), end.status

    def _known(self, graph: PoseGraph, T: Array) -> tuple[KnownPoses, Array]:
        """Priors and control points as priors, and their weights."""
        points, v, dtype = self.points, graph.num_poses, T.dtype
        trust, size = _trust(jax.lax.stop_gradient(points), T, self.found.placed)
        R = lie.rotation(T[points.frame])
        t = points.in_world - _turned(R, points.in_frame)
        J = _by_tangent(points.in_frame)
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


def _usual_information(graph: PoseGraph, given: Array | None, num: int) -> Array:
    if given is not None:
        return given
    assert graph.information is not None
    return jnp.broadcast_to(graph.information[0], (num, *graph.information.shape[1:]))


def _turned(R: Float[Array, "c d d"], x: Float[Array, "c d"]) -> Float[Array, "c d"]:
    return jnp.sum(R * x[:, None, :], axis=-1)


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
    at = T[points.frame]
    off = _turned(lie.rotation(at), points.in_frame) + lie.translation(at)
    off = off - points.in_world
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
    trust = jnp.exp(-((off / (_DEVIATIONS * size)) ** 2) / 2)
    return jnp.where(usable, trust, 0), size


def _T_world_0(
    points: ControlPoints, T_0_i: Float[Array, "v D D"], usable: Array
) -> Float[Array, "D D"]:
    """The likeliest place of frame 0, all poses moved as one body."""
    at = T_0_i[points.frame]
    seen = _turned(lie.rotation(at), points.in_frame) + lie.translation(at)
    num, d = seen.shape
    rows = jnp.asarray(_choices(num, min(d, num)))
    present = usable.astype(seen.dtype)
    tried = jax.vmap(lambda r: kabsch(seen[r], points.in_world[r], present[r]))(rows)

    def squares(T: Array) -> Array:
        moved = jnp.sum(lie.rotation(T) * seen[:, None], axis=-1) + lie.translation(T)
        return jnp.sum((moved - points.in_world) ** 2, axis=-1)

    extent = jnp.max(jnp.linalg.norm(points.in_world - points.in_world[:1], axis=-1))
    extent = jnp.where(extent > 0, extent, 1)
    scores, sizes = jax.vmap(lambda T: _log_evidence(squares(T), present, extent, d))(
        tried
    )
    whole = jnp.all(usable[rows], axis=1)
    first = jnp.argmax(jnp.where(whole, scores, -jnp.inf))
    size = sizes[first]

    def closer(_: Array, T: Array) -> Array:
        w = jnp.exp(-squares(T) / (_DEVIATIONS * size) ** 2 / 2)
        return kabsch(seen, points.in_world, present * w)

    return control.fori_loop(0, 5, closer, tried[first])


def _log_evidence(
    sq: Float[Array, " c"], present: Array, extent: Array, d: int
) -> tuple[Array, Array]:
    """The likeliest deviation of right points, and how likely.

    A point is right or wrong with even odds, and lies anywhere in the extent if wrong.
    A motion fits k / d points whatever they are, which are taken off.
    """
    deviation = extent * jnp.asarray(_LADDER, sq.dtype)
    gain = d * jnp.log(extent / deviation)
    each = jax.nn.softplus(gain[:, None] - sq / (2 * deviation[:, None] ** 2))
    free = lie.tangent_dim(d) / d
    total = jnp.sum(present * each, axis=1) - free * gain
    best = jnp.argmax(total)
    return total[best], deviation[best]


def _choices(num: int, size: int) -> np.ndarray:
    """Rows of points to fit, all choices if they are few; no key is needed."""
    if math.comb(num, size) <= _CHOICES:
        return np.array(list(itertools.combinations(range(num), size)))
    draw = np.random.default_rng(0)
    return np.stack([draw.choice(num, size, replace=False) for _ in range(_CHOICES)])


def _spans(points: ControlPoints, trust: Array) -> Array:
    """Whether the trusted points hold every turn: they lie on no line, in 2D apart."""
    w = jnp.where(trust > 0.5, 1.0, 0.0).astype(points.in_world.dtype)
    mean = jnp.sum(w[:, None] * points.in_world, axis=0) / jnp.maximum(jnp.sum(w), 1)
    off = (points.in_world - mean) * w[:, None]
    spread = jnp.sum(off[:, :, None] * off[:, None, :], axis=0)
    whole = jnp.trace(spread)
    if points.in_world.shape[-1] == 2:
        return whole > 0
    # The sum of the minors: the products of two of the squared widths.
    minors = (whole**2 - jnp.sum(spread**2)) / 2
    return minors > 1e-6 * whole**2
