"""How poses follow errors of the motions between them, averaged by least squares."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg.geometry import lie
from jaxreg.linear.carried import carried_back
from jaxreg.linear.laplacian import solver_for
from jaxreg.linear.operator import GraphLaplacian
from jaxreg.linear.solvers import RidgedCholesky


def follow_motions(
    edges: Int[Array, "e 2"],
    weight: Float[Array, " e"],
    T_world_i: Float[Array, "v D D"],
    first: Int[Array, ""],
    errors: Callable[[Array, Array], tuple[Float[Array, "r k c"], Array]],
    num: tuple[int, int],
) -> Float[Array, "r v k c"]:
    """Velocities of all poses but the first, which is held, in the axes of the world.

    Of many poses no matrix over all is formed (`solver_for`).

    Args:
        edges: frames i and j; every frame hangs together with the first or on nothing.
        weight: of each edge.
        T_world_i: the poses.
        first: which frame stays.
        errors: of the motion from frame j to frame i, each in the axes of the world at
            the point of j, and `(k, k)` how far, where the poses are off, the motion is
            not: 1 if it was found without them.
        num: r, that are taken one after another, and c.
    """
    place, k = lie.translation(T_world_i), lie.tangent_dim(T_world_i.shape[-1] - 1)
    dtype = T_world_i.dtype

    def add(total: Array, edge: tuple[Array, Array]) -> tuple[Array, Array]:
        (i, j), w = edge
        y, share = errors(i, j)
        y, share = w * y, w * (share + share.T) / 2
        lever = jnp.broadcast_to(place[j] - place[i], (len(y), place.shape[1]))
        return total.at[:, i].add(-carried_back(y, lever)).at[:, j].add(y), share

    pulls = jnp.zeros((num[0], len(place), k, num[1]), dtype)
    pulls, stiffness = lax.scan(add, pulls, (edges, weight))
    told = edges, stiffness, len(place), 0.0, place
    matrix = GraphLaplacian.anchored(*told, anchor=first)
    solver = solver_for(len(place), RidgedCholesky())
    state = solver.init(matrix, {})
    return lax.map(lambda rhs: solver.compute(state, rhs, {})[0], pulls)
