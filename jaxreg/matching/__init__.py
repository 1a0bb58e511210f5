"""Points of one cloud beside those of another: matches, residuals, scores, slippage."""

from jaxreg.matching.problem import Match as Match
from jaxreg.matching.problem import Problem as Problem
from jaxreg.matching.problem import match as match
from jaxreg.matching.problem import moved as moved
from jaxreg.matching.residuals import AbstractResidual as AbstractResidual
from jaxreg.matching.residuals import PlaneToPlane as PlaneToPlane
from jaxreg.matching.residuals import PointToPlane as PointToPlane
from jaxreg.matching.residuals import PointToPoint as PointToPoint
from jaxreg.matching.residuals import Symmetric as Symmetric
from jaxreg.matching.score import Score as Score
from jaxreg.matching.score import agreeing as agreeing
from jaxreg.matching.score import mutual_overlap as mutual_overlap
from jaxreg.matching.score import score as score
from jaxreg.matching.score import score_both_ways as score_both_ways
from jaxreg.matching.slippage import Grip as Grip
from jaxreg.matching.slippage import can_slip as can_slip
