"""Points that lie on a surface, and points anywhere beside it: a mixture, and its fit.

The formula is that of `jaxreg.matching.evidence`.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float

from jaxreg._core import control
from jaxreg._core.arrays import weighted_sums
from jaxreg._core.typing import Scalar
from jaxreg.matching.chance import ZONE
from jaxreg.matching.problem import Match, known


# Steps of the mixture, and the bounds of its width and concentration: exact data have
# no width, normals that tell agree within 35 degrees and are known to 4.
_FIT_STEPS, _LEAST_WIDTH, _LEAST_SHARE = 16, 0.01, 1e-3
_LEAST_ALIKE, _MOST_ALIKE = 4.0, 200.0
_START = 0.5, 0.2, 4.0
# Points that the mixture is fitted to, spread over the cloud.
_FIT_POINTS = 1024
# Width of the borders that numbers of points are differentiated at, in spacings. On
# scans of the sculpture, moved by 0.1 spacings, changes of the share near are predicted
# with correlations of 0.98; widths of 0.2 and more have 0.7 to 0.97, and one of 0.05
# falls to 0.6 for steps of 0.02. (Of the evidence of four pairs of lidars and depth
# cameras, not chosen on: 0.97 to 0.99 a spacing from the truth, and to 16 to 24 %; by
# motions of 0.1 spacings 0.93 to 0.98 half a spacing or less from it, and 0.5 to 0.97
# at the best pose, where slopes vanish. Motions of 0.03 are predicted worse.)
_BORDER = 0.1


class Beside(eqx.Module):
    """Source points beside the target: heights in local spacings, and normals.

    Attributes:
        height: over the plane of the closest sample, in spacings; where either has no
            normal the distance to the sample.
        reach: the spacing there.
        log_cosine: between the normals.
        flat: whether both have one.
        mask: which are beside.
        part: the same as a number, of which the derivative is smooth (`heaviside`).
    """

    height: Float[Array, " n"]
    reach: Float[Array, " n"]
    log_cosine: Float[Array, " n"]
    flat: Bool[Array, " n"]
    mask: Bool[Array, " n"]
    part: Float[Array, " n"]

    @classmethod
    def of(
        cls, found: Match, own: Float[Array, " n"], other: Float[Array, " m"]
    ) -> "Beside":
        """Of a match, and the spacings of both clouds."""
        reach = jnp.maximum(own, other[found.row])
        flat = known(found.normal) & known(found.source_normal)
        height = jnp.where(flat, jnp.abs(found.plane_residual), 0)
        along = found.sq_residual - height**2
        # The root of zero has no finite slope.
        sq = jnp.where(flat | (found.sq_residual == 0), 1, found.sq_residual)
        distance = jnp.where(found.sq_residual > 0, jnp.sqrt(sq), 0)
        height = jnp.where(flat, height, distance)
        along = jnp.where(flat, along, 0)
        mask = found.mask & (reach > 0)
        mask = mask & (along < reach**2) & (height < ZONE * reach)
        log_cosine = 0.5 * jnp.log(jnp.maximum(found.agreement, 1e-6))
        unit = jnp.where(reach > 0, reach, 1)
        height = height / unit
        # In spacings from either border, of points near it.
        inside = heaviside((1 - along / unit**2) / 2) * heaviside(ZONE - height)
        inside = jnp.where(found.mask & (reach > 0), inside, 0)
        part = followed(mask.astype(height.dtype), inside)
        return cls(height, reach, log_cosine, flat, mask, part)

    @property
    def near(self) -> Float[Array, " n"]:
        """One of those within a spacing of the plane, zero of the others; smooth."""
        return self.part * heaviside(1 - self.height)


def heaviside(x: Float[Array, " n"]) -> Float[Array, " n"]:
    """One above zero, else zero; with the derivative of a steep logistic function.

    A sum of steps is a number of points, which jumps as points cross a border. What it
    changes by when all move a little is how many are near the border times how far they
    move, and these are told from the points within about a fifth of a spacing of it.
    """
    return followed((x > 0).astype(x.dtype), jax.nn.sigmoid(x / _BORDER))


def _positive(x: Scalar) -> Scalar:
    """One where it is zero: of a sum of nothing, which has no finite inverse."""
    return jnp.where(x > 0, x, 1)


@jax.custom_jvp
def followed(value: Float[Array, " n"], smooth: Float[Array, " n"]) -> Array:
    """The value with the derivative of a smooth one, which nothing else is told of."""
    del smooth
    return value


@followed.defjvp
def _followed_jvp(primals: tuple, tangents: tuple) -> tuple:
    return followed(*primals), tangents[1]


class Mixture(eqx.Module):
    """Points on the surface and points anywhere beside it.

    Attributes:
        share: of those on the surface, w.
        width: of their heights in spacings, s.
        alike: concentration of their normals, k: density over that of directions at
            random is |cos|^k over its mean.
        chance: share of the points anywhere beside that is within a spacing.
        d: dimension.
    """

    share: Scalar
    width: Scalar
    alike: Scalar
    chance: Scalar
    d: int = eqx.field(static=True)

    @classmethod
    def fitted(
        cls, beside: Beside, balance: Float[Array, " n"], chance: Scalar, d: int
    ) -> "Mixture":
        """By expectation maximisation."""
        step = max(1, len(balance) // _FIT_POINTS)
        beside, balance = jax.tree.map(lambda x: x[::step], (beside, balance))
        weight = beside.part * balance
        total = _positive(jnp.sum(weight))
        half = (d - 1) / 2
        each = jnp.ones_like(weight), beside.height**2, -beside.log_cosine
        told = jnp.stack(each)

        def improve(_: Array, now: Array) -> Array:
            mixture = cls(now[0], now[1], now[2], chance, d)
            part = weight * jax.nn.sigmoid(mixture.log_odds(beside))
            some, sq_width, apart = weighted_sums(told, part)
            some = _positive(some)
            sq_width, apart = sq_width / some, apart / some
            alike = half / jnp.maximum(apart, half / (2 * _MOST_ALIKE)) - half
            share = jnp.clip(some / total, _LEAST_SHARE, 1 - _LEAST_SHARE)
            width = jnp.sqrt(jnp.clip(sq_width, _LEAST_WIDTH**2, 1))
            return jnp.stack([share, width, jnp.clip(alike, _LEAST_ALIKE, _MOST_ALIKE)])

        start = jnp.asarray(_START, weight.dtype)
        share, width, alike = control.fori_loop(0, _FIT_STEPS, improve, start)
        return cls(share, width, alike, chance, d)

    def log_odds(self, beside: Beside) -> Float[Array, " n"]:
        """Of each point lying on the surface."""
        k, log_mean = self.alike, _log_mean_of_power(self.alike, self.d)
        beyond = (1 - self.chance) / (2 * (ZONE - 1))
        anywhere = jnp.where(beside.height < 1, self.chance / 2, beyond)
        log_scale = -jnp.log(math.sqrt(2 * math.pi) * self.width * anywhere)
        log_share = jnp.log(self.share) - jnp.log1p(-self.share)
        normals = jnp.where(beside.flat, k * beside.log_cosine - log_mean, 0)
        return log_share + log_scale - (beside.height / self.width) ** 2 / 2 + normals

    def gain(
        self, beside: Beside, balance: Float[Array, " n"]
    ) -> tuple[Scalar, Bool[Array, " n"]]:
        """Mean log-likelihood over that of chance, and the points on the surface."""
        odds = self.log_odds(beside)
        weight = beside.part * balance
        gain = jax.nn.softplus(odds) + jnp.log1p(-self.share)
        said, weight = jnp.sum(jnp.stack([weight * gain, weight]), axis=1)
        return said / _positive(weight), beside.mask & (odds > 0)


def _log_mean_of_power(k: Scalar, d: int) -> Scalar:
    """The logarithm of the mean of |cos|^k over all directions."""
    if d == 3:
        return -jnp.log1p(k)
    return gammaln((k + 1) / 2) - gammaln(k / 2 + 1) - gammaln(0.5)
