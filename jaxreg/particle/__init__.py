"""Particle filtering over ICP."""

from jaxreg.particle.filter import ParticleFilter as ParticleFilter
from jaxreg.particle.state import Particles as Particles
