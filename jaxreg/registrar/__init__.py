"""The contract of every method of `register`, and what it returns."""

from jaxreg.registrar.base import AbstractRegistrar as AbstractRegistrar
from jaxreg.registrar.base import Modes as Modes
from jaxreg.registrar.base import RegistrationSolution as RegistrationSolution
from jaxreg.registrar.frames import Frames as Frames
from jaxreg.registrar.trace import SearchTrace as SearchTrace
