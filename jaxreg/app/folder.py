"""The folder of results: held by one run at a time, and never a mixture of two."""

import contextlib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

from jaxreg.io.atomic import atomic_folder, complete_folder, require_writable
from jaxreg.io.errors import InputError


_LOCK = ".jaxreg.lock"
_OWN = re.compile(
    r"result\.json|figure\.png|report\.html"
    r"|poses(_\d+)?\.tum|graph(_\d+)?\.g2o|merged(_\d+)?\.ply"
    r"|aligned(_\d+)?/[^/]+"
)


@contextlib.contextmanager
def held(folder: str | Path) -> Iterator[None]:
    """Keeps other runs out of a folder, and ends what killed ones began in it.

    The operating system lets go of the lock when the process ends in whatever way. A
    folder that was made for it goes if nothing was written.

    Raises:
        InputError: if the folder cannot be written or another run holds it.
    """
    folder = Path(folder)
    require_writable(folder)
    made = [p for p in (folder, *folder.parents) if not p.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    lock = None
    try:
        lock = _locked(folder / _LOCK)
        complete_folder(folder)
        for part in folder.glob(".pairs.jsonl.*.part"):
            part.unlink(missing_ok=True)
        yield
    finally:
        if lock is not None:
            (folder / _LOCK).unlink(missing_ok=True)
            os.close(lock)
        with contextlib.suppress(OSError):  # something was written
            for path in made:
                path.rmdir()


@contextlib.contextmanager
def result_folder(folder: str | Path) -> Iterator[Path]:
    """`atomic_folder`, without what an earlier result there has and this one lacks.

    A folder then never mixes two results: `merged_2.ply` goes if the new result has one
    component. Only regular files that jaxreg calls so and the earlier result.json names
    are removed.

    Raises:
        InputError: if the folder cannot be written.
    """
    with atomic_folder(folder, replaces=_files_of_earlier(Path(folder))) as staging:
        yield staging


def _files_of_earlier(folder: Path) -> set[str]:
    try:
        document = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        names = document["files"] if "jaxreg" in document["versions"] else []
        return {
            name
            for name in names
            if _OWN.fullmatch(name)
            and (folder / name).is_file()
            and not (folder / name).is_symlink()
        }
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return set()  # none there, or another program's


def _locked(path: Path) -> int:
    """An open file that is locked, with the number of this process in it."""
    while True:
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _lock(lock)
        except BlockingIOError as err:
            holder = os.read(lock, 20).decode("ascii", "replace").strip() or "?"
            os.close(lock)
            raise InputError(
                f"{path.parent}: another run (process {holder}) writes its results "
                "there.\nWait for its end, or choose another folder (--out)."
            ) from err
        # Its holder may have ended and removed it meanwhile.
        if path.exists() and os.path.samestat(os.fstat(lock), os.stat(path)):
            os.ftruncate(lock, 0)
            os.write(lock, f"{os.getpid()}\n".encode())
            return lock
        os.close(lock)


def _lock(lock: int) -> None:
    try:
        import fcntl
    except ModuleNotFoundError:  # not on Windows, where two runs are not told apart
        return
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:  # a file system without locks
        return
