"""Points of one cloud beside those of another: residuals, evidence, slippage."""

from jaxreg.matching.evidence import LIKELY as LIKELY
from jaxreg.matching.evidence import NO_EVIDENCE as NO_EVIDENCE
from jaxreg.matching.evidence import Evidence as Evidence
from jaxreg.matching.evidence import Witness as Witness
from jaxreg.matching.problem import Match as Match
from jaxreg.matching.problem import Problem as Problem
from jaxreg.matching.problem import known as known
from jaxreg.matching.problem import match as match
from jaxreg.matching.problem import moved as moved
from jaxreg.matching.residuals import AbstractResidual as AbstractResidual
from jaxreg.matching.residuals import PlaneToPlane as PlaneToPlane
from jaxreg.matching.residuals import PointToPlane as PointToPlane
from jaxreg.matching.residuals import PointToPoint as PointToPoint
from jaxreg.matching.residuals import Symmetric as Symmetric
from jaxreg.matching.slippage import Grip as Grip
from jaxreg.matching.soft import SoftMatches as SoftMatches
