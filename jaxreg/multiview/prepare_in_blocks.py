"""Scans prepared a few at a time, on all cores, outside of `jit`.

The programs are of a few scans, whatever their number; and what follows finds rows for
one of few numbers of scans, so that a map that grows takes the programs that it has.
"""

from collections.abc import Callable
from functools import partial
from itertools import chain
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxreg._core.platforms import platform_of
from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar
from jaxreg.batching.padding import rounded_up
from jaxreg.batching.side_by_side import map_side_by_side
from jaxreg.batching.threads import map_in_threads, num_cores
from jaxreg.cloud import PointCloud, rms_radius
from jaxreg.multiview.method import with_features
from jaxreg.multiview.positions import ScanPositions
from jaxreg.multiview.prepare import (
    PreparedScan,
    clean,
    common_radius,
    common_spacing,
    gathered,
    holds_tables,
    prepare_scan,
)
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.registrar import AbstractRegistrar


Tree = TypeVar("Tree")

# Points, which of them are valid, and the viewpoint or None; of one scan or of several.
_Scans = tuple[Array, Array, Array | None]

# Scans of a block: few, so that cores share them, but an accelerator wants more.
_ON_CPU, _ON_ACCELERATOR = 4, 32


def rows_for(num_scans: int) -> int:
    """4, 6, 8, 12, 16, 24, ...: of so many scans programs are compiled."""
    return rounded_up(num_scans, 4, an_octave=2)


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
    block = _ON_CPU if platform_of(points) == "cpu" else _ON_ACCELERATOR
    put = partial(jax.device_put, device=_home(points))
    each = partial(_of_each, num=num, block=block, put=put)
    radius = each(_radii, (points, mask))
    radius[num:] = 0  # of those that are padding
    radius = common_radius(put(radius))

    def prepared(scans: _Scans) -> PreparedScan:
        return _prepared(method, scans, radius, with_table=held)

    scan = each(prepared, (points, mask, viewpoints))
    if to_search and held:
        scan.within[num:] = 0
        spacing = common_spacing(put(scan.within))

        def described(clouds: PointCloud) -> PointCloud:
            return _described(method, clouds, spacing)

        scan = scan._replace(cloud=each(described, scan.cloud))
    scan.fault[num:] = Status.TOO_FEW_POINTS
    if positions is not None:
        positions = positions.padded(rows_for(num))
    return gathered(put(scan), radius, positions, num)


def _home(points: Array) -> Any:
    """The device that the scans were put on, None for the usual."""
    here = points.devices()
    usual = jax.device_put(0).devices()
    return None if len(here) > 1 or here == usual else next(iter(here))


def _of_each(
    run: Callable[[Any], Tree],
    scans: Any,
    num: int,
    block: int,
    put: Callable[[Any], Any],
) -> Tree:
    """What `run` tells of each scan, as NumPy arrays; of the last for the padding, too.

    Args:
        run: works on a block of scans.
        scans: arrays with a leading axis.
        num: how many of the rows are to be worked on.
        block: scans of a block.
        put: brings arrays to where they are worked on.
    """
    scans = jax.tree.map(np.asarray, scans)

    def told(start: int) -> Tree:
        rows = np.minimum(np.arange(start, start + block), num - 1)
        some = jax.tree.map(lambda x: x[rows], scans)
        return jax.tree.map(np.asarray, run(put(some)))

    starts = range(0, num, block)
    parts = map_in_threads(told, starts, num_cores())
    first = next(parts)
    out = jax.tree.map(partial(_room, rows_for(num)), first)
    for start, part in zip(starts, chain([first], parts), strict=True):
        for every, x in zip(jax.tree.leaves(out), jax.tree.leaves(part), strict=True):
            every[start : start + block] = x[: len(every) - start]
    for every in jax.tree.leaves(out):
        every[num:] = every[num - 1]
    return out


def _room(num: int, like: np.ndarray) -> np.ndarray:
    """For so many rows like those of an array."""
    return np.empty((num, *like.shape[1:]), like.dtype)


@kept_program
def _radii(scans: tuple[Array, Array]) -> Float[Array, " b"]:
    points, mask, _ = clean(*scans)
    return jax.vmap(rms_radius)(points, mask)


@kept_program
def _prepared(
    method: AbstractRegistrar, scans: _Scans, radius: Scalar, *, with_table: bool
) -> PreparedScan:
    def one(scan: _Scans) -> PreparedScan:
        return prepare_scan(method, *scan, radius, with_table=with_table)

    return map_side_by_side(one, scans, scans[1].shape[1])


@kept_program
def _described(
    method: AbstractRegistrar, clouds: PointCloud, spacing: Scalar
) -> PointCloud:
    described = partial(with_features, method, spacing=spacing)
    return map_side_by_side(described, clouds, clouds.points.shape[1])
