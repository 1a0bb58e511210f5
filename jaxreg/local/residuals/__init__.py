"""What a local optimiser makes small: residuals and their normal equations."""

from jaxreg.local.residuals.base import AbstractResidual as AbstractResidual
from jaxreg.local.residuals.gram import Moments as Moments
from jaxreg.local.residuals.gram import weighted_gram as weighted_gram
from jaxreg.local.residuals.plane_to_plane import PlaneToPlane as PlaneToPlane
from jaxreg.local.residuals.point_to_plane import PointToPlane as PointToPlane
from jaxreg.local.residuals.point_to_point import PointToPoint as PointToPoint
from jaxreg.local.residuals.symmetric import Symmetric as Symmetric
