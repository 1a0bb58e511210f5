"""Particle filtering over ICP."""

from jaxreg.particle.base import AbstractSearch as AbstractSearch
from jaxreg.particle.dynamics import AbstractDynamics as AbstractDynamics
from jaxreg.particle.dynamics import ConstantVelocity as ConstantVelocity
from jaxreg.particle.dynamics import EnsembleSpread as EnsembleSpread
from jaxreg.particle.dynamics import NoDynamics as NoDynamics
from jaxreg.particle.dynamics import OwnSpread as OwnSpread
from jaxreg.particle.dynamics import PathSpread as PathSpread
from jaxreg.particle.dynamics import StochasticDynamics as StochasticDynamics
from jaxreg.particle.energies import AbsoluteEnergy as AbsoluteEnergy
from jaxreg.particle.energies import AbstractEnergy as AbstractEnergy
from jaxreg.particle.energies import BoundedEnergy as BoundedEnergy
from jaxreg.particle.energies import SquaredEnergy as SquaredEnergy
from jaxreg.particle.filter import ParticleFilter as ParticleFilter
from jaxreg.particle.multi_start import MultiStart as MultiStart
from jaxreg.particle.presets import sandhu2010 as sandhu2010
from jaxreg.particle.priors import AbstractPrior as AbstractPrior
from jaxreg.particle.priors import GaussianPrior as GaussianPrior
from jaxreg.particle.priors import GivenParticles as GivenParticles
from jaxreg.particle.priors import UniformPrior as UniformPrior
from jaxreg.particle.resamplers import AbstractResampler as AbstractResampler
from jaxreg.particle.resamplers import Multinomial as Multinomial
from jaxreg.particle.resamplers import Residual as Residual
from jaxreg.particle.resamplers import Stratified as Stratified
from jaxreg.particle.resamplers import Systematic as Systematic
from jaxreg.particle.state import Particles as Particles
