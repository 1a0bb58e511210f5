"""How well a pose fits: the negative logarithm of a particle's likelihood."""

from jaxreg.particle.energies.absolute import AbsoluteEnergy as AbsoluteEnergy
from jaxreg.particle.energies.base import AbstractEnergy as AbstractEnergy
from jaxreg.particle.energies.bounded import BoundedEnergy as BoundedEnergy
from jaxreg.particle.energies.squared import SquaredEnergy as SquaredEnergy
