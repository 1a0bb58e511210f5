"""Rigid registration of 2D and 3D point sets in JAX, without an initial guess.

    register      the pose of one point set in the frame of another
    average       one pose per frame from relative motions
    reconstruct   many scans into one frame

Each is a free function that takes a frozen *method object* and returns a *Solution* of
arrays, which passes through `jit`, `vmap`, `scan` and pickling.

# Conventions

Points:
    `(n, d)`, d = 2 or 3, read from the array; batches add leading axes. What is valid
    is a mask, never a ragged list.

Motions:
    Homogeneous matrices `(..., d+1, d+1)`. `T_target_source` maps source coordinates
    to target coordinates. `T_world_i` is the pose of frame i, and
    `T_i_j = inv(T_world_i) @ T_world_j` maps frame j into frame i. The MCC paper's M_i
    is `T_world_i`, its M_ij is `T_i_j`.

Tangents:
    Translation first, then rotation; k = 3 in 2D, 6 in 3D. Updates are on the left:
    `T <- exp(v) T`.

Quaternions:
    Named `wxyz` or `xyzw`. g2o and TUM files hold xyzw.

Units:
    Lengths in the unit of the input, angles in radians, degrees only in names that end
    in `_deg`. Defaults that are lengths are derived from the data, so the same scans in
    mm and in m give the same answer.

Randomness:
    An explicit `key`. No global state; nothing is configured on import.

Precision:
    The result has the dtype of the input, float32 or float64.

Graphs:
    A g2o edge `i j` holds `T_i_j`, as does a block `i j n` of a 3DMatch `.log`. An
    Open3D pose-graph edge (s, t) is the g2o edge `t s`.

Failure:
    A wrong shape, dtype or option raises while tracing. Numerical failure is a value:
    `sol.status`, one per lane, with `Status(int(sol.status)).advice`.

Static and traced:
    Counts and classes in a method object are static, changing one compiles again.
    Numbers (tolerances, widths, scales) are traced, changing one does not.
"""

from jaxreg import io as io
from jaxreg import metrics as metrics
from jaxreg import neighbours as neighbours
from jaxreg import particle as particle
from jaxreg import robust as robust
from jaxreg._core.adjoint import ImplicitAdjoint as ImplicitAdjoint
from jaxreg._core.adjoint import (
    RecursiveCheckpointAdjoint as RecursiveCheckpointAdjoint,
)
from jaxreg._core.status import Status as Status
from jaxreg.averaging import MCC as MCC
from jaxreg.averaging import AbstractAverager as AbstractAverager
from jaxreg.averaging import AveragingSolution as AveragingSolution
from jaxreg.averaging import AveragingTrace as AveragingTrace
from jaxreg.averaging import ChordalError as ChordalError
from jaxreg.averaging import Correntropy as Correntropy
from jaxreg.averaging import LogError as LogError
from jaxreg.averaging import LowRankSparse as LowRankSparse
from jaxreg.averaging import MotionAveraging as MotionAveraging
from jaxreg.averaging import PoseGraphLM as PoseGraphLM
from jaxreg.averaging import RootRows as RootRows
from jaxreg.averaging import ShortestPaths as ShortestPaths
from jaxreg.averaging import SpanningTree as SpanningTree
from jaxreg.averaging import WeightedMotionAveraging as WeightedMotionAveraging
from jaxreg.averaging import WeightRows as WeightRows
from jaxreg.averaging import average as average
from jaxreg.averaging import pose_covariances as pose_covariances
from jaxreg.correlation import KernelCorrelation as KernelCorrelation
from jaxreg.graph import PoseGraph as PoseGraph
from jaxreg.local import ICP as ICP
from jaxreg.local import AbstractStep as AbstractStep
from jaxreg.local import ClosedForm as ClosedForm
from jaxreg.local import GaussNewton as GaussNewton
from jaxreg.local import GradientDescent as GradientDescent
from jaxreg.local import LevenbergMarquardt as LevenbergMarquardt
from jaxreg.matching import AbstractResidual as AbstractResidual
from jaxreg.matching import PlaneToPlane as PlaneToPlane
from jaxreg.matching import PointToPlane as PointToPlane
from jaxreg.matching import PointToPoint as PointToPoint
from jaxreg.matching import Symmetric as Symmetric
from jaxreg.multiview import ReconstructionSolution as ReconstructionSolution
from jaxreg.multiview import RelativeMotions as RelativeMotions
from jaxreg.multiview import ScanPositions as ScanPositions
from jaxreg.multiview import reconstruct as reconstruct
from jaxreg.neighbours import AbstractIndex as AbstractIndex
from jaxreg.neighbours import BoxTree as BoxTree
from jaxreg.neighbours import BruteForce as BruteForce
from jaxreg.neighbours import CellGrid as CellGrid
from jaxreg.neighbours import VoxelTable as VoxelTable
from jaxreg.neighbours import correspondences as correspondences
from jaxreg.particle import AbstractDynamics as AbstractDynamics
from jaxreg.particle import AbstractEnergy as AbstractEnergy
from jaxreg.particle import AbstractPrior as AbstractPrior
from jaxreg.particle import AbstractResampler as AbstractResampler
from jaxreg.particle import MultiStart as MultiStart
from jaxreg.particle import PartialPose as PartialPose
from jaxreg.particle import ParticleFilter as ParticleFilter
from jaxreg.particle import sandhu2010 as sandhu2010
from jaxreg.registrar import AbstractRegistrar as AbstractRegistrar
from jaxreg.registrar import RegistrationSolution as RegistrationSolution
from jaxreg.registrar import SearchTrace as SearchTrace
from jaxreg.registration import register as register
from jaxreg.robust import AbstractKernel as AbstractKernel


__version__ = "0.1.0"
