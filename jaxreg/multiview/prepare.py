"""Scans made ready for pairs, once each: cleaned, centred, scaled, thinned, indexed."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar
from jaxreg.batching.side_by_side import map_side_by_side
from jaxreg.cloud import (
    OTHER_UNIT,
    Frames,
    PointCloud,
    centroid,
    median_spacing,
    rms_radius,
)
from jaxreg.multiview.method import index_of, with_features
from jaxreg.multiview.positions import ScanPositions
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.neighbours import AbstractIndex, index_within
from jaxreg.registrar import AbstractRegistrar


# Scans whose tables and features are held, a megabyte and half of one each; of more
# they are made when needed, 10 and 35 ms each, where the search of a pair takes 200.
_MOST_TABLES = 512


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
