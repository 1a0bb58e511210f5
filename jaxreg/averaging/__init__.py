"""One pose per frame from relative motions.

`certificate` and `methods.riemannian_staircase` are imported by those who use them:
SciPy's sparse solvers take half a second.
"""

from jaxreg.averaging.average import average as average
from jaxreg.averaging.base import AbstractAverager as AbstractAverager
from jaxreg.averaging.base import AveragingSolution as AveragingSolution
from jaxreg.averaging.base import solution as solution
from jaxreg.averaging.base import starting_poses as starting_poses
from jaxreg.averaging.covariance import pose_covariances as pose_covariances
from jaxreg.averaging.edge_report import EdgeReport as EdgeReport
from jaxreg.averaging.edge_report import edge_report as edge_report
from jaxreg.averaging.methods.correntropy import Correntropy as Correntropy
from jaxreg.averaging.methods.low_rank_sparse import LowRankSparse as LowRankSparse
from jaxreg.averaging.methods.mcc import MCC as MCC
from jaxreg.averaging.methods.motion_averaging import MotionAveraging as MotionAveraging
from jaxreg.averaging.methods.motion_averaging import (
    WeightedMotionAveraging as WeightedMotionAveraging,
)
from jaxreg.averaging.methods.pose_graph_lm import PoseGraphLM as PoseGraphLM
from jaxreg.averaging.methods.shortest_paths import ShortestPaths as ShortestPaths
from jaxreg.averaging.methods.spanning_tree import SpanningTree as SpanningTree
from jaxreg.averaging.start.cycle_consensus import CycleConsensus as CycleConsensus
from jaxreg.averaging.steps.edge_errors import ChordalError as ChordalError
from jaxreg.averaging.steps.edge_errors import LogError as LogError
from jaxreg.averaging.steps.rows import RootRows as RootRows
from jaxreg.averaging.steps.rows import WeightRows as WeightRows
from jaxreg.averaging.trace import AveragingTrace as AveragingTrace
