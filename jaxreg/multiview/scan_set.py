"""`ScanSet`: scans made ready once, for many calls and for scans that come later."""

import dataclasses

import equinox as eqx
import numpy as np

from jaxreg._core.arrays import cast_floats
from jaxreg._core.checks import as_host_array, check_mask, check_method, is_concrete
from jaxreg._core.typing import ArrayLike
from jaxreg.multiview.far_scans import FarScans
from jaxreg.multiview.given_scans import GivenScans
from jaxreg.multiview.positions import ScanPositions
from jaxreg.multiview.prepare_in_blocks import prepare_further
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.scan_blocks import rows_for
from jaxreg.multiview.similar_scans import Words, words_of
from jaxreg.particle import ParticleFilter
from jaxreg.registrar import AbstractRegistrar


#: Said of one that is met in a trace.
OUTSIDE = "scans: a ScanSet is for calls outside of jit only."


class ScanSet(eqx.Module):
    """Scans made ready for `reconstruct`: cleaned, thinned, indexed and described.

    Pass it as `scans`; the answer is that of the scans themselves, but of a sequence,
    whose scans have no local features by themselves. A map that grows prepares its new
    scans alone:

        ready = jr.ScanSet.of(scans)
        sol = jr.reconstruct(ready, key=key)
        ready = ready.joined([new])
        sol = jr.reconstruct(ready, key=key, previous=sol, hold_previous=True)

    `jr.io.write_scan_set` keeps one on disk. Outside of `jit` only, and without
    derivatives by the points.

    Attributes:
        method: that registers pairs of them, and that they were made ready for.
        scans: what the stages read.
        origin: `(v, d)` float64, what was subtracted from each of scans that are far
            from their origins; None if none is.
        num_rows: points of a scan at most; of later ones with more so many are drawn.
        words: which scans look alike; None if that is not known.
    """

    method: AbstractRegistrar
    scans: PreparedScans
    origin: np.ndarray | None
    num_rows: int = eqx.field(static=True)
    words: Words | None

    @classmethod
    def of(
        cls,
        scans: ArrayLike,
        *,
        method: AbstractRegistrar | None = None,
        mask: ArrayLike | None = None,
        viewpoints: ArrayLike | None = None,
    ) -> "ScanSet":
        """Makes scans ready.

        Args:
            scans: two or more, as in `reconstruct`. Their median radius becomes the
                unit of the set.
            method: that will register pairs, `ParticleFilter()` by default.
            mask: as there.
            viewpoints: as there.

        Raises:
            ValueError, TypeError: as `reconstruct` does.
        """
        method = ParticleFilter() if method is None else method
        check_method(method, AbstractRegistrar)
        given = GivenScans.of(scans, mask, viewpoints)
        if not given.is_concrete:
            raise ValueError(OUTSIDE)
        ready, words = given.prepared(method, None, to_search=True)
        origin = given.far.origin if given.far.moved else None
        return cls(method, ready, origin, given.points.shape[1], words)

    def joined(
        self,
        scans: ArrayLike,
        *,
        mask: ArrayLike | None = None,
        viewpoints: ArrayLike | None = None,
    ) -> "ScanSet":
        """A set with further scans; the old one stays as it is.

        Args:
            scans: one or more, as in `reconstruct`.
            mask: as there.
            viewpoints: of these scans, as there.

        Raises:
            ValueError, TypeError: for what are no scans, or of another dimension.
        """
        if not isinstance(scans, list | tuple):
            scans, mask = _as_list(scans, mask), None
        given = GivenScans.of(scans, mask, viewpoints, least=1, num_rows=self.num_rows)
        if given.shape[1] != self.shape[1]:
            raise ValueError(
                f"scans: of dimension {given.shape[1]}, those of the set of "
                f"{self.shape[1]}."
            )
        inputs = given.points, given.mask, given.viewpoints
        ready = prepare_further(
            self.method, self.scans, *cast_floats(inputs, self.dtype)
        )
        words = words_of(self.method, ready, self.words)
        origin = _origins(self, given)
        return dataclasses.replace(self, scans=ready, origin=origin, words=words)

    @property
    def far(self) -> FarScans:
        """Where scans far from their origins were."""
        return FarScans(self.origin)

    @property
    def shape(self) -> tuple[int, int]:
        """The number of scans, and that of dimensions."""
        return self.scans.num_present, self.scans.mean.shape[1]

    @property
    def dtype(self) -> np.dtype:
        """Of the points."""
        return self.scans.mean.dtype

    @property
    def is_concrete(self) -> bool:
        """Whether no scan is traced."""
        return is_concrete(self.scans.mean)

    def __len__(self) -> int:
        """The number of scans."""
        return self.shape[0]

    def __repr__(self) -> str:
        """One line."""
        v, d = self.shape
        kind = type(self.method).__name__
        return f"ScanSet({v} scans in {d}D, {self.dtype}, for {kind})"

    def prepared(
        self,
        method: AbstractRegistrar,
        positions: ScanPositions | None,
        *,
        to_search: bool,
    ) -> tuple[PreparedScans, Words | None]:
        """What `GivenScans.prepared` returns; all is done.

        Args:
            method: that of the set.
            positions: as there.
            to_search: they are ready for that.
        """
        del method, to_search
        if positions is None:
            return self.scans, self.words
        positions = positions.padded(rows_for(len(self)))
        return dataclasses.replace(self.scans, positions=positions), self.words

    def check_usable(
        self, method: AbstractRegistrar | None, mask: object, viewpoints: object
    ) -> None:
        """Refuses a set that is traced, and what a set was made with beside it.

        Args:
            method: as in `reconstruct`.
            mask: as there.
            viewpoints: as there.
        """
        if not self.is_concrete:
            raise ValueError(OUTSIDE)
        if mask is not None or viewpoints is not None:
            raise ValueError("mask, viewpoints: a ScanSet has its own; leave them out.")
        if method is not None and not eqx.tree_equal(method, self.method):
            raise ValueError(
                "method: a ScanSet is ready for its own alone: leave it out, or make "
                "the set with ScanSet.of(scans, method=...)."
            )


def _as_list(scans: ArrayLike, mask: object) -> list[np.ndarray]:
    """The valid points of each; a row that is not finite where none is."""
    every = as_host_array(scans, "scans")
    if every.ndim != 3:
        raise ValueError(
            "scans: wanted a list of (n, d) arrays or a padded array (v, n, d), found "
            f"shape {every.shape}."
        )
    valid = np.asarray(check_mask(mask, every.shape[:2], "mask"))
    nothing = np.full((1, every.shape[2]), np.nan)
    return [x[m] if m.any() else nothing for x, m in zip(every, valid, strict=True)]


def _origins(before: ScanSet, after: GivenScans) -> np.ndarray | None:
    """What was subtracted from each of all scans."""
    if not (before.far.moved or after.far.moved):
        return None
    both = [x.far.origin if x.far.moved else np.zeros(x.shape) for x in (before, after)]
    return np.concatenate(both)
