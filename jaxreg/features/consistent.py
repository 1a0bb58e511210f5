"""Poses that many correspondences agree on, though most of them are wrong.

A rigid motion keeps what two points with normals have between them: their distance, the
angle between the normals, and the angles of either to the line. Two correspondences of
which all these agree are compatible. Right ones are compatible with one another; wrong
ones rarely with one another's partners, too. So each correspondence is scored with each
other by how many they are both compatible with (second order, Chen et al. 2022), the
best partners of each give a pose in closed form, and those that agree with it a better
one.

References: Leordeanu, Hebert, A Spectral Technique for Correspondence Problems using
Pairwise Constraints, ICCV 2005; Chen, Sun, Yang, Tao, SC2-PCR, CVPR 2022; Lim et al.,
KISS-Matcher, ICRA 2025.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import full_matmul
from jaxreg._core.typing import Scalar
from jaxreg.features.correspond import Correspondences
from jaxreg.geometry import lie
from jaxreg.geometry.nearest_rotation import nearest_rotation


# Cosines of angles that agree differ by no more than this.
_ANGLES = 0.3
# Points nearer than this, in tolerances, say too little of a rotation.
_APART = 3.0
# Partners that a pose is first fitted to, and fits: to them, then to all that agree.
_PARTNERS, _FITS = 20, 3
# Cosine of normals that agree with a pose.
_ALIKE = 0.8


class Agreed(eqx.Module):
    """Poses and how many correspondences agree with each.

    Attributes:
        T_target_source: `(m, 4, 4)`, one for each correspondence, of many the same.
        num_agreeing: `(m,)` int32, within the tolerance and with normals alike; zero of
            masked ones.
    """

    T_target_source: Float[Array, "m 4 4"]
    num_agreeing: Int[Array, " m"]


def consistent_poses(pairs: Correspondences, tolerance: Scalar) -> Agreed:
    """A pose of each correspondence and its partners.

    Args:
        pairs: correspondences; all pairs of them are compared.
        tolerance: of distances.
    """
    compatible = _compatible(pairs, tolerance).astype(pairs.source.dtype)
    common = compatible * full_matmul(compatible, compatible)
    num = len(pairs.mask)
    score, partner = lax.top_k(common, min(_PARTNERS, num))
    agree = jnp.eye(num, dtype=common.dtype)
    seeds = jnp.arange(num)[:, None]
    agree = agree.at[seeds, partner].max((score > 0).astype(common.dtype))

    def fit(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        T, agree = state
        enough = jnp.sum(agree, axis=1) >= 3
        T = jnp.where(enough[:, None, None], _fitted(pairs, agree), T)
        return T, _agreeing(pairs, T, tolerance).astype(agree.dtype)

    start = lie.identity(3, common.dtype, (num,)), agree
    T, agree = control.fori_loop(0, _FITS, fit, start)
    number = jnp.where(pairs.mask, jnp.sum(agree, axis=1), 0)
    return Agreed(T, number.astype(jnp.int32))


def _compatible(pairs: Correspondences, tolerance: Scalar) -> Bool[Array, "m m"]:
    """Which two correspondences a rigid motion may explain."""
    sides = (
        (pairs.source, pairs.source_normals),
        (pairs.target, pairs.target_normals),
    )
    (long, facing, over), (long_, facing_, over_) = (_between(*x) for x in sides)
    alike = jnp.abs(over - over_) < _ANGLES
    alike = alike & alike.T & (jnp.abs(facing - facing_) < _ANGLES)
    apart = jnp.minimum(long, long_) > _APART * tolerance
    same = (jnp.abs(long - long_) < tolerance) & apart & alike
    return same & pairs.mask[:, None] & pairs.mask[None]


def _between(
    points: Float[Array, "m 3"], normals: Float[Array, "m 3"]
) -> tuple[Array, Array, Array]:
    """Of each two points: distance, |cosine| of normals, and of the first to the line.

    By differences of each coordinate: products of inner ones would cancel.
    """
    delta = [x[:, None] - x[None] for x in points.T]
    distance = jnp.sqrt(sum(x * x for x in delta))
    over = sum(x * n[:, None] for x, n in zip(delta, normals.T, strict=True))
    over = jnp.abs(over) / jnp.where(distance > 0, distance, 1)
    return distance, jnp.abs(full_matmul(normals, normals.T)), over


def _fitted(pairs: Correspondences, weight: Float[Array, "b m"]) -> Array:
    """`(b, 4, 4)` rigid fits of weighted correspondences (Kabsch 1976)."""
    total = jnp.maximum(jnp.sum(weight, axis=1), 1)[:, None]
    source, target = (
        full_matmul(weight, x) / total for x in (pairs.source, pairs.target)
    )
    outer = (pairs.target[:, :, None] * pairs.source[:, None, :]).reshape(-1, 9)
    spread = full_matmul(weight, outer).reshape(-1, 3, 3)
    spread = spread - (total * target)[:, :, None] * source[:, None, :]
    R = nearest_rotation(spread)
    return lie.compose(R, target - _turned(R, source))


def _agreeing(
    pairs: Correspondences, T: Float[Array, "b 4 4"], tolerance: Scalar
) -> Bool[Array, "b m"]:
    """Correspondences within the tolerance of each pose, with normals alike."""
    R, t = lie.rotation(T), lie.translation(T)
    sq = cosine = jnp.zeros((), t.dtype)
    for i in range(3):
        moved = full_matmul(R[:, i], pairs.source.T) + t[:, i : i + 1]
        sq = sq + (moved - pairs.target[None, :, i]) ** 2
        turned = full_matmul(R[:, i], pairs.source_normals.T)
        cosine = cosine + turned * pairs.target_normals[None, :, i]
    return (sq < tolerance**2) & (jnp.abs(cosine) > _ALIKE) & pairs.mask[None]


def _turned(R: Float[Array, "b 3 3"], x: Float[Array, "b 3"]) -> Float[Array, "b 3"]:
    return jnp.sum(R * x[:, None, :], axis=-1)
