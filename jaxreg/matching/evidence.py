"""How likely it is that two surfaces coincide at a pose, without knowing the truth.

A point has something to say where it is *beside* a sample of the other cloud: no
farther from it along the surface than the samples around are apart, and no more than
three such spacings over or under its plane. Of points beside, with heights u over the
plane in local spacings and cosines c between normals, the pair itself tells the noise
by a mixture, fitted by maximum likelihood (expectation maximisation):

    p(u, c) = w N(u; 0, s^2) f_k(c) + (1 - w) / 6 f_0(c)

points that lie on the surface, with a width s and a concentration k of their normals,
and points that are anywhere beside it. (Where both clouds fill a volume, chance alone
puts points near the other's samples, and 1 / 6 is more within a spacing and less
beyond: `jaxreg.matching.chance`.) Directions count alike however many points show
them: the ground is most of what a lidar sees, and it fits nearly everywhere. Two
numbers of both ways are left,

    gain    the mean of log p(u, c) / p(u, c; w = 0): how much better than chance the
            points lie, in nats a point,
    near    the share of the points beside that are within one spacing of the plane:
            surfaces that touch by chance part again.

The logarithm of the odds of a right pose against the best wrong one is taken to be
linear in log gain and near (logistic regression on pairs of scans):

    log_evidence = _GAIN log gain + _NEAR near - _OFFSET

at equal odds before. Nothing here is a length or a density of points, so lidar, RGB-D
and scanned objects share the three numbers. They were found on clouds thinned to 4,096
points, and searches judge by as many; how, and what they say of data that they were not
found on: bench/studies/evidence.md.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import on_both
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import PointCloud, levelled
from jaxreg.geometry import lie
from jaxreg.matching.chance import ZONE, near_by_chance
from jaxreg.matching.problem import Match, Problem, match
from jaxreg.matching.slippage import Grip
from jaxreg.neighbours import AbstractIndex, BruteForce


#: Poses of no less log evidence are believed, on all data alike: of the answers of
#: `register` to lidar, depth cameras and objects 262 of 272 right ones, none of 136
#: wrong ones.
LIKELY = 1.0
#: Of poses that are none: less than any pose has.
NO_EVIDENCE = -100.0
# The regression; `near` weighs like 25 independent places of which 95 % of those of
# a right pose are near and 80 % of those of a wrong one.
_GAIN, _NEAR, _OFFSET = 2.3, 38.0, 34.8
# A gain so small is none: the mixture found nothing on the surface.
_LEAST_GAIN = 0.05
# Steps of the mixture, and the bounds of its width and concentration: exact data have
# no width, normals that tell agree within 35 degrees and are known to 4.
_FIT_STEPS, _LEAST_WIDTH, _LEAST_SHARE = 16, 0.01, 1e-3
_LEAST_ALIKE, _MOST_ALIKE = 4.0, 200.0
_START = 0.5, 0.2, 4.0
# Points that the mixture is fitted to, spread over the cloud.
_FIT_POINTS = 1024
# Points of each cloud that are asked where all pairs are compared: 2 ms; twice as many
# take 6, a third of an ICP on 2,000 points.
_SOME = 512
# Directions over which normals are balanced, and how sharply.
_DIRECTIONS, _SHARPNESS = {2: 32, 3: 128}, 16
# A point so many spacings before the surface that the other scanner saw speaks against
# the pose, as much as so many others: that ray was free.
_BEFORE, _AGAINST = 1.5, 100.0


class Evidence(eqx.Module):
    """What two clouds say of a pose.

    Attributes:
        log_evidence: log of how much likelier the clouds are if their surfaces coincide
            at the pose than if it is the best of wrong ones; `NO_EVIDENCE` of none.
        overlap: share of the source that the target saw: the points within a local
            spacing of a sample and of its plane.
        fitness: share of the source that lies on the target, within the noise.
        inlier_rmse: residual of that share.
        num_inliers: int32, points in that share.
        grip: how firmly that share holds the pose, in the target's frame.
    """

    log_evidence: Float[Array, "*q"]
    overlap: Float[Array, "*q"]
    fitness: Float[Array, "*q"]
    inlier_rmse: Float[Array, "*q"]
    num_inliers: Int[Array, "*q"]
    grip: Grip


class _Way(eqx.Module):
    """What the points of one cloud say: shares of it, and the two numbers."""

    overlap: Float[Array, "*q"]
    near: Float[Array, "*q"]
    gain: Float[Array, "*q"]
    fitness: Float[Array, "*q"]
    rmse: Float[Array, "*q"]
    num: Int[Array, "*q"]
    grip: Grip


class Witness(eqx.Module):
    """A pair of clouds that can be asked about poses.

    Attributes:
        problems: of the source on the target, and of the target on the source.
        spacings: of the samples around each point, of the source and of the target.
        shares: weights by which the directions of either's normals count alike.
        chance: share of the heights beside that is near by chance, of the cloud that
            has less of it.
    """

    problems: tuple[Problem, Problem]
    spacings: tuple[Float[Array, " n"], Float[Array, " n"]]
    shares: tuple[Float[Array, " n"], Float[Array, " n"]]
    chance: Scalar

    @classmethod
    def of(
        cls,
        source: PointCloud,
        target: PointCloud,
        source_index: AbstractIndex,
        target_index: AbstractIndex,
    ) -> "Witness":
        """Of clouds and their indexes."""
        source, target = levelled(source.with_spacing(), target.with_spacing())
        if source.spacing is None or target.spacing is None:
            raise ValueError("Witness: clouds without spacings.")
        return cls(
            (
                Problem.of(source, target, target_index),
                Problem.of(target, source, source_index),
            ),
            (source.spacing, target.spacing),
            on_both(_balanced, source, target),
            jnp.minimum(
                near_by_chance(source, source_index),
                near_by_chance(target, target_index),
            ),
        )

    @classmethod
    def of_some(cls, source: PointCloud, target: PointCloud) -> "Witness":
        """Of some points of clouds that have no index: all pairs are compared."""
        source = source.spread(_SOME).with_spacing()
        target = target.spread(_SOME).with_spacing()
        index = BruteForce.build(source.points, source.mask)
        return cls.of(
            source, target, index, BruteForce.build(target.points, target.mask)
        )

    def of_poses(
        self, T_target_source: Float[Array, "q D D"], used: Bool[Array, " q"]
    ) -> Evidence:
        """Of each pose in use, one after another; `NO_EVIDENCE` of the others."""
        (there, back), (own, other) = self.problems, self.spacings
        T_source_target, chance = lie.inverse(T_target_source), self.chance
        forward = there, T_target_source, own, other, self.shares[0], chance
        backward = back, T_source_target, other, own, self.shares[1], chance

        def ways(way: tuple) -> _Way:
            problem, T, *rest = way

            def one(pose: tuple[Motion, Array]) -> _Way:
                return lax.cond(
                    pose[1], lambda T: _one_way(problem, T, *rest), _nothing, pose[0]
                )

            return lax.map(one, (T, used))

        return _of_both(*on_both(ways, forward, backward), used)

    def of_pose(self, T_target_source: Motion) -> Evidence:
        """Of one pose."""
        found = self.of_poses(T_target_source[None], jnp.ones(1, bool))
        return jax.tree.map(lambda x: x[0], found)


class _Beside(eqx.Module):
    """Source points beside the target: heights in local spacings, and normals.

    Attributes:
        height: over the plane of the closest sample, in spacings; where either has no
            normal the distance to the sample.
        reach: the spacing there.
        log_cosine: between the normals.
        flat: whether both have one.
        mask: which are beside.
    """

    height: Float[Array, " n"]
    reach: Float[Array, " n"]
    log_cosine: Float[Array, " n"]
    flat: Bool[Array, " n"]
    mask: Bool[Array, " n"]

    @classmethod
    def of(
        cls, found: Match, own: Float[Array, " n"], other: Float[Array, " m"]
    ) -> "_Beside":
        """Of a match, and the spacings of both clouds."""
        reach = jnp.maximum(own, other[found.row])
        flat = jnp.any(found.normal != 0, axis=0)
        flat = flat & jnp.any(found.source_normal != 0, axis=0)
        height = jnp.where(flat, jnp.abs(found.plane_residual), 0)
        along = found.sq_residual - height**2
        height = jnp.where(flat, height, jnp.sqrt(found.sq_residual))
        along = jnp.where(flat, along, 0)
        mask = found.mask & (reach > 0)
        mask = mask & (along < reach**2) & (height < ZONE * reach)
        log_cosine = 0.5 * jnp.log(jnp.maximum(found.agreement, 1e-6))
        height = height / jnp.where(reach > 0, reach, 1)
        return cls(height, reach, log_cosine, flat, mask)


class _Mixture(eqx.Module):
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
        cls, beside: _Beside, balance: Float[Array, " n"], chance: Scalar, d: int
    ) -> "_Mixture":
        """By expectation maximisation."""
        step = max(1, len(balance) // _FIT_POINTS)
        beside, balance = jax.tree.map(lambda x: x[::step], (beside, balance))
        weight = jnp.where(beside.mask, balance, 0)
        tiny = jnp.finfo(weight.dtype).tiny
        total = jnp.maximum(jnp.sum(weight), tiny)
        half = (d - 1) / 2

        def improve(_: Array, now: Array) -> Array:
            mixture = cls(now[0], now[1], now[2], chance, d)
            part = weight * jax.nn.sigmoid(mixture.log_odds(beside))
            some = jnp.maximum(jnp.sum(part), tiny)
            sq_width = jnp.sum(part * beside.height**2) / some
            apart = jnp.sum(part * -beside.log_cosine) / some
            alike = half / jnp.maximum(apart, half / (2 * _MOST_ALIKE)) - half
            share = jnp.clip(some / total, _LEAST_SHARE, 1 - _LEAST_SHARE)
            width = jnp.clip(jnp.sqrt(sq_width), _LEAST_WIDTH, 1)
            return jnp.stack([share, width, jnp.clip(alike, _LEAST_ALIKE, _MOST_ALIKE)])

        start = jnp.asarray(_START, weight.dtype)
        share, width, alike = lax.fori_loop(0, _FIT_STEPS, improve, start)
        return cls(share, width, alike, chance, d)

    def log_odds(self, beside: _Beside) -> Float[Array, " n"]:
        """Of each point lying on the surface."""
        k, half = self.alike, self.d / 2
        log_mean = gammaln((k + 1) / 2) - gammaln(k / 2 + half)
        log_mean = log_mean + gammaln(half) - gammaln(0.5)
        beyond = (1 - self.chance) / (2 * (ZONE - 1))
        anywhere = jnp.where(beside.height < 1, self.chance / 2, beyond)
        log_scale = -jnp.log(math.sqrt(2 * math.pi) * self.width * anywhere)
        log_share = jnp.log(self.share) - jnp.log1p(-self.share)
        normals = jnp.where(beside.flat, k * beside.log_cosine - log_mean, 0)
        return log_share + log_scale - (beside.height / self.width) ** 2 / 2 + normals

    def gain(
        self, beside: _Beside, balance: Float[Array, " n"]
    ) -> tuple[Scalar, Bool[Array, " n"]]:
        """Mean log-likelihood over that of chance, and the points on the surface."""
        odds = self.log_odds(beside)
        weight = jnp.where(beside.mask, balance, 0)
        gain = jax.nn.softplus(odds) + jnp.log1p(-self.share)
        tiny = jnp.finfo(weight.dtype).tiny
        mean = jnp.sum(weight * gain) / jnp.maximum(jnp.sum(weight), tiny)
        return mean, beside.mask & (odds > 0)


def _one_way(
    problem: Problem,
    T_target_source: Motion,
    own: Float[Array, " n"],
    other: Float[Array, " m"],
    balance: Float[Array, " n"],
    chance: Scalar,
) -> _Way:
    """What the source of a problem says of a pose."""
    found = match(problem, T_target_source)
    beside = _Beside.of(found, own, other)
    mixture = _Mixture.fitted(beside, balance, chance, problem.source.shape[0])
    gain, on = mixture.gain(beside, balance)
    near = beside.mask & (beside.height < 1)
    moved = found.rotated + lie.translation(T_target_source)[:, None]
    before = _num_before(problem, moved, beside, found.mask)
    num = jnp.sum(on)
    total = jnp.maximum(jnp.sum(found.mask), 1)
    said = jnp.sum(beside.mask) + _AGAINST * before
    sq = jnp.where(on, (beside.height * beside.reach) ** 2, 0)
    return _Way(
        overlap=(jnp.sum(near) / total).astype(gain.dtype),
        near=(jnp.sum(near) / jnp.maximum(said, 1)).astype(gain.dtype),
        gain=gain,
        fitness=(num / total).astype(gain.dtype),
        rmse=jnp.sqrt(jnp.sum(sq) / jnp.maximum(num, 1)),
        num=num.astype(jnp.int32),
        grip=Grip.of(found, moved, on),
    )


def _of_both(there: _Way, back: _Way, used: Bool[Array, " q"]) -> Evidence:
    gain = jnp.maximum((there.gain + back.gain) / 2, _LEAST_GAIN)
    near = jnp.sqrt(there.near * back.near)
    log_evidence = _GAIN * jnp.log(gain) + _NEAR * near - _OFFSET
    return Evidence(
        jnp.where(used, log_evidence, NO_EVIDENCE),
        there.overlap,
        there.fitness,
        there.rmse,
        there.num,
        there.grip,
    )


def _nothing(T: Motion) -> _Way:
    zero, d = jnp.zeros((), T.dtype), T.shape[-1] - 1
    k = d * (d + 1) // 2
    grip = Grip(jnp.zeros((k, k), T.dtype), jnp.zeros(d, T.dtype), zero)
    return _Way(zero, zero, zero, zero, zero, jnp.zeros((), jnp.int32), grip)


def _num_before(
    problem: Problem,
    moved: Float[Array, "d n"],
    beside: _Beside,
    mask: Bool[Array, " n"],
) -> Int[Array, ""]:
    """Source points in what the target's scanner saw to be free."""
    if problem.seen is None:
        return jnp.zeros((), jnp.int32)
    before = problem.seen.depth_before(moved) > _BEFORE * beside.reach
    return jnp.sum(before & mask).astype(jnp.int32)


