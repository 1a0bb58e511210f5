"""How particles move between measurements."""

from jaxreg.particle.dynamics.base import AbstractDynamics as AbstractDynamics
from jaxreg.particle.dynamics.constant_velocity import (
    ConstantVelocity as ConstantVelocity,
)
from jaxreg.particle.dynamics.none import NoDynamics as NoDynamics
from jaxreg.particle.dynamics.spread import EnsembleSpread as EnsembleSpread
from jaxreg.particle.dynamics.spread import MeasuredSpread as MeasuredSpread
from jaxreg.particle.dynamics.spread import OwnSpread as OwnSpread
from jaxreg.particle.dynamics.spread import PathSpread as PathSpread
from jaxreg.particle.dynamics.stochastic import StochasticDynamics as StochasticDynamics
