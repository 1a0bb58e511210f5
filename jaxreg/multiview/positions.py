"""`ScanPositions`: about where scanners stood, as satellite fixes tell."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import traced
from jaxreg._core.brief import BriefModule
from jaxreg._core.checks import (
    as_float_array,
    as_host_array,
    check_positive,
    is_concrete,
)
from jaxreg.particle import AbstractSearch, PartialPose
from jaxreg.registrar import AbstractRegistrar


def _places(x: object) -> Array:
    """Rows less their mean if they are concrete: map coordinates are long."""
    if not eqx.is_array(x) or is_concrete(x):
        x = as_host_array(x, "ScanPositions: position")
        if x.ndim == 2 and len(x) and x.dtype.kind in "iuf":
            x = x - np.mean(x, axis=0, dtype=np.float64)
    return as_float_array(x, "ScanPositions: position")


def _antennas(x: object) -> Array | None:
    return None if x is None else as_float_array(x, "ScanPositions: antenna")


class ScanPositions(BriefModule):
    """About where the scanner of each scan stood, in one frame for all scans.

    Only differences count, and of these what does not depend on where a scan faced:
    lengths and, where the search knows which way is up (`PartialPose`), heights. The
    answer is in the frame of the first scan, as always.

    Attributes:
        position: `(v, d)` in the unit of the input, for instance metres east, north and
            up; longer numbers than float32 holds as NumPy arrays of float64.
        deviation: of each coordinate.
        antenna: `(v, d)` where the antenna is in each scan's own frame; the origins by
            default.

    Raises: ValueError for shapes that differ or do not fit the scans, for numbers that
        are not finite, and for a deviation that is not above zero.
    """

    described: ClassVar[str] = "ScanPositions of the scans"

    position: Float[Array, "v d"] = eqx.field(converter=_places)
    deviation: Array | float = traced(1.0)
    antenna: Float[Array, "v d"] | None = eqx.field(default=None, converter=_antennas)

    def __check_init__(self) -> None:
        """Refuses what are no positions."""
        check_positive(self, "deviation")
        shape = self.position.shape
        for name, found in (("position", self.position), ("antenna", self.antenna)):
            if found is None:
                continue
            if found.ndim != 2 or found.shape != shape:
                raise ValueError(
                    f"ScanPositions: {name}: wanted shape (v, d) like position, "
                    f"found {found.shape}."
                )
            if is_concrete(found) and not np.all(np.isfinite(found)):
                raise ValueError(f"ScanPositions: {name}: wanted finite numbers.")

    def check_fits(self, wanted: tuple[int, int], method: object) -> None:
        """Requires positions of this shape, and a search that can use them."""
        if self.position.shape != wanted:
            raise ValueError(
                f"positions: wanted shape {wanted}, found {self.position.shape}."
            )
        prior = method.prior if isinstance(method, AbstractSearch) else method
        if prior is not None and not (
            isinstance(prior, PartialPose) and prior.position is None
        ):
            raise ValueError(
                "positions: wanted a search such as ParticleFilter(), without a prior "
                f"or with PartialPose(up=...), found {type(prior).__name__}."
            )

    def padded(self, num: int) -> "ScanPositions":
        """With places of no consequence, for so many scans."""
        return self._with(lambda x: jnp.pad(x, ((0, num - len(x)), (0, 0))))

    def some(self, rows: Int[Array, " r"]) -> "ScanPositions":
        """Those of some scans."""
        return self._with(lambda x: x[rows])

    def _with(self, of: Callable[[Array], Array]) -> "ScanPositions":
        """Other rows; not by the constructor, which takes the mean of places off."""
        rows = jax.tree.map(of, (self.position, self.antenna))
        return eqx.tree_at(
            lambda p: (p.position, p.antenna), self, rows, is_leaf=lambda x: x is None
        )

    def of_pair(
        self, method: AbstractRegistrar, i: Int[Array, ""], j: Int[Array, ""]
    ) -> AbstractRegistrar:
        """The method, knowing about where scan j stood as seen from scan i."""
        known = PartialPose(
            position=self.position[j] - self.position[i],
            deviation=jnp.sqrt(2.0) * self.deviation,
            oriented=False,
            source_scanner=None if self.antenna is None else self.antenna[j],
            target_scanner=None if self.antenna is None else self.antenna[i],
        )
        assert isinstance(method, AbstractSearch)
        if isinstance(method.prior, PartialPose):
            known = dataclasses.replace(
                known, up=method.prior.up, tilt=method.prior.tilt
            )
        return eqx.tree_at(
            lambda m: m.prior, method, known, is_leaf=lambda x: x is None
        )
