"""How well poses explain motions: one likelihood ratio, without a noise level.

Edge e is right with probability p, wrong otherwise. Its error r (radians, and lengths
in `length_scale`) has k components, k = 6 or 3.

* The error of a right edge is normal with deviation s in each component. All edges
  share s, which is unknown: the mean over a ladder of octaves, each as likely.
* Wrong motions fill the volume V of all motions whose mean length is one. Where each
  fails on its own, their density is 1 / V, and an error r is so many times likelier of
  a right edge:

      g(r, s) = (R / s)^D exp(-r^2 / (2 s^2)),   R = V^(1/k) / sqrt(2 pi),   D = k.

  So much for the question whether anything agrees (`log_evidence`). But an object that
  looks alike from two sides gives wrong motions that agree with each other, and
  surfaces that slide give such as nearly do: the share of wrong motions within r of
  where some poses want them falls as r^D with a smaller D, their effective dimension.
  That is the D for the question which of several poses are right (`explained`).
* Registration fails for views far apart and seldom for near ones. So p is one number
  for the edges to the nearest t measured neighbours of one of their ends, as the poses
  place them, and another, no larger, for those beyond. Both, and t, are unknown. Of
  short sequences, most edges steps, near may be the steps instead: a false closure
  that no other crosses and a false step under it explain a loop equally well.
* A prior weight w, over the middle one, multiplies the odds: p / (1 - p) w.
* The poses are fitted to the same motions. Integrating them out (Laplace's method)
  costs each of the n - 1 that are free the factor (R / s)^D, which is what an edge that
  holds exactly gains: a tree that agrees with its own edges alone has no evidence.

Together, against "every motion is wrong",

    Lambda = mean over s, t, p_near >= p_far of
             (R / s)^(-D (n - 1)) product over e of (1 - p_e + p_e g(r_e, s)).

What is left out: the determinant of the reduced Laplacian, which differs little between
hypotheses, and that rotation and translation may have deviations of their own.
"""

import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.quantile import nearest_rank
from jaxreg.geometry import lie
from jaxreg.graph import trees
from jaxreg.graph.near_edges import near_ways
from jaxreg.graph.pose_graph import PoseGraph


#: Deviations of right edges, radians and length scales: octaves from where the normal
#: law is hardly narrower than V to a quarter of a degree.
DEVIATIONS = tuple(0.5 / 2**k for k in range(8))
# The effective dimension D of wrong motions. From real scenes and graphs of half wrong
# motions (`bench/studies/averaging_objective.md`, the half to choose on): 0.6 to 0.8.
_DIMENSION = 0.8
# Log odds that p may have: from 1 to 99 %, of near views one half at least.
_LOG_ODDS = (-4.5, -3.0, -1.5, 0.0, 1.5, 3.0, 4.5)
#: Poses that agree with more than this share of trusted edges need no search: noise
#: leaves out about one of a hundred right ones.
SETTLED = 0.98
# Which of them near and far edges may have.
_ALLOWED = np.asarray(_LOG_ODDS)[:, None] >= np.maximum(_LOG_ODDS, 0)[None]


class Explained(NamedTuple):
    """What poses make of motions.

    Attributes:
        log_ratio: log Lambda; among several poses of a graph the greatest is likeliest.
        deviation: the likeliest s, in radians and length scales.
        log_odds: `(e,)` that each edge is right, at the likeliest s, t and p; -inf for
            absent edges.
    """

    log_ratio: Float[Array, ""]
    deviation: Float[Array, ""]
    log_odds: Float[Array, " e"]


