"""Packages that only some formats need, imported when they are needed."""

import importlib
from pathlib import Path
from types import ModuleType

from jaxreg.io.errors import InputError, MissingExtraError


def require(package: str, purpose: str, extra: str = "formats") -> ModuleType:
    """The package of an extra that is needed for a purpose, for the message.

    Raises:
        MissingExtraError: if it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as err:
        raise MissingExtraError(package, purpose, extra) from err


def unreadable(path: str | Path, kind: str, reason: object) -> InputError:
    """The error for a file that is not what its suffix says, or not whole."""
    why = " ".join(str(reason).split())[:80] or type(reason).__name__
    return InputError(
        f"{path}: not a complete {kind} file with points ({why}).\n"
        "Export the scan again, or as PLY."
    )
