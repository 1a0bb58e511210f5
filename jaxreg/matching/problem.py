"""What a local optimiser works on: a source, a target, and the index between them.

Coordinates of the source are held as rows `(d, n)`, which XLA vectorises over points.
The source is centred at its own centroid, so that rotation and translation decouple
(PF paper, section 3.1); see `jaxreg.cloud.frames` for the frames around it.
"""

import dataclasses
import functools
import operator

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import rows_of
from jaxreg._core.typing import Motion, Scalar
from jaxreg.cloud import Frames, PointCloud, RangeImage
from jaxreg.geometry import lie
from jaxreg.matching.soft import Surroundings
from jaxreg.neighbours.base import AbstractIndex


class Problem(eqx.Module):
    """One pair of point sets, with the target indexed.

    Attributes:
        source: `(d, n)` points, centred.
        source_normals: `(d, n)` unit normals of either sign, zero where undefined.
        source_mask: `(n,)`.
        target: `(2d, m)` points and unit normals of either sign, one above the other.
        index: closest points among the target.
        seen: what the target's scanner saw, where its viewpoint is known.
        frames: those of the input, where they are known.
        soft: what surrounds the target points, if matches are means over these.
    """

    source: Float[Array, "d n"]
    source_normals: Float[Array, "d n"]
    source_mask: Bool[Array, " n"]
    target: Float[Array, "two_d m"]
    index: AbstractIndex
    seen: RangeImage | None = None
    frames: Frames | None = None
    soft: Surroundings | None = None

    @classmethod
    def of(
        cls,
        source: PointCloud,
        target: PointCloud,
        index: AbstractIndex,
        frames: Frames | None = None,
    ) -> "Problem":
        """The problem of two clouds; `index` was built on the target's points."""
        return cls(
            source.points.T,
            source.normals.T,
            source.mask,
            jnp.concatenate([target.points.T, target.normals.T]),
            index,
            target.seen,
            frames,
        )

    def of_rows(self, rows: Int[Array, " r"] | slice) -> "Problem":
        """The problem of some of the source points."""
        return dataclasses.replace(
            self,
            source=self.source[:, rows],
            source_normals=self.source_normals[:, rows],
            source_mask=self.source_mask[rows],
        )

    def every(self, step: int) -> "Problem":
        """The problem of every `step`-th source point."""
        return self.of_rows(slice(None, None, step))

    def scaled(self, scale: Scalar) -> "Problem":
        """The problem with the source a factor larger."""
        return eqx.tree_at(lambda p: p.source, self, scale * self.source)

    def beside(self, other: "Problem") -> "Problem":
        """The problem of the source points of both, with what else this one has."""
        return dataclasses.replace(
            self,
            source=jnp.concatenate([self.source, other.source], axis=1),
            source_normals=jnp.concatenate(
                [self.source_normals, other.source_normals], axis=1
            ),
            source_mask=jnp.concatenate([self.source_mask, other.source_mask]),
        )

    def padded(self, num: int) -> "Problem":
        """The problem with masked rows behind the source, `num` in all."""
        pad = num - self.source_mask.shape[0]
        return dataclasses.replace(
            self,
            source=jnp.pad(self.source, ((0, 0), (0, pad))),
            source_normals=jnp.pad(self.source_normals, ((0, 0), (0, pad))),
            source_mask=jnp.pad(self.source_mask, (0, pad)),
        )


class Match(eqx.Module):
    """Source points under a pose beside their closest target points.

    Attributes:
        source: `(d, n)` p, centred.
        R: `(d, d)` rotation of the pose.
        residual: `(d, n)` q - (R p + t), from the moved source to the target.
        normal: `(d, n)` target normals.
        source_normal: `(d, n)` source normals, rotated with the pose of the match.
        agreement: `(n,)` squared cosine between the two normals, in [0, 1]; one where
            either is undefined, zero for masked points.
        row: `(n,)` rows in the target.
        mask: `(n,)` False for masked source points.
        turn: `(d, d)` how the source was rotated since the match: the identity, unless
            the match was `moved`.
    """

    source: Float[Array, "d n"]
    R: Float[Array, "d d"]
    residual: Float[Array, "d n"]
    normal: Float[Array, "d n"]
    source_normal: Float[Array, "d n"]
    agreement: Float[Array, " n"]
    row: Int[Array, " n"]
    mask: Bool[Array, " n"]
    turn: Float[Array, "d d"]

    @property
    def rotated(self) -> Float[Array, "d n"]:
        """R p: the lever arms of the rotation."""
        return rotate(self.R, self.source)

    @property
    def sq_residual(self) -> Float[Array, " n"]:
        """Squared distance to the closest target point."""
        return inner(self.residual, self.residual)

    @property
    def plane_residual(self) -> Float[Array, " n"]:
        """Signed distance to the target's tangent plane (line in 2D)."""
        return inner(self.normal, self.residual)

    def of_rows(self, rows: Int[Array, " r"]) -> "Match":
        """The match of some of the source points."""
        return dataclasses.replace(
            self,
            source=self.source[:, rows],
            residual=self.residual[:, rows],
            normal=self.normal[:, rows],
            source_normal=self.source_normal[:, rows],
            agreement=self.agreement[rows],
            row=self.row[rows],
            mask=self.mask[rows],
        )

    def within(self, distance: Scalar) -> "Match":
        """With the pairs that are farther apart masked."""
        near = self.sq_residual <= distance**2
        return eqx.tree_at(
            lambda m: (m.mask, m.agreement),
            self,
            (self.mask & near, jnp.where(near, self.agreement, 0)),
        )


