"""One pose per frame from relative motions."""

from jaxreg.averaging.average import average as average
from jaxreg.averaging.base import AbstractAverager as AbstractAverager
from jaxreg.averaging.base import AveragingSolution as AveragingSolution
from jaxreg.averaging.consensus import CycleConsensus as CycleConsensus
from jaxreg.averaging.correntropy import Correntropy as Correntropy
from jaxreg.averaging.covariance import pose_covariances as pose_covariances
from jaxreg.averaging.lowrank import LowRankSparse as LowRankSparse
from jaxreg.averaging.plain import MotionAveraging as MotionAveraging
from jaxreg.averaging.plain import WeightedMotionAveraging as WeightedMotionAveraging
from jaxreg.averaging.posegraph_lm import PoseGraphLM as PoseGraphLM
from jaxreg.averaging.trace import AveragingTrace as AveragingTrace
from jaxreg.averaging.tree import SpanningTree as SpanningTree
