"""What an earlier run found: motions that need not be found again, poses to hold."""

import numpy as np

from jaxreg.multiview.choose_pairs import Order, first_pairs
from jaxreg.multiview.known_world import KnownWorld
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.solution import ReconstructionSolution


def known_before(
    previous: object,
    scans: PreparedScans,
    order: Order,
    words: np.ndarray | None,
) -> tuple[RelativeMotions | None, np.ndarray | None]:
    """Motions in the centred frames, and the pairs to begin with, None for the usual.

    Those of an earlier solution and those that join new scans to each other and to it.
    """
    if previous is None:
        return None, None
    earlier = previous if isinstance(previous, ReconstructionSolution) else None
    motions = previous if earlier is None else earlier.motions
    if not isinstance(motions, RelativeMotions):
        raise TypeError(
            "previous: wanted a ReconstructionSolution or RelativeMotions, found "
            f"{type(previous).__name__}."
        )
    if motions.T_i_j.shape[-1] != scans.mean.shape[-1] + 1:
        raise ValueError("previous: of another dimension than the scans.")
    num_old = (
        earlier.num_scans if earlier is not None else 1 + int(np.max(motions.pairs))
    )
    if num_old > scans.num_present:
        raise ValueError(
            f"previous: of {num_old} scans, but there are {scans.num_present}."
        )
    first = None
    if earlier is not None:
        rng = np.random.default_rng(num_old)
        new = first_pairs(scans.num_present, order, rng, words, num_old)
        first = np.concatenate([motions.pairs, new])
        first = np.unique(first, axis=0)
    return motions.heard(scans), first


def check_can_hold(previous: object, known: KnownWorld | None) -> None:
    """That there are poses to hold, and no world that says otherwise."""
    if not isinstance(previous, ReconstructionSolution):
        raise ValueError(
            "hold_previous: wanted a ReconstructionSolution as previous, found "
            f"{type(previous).__name__}."
        )
    if known is not None or previous.prior_weight is not None:
        raise ValueError(
            "hold_previous: in a world that is known give the poses to hold as fixed=."
        )
