"""Local features: what the surface around a point looks like, and poses from it."""

from jaxreg.features.consistent import Agreed as Agreed
from jaxreg.features.consistent import consistent_poses as consistent_poses
from jaxreg.features.correspond import Correspondences as Correspondences
from jaxreg.features.correspond import mutual as mutual
from jaxreg.features.fpfh import described as described
from jaxreg.features.propose import features_of as features_of
from jaxreg.features.propose import propose as propose
