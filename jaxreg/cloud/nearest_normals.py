"""Normals from the nearest neighbours, by exact search.

Finer where samples are sparse and uneven than the cells of `normals.py`, independent
of the orientation of the axes, and ten times slower.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.typing import Mask, Points
from jaxreg.cloud.point_cloud import num_around, spacing_around
from jaxreg.geometry.eigen import least_eigenvectors
from jaxreg.neighbours import BruteForce


# Least share of the largest spread that the second least needs to span a plane.
_SPAN = 1e-6


def normals_from_neighbours(
    places: Points,
    mask: Mask,
    count: Float[Array, " n"],
    spread: Float[Array, "n d d"],
    num_neighbours: int,
    fading: bool = False,
) -> tuple[Float[Array, "n d"], Float[Array, " n"]]:
    """Unit normals of either sign of the valid places, and the spacing around them.

    Zero where undefined.

    A place stands for `count` points with mean there and summed outer products of
    offsets `spread`; a normal is the direction of least spread of all the points of
    the nearest places, itself among them. With `fading` the weight of a place falls to
    zero with its squared distance: which ones are near then changes no normal at once.

    Gradients: of the normals by places and spread, which places are near is held; the
    spacing is cut.
    """
    d = places.shape[1]
    k = min(num_neighbours, places.shape[0])
    frozen = lax.stop_gradient(places)
    found = BruteForce.build(frozen, mask).query(frozen, k)
    row, valid = found.index.T, found.valid.T
    weight = jnp.where(valid, count[row], 0)
    delta = [places[:, i][row] - places[None, :, i] for i in range(d)]
    if fading:
        sq = sum(x * x for x in delta)
        last = jnp.max(jnp.where(valid, sq, 0), axis=0)
        weight = weight * (1 - sq / jnp.where(last > 0, last, 1))
    total = jnp.sum(weight, axis=0)
    total = jnp.where(total > 0, total, 1)
    mean = [jnp.sum(weight * x, axis=0) / total for x in delta]
    off = [x - m[None] for x, m in zip(delta, mean, strict=True)]
    moments = [[total] * d for _ in range(d)]
    for i in range(d):
        for j in range(i, d):
            inner = jnp.where(valid, spread[:, i, j][row], 0)
            outer = weight * off[i] * off[j]
            moments[i][j] = moments[j][i] = jnp.sum(inner + outer, axis=0) / total
    entries = jnp.stack([jnp.stack(line) for line in moments])
    vectors, second, largest = least_eigenvectors(entries)
    flat = mask & (largest > 0) & (second > _SPAN * largest)
    near = jax.tree.map(lambda x: x[:, : 1 + num_around(d)], found)
    return jnp.where(flat[None], vectors, 0).T, spacing_around(near, mask)
