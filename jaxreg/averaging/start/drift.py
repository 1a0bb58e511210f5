"""Closures of a sequence that the drift of its frames allows.

The motion along the frames from one end of a closure to the other has a covariance: the
sum of those of the steps, each carried to the end. A right closure is off by as much
as this and its own covariance say; a false one, as a rule, by far more. Covariances of
paths are put together from those of 1, 2, 4, ... steps, as a difference of sums from
the first frame would be lost in rounding.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.chi_squared import exceeded_with
from jaxreg._core.quantile import nearest_rank
from jaxreg.averaging.steps.gauss_newton import precisions
from jaxreg.averaging.steps.kernel_width import chi2_median
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.small import inverse_semidefinite, product, solve_semidefinite


# Share of right closures that are taken for false: many follow each other.
_REFUSED = 1e-3
# So many closures that are all off say less than one false step: registrations of
# places that look alike fail one time in ten or so, those of successive frames seldom.
_FEW = 3


class _Leg(NamedTuple):
    """Motions, and their covariances in right tangents."""

    T: Float[Array, "n D D"]
    covariance: Float[Array, "n k k"]

    def then(self, later: "_Leg") -> "_Leg":
        """This one first."""
        carry = lie.adjoint(lie.inverse(later.T))
        return _Leg(
            product(self.T, later.T), _turned(carry, self.covariance) + later.covariance
        )

    def back(self) -> "_Leg":
        """The other way."""
        return _Leg(lie.inverse(self.T), _turned(lie.adjoint(self.T), self.covariance))

    def at(self, rows: Int[Array, " m"]) -> "_Leg":
        """Some of them."""
        return _Leg(self.T[rows], self.covariance[rows])


class _Paths(NamedTuple):
    """Of each edge the path so far, and where it ends; of each frame the next steps."""

    level: Int[Array, ""]
    path: _Leg
    end: Int[Array, " e"]
    steps: _Leg


def drifted(graph: PoseGraph, closure: Bool[Array, " e"]) -> Bool[Array, " e"]:
    """Closures that are off by more than the drift along the frames between explains.

    The deviations of steps and closures are taken to be in the proportions of their
    information, and their common factor is the one that the middle closure shows: fewer
    than half of them are false. One of a thousand right closures is off by more.

    Where more than a few closures over a step are off and none is not, the step may be
    false itself: those are none of them. Nor are closures over a step that is missing.
    """
    square, known = squared_misclosures(graph)
    known = known & closure
    k = lie.tangent_dim(graph.dim)
    usual = nearest_rank(square, known, 0.5) / chi2_median(k)
    off = known & (square > usual * exceeded_with(_REFUSED, k))
    low, high = jnp.min(graph.edges, axis=1), jnp.max(graph.edges, axis=1)
    in_question = (_over(graph, off) > _FEW) & (_over(graph, known & ~off) == 0)
    before = jnp.cumsum(in_question) - in_question
    return off & (before[high] == before[low])


def _over(graph: PoseGraph, closure: Array) -> Int[Array, " v"]:
    """How many closures there are over the step from each frame to the next."""
    ends, one = jnp.sort(graph.edges, axis=1), closure.astype(jnp.int32)
    none = jnp.zeros((graph.num_poses,), jnp.int32)
    return jnp.cumsum(none.at[ends[:, 0]].add(one).at[ends[:, 1]].add(-one))


def squared_misclosures(
    graph: PoseGraph,
) -> tuple[Float[Array, " e"], Bool[Array, " e"]]:
    """Squared error of each edge against its path of steps, in deviations of both.

    And whether there is a path: the frames between its ends are all joined.
    """
    low, high = jnp.min(graph.edges, axis=1), jnp.max(graph.edges, axis=1)
    edges = _along_numbers(graph)
    steps, joined = _steps(graph, edges, low, high)
    gaps = jnp.cumsum(~joined)
    known = (graph.weight > 0) & (gaps[high] == gaps[low])
    path = _paths(steps, low, high)
    error = lie.log(lie.between(edges.T, path.T))
    P = path.covariance + edges.covariance
    scale = jax.lax.rsqrt(jnp.diagonal(P, axis1=-2, axis2=-1))
    scaled, r = P * scale[:, :, None] * scale[:, None, :], error * scale
    square = jnp.sum(r * solve_semidefinite(scaled, r), axis=-1)
    return jnp.where(known, jnp.maximum(square, 0), 0), known


def _turned(A: Array, covariance: Array) -> Float[Array, "n k k"]:
    return product(product(A, covariance), jnp.swapaxes(A, -1, -2))


def _along_numbers(graph: PoseGraph) -> _Leg:
    """Each edge from the frame of the lower number to the other."""
    one = jnp.ones_like(graph.weight)
    unit = jnp.stack([graph.length_scale, jnp.ones_like(graph.length_scale)])
    W = precisions(graph, one, unit)
    there = _Leg(graph.T_i_j, _covariances(W))
    turned = graph.edges[:, 0] > graph.edges[:, 1]
    return jax.tree.map(
        lambda a, b: jnp.where(turned[:, None, None], b, a), there, there.back()
    )


def _covariances(W: Float[Array, "e k k"]) -> Float[Array, "e k k"]:
    """Of information; what an edge does not measure it measures badly."""
    diagonal = jnp.diagonal(W, axis1=-2, axis2=-1)
    # A unit diagonal first, so that parts in other units keep their digits.
    root = jax.lax.rsqrt(jnp.where(diagonal > 0, diagonal, 1))
    both = root[:, :, None] * root[:, None, :]
    badly = jnp.finfo(W.dtype).eps ** 0.5 * jnp.eye(W.shape[-1], dtype=W.dtype)
    return inverse_semidefinite(W * both + badly[None]) * both


def _steps(
    graph: PoseGraph, edges: _Leg, low: Array, high: Array
) -> tuple[_Leg, Bool[Array, " v"]]:
    """From each frame to the next; and whether the one before is joined to a frame."""
    num, count = graph.num_poses, graph.num_edges
    step = (graph.weight > 0) & (high - low == 1)
    first = jnp.full((num,), count, jnp.int32)
    first = first.at[jnp.where(step, low, num)].min(
        jnp.arange(count, dtype=jnp.int32), mode="drop"
    )
    there = first < count
    legs = edges.at(jnp.minimum(first, count - 1))
    return legs, jnp.roll(there, 1).at[0].set(True)


def _paths(steps: _Leg, low: Array, high: Array) -> _Leg:
    """From frames `low` to frames `high`."""
    num, length = len(steps.T), high - low
    longest = jnp.max(length)

    def further(p: _Paths) -> _Paths:
        reach = jnp.left_shift(1, p.level)
        taken = (jnp.right_shift(length, p.level) & 1) == 1
        longer = p.path.then(p.steps.at(p.end))
        path = jax.tree.map(
            lambda a, b: jnp.where(taken[:, None, None], a, b), longer, p.path
        )
        behind = jnp.minimum(jnp.arange(num, dtype=jnp.int32) + reach, num - 1)
        end = jnp.where(taken, jnp.minimum(p.end + reach, num - 1), p.end)
        return _Paths(p.level + 1, path, end, p.steps.then(p.steps.at(behind)))

    D, k = steps.T.shape[-1], steps.covariance.shape[-1]
    none = _Leg(
        lie.identity(D - 1, steps.T.dtype, low.shape),
        jnp.zeros((*low.shape, k, k), steps.T.dtype),
    )
    begin = _Paths(jnp.asarray(0, jnp.int32), none, low, steps)
    return control.while_loop(
        lambda p: jnp.left_shift(1, p.level) <= longest, further, begin
    ).path