def _balanced(cloud: PointCloud) -> Float[Array, " n"]:
    """Weights of mean one over the valid points: all directions count alike."""
    d = cloud.points.shape[1]
    axes = jnp.asarray(_directions(d), cloud.points.dtype)
    cosine = jnp.matmul(cloud.normals, axes.T, precision=lax.Precision.HIGHEST)
    kernel = cosine**_SHARPNESS
    valid = cloud.mask.astype(kernel.dtype)
    num = jnp.maximum(jnp.sum(valid), 1)
    crowd = jnp.sum(valid[:, None] * kernel, axis=0) / num
    own = jnp.sum(kernel, axis=1)
    density = (kernel @ crowd) / jnp.where(own > 0, own, 1)
    # Where few points face the same way their number is chance.
    weight = jnp.where(own > 0, 1 / jnp.maximum(density, 1 / num), 0)
    weight = jnp.where(own > 0, weight, jnp.min(jnp.where(own > 0, weight, jnp.inf)))
    weight = jnp.where(jnp.isfinite(weight), weight, 1) * valid
    return weight * num / jnp.maximum(jnp.sum(weight), jnp.finfo(kernel.dtype).tiny)


def _directions(d: int) -> np.ndarray:
    """`(m, d)` axes of either sign, evenly spread."""
    m = _DIRECTIONS[d]
    step = np.arange(m) + 0.5
    if d == 2:
        return np.stack([np.cos(np.pi * step / m), np.sin(np.pi * step / m)], axis=1)
    z, turn = step / m, np.pi * (1 + 5**0.5) * step
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
