"""What became of a numerical problem, as a value that lives in an array.

A Solution holds its status as an int32 array, so that it passes through `jit`, `vmap`
and pickling and keeps one status per lane. `Status(int(sol.status)).advice` says what
happened and what to change.
"""

import enum
from typing import Any

import numpy as np


class Status(enum.IntEnum):
    """The outcome of a solve. Compare with `sol.status == Status.CONVERGED`.

    >>> import jaxreg as jr
    >>> print(jr.Status(1), "-", jr.Status(1).advice)
    MAX_STEPS - The steps ran out before the answer stood still. Raise `max_steps`, \
or start nearer to the solution.
    """

    CONVERGED = 0
    MAX_STEPS = 1
    DEGENERATE = 2
    TOO_FEW_POINTS = 3
    NON_FINITE = 4
    LOW_OVERLAP = 5
    AMBIGUOUS = 6
    DISCONNECTED = 7
    DIVERGED = 8
    UNIT_DIFFERS = 9
    NO_AGREEMENT = 10
    UNCERTIFIED = 11

    def __str__(self) -> str:
        return self.name

    @property
    def advice(self) -> str:
        """What happened, why that is likely, and what to change."""
        return _ADVICE[self]


def counted(status: Any) -> str:
    """How many of a batch have each status: "CONVERGED 990, LOW_OVERLAP 10"."""
    values, counts = np.unique(np.asarray(status), return_counts=True)
    told = zip(values.tolist(), counts.tolist(), strict=True)
    return ", ".join(f"{Status(int(value)).name} {num}" for value, num in told)


_ADVICE = {
    Status.CONVERGED: "Converged.",
    Status.MAX_STEPS: (
        "The steps ran out before the answer stood still. Raise `max_steps`, or start "
        "nearer to the solution."
    ),
    Status.DEGENERATE: (
        "The data leave some direction of the motion free (points on a line or a "
        "plane, a rotationally symmetric shape). Use more or other points."
    ),
    Status.TOO_FEW_POINTS: (
        "Fewer valid distinct points than d + 1. Check the file, the mask, and the "
        "voxel size if the cloud was thinned."
    ),
    Status.NON_FINITE: (
        "A number overflowed or was not finite in the input. Mask rows with NaN or "
        "inf, and check the unit of the coordinates."
    ),
    Status.LOW_OVERLAP: (
        "No pose was found at which enough of the two point sets agree. They may not "
        "overlap; else draw more particles (`num_prior`), tell where the scanners "
        "stood (`viewpoints`), or give an initial guess (`init`)."
    ),
    Status.AMBIGUOUS: (
        "Several poses agree about equally well (a symmetric object?), or surfaces "
        "that agree can slip along each other. See the modes of the solution, tell "
        "where the scanners stood (`viewpoints`), or give an initial guess."
    ),
    Status.DIVERGED: (
        "The steps led to a worse pose than the initial guess, which is returned. "
        "Start nearer, use a robust kernel, or search with ParticleFilter."
    ),
    Status.UNIT_DIFFERS: (
        "The scan is more than 50 times larger or smaller than the other or others, "
        "and does not fit. Is it in another unit? Bring all scans to one unit."
    ),
    Status.NO_AGREEMENT: (
        "No motions agree with each other beyond what any tree of them agrees with by "
        "itself, so the poses are a guess: register again with more overlap, or add "
        "edges. Or priors, control points and levels contradict each other: look at "
        "those that are farthest off."
    ),
    Status.UNCERTIFIED: (
        "The poses are not proved to be the best: they are a local minimum or none, or "
        "the noise is too large for a proof. Average by `RiemannianStaircase()`."
    ),
    Status.DISCONNECTED: (
        "The trusted edges do not reach every pose. See `placed`, and `component` and "
        "`scan_status` where there are any: other poses are meaningless or in a frame "
        "of their own. Add edges or scans that bridge the parts."
    ),
}
