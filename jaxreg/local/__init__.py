"""Local registration: one algorithm, ICP, assembled from parts."""

from jaxreg.local.base import AbstractRegistrar as AbstractRegistrar
from jaxreg.local.base import Modes as Modes
from jaxreg.local.base import RegistrationSolution as RegistrationSolution
from jaxreg.local.icp import ICP as ICP
from jaxreg.local.icp import LocalOptimiser as LocalOptimiser
from jaxreg.local.problem import Match as Match
from jaxreg.local.problem import Problem as Problem
from jaxreg.local.problem import match as match
from jaxreg.local.problem import moved as moved
from jaxreg.local.residuals import AbstractResidual as AbstractResidual
from jaxreg.local.residuals import PlaneToPlane as PlaneToPlane
from jaxreg.local.residuals import PointToPlane as PointToPlane
from jaxreg.local.residuals import PointToPoint as PointToPoint
from jaxreg.local.residuals import Symmetric as Symmetric
from jaxreg.local.score import Score as Score
from jaxreg.local.score import score as score
from jaxreg.local.score import score_both_ways as score_both_ways
from jaxreg.local.steps import AbstractStep as AbstractStep
from jaxreg.local.steps import ClosedForm as ClosedForm
from jaxreg.local.steps import GaussNewton as GaussNewton
from jaxreg.local.steps import GradientDescent as GradientDescent
from jaxreg.local.steps import LevenbergMarquardt as LevenbergMarquardt
from jaxreg.local.steps import condition as condition
from jaxreg.local.steps import decoupled_error as decoupled_error
from jaxreg.local.steps import gyration_radius as gyration_radius
from jaxreg.local.steps import turn_and_shift as turn_and_shift
