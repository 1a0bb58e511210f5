"""Errors of files and options: one or two lines that say what to do."""


class InputError(ValueError):
    """A file, folder or option that cannot be used, named in the message."""


class MissingExtraError(ImportError):
    """A package of the optional extra `app` is not installed."""

    def __init__(self, package: str, purpose: str):
        super().__init__(
            f"{purpose} needs the package {package}, which is not installed.\n"
            "Install it with: python -m pip install 'jaxreg[app]'"
        )
