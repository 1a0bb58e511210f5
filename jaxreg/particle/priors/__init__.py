"""Where the particles start."""

from jaxreg.particle.priors.base import AbstractPrior as AbstractPrior
from jaxreg.particle.priors.gaussian import GaussianPrior as GaussianPrior
from jaxreg.particle.priors.given import GivenParticles as GivenParticles
from jaxreg.particle.priors.partial import PartialPose as PartialPose
from jaxreg.particle.priors.uniform import UniformPrior as UniformPrior
