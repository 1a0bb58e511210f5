"""What a local optimiser makes small: residuals and their normal equations."""

from jaxreg.matching.residuals.base import AbstractResidual as AbstractResidual
from jaxreg.matching.residuals.gram import Moments as Moments
from jaxreg.matching.residuals.gram import along as along
from jaxreg.matching.residuals.gram import half_sum as half_sum
from jaxreg.matching.residuals.gram import weighted_gram as weighted_gram
from jaxreg.matching.residuals.plane_to_plane import PlaneToPlane as PlaneToPlane
from jaxreg.matching.residuals.point_to_plane import PointToPlane as PointToPlane
from jaxreg.matching.residuals.point_to_point import PointToPoint as PointToPoint
from jaxreg.matching.residuals.symmetric import Symmetric as Symmetric
