"""Robust averaging of large graphs: Levenberg-Marquardt under a shrinking kernel.

Every edge counts by its information and by a Gaussian of its whitened error, whose
width falls from many deviations, where the problem is near least squares, to five. The
deviation is that of the middle edge: half of the edges may be wrong.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg.averaging.base import length_scale, masked_quantile
from jaxreg.averaging.gauss_newton import gauss_newton_gradients, precisions
from jaxreg.averaging.iterate import Iterated
from jaxreg.averaging.posegraph_lm import (
    Minimum,
    Problem,
    log_error,
    minimise,
    robust_problem,
)
from jaxreg.averaging.scales import CHI2_MEDIAN
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.robust import Correntropy


# Widths in deviations, round by round, and tolerances of the minimisations. At ten,
# right edges lose nothing, and the wrong ones of large graphs are far beyond.
_WIDTHS = (40.0, 20.0, 10.0, 10.0, 10.0)
_TOLERANCES = (1e-2, 1e-2, 1e-3, 1e-3, 1e-6)
_LATE = (0, 0, 0, 1, 1)


class _State(NamedTuple):
    found: Minimum
    parts: Array  # (2,) deviations of a translation and a rotation
    width: Array


def graduated(
    graph: PoseGraph, T_start: Float[Array, "v D D"], max_steps: int
) -> Iterated:
    """Rounds of scale and minimisation, at most `max_steps` steps each.

    Gradients: implicit at the fixed point, scales are cut.
    """
    fixed, T_start = jax.lax.stop_gradient((graph, T_start))
    ones = jnp.ones_like(graph.weight)

    def problem(g: PoseGraph, parts: Array, width: Array) -> Problem:
        W = precisions(g, ones, parts)
        return robust_problem(g, log_error, W, Correntropy(), width)

    def turn(s: _State, plan: Array) -> tuple[_State, None]:
        deviations, tolerance, late = plan
        parts = _parts(fixed, s.found.T)
        now = problem(fixed, parts, s.width)
        squares = now.squares(s.found.T)
        middle = _deviation(fixed, squares)
        # Heavy tails of right edges are let in once the kernel keeps wrong ones out.
        inside = _inside_deviation(fixed, squares, now.trust(squares), s.width)
        width = deviations * jnp.where(late > 0, jnp.maximum(middle, inside), middle)
        new = minimise(problem(fixed, parts, width), s.found.T, max_steps, tolerance)
        return _State(new._replace(step=s.found.step + new.step), parts, width), None

    one = jnp.ones((), T_start.dtype)
    begin = _State(
        Minimum(T_start, jnp.asarray(False), jnp.asarray(0, jnp.int32)),
        jnp.ones((2,), T_start.dtype),
        one,
    )
    plan = jnp.asarray((_WIDTHS, _TOLERANCES, _LATE), one.dtype).T
    end = jax.lax.scan(turn, begin, plan)[0]

    def trust_of(g: PoseGraph, T: Array, _: Array) -> Array:
        now = problem(g, end.parts, end.width)
        return now.trust(now.squares(T))

    result = Iterated(
        end.found.T,
        trust_of(fixed, end.found.T, end.parts),
        _WIDTHS[-1] * end.parts,
        end.found.converged,
        end.found.step,
    )
    return gauss_newton_gradients(graph, result, trust_of)


def _deviation(graph: PoseGraph, squares: Array) -> Array:
    """Of one whitened component, by the middle edge."""
    middle = masked_quantile(squares, graph.weight > 0, 0.5)
    middle = middle / CHI2_MEDIAN[lie.tangent_dim(graph.dim)]
    floor = 64 * jnp.finfo(squares.dtype).eps
    return jnp.maximum(jnp.sqrt(middle * _spare(graph)), floor)


def _inside_deviation(
    graph: PoseGraph, squares: Array, trust: Array, width: Array
) -> Array:
    """Of one whitened component, by the mean of the edges inside a kernel.

    As in `annealed_width`: the kernel's own narrowing of the mean is undone.
    """
    w = jnp.where(graph.weight > 0, trust, 0)
    total = jnp.maximum(jnp.sum(w), jnp.finfo(w.dtype).tiny)
    mean = jnp.sum(w * squares) / total / lie.tangent_dim(graph.dim)
    ratio = jnp.minimum(mean / width**2, 0.9)
    return jnp.sqrt(ratio / (1 - ratio) * _spare(graph)) * width


def _parts(graph: PoseGraph, T: Array) -> Float[Array, "2"]:
    """Of one component of the translation and of the rotation, by the middle edges."""
    rotation, translation = graph.differences(T)
    d, present = graph.dim, graph.weight > 0
    dof = lie.tangent_dim(d) - d
    middle = jnp.stack(
        [
            masked_quantile(translation, present, 0.5) / CHI2_MEDIAN[d],
            masked_quantile(rotation, present, 0.5) / (2 * CHI2_MEDIAN[dof]),
        ]
    )
    floor = 64 * jnp.finfo(middle.dtype).eps
    floor = floor * jnp.stack([length_scale(graph), jnp.ones_like(middle[1])])
    return jnp.maximum(jnp.sqrt(middle * _spare(graph)), floor)


def _spare(graph: PoseGraph) -> Array:
    """Edges over those that the poses do not use up, at most 4."""
    count = jnp.sum(graph.weight > 0).astype(graph.weight.dtype)
    spare = jnp.maximum(count - (graph.num_poses - 1), 0.25 * count)
    return count / jnp.maximum(spare, 1)
