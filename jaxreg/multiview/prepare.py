"""Scans made ready for pairs, once each: cleaned, centred, scaled, thinned, indexed."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar
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
    points: Float[Array, "*v n d"], mask: Bool[Array, "*v n"]
) -> tuple[Float[Array, "*v n d"], Bool[Array, "*v n"], Int[Array, "*v"]]:
    """Masks and counts rows that are not finite."""
    finite = jnp.all(jnp.isfinite(points), axis=-1)
    dropped = jnp.sum(mask & ~finite, axis=-1).astype(jnp.int32)
    mask = mask & finite
    return jnp.where(mask[..., None], points, 0), mask, dropped


@jax.jit
def common_radius(radius: Float[Array, " v"]) -> Scalar:
    """The median radius of the scans that have points; 1 if none has an extent."""
    radius = jnp.nanmedian(jnp.where(radius > 0, radius, jnp.nan))
    return jnp.where(jnp.isfinite(radius), radius, 1)


class PreparedScan(NamedTuple):
    """One scan, or several with a leading axis; see `PreparedScans`.

    Attributes:
        within: the spacing of the cloud as it is judged.
    """

    cloud: PointCloud
    table: AbstractIndex | None
    exact: AbstractIndex
    mean: Float[Array, " d"]
    spacing: Scalar
    within: Scalar
    fault: Int[Array, ""]
    num_dropped: Int[Array, ""]


def prepare_scan(
    method: AbstractRegistrar,
    points: Float[Array, "n d"],
    mask: Bool[Array, " n"],
    viewpoint: Float[Array, " d"] | None,
    radius: Scalar,
    *,
    with_table: bool,
) -> PreparedScan:
    """One scan by itself, in a unit that is given; NaN stands for no viewpoint."""
    points, mask, dropped = clean(points, mask)
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
    if viewpoint is not None:
        cloud = cloud.seen_from((viewpoint - mean) / radius)
    fault = _fault(cloud, rms_radius(points, mask) / radius, spacing)
    return PreparedScan(cloud, table, exact, mean, spacing, within, fault, dropped)


@kept_program
def prepare_scans(
    method: AbstractRegistrar,
    points: Float[Array, "v n d"],
    mask: Bool[Array, "v n"],
    viewpoints: Float[Array, "v d"] | None = None,
    positions: ScanPositions | None = None,
    *,
    to_search: bool = False,
) -> PreparedScans:
    """Prepares all scans inside of one program; NaN stands for an unknown viewpoint.

    Side by side: in a loop JAX leaves the rules for derivatives out under `vmap`, and
    what it takes instead is not a number.

    Args:
        method: of registration.
        points: of the scans.
        mask: which of them are valid.
        viewpoints: where the scanners stood, or None.
        positions: likewise, in the world.
        to_search: whether most pairs are searched for, so that local features pay.
    """
    num, held = len(points), holds_tables(len(points))
    radius = common_radius(jax.vmap(rms_radius)(*clean(points, mask)[:2]))
    one = partial(prepare_scan, method, radius=radius, with_table=held)
    scan = jax.vmap(one)(points, mask, viewpoints)
    cloud, spacing = scan.cloud, None
    if to_search and held:
        spacing = common_spacing(scan.within)
        cloud = jax.vmap(partial(with_features, method, spacing=spacing))(cloud)
    return gathered(scan._replace(cloud=cloud), radius, spacing, positions, num)


def holds_tables(num_scans: int) -> bool:
    """Whether tables and features of so many scans are held."""
    return num_scans <= _MOST_TABLES


def gathered(
    scan: PreparedScan,
    radius: Scalar,
    spacing: Scalar | None,
    positions: ScanPositions | None,
    num: int,
) -> PreparedScans:
    """Scans as every stage has them.

    Args:
        scan: all of them, those that are padding last.
        radius: their unit.
        spacing: of the samples that local features were made for; None without them.
        positions: about where their scanners stood, or None.
        num: how many there are.
    """
    return PreparedScans(
        clouds=scan.cloud,
        tables=scan.table,
        exact=scan.exact,
        mean=scan.mean,
        radius=radius,
        spacing=scan.spacing,
        feature_spacing=spacing,
        fault=scan.fault,
        num_dropped=scan.num_dropped,
        ids=jax.device_put(np.arange(len(scan.fault), dtype=np.int32)),
        count=jax.device_put(np.int32(num)),
        positions=positions,
    )


def ungathered(scans: PreparedScans) -> PreparedScan:
    """The other way; what `within` was is not needed any more."""
    made = scans.clouds, scans.tables, scans.exact, scans.mean
    return PreparedScan(
        *made, scans.spacing, scans.spacing, scans.fault, scans.num_dropped
    )


@jax.jit
def common_spacing(spacing: Float[Array, " v"]) -> Scalar:
    """The coarsest, at most twice the middle one: a scan may be a few dots."""
    known = jnp.where(spacing > 0, spacing, jnp.nan)
    coarsest = jnp.minimum(jnp.nanmax(known), 2 * jnp.nanmedian(known))
    return jnp.nan_to_num(coarsest)


def _fault(cloud: PointCloud, size: Scalar, spacing: Scalar) -> Int[Array, ""]:
    """What is wrong with a scan, see `PreparedScans`."""
    differs = (size > OTHER_UNIT) | (size < 1 / OTHER_UNIT)
    fault = jnp.where(differs, Status.UNIT_DIFFERS, Status.CONVERGED)
    enough = (jnp.sum(cloud.mask) > cloud.points.shape[1]) & (spacing > 0)
    return jnp.where(enough, fault, Status.TOO_FEW_POINTS).astype(jnp.int32)