def inner(a: Float[Array, "d n"], b: Float[Array, "d n"]) -> Float[Array, " n"]:
    """Inner products of columns, row by row: faster than a reduction of length 3."""
    return functools.reduce(operator.add, jnp.unstack(a * b))


def known(normals: Float[Array, "d n"]) -> Bool[Array, " n"]:
    """Which of these columns are unit normals, and not zero."""
    return inner(normals, normals) > 0


def rotate(R: Float[Array, "d d"], columns: Float[Array, "d n"]) -> Float[Array, "d n"]:
    """R times columns, in full precision."""
    return jnp.stack(_rotated(R, columns))


def _rotated(
    R: Float[Array, "d d"], columns: Float[Array, "d n"]
) -> list[Float[Array, " n"]]:
    """The rows of R times columns, each a loop of its own.

    XLA on a CPU vectorises no loop over rows that are stacked before their use: with
    the rows of `rotate` and of `match` stacked a search takes 1.6 times as long.
    """
    rows = jnp.unstack(columns)
    terms = (map(operator.mul, jnp.unstack(axis), rows) for axis in jnp.unstack(R))
    return [functools.reduce(operator.add, each) for each in terms]


def match(
    problem: Problem,
    T_target_source: Motion,
    row: Int[Array, " n"] | None = None,
    num: Int[Array, ""] | None = None,
    coarse: Bool[Array, ""] | None = None,
    width: Scalar | None = None,
) -> Match:
    """Closest target points of the source under a pose (PF paper, Eq. 2).

    Where `row` is given, those rows of the target are taken instead of the closest;
    with `num`, matches of source points beyond the first `num` are arbitrary; where
    `coarse` is True, an index may take a near point for the closest. With the `width`
    of the kernel the matches of a problem that has them soft are means.
    """
    d = problem.source.shape[0]
    R, t = lie.rotation(T_target_source), lie.translation(T_target_source)
    turned = zip(_rotated(R, problem.source), jnp.unstack(t), strict=True)
    moved = [x + shift for x, shift in turned]
    if row is None:
        row = problem.index.lookup(jnp.stack(moved), num, coarse)
    if problem.soft is None or width is None:
        found = [rows_of(x, row) for x in jnp.unstack(problem.target)]
    else:
        found = problem.soft.blended(problem.target, jnp.stack(moved), row, width)
    residual = jnp.stack([found[k] - moved[k] for k in range(d)])
    normal = jnp.stack([found[d + k] for k in range(d)])
    cosine = inner(problem.source_normals, rotate(R.T, normal))
    both = known(normal) & known(problem.source_normals)
    agreement = jnp.where(both, cosine * cosine, 1)
    agreement = jnp.where(problem.source_mask, agreement, 0)
    return Match(
        problem.source,
        R,
        residual,
        normal,
        rotate(R, problem.source_normals),
        agreement,
        row,
        problem.source_mask,
        turn=jnp.eye(d, dtype=t.dtype),
    )


def moved(match: Match, T_before: Motion, T_after: Motion) -> Match:
    """A match seen from another pose, with its correspondences held.

    Lever arms and residuals follow the pose, and `turn` says by which rotation. The
    normals and their agreement stay those of the match: what a residual derives from
    them, such as a metric, is held too.

    Args:
        match: as found at `T_before`.
        T_before: `T_target_source` of the match.
        T_after: the pose to see it from.
    """
    R_after, R_before = lie.rotation(T_after), lie.rotation(T_before)
    turn = jnp.sum(R_after[:, None, :] * R_before[None, :, :], axis=-1)
    shift = lie.translation(T_after) - lie.translation(T_before)
    rotated = rotate(turn, match.rotated)
    residual = match.residual - (rotated - match.rotated) - shift[:, None]
    R = jnp.sum(turn[:, :, None] * match.R[None], axis=1)
    return eqx.tree_at(lambda m: (m.R, m.residual, m.turn), match, (R, residual, turn))
