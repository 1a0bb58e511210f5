"""Scans made ready for pairs, once each: cleaned, centred, scaled, thinned, indexed."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Motions, Scalar
from jaxreg.batching.side_by_side import map_side_by_side
from jaxreg.cloud import (
    OTHER_UNIT,
    Frames,
    PointCloud,
    centroid,
    median_spacing,
    rms_radius,
)
from jaxreg.geometry import lie
from jaxreg.matching import Problem, Witness
from jaxreg.multiview.method import index_of, with_features
from jaxreg.multiview.positions import ScanPositions
from jaxreg.neighbours import AbstractIndex, exact_index, index_within
from jaxreg.registrar import AbstractRegistrar


# Scans whose tables and features are held, a megabyte and half of one each; of more
# they are made when needed, 10 and 35 ms each, where the search of a pair takes 200.
_MOST_TABLES = 512


class PreparedScans(eqx.Module):
    """Scans with a leading axis, each in its own centred frame, in one common scale.

    Attributes:
        clouds: `(v, n, d)` thinned points with normals; the unit is `radius`. With what
            was seen from the viewpoints, where these are given, and with local features
            where many pairs are to be searched.
        tables: their indexes, of the method's kind; None of very many scans.
        exact: indexes that miss no near point, for the evidence.
        mean: `(v, d)` centroid of each scan in its input frame.
        radius: the median root mean square radius of the scans, in the input's unit.
        spacing: `(v,)` distance between thinned points, in units of `radius`.
        fault: `(v,)` int32, what is wrong with a scan: TOO_FEW_POINTS, fewer than d + 1
            valid ones; UNIT_DIFFERS, its radius is not of the others' order; CONVERGED,
            nothing.
        num_dropped: `(v,)` rows of the input that were not finite.
        positions: about where their scanners stood, None if unknown.
    """

    clouds: PointCloud
    tables: AbstractIndex | None
    exact: AbstractIndex
    mean: Float[Array, "v d"]
    radius: Scalar
    spacing: Float[Array, " v"]
    fault: Int[Array, " v"]
    num_dropped: Int[Array, " v"]
    positions: ScanPositions | None = None

    @property
    def num_scans(self) -> int:
        """V."""
        return self.mean.shape[0]

    @property
    def num_rows(self) -> int:
        """Points of a pair."""
        return 2 * self.clouds.points.shape[1]

    @property
    def usable(self) -> Bool[Array, " v"]:
        """Which scans can be registered."""
        return self.fault == Status.CONVERGED

    @property
    def coarsest(self) -> Scalar:
        """The largest spacing of the scans that can be registered."""
        return jnp.max(jnp.where(self.usable, self.spacing, 0))

    def cloud(self, i: Int[Array, ""]) -> PointCloud:
        """One scan's thinned points."""
        return jax.tree.map(lambda x: x[i], self.clouds)

    def table(self, method: AbstractRegistrar, i: Int[Array, ""]) -> AbstractIndex:
        """One scan's index, of the method's kind."""
        if self.tables is None:
            return index_of(method.in_frames(self.frames(i, i)), self.cloud(i))
        return jax.tree.map(lambda x: x[i], self.tables)

    def problem(
        self, i: Int[Array, ""], j: Int[Array, ""], *, exact: bool = False
    ) -> Problem:
        """Scan j as the source, scan i as the target, its closest points from a table.

        Args:
            i: of the target.
            j: of the source.
            exact: no near point is missed; so it is where no tables are held.
        """
        source, target = self.cloud(j), self.cloud(i)
        if not exact and self.tables is not None:
            return Problem.of(source, target, jax.tree.map(lambda x: x[i], self.tables))
        if target.judged is None:  # whose index is that of the evidence
            return Problem.of(source, target, jax.tree.map(lambda x: x[i], self.exact))
        kind = exact_index(target.points.shape[0])
        return Problem.of(source, target, kind.build(target.points, target.mask))

    def witness(self, i: Int[Array, ""], j: Int[Array, ""]) -> Witness:
        """Who tells how likely motions of scan j into scan i are."""
        clouds = self.cloud(j).as_judged, self.cloud(i).as_judged
        near = (jax.tree.map(lambda x, k=k: x[k], self.exact) for k in (j, i))
        return Witness.of(*clouds, *near)

    def method_of(
        self, method: AbstractRegistrar, i: Int[Array, ""], j: Int[Array, ""]
    ) -> AbstractRegistrar:
        """The method for scan j as the source and scan i as the target."""
        if self.positions is not None:
            method = self.positions.of_pair(method, i, j)
        return method.in_frames(self.frames(i, j))

    def frames(self, i: Int[Array, ""], j: Int[Array, ""]) -> Frames:
        """Those of scan j as the source and scan i as the target."""
        return Frames(self.mean[j], self.mean[i], self.radius)

    def to_input_frames(
        self, T_i_j: Motions, i: Int[Array, "*b"], j: Int[Array, "*b"]
    ) -> Motions:
        """Motions between centred, scaled frames as motions between input frames."""
        R = lie.rotation(T_i_j)
        t = self.radius * lie.translation(T_i_j) + self.mean[i]
        return lie.compose(R, t - jnp.einsum("...ij,...j->...i", R, self.mean[j]))

    def to_centred_frames(
        self, T_i_j: Motions, i: Int[Array, "*b"], j: Int[Array, "*b"]
    ) -> Motions:
        """The other way."""
        R = lie.rotation(T_i_j)
        moved = jnp.einsum("...ij,...j->...i", R, self.mean[j])
        t = lie.translation(T_i_j) + moved - self.mean[i]
        return lie.compose(R, t / self.radius)

    def to_world(self, T_world_i: Motions) -> Motions:
        """Poses of the centred frames, in radii, as those of the input frames."""
        R = lie.rotation(T_world_i)
        t = self.radius * lie.translation(T_world_i)
        return lie.compose(R, t - jnp.sum(R * self.mean[:, None], axis=-1))