class Likelihood(eqx.Module):
    """Of the motions of a graph, for any poses; what all poses share is found once.

    Attributes:
        graph: held, with all its frames joined.
        scale: the graph's `length_scale`.
        prior_odds: `(e,)`, see `prior_odds`.
        free: how many poses are free, n - 1.

    Gradients: none (cut).
    """

    graph: PoseGraph
    scale: Float[Array, ""]
    prior_odds: Float[Array, " e"]
    free: Float[Array, ""]

    @classmethod
    def of(cls, graph: PoseGraph) -> "Likelihood":
        """Of a graph whose frames are all joined."""
        graph = jax.lax.stop_gradient(graph)
        return cls(graph, graph.length_scale, prior_odds(graph), graph.num_held - 1)

    def log_evidence(self, T_world_i: Float[Array, "v D D"]) -> Float[Array, ""]:
        """Log Lambda where each wrong motion is wrong on its own.

        At most 0 if nothing agrees beyond what a tree agrees with. Does not depend on
        the unit of length, the order of frames and edges, or a common motion of the
        poses. Memory in proportion to the edges.
        """
        return self.explained(T_world_i, alone=True).log_ratio

    def nothing_agrees(self, evidence: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether there are edges to spare, and no evidence that any agrees.

        Args:
            evidence: `log_evidence` of the answer. Where it has none, because wrong
                motions pulled on it, the spanning tree of greatest weight may have
                some.
        """
        graph = self.graph
        args = (graph.edges, graph.T_i_j, graph.weight, graph.num_poses)

        def of_tree() -> Array:
            T = trees.maximum_spanning_tree(*args).T_world_i
            return self.log_evidence(T) <= 0

        none = (jnp.sum(graph.weight > 0) > self.free) & (evidence <= 0)
        return control.cond(none, of_tree, lambda: jnp.asarray(False))

    def agreed_share(self, told: Explained) -> Float[Array, ""]:
        """The share of the edges to spare that are likelier right than wrong.

        A tree agrees with its own edges, wherever it leads: only those beyond count,
        but where there are none. 0 without edges.

        Args:
            told: how some poses explain the motions.
        """
        present = jnp.sum(self.graph.weight > 0)
        right = jnp.sum(told.log_odds > 0)
        tree = self.free.astype(right.dtype)
        tree = jnp.where(present > tree, tree, 0)
        count = jnp.maximum(present - tree, 1).astype(self.graph.weight.dtype)
        return (right - tree) / count

    def explained(
        self, T_world_i: Float[Array, "v D D"], *, alone: bool = False
    ) -> Explained:
        """Log Lambda, and what is likeliest.

        Args:
            T_world_i: `(v, d+1, d+1)`.
            alone: each wrong motion is wrong on its own (D = k), and the deviation is
                that of a component, at most a quarter: at a half, what poses fitted to
                random motions gain is more than Laplace's method takes off. Else wrong
                ones may agree with each other.
        """
        return jax.tree.map(lambda x: x[0], self._explained_by(T_world_i, (alone,)))

    def explained_both(
        self, T_world_i: Float[Array, "v D D"]
    ) -> tuple[Explained, Explained]:
        """`explained`, and where each wrong motion is `alone`, by one piece of code."""
        both = self._explained_by(T_world_i, (False, True))
        return jax.tree.map(lambda x: x[0], both), jax.tree.map(lambda x: x[1], both)

    def _explained_by(self, T_world_i: Array, laws: tuple[bool, ...]) -> Explained:
        """For each law, whether wrong motions are alone; a leading axis of laws."""
        seen, meant = self._seen(jax.lax.stop_gradient(T_world_i), laws)
        ladder = jnp.asarray(DEVIATIONS, seen.sq.dtype)
        k, num = lie.tangent_dim(self.graph.dim), len(ladder)
        dimensions = jnp.asarray([k if x else _DIMENSION for x in laws], ladder.dtype)
        rows = jnp.repeat(dimensions, num), jnp.tile(ladder, len(laws))
        rows = (*rows, jnp.repeat(meant, num, axis=0))
        every = jax.lax.map(lambda row: self._terms(seen, *row), rows)
        every = every.reshape(len(laws), num, *every.shape[1:])
        # The widest is no deviation of a component.
        fits = np.asarray([[not x] + [True] * (num - 1) for x in laws])
        every = jnp.where(fits.reshape(*fits.shape, 1, 1, 1), every, -jnp.inf)
        counts = fits.sum(axis=1) * np.sum(_ALLOWED) * jnp.sum(meant, axis=1)
        of_law = functools.partial(self._likeliest, seen)
        return jax.vmap(of_law)(every, dimensions, counts)

    def _seen(self, T_world_i: Array, laws: tuple[bool, ...]) -> tuple["_Seen", Array]:
        """What poses make of the motions, and which ways of nearness laws may mean."""
        T_i_j = self.graph.predicted(T_world_i)
        sq = squared_errors(self.graph, T_i_j, self.scale)
        near, meant = near_ways(self.graph, T_i_j, self.scale, laws)
        prior = jnp.asarray(_LOG_ODDS, sq.dtype)[:, None] + self.prior_odds[None]
        sides = jnp.concatenate([near, ~near]).astype(sq.dtype)
        return _Seen(sq, near, sides, prior, jax.nn.softplus(prior)), meant

    def _log_gain(
        self, sq: Array, dimension: Array, deviation: Array
    ) -> tuple[Array, Array]:
        """The logarithm of g for each edge, and for one that holds exactly."""
        most = dimension * jnp.log(_reach(self.graph.dim) / deviation)
        return most - sq / (2 * deviation**2), most

    def _terms(
        self, seen: "_Seen", dimension: Array, deviation: Array, meant: Array
    ) -> Float[Array, "near far t"]:
        """The terms of log Lambda of one deviation."""
        gain, most = self._log_gain(seen.sq, dimension, deviation)
        each = jax.nn.softplus(seen.prior + gain[None]) - seen.none
        each = jnp.where(self.graph.weight[None] > 0, each, 0)
        sums = jnp.matmul(each, seen.sides.T, precision=jax.lax.Precision.HIGHEST)
        near, far = jnp.split(sums, 2, axis=1)
        both = near[:, None] + far[None]
        may = jnp.asarray(_ALLOWED)[..., None] & meant[None, None]
        return jnp.where(may, both, -jnp.inf) - self.free * most

    def _likeliest(
        self, seen: "_Seen", every: Array, dimension: Array, count: Array
    ) -> Explained:
        """From the terms of a law."""
        ladder = jnp.asarray(DEVIATIONS, seen.sq.dtype)
        s, near, far, t = _places(every.shape)[:, jnp.argmax(every)]
        right = jnp.where(seen.near[t], seen.prior[near], seen.prior[far])
        gain, _ = self._log_gain(seen.sq, dimension, ladder[s])
        ratio = jax.nn.logsumexp(every) - jnp.log(count.astype(ladder.dtype))
        return Explained(
            jnp.where(jnp.isfinite(ratio), ratio, -jnp.inf),
            ladder[s],
            jnp.where(self.graph.weight > 0, right + gain, -jnp.inf),
        )


class _Seen(NamedTuple):
    """What poses make of the motions of a graph, and all that deviations share.

    Attributes:
        sq: `squared_errors`.
        near: which edges are near in each way.
        sides: those, and those that are far in each way, as numbers.
        prior: log odds of each edge for each p.
        none: the logarithm of 1 plus those odds.
    """

    sq: Float[Array, " e"]
    near: Bool[Array, "t e"]
    sides: Float[Array, "s e"]
    prior: Float[Array, "p e"]
    none: Float[Array, "p e"]


def least_after_fitting(found: Explained) -> Float[Array, ""]:
    """What other poses of the same right edges reach, but for a standard deviation.

    The terms r^2 / (2 s^2) of right edges have variance D / 2 each.
    """
    right = jnp.sum(jax.nn.sigmoid(found.log_odds))
    return found.log_ratio - jnp.sqrt(_DIMENSION / 2 * right)


def squared_errors(
    graph: PoseGraph, T_i_j: Float[Array, "e D D"], scale: Float[Array, ""]
) -> Float[Array, " e"]:
    """Squared angle (chordal) plus squared length over `scale` of each edge.

    Args:
        graph: the motions.
        T_i_j: what poses make of them, `graph.predicted`.
        scale: `graph.length_scale`.
    """
    rotation, translation = graph.differences_from(T_i_j)
    return rotation / 2 + translation / scale**2


def prior_odds(graph: PoseGraph) -> Float[Array, " e"]:
    """The logarithm of each prior weight over the middle one; 0 for absent edges.

    A weight says how much likelier than usual an edge is right.
    """
    present = graph.weight > 0
    usual = nearest_rank(graph.weight, present, 0.5)
    return jnp.log(jnp.where(present, graph.weight / jnp.where(usual > 0, usual, 1), 1))


def _reach(dim: int) -> float:
    """R: the turns times the ball (disc) in which the mean length is one."""
    k, radius = lie.tangent_dim(dim), (dim + 1) / dim
    turns = 8 * math.pi**2 if dim == 3 else 2 * math.pi
    ball = 4 / 3 * math.pi * radius**3 if dim == 3 else math.pi * radius**2
    return (turns * ball) ** (1 / k) / math.sqrt(2 * math.pi)


def _places(shape: tuple[int, ...]) -> Int[Array, "axes size"]:
    """Where each number of an array is, read off, not divided out."""
    return jnp.asarray(np.indices(shape).reshape(len(shape), -1), jnp.int32)
