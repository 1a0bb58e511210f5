"""The contract of every method of `register`, and what it returns."""

from jaxreg.cloud import Frames as Frames
from jaxreg.registrar.base import AbstractRegistrar as AbstractRegistrar
from jaxreg.registrar.base import Modes as Modes
from jaxreg.registrar.base import RegistrationSolution as RegistrationSolution
from jaxreg.registrar.indexed import (
    AbstractIndexedRegistrar as AbstractIndexedRegistrar,
)
from jaxreg.registrar.prepare import GivenPair as GivenPair
from jaxreg.registrar.prepare import PreparedPair as PreparedPair
from jaxreg.registrar.prepare import prepare_pair as prepare_pair
from jaxreg.registrar.trace import SearchTrace as SearchTrace
