"""Files that appear whole or not at all: write beside the target, then rename.

By hand: packages for single files are no longer kept up, and none does folders.
"""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO, Any

from jaxreg.io.errors import InputError


# Folders of results that are being written, and of those that are whole; a file of the
# latter names what an older result has and they have not.
_STAGING, _READY, _OLD = ".jaxreg-part-", ".jaxreg-whole-", ".old"


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

    Those in folders of it move into folders of the same names.

    If the block raises, none of them appears: `folder` never holds half a result. A
    process that is killed while they move leaves them for `complete_folder`.

    Args:
        folder: made if needed, parents included; files of other names in it stay.
        replaces: names of files in it that go, too, when the block succeeds.

    Raises:
        InputError: if the folder cannot be written, or a folder in it has the name of
            a file that is to appear.
    """
    folder = Path(folder)
    require_writable(folder)
    made = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=_STAGING, dir=folder))
    try:
        yield staging
        names = [file.relative_to(staging).as_posix() for file in _files(staging)]
        for name in names:
            if (folder / name).is_dir():
                raise InputError(
                    f"{folder / name}: a folder is where a result is to be written.\n"
                    "Rename it, or choose another folder for the results (--out)."
                )
        old = sorted(set(replaces) - set(names))
        (staging / _OLD).write_text(json.dumps(old), encoding="utf-8")
        ready = folder / staging.name.replace(_STAGING, _READY, 1)
        os.replace(staging, ready)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        if made:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise
    _move(ready)


def complete_folder(folder: str | Path) -> None:
    """Ends what killed processes began in a folder that no living one writes to.

    A result that was whole moves to its place, half ones go.
    """
    for ready in Path(folder).glob(f"{_READY}*"):
        _move(ready)
    for staging in Path(folder).glob(f"{_STAGING}*"):
        shutil.rmtree(staging, ignore_errors=True)


def _move(ready: Path) -> None:
    """Moves the files of a folder up; begun again, it goes on."""
    with contextlib.suppress(FileNotFoundError):  # it goes last
        for name in json.loads((ready / _OLD).read_text(encoding="utf-8")):
            (ready.parent / name).unlink(missing_ok=True)
    for file in _files(ready):
        if file.name != _OLD:
            place = ready.parent / file.relative_to(ready)
            place.parent.mkdir(exist_ok=True)
            os.replace(file, place)
    shutil.rmtree(ready)


def _files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.is_file())


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
