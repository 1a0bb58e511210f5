"""Local registration: one algorithm, ICP, assembled from parts."""

from jaxreg.local.curvature import Curvature as Curvature
from jaxreg.local.curvature import sandwich as sandwich
from jaxreg.local.curvature import tangent_unit as tangent_unit
from jaxreg.local.icp import ICP as ICP
from jaxreg.local.implicit import AbstractRest as AbstractRest
from jaxreg.local.implicit import Rest as Rest
from jaxreg.local.implicit import at_rest as at_rest
from jaxreg.local.optimiser import LocalOptimiser as LocalOptimiser
from jaxreg.local.settle import settled as settled
from jaxreg.local.steps import AbstractStep as AbstractStep
from jaxreg.local.steps import ClosedForm as ClosedForm
from jaxreg.local.steps import GaussNewton as GaussNewton
from jaxreg.local.steps import GradientDescent as GradientDescent
from jaxreg.local.steps import LevenbergMarquardt as LevenbergMarquardt
from jaxreg.local.steps import OptimistixStep as OptimistixStep
from jaxreg.local.steps import condition as condition
from jaxreg.local.steps import decoupled_error as decoupled_error
from jaxreg.local.steps import gyration_radius as gyration_radius
from jaxreg.local.steps import tangent_slopes as tangent_slopes
from jaxreg.local.steps import turn_and_shift as turn_and_shift
