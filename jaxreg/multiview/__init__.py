"""Many scans into one frame."""

from jaxreg.multiview.reconstruct import (
    ReconstructionSolution as ReconstructionSolution,
)
from jaxreg.multiview.reconstruct import reconstruct as reconstruct
