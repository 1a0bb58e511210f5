"""Many scans into one frame."""

from jaxreg.multiview.averaged_pairs import AveragedPairs as AveragedPairs
from jaxreg.multiview.covariances import (
    joint_scan_covariances as joint_scan_covariances,
)
from jaxreg.multiview.covariances import scan_covariances as scan_covariances
from jaxreg.multiview.positions import ScanPositions as ScanPositions
from jaxreg.multiview.reconstruct import reconstruct as reconstruct
from jaxreg.multiview.relative_motions import RelativeMotions as RelativeMotions
from jaxreg.multiview.scan_set import ScanSet as ScanSet
from jaxreg.multiview.solution import ReconstructionSolution as ReconstructionSolution
