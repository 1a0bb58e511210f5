"""How particles move between measurements."""

from jaxreg.particle.dynamics.base import AbstractDynamics as AbstractDynamics
from jaxreg.particle.dynamics.constant_velocity import (
    ConstantVelocity as ConstantVelocity,
)
from jaxreg.particle.dynamics.none import NoDynamics as NoDynamics
from jaxreg.particle.dynamics.stochastic import StochasticDynamics as StochasticDynamics
