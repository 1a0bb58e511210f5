"""Packages that only some formats need, imported when they are needed."""

import importlib
from types import ModuleType

from jaxreg.io.errors import MissingExtraError


def require(package: str, purpose: str, extra: str = "formats") -> ModuleType:
    """The package of an extra that is needed for a purpose, for the message.

    Raises:
        MissingExtraError: if it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as err:
        raise MissingExtraError(package, purpose, extra) from err
