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
them: the ground is most of what a lidar sees, and it fits nearly everywhere. What is
left are numbers of both ways; `jaxreg.matching.odds` says what they are worth.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import on_both
from jaxreg._core.quantile import masked_quantile
from jaxreg._core.shares import shared
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import PointCloud, centroid, levelled
from jaxreg.geometry import lie
from jaxreg.matching.chance import near_by_chance
from jaxreg.matching.directions import balanced
from jaxreg.matching.mixture import Beside, Mixture
from jaxreg.matching.odds import Said
from jaxreg.matching.problem import Problem, match
from jaxreg.matching.slippage import Grip
from jaxreg.neighbours import AbstractIndex, BruteForce


#: Poses of no less log evidence are believed, on all data alike.
LIKELY = 1.0
#: Of poses that are none: less than any pose has.
NO_EVIDENCE = -100.0
# Points of each cloud that are asked where all pairs are compared: 2 ms; twice as many
# take 6, a third of an ICP on 2,000 points.
_SOME = 512
# A point so many spacings before the surface that the other scanner saw speaks against
# the pose, as much as so many others: that ray was free.
_BEFORE, _AGAINST = 1.5, 100.0


class Evidence(eqx.Module):
    """What two clouds say of a pose.

    Attributes:
        log_evidence: log of how much likelier the clouds are if their surfaces coincide
            at the pose than if it is the best of wrong ones; `NO_EVIDENCE` of none.
        contact: the same of the surfaces coinciding, whatever holds the pose: of poses
            that slip, whether they slip on one surface.
        overlap: share of the source that the target saw: the points within a local
            spacing of a sample and of its plane.
        fitness: share of the source that lies on the target, within the noise.
        inlier_rmse: residual of that share.
        num_inliers: int32, points in that share.
        grip: how firmly that share holds the pose, in the target's frame.
    """

    log_evidence: Float[Array, "*q"]
    contact: Float[Array, "*q"]
    overlap: Float[Array, "*q"]
    fitness: Float[Array, "*q"]
    inlier_rmse: Float[Array, "*q"]
    num_inliers: Int[Array, "*q"]
    grip: Grip


