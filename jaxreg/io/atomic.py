"""Files that appear whole or not at all: write beside the target, then rename.

By hand: packages for single files are no longer kept up, and none does folders.
"""

import contextlib
import os
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO, Any

from jaxreg.io.errors import InputError


@contextlib.contextmanager
def atomic_write(path: str | Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Opens a file beside `path` that takes its place when the block succeeds.

    If the block raises, the new file is removed and an older file of that name stays
    as it was. Text is UTF-8 with Unix line ends.

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
        text = mode == "w"
        with open(
            handle,
            mode,
            encoding="utf-8" if text else None,
            newline="\n" if text else None,
        ) as file:
            yield file
            file.flush()
            os.fsync(handle)
        os.chmod(beside, 0o666 & ~_umask())  # mkstemp makes it private
        os.replace(beside, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(beside)
        raise


@contextlib.contextmanager
def atomic_folder(folder: str | Path, replaces: Collection[str] = ()) -> Iterator[Path]:
    """Yields a staging folder whose files move into `folder` when the block succeeds.

    If the block raises, none of them appears: `folder` never holds half a result.

    Args:
        folder: made if needed, parents included; files of other names in it stay.
        replaces: names of files in it that go, too, when the block succeeds.

    Raises:
        InputError: if the folder cannot be written.
    """
    folder = Path(folder)
    require_writable(folder)
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix=".jaxreg-", dir=folder) as staging:
            yield Path(staging)
            for name in replaces:
                (folder / name).unlink(missing_ok=True)
            for file in sorted(Path(staging).iterdir()):
                os.replace(file, folder / file.name)
    except BaseException:
        if made:
            folder.rmdir()
        raise


def require_writable(folder: str | Path) -> None:
    """Tries whether a folder can be made and written, and leaves no trace.

    Meant to be called before the computation whose results go there.

    Raises:
        InputError: if it cannot be made or written.
    """
    folder = Path(folder)
    existing = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as err:
        raise InputError(
            f"{folder}: cannot be written ({err.strerror}).\n"
            "Choose another folder for the results (--out)."
        ) from err


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
