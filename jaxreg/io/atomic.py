"""Files that appear whole or not at all: write beside the target, then rename."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from jaxreg.io.errors import InputError


@contextlib.contextmanager
def atomic_write(path: str | Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Opens a file beside `path` that takes its place when the block succeeds.

    If the block raises, the new file is removed and an older file of that name stays
    as it was. Text is UTF-8 with newline "\\n".

    Args:
        path: where the file shall appear; its folder must exist.
        mode: "w" for text, "wb" for bytes.

    Raises:
        InputError: if the folder cannot be written.
        ValueError: if `mode` is neither "w" nor "wb".
    """
    if mode not in ("w", "wb"):
        raise ValueError(f"mode: wanted 'w' or 'wb', found {mode!r}.")
    path = Path(path)
    text = {} if mode == "wb" else {"encoding": "utf-8", "newline": "\n"}
    try:
        handle, beside = tempfile.mkstemp(
            prefix=f".{path.name}.", suffix=".part", dir=path.parent
        )
    except OSError as err:
        raise InputError(
            f"{path}: cannot be written ({err.strerror}).\n"
            "Choose a folder that exists and that you may write to."
        ) from err
    try:
        with os.fdopen(handle, mode, **text) as file:
            yield file
            file.flush()
            os.fsync(handle)
        os.chmod(beside, 0o666 & ~_umask())  # mkstemp makes it private
        os.replace(beside, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(beside)
        raise


def require_writable(folder: str | Path) -> Path:
    """Makes a folder if needed and tries it, before hours of work depend on it.

    Args:
        folder: an existing folder or one to be made, parents included.

    Returns:
        The folder as a path.

    Raises:
        InputError: if it cannot be made or written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as err:
        raise InputError(
            f"{folder}: cannot be written ({err.strerror}).\n"
            "Choose another output folder with --out."
        ) from err
    return folder


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
