"""Scans worked on a few at a time, on all cores, outside of `jit`.

The programs are of a few scans, whatever their number; and what follows finds rows for
one of few numbers of scans, so that a map that grows takes the programs that it has.
"""

from collections.abc import Callable
from functools import partial
from itertools import chain
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.cores import num_cores
from jaxreg._core.platforms import platform_of
from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Scalar
from jaxreg.batching.padding import rounded_up
from jaxreg.batching.side_by_side import map_side_by_side
from jaxreg.batching.threads import map_in_threads
from jaxreg.cloud import PointCloud
from jaxreg.multiview.method import with_features
from jaxreg.multiview.prepare import PreparedScan, prepare_scan
from jaxreg.registrar import AbstractRegistrar


Tree = TypeVar("Tree")

# Points, which of them are valid, and the viewpoint or None; of one scan or of several.
_Scans = tuple[Array, Array, Array | None]

# Scans of a block: few, so that cores share them, but an accelerator wants more.
_ON_CPU, _ON_ACCELERATOR = 4, 32


def rows_for(num_scans: int) -> int:
    """4, 6, 8, 12, 16, 24, ...: of so many scans programs are compiled."""
    return rounded_up(num_scans, 4, an_octave=2)


class ScanBlocks(NamedTuple):
    """How scans are worked on: so many at a time, on one device.

    Attributes:
        num: how many of the rows are to be worked on.
        block: scans of a block.
        device: None for the usual.
    """

    num: int
    block: int
    device: Any

    @classmethod
    def of(cls, points: Float[Array, "v n d"]) -> "ScanBlocks":
        """For these."""
        block = _ON_CPU if platform_of(points) == "cpu" else _ON_ACCELERATOR
        return cls(len(points), block, _home(points))

    def put(self, tree: Tree) -> Tree:
        """Brings arrays to where they are worked on."""
        return jax.device_put(tree, self.device)

    def prepared(
        self,
        method: AbstractRegistrar,
        scans: _Scans,
        radius: Scalar,
        *,
        with_table: bool,
    ) -> PreparedScan:
        """Each scan by itself."""
        return self.each(
            lambda some: _prepared(method, some, radius, with_table=with_table), scans
        )

    def described(
        self, method: AbstractRegistrar, scan: PreparedScan, spacing: Scalar
    ) -> PreparedScan:
        """With the features that the search asks for."""
        clouds = self.each(lambda some: described(method, some, spacing), scan.cloud)
        return scan._replace(cloud=clouds)

    def each(self, run: Callable[[Any], Tree], scans: Any) -> Tree:
        """What `run` tells of each scan, in NumPy; of the last for the padding, too.

        Args:
            run: works on a block of scans.
            scans: arrays with a leading axis.
        """
        num, block = self.num, self.block
        scans = jax.tree.map(np.asarray, scans)

        def told(start: int) -> Tree:
            rows = np.minimum(np.arange(start, start + block), num - 1)
            some = jax.tree.map(lambda x: x[rows], scans)
            return jax.tree.map(np.asarray, run(self.put(some)))

        starts = range(0, num, block)
        parts = map_in_threads(told, starts, num_cores())
        first = next(parts)
        out = jax.tree.map(partial(_room, rows_for(num)), first)
        leaves = jax.tree.leaves(out)
        for start, part in zip(starts, chain([first], parts), strict=True):
            for every, x in zip(leaves, jax.tree.leaves(part), strict=True):
                every[start : start + block] = x[: len(every) - start]
        for every in leaves:
            every[num:] = every[num - 1]
        return out


def _home(points: Array) -> Any:
    """The device that the scans were put on, None for the usual."""
    here = points.devices()
    usual = jax.device_put(0).devices()
    return None if len(here) > 1 or here == usual else next(iter(here))


def _room(num: int, like: np.ndarray) -> np.ndarray:
    """For so many rows like those of an array."""
    return np.empty((num, *like.shape[1:]), like.dtype)


@kept_program
def _prepared(
    method: AbstractRegistrar, scans: _Scans, radius: Scalar, *, with_table: bool
) -> PreparedScan:
    def one(scan: _Scans) -> PreparedScan:
        return prepare_scan(method, *scan, radius, with_table=with_table)

    return map_side_by_side(one, scans, scans[1].shape[1])


@kept_program
def described(
    method: AbstractRegistrar, clouds: PointCloud, spacing: Scalar
) -> PointCloud:
    """A block of clouds with the features that the search asks for."""
    one = partial(with_features, method, spacing=spacing)
    return map_side_by_side(one, clouds, clouds.points.shape[1])
