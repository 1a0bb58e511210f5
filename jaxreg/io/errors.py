"""Errors of files and options: one or two lines that say what to do."""


class InputError(ValueError):
    """A file, folder or option that cannot be used, named in the message."""


class MissingExtraError(ImportError):
    """A package of an optional extra, such as `app`, is not installed."""

    def __init__(self, package: str, purpose: str, extra: str = "app"):
        super().__init__(
            f"{purpose} needs the package {package}, which is not installed.\n"
            f"Install it with: python -m pip install 'jaxreg[{extra}]'"
        )