def clean(
    points: Float[Array, "v n d"], mask: Bool[Array, "v n"]
) -> tuple[Float[Array, "v n d"], Bool[Array, "v n"], Int[Array, " v"]]:
    """Masks and counts rows that are not finite."""
    finite = jnp.all(jnp.isfinite(points), axis=-1)
    dropped = jnp.sum(mask & ~finite, axis=-1).astype(jnp.int32)
    mask = mask & finite
    return jnp.where(mask[..., None], points, 0), mask, dropped


def common_radius(points: Float[Array, "v n d"], mask: Bool[Array, "v n"]) -> Scalar:
    """The median radius of the scans that have points; 1 if none has an extent."""
    radius = jax.vmap(rms_radius)(points, mask)
    radius = jnp.nanmedian(jnp.where(radius > 0, radius, jnp.nan))
    return jnp.where(jnp.isfinite(radius), radius, 1)


def prepare_scan(
    method: AbstractRegistrar,
    points: Float[Array, "n d"],
    mask: Bool[Array, " n"],
    radius: Scalar,
    *,
    with_table: bool,
) -> tuple[
    PointCloud, AbstractIndex | None, AbstractIndex, Float[Array, " d"], Scalar, Scalar
]:
    """One scan: cloud, table, exact index, centroid, spacing and that as judged."""
    mean = centroid(points, mask)
    method = method.in_frames(Frames(mean, mean, radius))
    centred = (points - mean[None]) / radius
    cloud = method.prepare(centred, mask).followed().with_spacing()
    spacing = median_spacing(cloud.points, cloud.mask)
    judged, within = cloud.as_judged, spacing
    if cloud.judged is not None:
        within = median_spacing(judged.points, judged.mask)
    exact = index_within(judged.points, judged.mask, within)
    table = index_of(method, cloud) if with_table else None
    return cloud, table, exact, mean, spacing, within


@kept_program
def prepare_scans(
    method: AbstractRegistrar,
    points: Float[Array, "v n d"],
    mask: Bool[Array, "v n"],
    viewpoints: Float[Array, "v d"] | None = None,
    positions: ScanPositions | None = None,
    *,
    side_by_side: bool = False,
    to_search: bool = False,
) -> PreparedScans:
    """Prepares all scans; NaN stands for an unknown viewpoint.

    Side by side their derivatives are right under `vmap`, too: in a loop JAX leaves the
    rules for them out, and what it takes instead is not a number.

    Args:
        method: of registration.
        points: of the scans.
        mask: which of them are valid.
        viewpoints: where the scanners stood, or None.
        positions: likewise, in the world.
        side_by_side: whether under `vmap` rather than in a loop.
        to_search: whether most pairs are searched for, so that local features pay.
    """
    points, mask, dropped = clean(points, mask)
    radius = common_radius(points, mask)

    def one(scan: tuple[Array, Array]) -> tuple:
        held = len(points) <= _MOST_TABLES
        return prepare_scan(method, *scan, radius, with_table=held)

    num_rows = points.shape[1]
    if side_by_side:
        prepared = jax.vmap(one)((points, mask))
    else:
        prepared = map_side_by_side(one, (points, mask), num_rows)
    clouds, tables, exact, mean, spacing, judged = prepared
    if viewpoints is not None:
        eyes = (viewpoints - mean) / radius
        clouds = lax.map(lambda scan: scan[0].seen_from(scan[1]), (clouds, eyes))
    if to_search and len(points) <= _MOST_TABLES:
        described = partial(with_features, method, spacing=_common_spacing(judged))
        clouds = map_side_by_side(described, clouds, num_rows)
    fault = _fault(clouds, jax.vmap(rms_radius)(points, mask) / radius, spacing)
    return PreparedScans(
        clouds, tables, exact, mean, radius, spacing, fault, dropped, positions
    )


def _common_spacing(spacing: Float[Array, " v"]) -> Scalar:
    """The coarsest, at most twice the middle one: a scan may be a few dots."""
    known = jnp.where(spacing > 0, spacing, jnp.nan)
    coarsest = jnp.minimum(jnp.nanmax(known), 2 * jnp.nanmedian(known))
    return jnp.nan_to_num(coarsest)


def _fault(
    clouds: PointCloud, size: Float[Array, " v"], spacing: Float[Array, " v"]
) -> Int[Array, " v"]:
    """What is wrong with each scan, see `PreparedScans`."""
    differs = (size > OTHER_UNIT) | (size < 1 / OTHER_UNIT)
    fault = jnp.where(differs, Status.UNIT_DIFFERS, Status.CONVERGED)
    enough = (jnp.sum(clouds.mask, axis=1) > clouds.points.shape[-1]) & (spacing > 0)
    return jnp.where(enough, fault, Status.TOO_FEW_POINTS).astype(jnp.int32)