class _Way(eqx.Module):
    """What the points of one cloud say: shares of it, and what evidence is made of.

    `seen` is the overlap, less for points in what the other scanner saw to be free.
    """

    overlap: Float[Array, "*q"]
    seen: Float[Array, "*q"]
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
        radius: median distance from the middle, of the smaller cloud.
    """

    problems: tuple[Problem, Problem]
    spacings: tuple[Float[Array, " n"], Float[Array, " n"]]
    shares: tuple[Float[Array, " n"], Float[Array, " n"]]
    chance: Scalar
    radius: Scalar

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
        (own, here, a), (other, there, b) = on_both(
            lambda side: (balanced(side[0]), near_by_chance(*side), _radius(side[0])),
            (source, source_index),
            (target, target_index),
        )
        radius = jnp.minimum(a, b)
        return cls(
            (
                Problem.of(source, target, target_index),
                Problem.of(target, source, source_index),
            ),
            (source.spacing, target.spacing),
            (own, other),
            jnp.minimum(here, there),
            jnp.where(radius > 0, radius, 1),
        )

    @classmethod
    def of_some(cls, source: PointCloud, target: PointCloud) -> "Witness":
        """Of some points of clouds that have no index: all pairs are compared."""
        some = source.spread(_SOME), target.spread(_SOME)
        source, target = on_both(lambda cloud: cloud.with_spacing(), *some)
        index = BruteForce.build(source.points, source.mask)
        return cls.of(
            source, target, index, BruteForce.build(target.points, target.mask)
        )

    def of_poses(
        self, T_target_source: Float[Array, "q D D"], used: Bool[Array, " q"]
    ) -> Evidence:
        """Of each pose in use, one after another; `NO_EVIDENCE` of the others."""
        there, back = self._ways(T_target_source, used)
        said = self._said(there, back)
        d = T_target_source.shape[-1] - 1
        return Evidence(
            jnp.where(used, said.log_odds(d), NO_EVIDENCE),
            jnp.where(used, said.contact(), NO_EVIDENCE),
            there.overlap,
            there.fitness,
            there.rmse,
            there.num,
            there.grip,
        )

    def _ways(
        self, T_target_source: Float[Array, "q D D"], used: Bool[Array, " q"]
    ) -> tuple[_Way, _Way]:
        """What either cloud says of each pose in use."""
        (there, back), (own, other) = self.problems, self.spacings
        T_source_target, chance = lie.inverse(T_target_source), self.chance
        forward = there, T_target_source, own, other, self.shares[0], chance
        backward = back, T_source_target, other, own, self.shares[1], chance

        def ways(way: tuple) -> _Way:
            problem, T, *rest = way

            def one(pose: tuple[Motion, Array]) -> _Way:
                return control.cond(
                    pose[1], lambda T: _one_way(problem, T, *rest), _nothing, pose[0]
                )

            return shared(lambda poses: lax.map(one, poses), (T, used))

        return on_both(ways, forward, backward)

    def _said(self, there: _Way, back: _Way) -> Said:
        """The numbers that both ways leave."""
        viewed = [x.seen is not None and x.seen.known for x in self.problems]
        grips = jax.tree.map(lambda *x: jnp.stack(x), there.grip, back.grip)
        return Said(
            gain=(there.gain + back.gain) / 2,
            near=_root(there.near * back.near),
            firm=jnp.min(grips.firmness(self.radius), axis=0),
            seen=(there.seen, back.seen),
            viewed=jnp.asarray(viewed[0]) & jnp.asarray(viewed[1]),
        )

    def of_pose(self, T_target_source: Motion) -> Evidence:
        """Of one pose.

        Gradients: of `log_evidence` and `overlap`, in forward and reverse mode, by the
        pose, the points, normals and spacings of both clouds, with the closest points
        held. Numbers of points, which jump, have the derivative of a smooth one
        (`jaxreg.matching.mixture`), so that it tells what a motion by a tenth of a
        spacing changes, and not one by a millionth. Points that the other scanner saw
        through, what is near by chance, and which points are in `fitness`,
        `inlier_rmse` and `grip` are held.
        """
        found = self.of_poses(T_target_source[None], jnp.ones(1, bool))
        return jax.tree.map(lambda x: x[0], found)


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
    beside = Beside.of(found, own, other)
    mixture = Mixture.fitted(beside, balance, chance, problem.source.shape[0])
    gain, on = mixture.gain(beside, balance)
    moved = found.rotated + lie.translation(T_target_source)[:, None]
    before = _num_before(problem, moved, beside, found.mask)
    sq = jnp.where(on, (beside.height * beside.reach) ** 2, 0)
    each = jnp.stack([beside.near, beside.part, sq, on, found.mask])
    near, said, sq, num, total = jnp.sum(each, axis=1)
    total = jnp.maximum(total, 1)
    return _Way(
        overlap=near / total,
        seen=near / (total + _AGAINST * before),
        near=near / jnp.maximum(said + _AGAINST * before, 1),
        gain=gain,
        fitness=num / total,
        rmse=_root(sq / jnp.maximum(num, 1)),
        num=num.astype(jnp.int32),
        grip=Grip.of(found, moved, on),
    )


def _radius(cloud: PointCloud) -> Scalar:
    """Of half the points: a lidar that sees far has few of its points there."""
    away = cloud.points - centroid(cloud.points, cloud.mask)[None]
    sq = jnp.sum(jnp.where(cloud.mask[:, None], away, 0) ** 2, axis=1)
    return _root(masked_quantile(sq, cloud.mask, 0.5))


def _root(x: Float[Array, "*q"]) -> Float[Array, "*q"]:
    """The square root; that of zero has the slope zero."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)


def _nothing(T: Motion) -> _Way:
    zero, d = jnp.zeros((), T.dtype), T.shape[-1] - 1
    k = d * (d + 1) // 2
    grip = Grip(jnp.zeros((k, k), T.dtype), jnp.zeros(d, T.dtype), zero)
    return _Way(zero, zero, zero, zero, zero, zero, jnp.zeros((), jnp.int32), grip)


def _num_before(
    problem: Problem,
    moved: Float[Array, "d n"],
    beside: Beside,
    mask: Bool[Array, " n"],
) -> Int[Array, ""]:
    """Source points in what the target's scanner saw to be free."""
    if problem.seen is None:
        return jnp.zeros((), jnp.int32)
    before = problem.seen.depth_before(moved) > _BEFORE * beside.reach
    return jnp.sum(before & mask).astype(jnp.int32)
