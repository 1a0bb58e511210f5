"""The scans that `reconstruct` is given as arrays, ready to be prepared."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from jaxreg._core.checks import is_concrete
from jaxreg.multiview.check_scans import checked_viewpoints, padded_scans
from jaxreg.multiview.far_scans import FarScans
from jaxreg.multiview.positions import ScanPositions
from jaxreg.multiview.prepare_in_blocks import prepare_in_blocks
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.similar_scans import Words, words_of
from jaxreg.registrar import AbstractRegistrar
from jaxreg.registration.far import near_origin


class GivenScans(NamedTuple):
    """Scans checked, near their origins, and padded.

    Attributes:
        far: where they were.
        points: of the scans.
        mask: which of them are valid.
        viewpoints: where the scanners stood, NaN if unknown; None if all are.
    """

    far: FarScans
    points: Float[Array, "v n d"]
    mask: Bool[Array, "v n"]
    viewpoints: Float[Array, "v d"] | None

    @classmethod
    def of(
        cls,
        scans: object,
        mask: object,
        viewpoints: object,
        *,
        least: int = 2,
        num_rows: int | None = None,
    ) -> "GivenScans":
        """From what `reconstruct` is given.

        Args:
            scans: as there.
            mask: as there.
            viewpoints: as there.
            least: how many scans are wanted.
            num_rows: of the points of a scan in a list; None for what they need.
        """
        near, origin = near_origin(scans, mask, "scans")
        far = FarScans(origin)
        points, mask = padded_scans(near, mask, least=least, num_rows=num_rows)
        eyes = checked_viewpoints(far.viewpoints(viewpoints), points, mask)
        return cls(far, points, mask, eyes)

    @property
    def shape(self) -> tuple[int, int]:
        """The number of scans, and that of dimensions."""
        return self.points.shape[0], self.points.shape[2]

    @property
    def dtype(self) -> np.dtype:
        """Of the points."""
        return self.points.dtype

    @property
    def is_concrete(self) -> bool:
        """Whether no scan is traced."""
        return is_concrete(self.points)

    def prepared(
        self,
        method: AbstractRegistrar,
        positions: ScanPositions | None,
        *,
        to_search: bool,
    ) -> tuple[PreparedScans, Words | None]:
        """Made ready for pairs, and which of them look alike; outside of `jit`.

        Args:
            method: of registration.
            positions: about where the scanners stood, or None.
            to_search: whether most pairs are searched for.
        """
        scans = prepare_in_blocks(
            method,
            self.points,
            self.mask,
            self.viewpoints,
            positions,
            to_search=to_search,
        )
        return scans, words_of(method, scans)
