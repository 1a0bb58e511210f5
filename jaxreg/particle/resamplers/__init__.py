"""Which particles live on."""

from jaxreg.particle.resamplers.base import (
    AbstractHardResampler as AbstractHardResampler,
)
from jaxreg.particle.resamplers.base import AbstractResampler as AbstractResampler
from jaxreg.particle.resamplers.multinomial import Multinomial as Multinomial
from jaxreg.particle.resamplers.residual import Residual as Residual
from jaxreg.particle.resamplers.soft import Soft as Soft
from jaxreg.particle.resamplers.stratified import Stratified as Stratified
from jaxreg.particle.resamplers.systematic import Systematic as Systematic
from jaxreg.particle.resamplers.transport import Transport as Transport
