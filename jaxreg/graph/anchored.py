"""A graph whose frame 0 is the world, in which some poses are known.

What is known of a pose, more or less, is a motion between the world and its frame: an
edge like any other, which the robust methods trust or not. A frame whose pose is known
exactly is the world, seen from elsewhere: its edges become edges of the world, so that
no weight, however large, has to stand for exactness.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.linear.small import product


class KnownPoses(eqx.Module):
    """What is known of the poses of a graph.

    Attributes:
        frame: `(p,)` the frame of each prior.
        mask: `(p,)` False for rows that are padding.
        T_world_prior: `(p, d+1, d+1)` the pose that it should have.
        information: `(p, k, k)` of the right tangent error
            `log(inv(T_world_prior) T_world_i)`, or None where the graph has none.
        fixed: `(v,)` True for frames whose pose is known exactly.
        T_world_fixed: `(v, d+1, d+1)` those poses; the others mean nothing.
    """

    frame: Int[Array, " p"]
    mask: Bool[Array, " p"]
    T_world_prior: Float[Array, "p D D"]
    information: Float[Array, "p k k"] | None
    fixed: Bool[Array, " v"]
    T_world_fixed: Float[Array, "v D D"]

    def padded(self, num: int) -> "KnownPoses":
        """Of a graph of so many frames, the last of which are not known."""
        more = num - len(self.fixed)
        T = jnp.pad(self.T_world_fixed, ((0, more), (0, 0), (0, 0)))
        fixed = jnp.pad(self.fixed, (0, more))
        eye = jnp.eye(T.shape[-1], dtype=T.dtype)
        T = jnp.where(fixed[:, None, None], T, eye)
        return replace(self, fixed=fixed, T_world_fixed=T)


def anchored(graph: PoseGraph, known: KnownPoses) -> PoseGraph:
    """A graph of one more frame: 0 is the world, i + 1 what was frame i.

    Rows are the edges of the graph, then the priors. Those between frames that are
    fixed say nothing more and are masked.
    """
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    ends, T, info = _from_world(graph, known, known.fixed[i], known.fixed[j])
    prior_ends = jnp.stack([jnp.zeros_like(known.frame), known.frame + 1], axis=1)
    free = known.mask & ~known.fixed[known.frame]
    used = jnp.concatenate([graph.mask & ~(known.fixed[i] & known.fixed[j]), free])
    priors = jnp.ones(known.frame.shape, graph.weight.dtype)
    if info is not None and known.information is not None:
        info = jnp.concatenate([info, known.information])
        info = jnp.where(used[:, None, None], info, 0)
    T = jnp.concatenate([T, known.T_world_prior])
    return PoseGraph(
        edges=jnp.where(used[:, None], jnp.concatenate([ends, prior_ends]), 0),
        T_i_j=jnp.where(used[:, None, None], T, jnp.eye(T.shape[-1], dtype=T.dtype)),
        weight=jnp.where(used, jnp.concatenate([graph.weight, priors]), 0),
        mask=used,
        information=info,
        num_poses=graph.num_poses + 1,
    )


def without_priors(known: KnownPoses) -> KnownPoses:
    """The fixed frames alone."""
    info = known.information
    return eqx.tree_at(
        lambda k: (k.frame, k.mask, k.T_world_prior, k.information),
        known,
        (
            known.frame[:0],
            known.mask[:0],
            known.T_world_prior[:0],
            None if info is None else info[:0],
        ),
        is_leaf=lambda x: x is None,
    )


def fixed_as_priors(known: KnownPoses, num_fixed: int) -> KnownPoses:
    """The fixed frames, at most so many, as nearly known."""
    first = jnp.argmax(known.fixed)
    frame = jnp.nonzero(known.fixed, size=num_fixed, fill_value=first)[0]
    return KnownPoses(
        frame=frame.astype(jnp.int32),
        mask=jnp.arange(num_fixed) < jnp.sum(known.fixed),
        T_world_prior=known.T_world_fixed[frame],
        information=None,
        fixed=jnp.zeros_like(known.fixed),
        T_world_fixed=known.T_world_fixed,
    )


def joined_priors(known: KnownPoses, more: KnownPoses) -> KnownPoses:
    """With the priors of others after its own; all have information."""
    assert known.information is not None
    assert more.information is not None
    return eqx.tree_at(
        lambda k: (k.frame, k.mask, k.T_world_prior, k.information),
        known,
        (
            jnp.concatenate([known.frame, more.frame]),
            jnp.concatenate([known.mask, more.mask]),
            jnp.concatenate([known.T_world_prior, more.T_world_prior]),
            jnp.concatenate([known.information, more.information]),
        ),
    )


def _from_world(
    graph: PoseGraph, known: KnownPoses, fixed_i: Array, fixed_j: Array
) -> tuple[Array, Array, Array | None]:
    """Edges with a fixed end as edges from the world to the other.

    Where j is fixed the new error is that of the edge taken from j to i:
    e = log(E) becomes log(T_i_j inv(E) inv(T_i_j)) = -Ad(T_i_j) e.
    """
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    T_j_i = lie.inverse(graph.T_i_j)
    T_world_j = product(known.T_world_fixed[i], graph.T_i_j)
    T_world_i = product(known.T_world_fixed[j], T_j_i)
    of_i, of_j = fixed_j[:, None, None], fixed_i[:, None, None]
    T = jnp.where(of_j, T_world_j, jnp.where(of_i, T_world_i, graph.T_i_j))
    away = jnp.where(fixed_i | fixed_j, 0, i + 1)
    ends = jnp.stack([away, jnp.where(fixed_j, i + 1, j + 1)], axis=1)
    info = graph.information
    if info is not None:
        turn = lie.adjoint(T_j_i)
        turned = product(product(jnp.swapaxes(turn, -1, -2), info), turn)
        info = jnp.where(of_i & ~of_j, turned, info)
    return ends, T, info
