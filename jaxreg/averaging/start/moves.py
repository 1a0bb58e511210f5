"""Changes of hypotheses: single frames and groups move; all frames settle."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._core.typing import Key
from jaxreg.averaging.evidence import agrees, squared_errors, votes
from jaxreg.averaging.steps.iterate import nearby_rotation
from jaxreg.averaging.steps.kernel_width import gaussian_trust
from jaxreg.geometry import lie
from jaxreg.graph.pose_graph import PoseGraph, product
from jaxreg.graph.trees import ancestors
from jaxreg.linear.laplacian import laplacian
from jaxreg.linear.operator import divergence


# Motions tried for each group.
_TRIED = 16
# Kernel widths, in radians and length scales, of the steps in which poses settle.
_WIDTHS = (0.25, 0.2, 0.15, 0.12, 0.1)


def settled(
    graph: PoseGraph, T_world_i: Float[Array, "v D D"], scale: Float[Array, ""]
) -> Float[Array, "v D D"]:
    """The poses after a few steps of averaging the motions that agree with them.

    A chain of motions drifts; what agrees with it shows only then. Dense over frames.
    """
    num = graph.num_poses

    def step(T: Array, w: Array) -> tuple[Array, None]:
        trust = graph.weight * gaussian_trust(graph, T, jnp.stack([w * scale, w]))
        top = jnp.max(trust)
        trust = trust / jnp.where(top > 0, top, 1)
        flow = trust[:, None] * lie.log(graph.residual_motions(T))
        rhs = divergence(graph.edges, flow, num).at[0].set(0)
        L = laplacian(graph.edges, trust, num)
        # Frames that nothing holds stay.
        ridge = 1e-5 * jnp.max(jnp.diagonal(L)) * jnp.eye(num, dtype=L.dtype)
        factor = jnp.linalg.cholesky(L + ridge)
        tangent = jax.scipy.linalg.cho_solve((factor, True), rhs)
        return nearby_rotation(product(lie.exp(tangent), T)), None

    widths = jnp.asarray(_WIDTHS, T_world_i.dtype)
    return jax.lax.scan(step, T_world_i, widths)[0]


def groups_moved(
    graph: PoseGraph,
    T: Float[Array, "v D D"],
    scale: Float[Array, ""],
    in_tree: Bool[Array, " e"],
    odds: Float[Array, " e"],
    key: Key,
    most: int,
) -> Float[Array, "m v D D"]:
    """The poses with the frames beyond one edge of a tree moved as a whole.

    Of `_TRIED` motions across that do not agree with the poses, drawn by their log
    odds, the one that most others support. Frames whose motions agree with each
    other form groups, and the motions between groups may agree on several places: this
    exchanges one for another.
    """
    if graph.num_poses < 2:
        return T[None]
    beyond = _subtrees(graph, in_tree)
    num = min(most, graph.num_poses - 1)
    draw, pick = jax.random.split(key)
    turn = jax.random.randint(draw, (), 0, graph.num_poses)
    beyond = beyond[1 + (jnp.arange(num) + turn) % (graph.num_poses - 1)]
    i, j = graph.edges[:, 0], graph.edges[:, 1]
    there = product(T[i], graph.T_i_j)  # frame j as frame i puts it
    G_head = product(there, lie.inverse(T)[j])
    G_tail = lie.inverse(G_head)
    point_head, point_tail = lie.translation(T)[j], lie.translation(there)
    vote, count = votes(graph), graph.num_edges
    new = agrees(squared_errors(graph, T, scale)) < 0.5
    noise = jax.random.gumbel(pick, (num, count), T.dtype)
    likely = odds + noise

    def moved(inside: Array, likely: Array) -> Array:
        head, tail = inside[j], inside[i]
        across = (head != tail) & (vote > 0)
        order = jnp.where(across & new, likely, -jnp.inf)
        best, tried = jax.lax.top_k(order, min(_TRIED, count))
        G = jnp.where(head[:, None, None], G_head, G_tail)
        point = jnp.where(head[:, None], point_head, point_tail)
        goal = jnp.where(head[:, None], point_tail, point_head)
        sq = _gaps(G, point, goal, tried, scale)
        support = jnp.sum(jnp.where(across, vote, 0) * agrees(sq), axis=1)
        support = jnp.where(best > -jnp.inf, support, -jnp.inf)
        top = jnp.argmax(support)
        go = inside & (best[top] > -jnp.inf)
        moved = product(G[tried[top]][None], T)
        T_new = jnp.where(go[:, None, None], moved, T)
        return product(lie.inverse(T_new[:1]), T_new)

    return jax.vmap(moved)(beyond, likely)


def _gaps(G: Array, point: Array, goal: Array, tried: Array, scale: Array) -> Array:
    """`(c, e)` squared errors of all edges under each of the tried motions."""
    R, t = lie.rotation(G), lie.translation(G)
    size = point.shape[-1] ** 2
    turn = R[tried].reshape(-1, size) @ R.reshape(-1, size).T
    put = jnp.einsum("cab,eb->cea", R[tried], point) + t[tried][:, None]
    return point.shape[-1] - turn + jnp.sum((put - goal) ** 2, axis=-1) / scale**2


def _subtrees(graph: PoseGraph, in_tree: Array) -> Bool[Array, "v v"]:
    """Row f: the frames that the tree joins to frame 0 through frame f."""
    num = graph.num_poses
    i, j = graph.edges[jnp.nonzero(in_tree, size=num - 1, fill_value=0)[0]].T

    def relax(state: tuple[Array, Array]) -> tuple[Array, Array]:
        hops, _ = state
        new = hops.at[j].min(hops[i] + 1).at[i].min(hops[j] + 1)
        return new, jnp.any(new < hops)

    far = jnp.full((num,), num, jnp.int32).at[0].set(0)
    hops = jax.lax.while_loop(lambda s: s[1], relax, (far, jnp.asarray(True)))[0]
    parent = jnp.zeros((num,), jnp.int32)
    parent = parent.at[jnp.where(hops[i] < hops[j], j, i)].set(
        jnp.where(hops[i] < hops[j], i, j)
    )
    return ancestors(parent.at[0].set(0)).T


def frames_moved(
    graph: PoseGraph, T: Float[Array, "v D D"], scale: Float[Array, ""], most: int
) -> Float[Array, "m v D D"]:
    """The poses with one frame moved to where most of its neighbours put it.

    A copy for each of at most `most` frames: those that gain most agreement by it.
    """
    num, none = graph.num_poses, 2 * graph.num_edges
    tail, head = jnp.concatenate([graph.edges, graph.edges[:, ::-1]]).T
    T_tail_head = jnp.concatenate([graph.T_i_j, lie.inverse(graph.T_i_j)])
    order = jnp.arange(none, dtype=jnp.int32)
    vote = jnp.append(jnp.tile(votes(graph), 2), 0)
    voters = jnp.full((num, num), none, jnp.int32)
    voters = voters.at[head, tail].min(jnp.where(vote[:-1] > 0, order, none))
    # Points whose squared distances are the errors between poses.
    unit = jnp.sqrt(0.5) * jnp.ones_like(T[0, :-1]).at[:, -1].set(jnp.sqrt(2) / scale)
    put = product(T[tail], T_tail_head)
    here, there = ((unit * X[:, :-1]).reshape(X.shape[0], -1) for X in (T, put))
    there = jnp.append(there, there[:1], axis=0)

    def support(x: Array, v: Array) -> Array:
        """The votes of the neighbours of frame v for placing it at x."""
        parts = [(there[voters[v], c] - x[:, c, None]) ** 2 for c in range(x.shape[1])]
        return jnp.sum(
            vote[voters[v]] * agrees(sum(parts, jnp.zeros((), T.dtype))), axis=1
        )

    gain = support(there[:-1], head) - support(here, jnp.arange(num))[head]
    gain = jnp.where((vote[:-1] > 0) & (head > 0), gain, -jnp.inf)
    best = jnp.full((num,), -jnp.inf, T.dtype).at[head].max(gain)
    first = jnp.where(gain == best[head], order, none - 1)
    first = jnp.full((num,), none - 1, jnp.int32).at[head].min(first)
    gained, frames = jax.lax.top_k(best, min(most, num))
    moved = jax.vmap(lambda v: T.at[v].set(put[first[v]]))(frames)
    return jnp.where((gained > 0)[:, None, None, None], moved, T)
