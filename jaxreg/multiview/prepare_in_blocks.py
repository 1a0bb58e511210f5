"""Scans prepared outside of `jit`, all at once or some beside others that are."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar
from jaxreg.cloud import PointCloud, rms_radius
from jaxreg.multiview.method import without_features
from jaxreg.multiview.positions import ScanPositions
from jaxreg.multiview.prepare import (
    PreparedScan,
    clean,
    common_radius,
    common_spacing,
    gathered,
    holds_tables,
    ungathered,
)
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.scan_blocks import ScanBlocks, rows_for
from jaxreg.registrar import AbstractRegistrar


def prepare_in_blocks(
    method: AbstractRegistrar,
    points: Float[Array, "v n d"],
    mask: Bool[Array, "v n"],
    viewpoints: Float[Array, "v d"] | None = None,
    positions: ScanPositions | None = None,
    *,
    to_search: bool = False,
) -> PreparedScans:
    """What `prepare_scans` returns, with rows of padding: the last scan's again."""
    num, held = len(points), holds_tables(len(points))
    on = ScanBlocks.of(points)
    radius = on.each(_radii, (points, mask))
    radius[num:] = 0  # of those that are padding
    radius = common_radius(on.put(radius))
    scan = on.prepared(method, (points, mask, viewpoints), radius, with_table=held)
    spacing = None
    if to_search:
        scan.within[num:] = 0
        spacing = common_spacing(on.put(scan.within))
    if spacing is not None and held:
        scan = on.described(method, scan, spacing)
    return _gathered(on, scan, radius, spacing, positions)


def prepare_further(
    method: AbstractRegistrar,
    scans: PreparedScans,
    points: Float[Array, "w n d"],
    mask: Bool[Array, "w n"],
    viewpoints: Float[Array, "w d"] | None = None,
) -> PreparedScans:
    """Scans that are prepared, and further ones, in the unit of the former.

    Args:
        method: that of the former.
        scans: those that are prepared; positions are left out.
        points: of the further ones, of as many rows as the former had.
        mask: which of them are valid.
        viewpoints: of the further ones, or None.
    """
    points, mask = jax.device_put((points, mask), next(iter(scans.mean.devices())))
    num, on = scans.num_present, ScanBlocks.of(points)
    held = scans.tables is not None and holds_tables(num + on.num)
    spacing = scans.feature_spacing
    old = ungathered(scans)
    if not held:
        old = old._replace(cloud=_undescribed(old.cloud), table=None)
    old, viewpoints = _both_seen(old, viewpoints, points)
    new = (points, mask, viewpoints)
    new = on.prepared(method, new, scans.radius, with_table=held)
    if spacing is not None and held:
        new = on.described(method, new, spacing)
    every = on._replace(num=num + on.num)

    def joined(x: Array, y: np.ndarray) -> np.ndarray:
        out = np.empty((rows_for(every.num), *y.shape[1:]), y.dtype)
        out[:num], out[num : every.num] = np.asarray(x)[:num], y[: on.num]
        out[every.num :] = out[every.num - 1]
        return out

    scan = jax.tree.map(joined, old, new._replace(within=new.spacing))
    return _gathered(every, scan, scans.radius, spacing, None)


def _both_seen(
    old: PreparedScan, viewpoints: Array | None, points: Float[Array, "w n d"]
) -> tuple[PreparedScan, Array | None]:
    """Where viewpoints are known of scans before or of those after: NaN for the others.

    Args:
        old: the scans before.
        viewpoints: of those after, or None.
        points: of those after.
    """
    had = old.cloud.seen is not None
    if had and viewpoints is None:
        viewpoints = jnp.full(points[:, 0].shape, jnp.nan, points.dtype)
    if viewpoints is None or had:
        return old, viewpoints
    return old._replace(cloud=_unseen(old.cloud)), viewpoints


@kept_program
def _undescribed(clouds: PointCloud) -> PointCloud:
    return jax.vmap(without_features)(clouds)


@kept_program
def _unseen(clouds: PointCloud) -> PointCloud:
    """From no known viewpoint."""
    nowhere = jnp.full(clouds.points.shape[-1], jnp.nan, clouds.points.dtype)
    return jax.vmap(lambda cloud: cloud.seen_from(nowhere))(clouds)


def _gathered(
    on: ScanBlocks,
    scan: PreparedScan,
    radius: Scalar,
    spacing: Scalar | None,
    positions: ScanPositions | None,
) -> PreparedScans:
    """With what is common to all, and padding marked."""
    scan.fault[on.num :] = Status.TOO_FEW_POINTS
    if positions is not None:
        positions = positions.padded(rows_for(on.num))
    return gathered(on.put(scan), radius, spacing, positions, on.num)


@kept_program
def _radii(scans: tuple[Array, Array]) -> Float[Array, " b"]:
    points, mask, _ = clean(*scans)
    return jax.vmap(rms_radius)(points, mask)
