"""Normal equations of residuals with a metric: the energy sum of w r^T M r / 2.

They are summed in the frame of the source. There products of coordinates are the same
for all poses, so that the sums of many particles are one matrix product, which takes a
third of the time of one for each particle.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.arrays import full_matmul
from jaxreg.matching.problem import Match


def metric_equations(
    match: Match,
    weight: Float[Array, " n"],
    metric: Float[Array, "t n"],
    force: Float[Array, "d n"],
) -> tuple[Float[Array, "k k"], Float[Array, " k"]]:
    """H and b for the tangent (v, w), see `AbstractResidual`.

    Args:
        match: the points.
        weight: of each.
        metric: the upper triangle of M row by row, in the frame of the source.
        force: M r row by row, in the frame of the target.
    """
    p, R = match.source, match.R
    d, number = len(p), len(metric)
    products = outer(jnp.concatenate([jnp.ones_like(p[:1]), p]))
    rows = weight[None] * jnp.concatenate([metric, force])
    sums = full_matmul(rows, products.T)
    # Sums of M_ij p_b p_c with 1 as p_0, at row (i, b) and column (j, c).
    spread = sums[:number][_places(d)][..., _places(d + 1)]
    spread = jnp.swapaxes(spread, 1, 2).reshape(d * (d + 1), -1)
    pull = full_matmul(R.T, sums[number:, : d + 1]).reshape(-1, 1)
    K = _turned(R, jnp.asarray(_tangents(d), weight.dtype))
    return full_matmul(full_matmul(K, spread), K.T), full_matmul(K, pull)[:, 0]


def outer(rows: Float[Array, "d n"]) -> Float[Array, "t n"]:
    """The upper triangle of each column's product with itself, row by row."""
    return jnp.concatenate([rows[i : i + 1] * rows[i:] for i in range(len(rows))])


def identity(d: int, dtype: Any) -> Float[Array, "t 1"]:
    """The upper triangle of the identity, row by row."""
    return jnp.asarray(np.eye(d)[np.triu_indices(d)][:, None], dtype)


def _places(num: int) -> np.ndarray:
    """Where each entry of a symmetric matrix is in its upper triangle."""
    places, (i, j) = np.zeros((num, num), int), np.triu_indices(num)
    places[i, j] = places[j, i] = np.arange(len(i))
    return places


def _tangents(d: int) -> np.ndarray:
    """`(k, d (d + 1))` K with (n, p cross n) = K vec(n outer (1, p))."""
    one, *axes = np.eye(d + 1)
    units = np.eye(d)
    turns = [(0, 1)] if d == 2 else [(1, 2), (2, 0), (0, 1)]
    rows = [np.kron(n, one) for n in units]
    rows += [np.kron(units[c], axes[b]) - np.kron(units[b], axes[c]) for b, c in turns]
    return np.stack(rows)


def _turned(R: Float[Array, "d d"], K: Float[Array, "k m"]) -> Float[Array, "k m"]:
    """Tangents of the source's frame as those of the target's."""
    d = len(R)
    turn = full_matmul(R, K[d:]) if d == 3 else K[d:]
    return jnp.concatenate([full_matmul(R, K[:d]), turn])
