"""Fast point feature histograms, of normals of either sign.

A point p with normal n and a neighbour q with normal m make three angles, which no
rigid motion changes. With u = n, v = (q - p) x u / |q - p|, w = u x v:

    alpha = v . m,   phi = u . (q - p) / |q - p|,   theta = atan2(w . m, u . m)

Their histograms over the neighbours of p are its simplified feature, SPFH; the feature
is

    FPFH(p) = SPFH(p) + mean over neighbours q of SPFH(q), weighted by 1 / |q - p|.

The sign of a normal is not known. Neighbours take that of n, so one sign is left for
each feature, and the other one mirrors the histograms of phi and theta. So a feature is
held as two parts: the even one does not know the sign, the odd one changes its own
with it.

Reference: Rusu, Blodow, Beetz, Fast Point Feature Histograms (FPFH) for 3D
Registration, ICRA 2009.
"""

import math

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.typing import Scalar
from jaxreg.cloud import Described, PointCloud
from jaxreg.neighbours import BruteForce


# Bins of each of the three histograms, as in the paper.
_BINS = 11
# A feature of fewer neighbours is none.
_LEAST = 5


def described(cloud: PointCloud, radius: Scalar, num_neighbours: int) -> Described:
    """Features of the points of a cloud.

    Histograms are filled linearly between bins, so that noise changes them little.

    Args:
        cloud: of any number of points; all pairs are compared.
        radius: of the neighbourhoods.
        num_neighbours: the nearest so many that are looked at.
    """
    k = min(num_neighbours + 1, cloud.mask.shape[0])
    found = BruteForce.build(cloud.points, cloud.mask).query(cloud.points, k)
    row, sq = found.index[:, 1:], found.sq_distance[:, 1:]  # the first is the point
    flat = cloud.mask & jnp.any(cloud.normals != 0, axis=1)
    near = found.valid[:, 1:] & (sq > 0) & (sq < radius**2)
    near = near & flat[row] & flat[:, None]
    distance = jnp.sqrt(jnp.where(near, sq, 1))
    even, odd, sign = _simplified(cloud, row, distance, near)
    weight = jnp.where(near, 1 / distance, 0)
    weight = weight / _or_one(jnp.sum(weight, axis=1))[:, None]
    even = even + jnp.einsum("nk,nkf->nf", weight, even[row])
    odd = odd + jnp.einsum("nk,nkf->nf", weight * sign, odd[row])
    known = flat & (jnp.sum(near, axis=1) >= _LEAST)
    return Described(cloud.points, cloud.normals, even, odd, known)


def _simplified(
    cloud: PointCloud, row: Array, distance: Array, near: Array
) -> tuple[Float[Array, "n f"], Float[Array, "n f"], Float[Array, "n k"]]:
    """Both parts of each SPFH, and the signs of neighbours' normals, as seen here."""
    n, m = cloud.normals[:, None], cloud.normals[row]
    sign = jnp.where(jnp.sum(n * m, axis=-1) < 0, -1, 1).astype(n.dtype)
    m = sign[..., None] * m
    along = (cloud.points[row] - cloud.points[:, None]) / distance[..., None]
    v = jnp.cross(along, n)
    w = jnp.cross(n, v)
    # |v| is the sine between the line and the normal: zero where v has no direction.
    sine = _or_one(jnp.sqrt(jnp.sum(v * v, axis=-1)))
    alpha = jnp.sum(v * m, axis=-1) / sine
    phi = jnp.sum(n * along, axis=-1)
    theta = jnp.arctan2(jnp.sum(w * m, axis=-1) / sine, jnp.sum(n * m, axis=-1))
    angles = alpha, phi, theta / (math.pi / 2)  # the normals agree in sign
    weight = near.astype(n.dtype)
    weight = weight / _or_one(jnp.sum(weight, axis=1))[:, None]
    first, *others = (_histogram(x, weight) for x in angles)
    mirrored = [first, *(x[:, ::-1] for x in others)]
    both = jnp.concatenate([first, *others], axis=1), jnp.concatenate(mirrored, axis=1)
    return (both[0] + both[1]) / 2, (both[0] - both[1]) / 2, sign


def _histogram(
    x: Float[Array, "n k"], weight: Float[Array, "n k"]
) -> Float[Array, "n b"]:
    """Of values in [-1, 1], each shared by the two nearest bins."""
    at = jnp.clip((x + 1) * (_BINS / 2) - 0.5, 0, _BINS - 1)
    bins = jnp.arange(_BINS, dtype=x.dtype)
    share = jnp.maximum(0, 1 - jnp.abs(at[..., None] - bins[None, None]))
    return jnp.einsum("nk,nkb->nb", weight, share, precision=lax.Precision.HIGHEST)


def _or_one(x: Array) -> Array:
    return jnp.where(x > 0, x, 1)
