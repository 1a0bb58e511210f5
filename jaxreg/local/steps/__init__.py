"""How a pose follows from a match: the steps of a local optimiser."""

from jaxreg.local.steps.base import AbstractStep as AbstractStep
from jaxreg.local.steps.base import decoupled_error as decoupled_error
from jaxreg.local.steps.base import tangent_slopes as tangent_slopes
from jaxreg.local.steps.base import turn_and_shift as turn_and_shift
from jaxreg.local.steps.closed_form import ClosedForm as ClosedForm
from jaxreg.local.steps.gauss_newton import GaussNewton as GaussNewton
from jaxreg.local.steps.gradient_descent import GradientDescent as GradientDescent
from jaxreg.local.steps.levenberg_marquardt import (
    LevenbergMarquardt as LevenbergMarquardt,
)
from jaxreg.local.steps.optimistix_step import OptimistixStep as OptimistixStep
from jaxreg.local.steps.scaling import condition as condition
from jaxreg.local.steps.scaling import gyration_radius as gyration_radius
