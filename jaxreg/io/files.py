"""Files before their content: regular ones, unpacked within bounds, and one guard.

Every reader of the package opens its files here, so that a bad one ends in one message:
the file, what is wrong and where, what to do.
"""

import contextlib
import gzip
import io
import os
import stat
import zlib
from collections.abc import Iterator
from pathlib import Path

from jaxreg.io.errors import InputError, MissingExtraError


AGAIN = "Export the scan again, or as PLY."
# Scans shrink by a factor of two to thirty; DEFLATE itself stops at a thousand.
_MOST_RATIO = 200
_FREE_SIZE = 16_000_000
_LONGEST_LINE = 1_000_000
_PIPED = "Write its content to a file first, and name that."
_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISDIR, "a folder"),
)


def unreadable(
    path: str | Path, kind: str, reason: object, advice: str = AGAIN
) -> InputError:
    """The error for a file that is not what its suffix says, or not whole."""
    why = " ".join(str(reason).split())[:120] or type(reason).__name__
    return InputError(f"{path}: not a complete {kind} file ({why}).\n{advice}")


@contextlib.contextmanager
def reading(path: str | Path, kind: str, advice: str = AGAIN) -> Iterator[None]:
    """Turns whatever a reader meets in damaged data into an `InputError`.

    Errors of this kind, `MissingExtraError` and interruptions pass.

    Args:
        path: of the file, for messages.
        kind: of the file, for messages, such as "PLY".
        advice: what to do.
    """
    try:
        yield
    except (InputError, MissingExtraError):
        raise
    except MemoryError as err:
        raise InputError(
            f"{path}: reading it takes more memory than there is.\n"
            "Thin it out or split it, if it is not damaged."
        ) from err
    except OSError as err:
        if err.errno is None:
            raise unreadable(path, kind, err, advice) from err
        raise _not_open(path, err) from err
    except Exception as err:
        raise unreadable(path, kind, err, advice) from err
    except BaseException as err:
        # Extension modules written in Rust panic past `Exception`.
        if type(err).__name__ != "PanicException":
            raise
        raise unreadable(path, kind, err, advice) from err


def require_regular(path: str | Path) -> int:
    """The size in bytes of a regular file.

    Raises:
        InputError: if there is none, or a folder, a named pipe, a device or a socket.
    """
    try:
        found = os.stat(path)
    except OSError as err:
        raise _not_open(path, err) from err
    except ValueError as err:
        raise InputError(f"{path!r}: no name of a file ({err}).\nCorrect it.") from err
    for is_kind, what in _KINDS:
        if is_kind(found.st_mode):
            raise InputError(
                f"{path}: cannot be read ({what}, not a file).\n"
                + ("Name a file in it." if what == "a folder" else _PIPED)
            )
    return found.st_size


def is_packed(path: str | Path) -> bool:
    """Whether the name says that the file is compressed."""
    return str(path).lower().endswith(".gz")


def open_bytes(path: str | Path) -> io.BufferedReader:
    """A regular file, unpacked if its name ends in `.gz`.

    Raises:
        InputError: if it cannot be opened; while reading, if the compressed data are
            damaged or unpack to far more than any scan does.
    """
    size = require_regular(path)
    try:
        file = open(path, "rb")
    except OSError as err:
        raise _not_open(path, err) from err
    if not is_packed(path):
        return file
    return io.BufferedReader(_Unpacked(file, path, size), 1 << 16)


def text_lines(path: str | Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file without their ends, with their numbers from 1.

    UTF-8 or, with a byte order mark, UTF-16; any line ends; unpacked if it ends in
    `.gz`. One line is in memory at a time.

    Raises:
        InputError: while reading, if the file cannot be read or is no text.
    """
    with open_bytes(path) as file, reading(path, "text", "Save it again as text."):
        start = file.peek(2)[:2]
        encoding = "utf-16" if start in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
        text, number = io.TextIOWrapper(file, encoding=encoding), 0
        while True:
            number += 1
            try:
                line = text.readline(_LONGEST_LINE)
            except UnicodeError as err:
                raise _no_text(str(path), "bytes that are no UTF-8") from err
            if "\0" in line:
                raise _no_text(f"{path}, line {number}", "NUL bytes")
            if len(line) >= _LONGEST_LINE:
                raise _no_text(f"{path}, line {number}", "a million characters")
            if not line:
                return
            yield number, line.rstrip("\n")


class _Unpacked(io.RawIOBase):
    """The content of a gzip file, refused when it grows beyond what scans do."""

    def __init__(self, file: io.BufferedIOBase, path: str | Path, size: int):
        self._file, self._path = file, path
        self._stream = gzip.GzipFile(fileobj=file)
        self._most = max(_FREE_SIZE, _MOST_RATIO * size)
        self._found = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:  # pyright: ignore
        try:
            data = self._stream.read(len(buffer))
        except (OSError, EOFError, zlib.error) as err:
            raise InputError(
                f"{self._path}: cannot be read (damaged gzip data).\n"
                "Copy or compress the file again."
            ) from err
        self._found += len(data)
        if self._found > self._most:
            raise InputError(
                f"{self._path}: unpacks to more than {_MOST_RATIO} times its size, as "
                "no scan does.\nUnpack it yourself if you trust it."
            )
        buffer[: len(data)] = data
        return len(data)

    def close(self) -> None:
        self._stream.close()
        self._file.close()
        super().close()


def _not_open(path: str | Path, err: OSError) -> InputError:
    if isinstance(err, FileNotFoundError):
        return InputError(f"{path}: no such file.\nCheck the name and folder.")
    return InputError(
        f"{path}: cannot be read ({err.strerror or err}).\n"
        "Check the file and its permissions."
    )


def _no_text(where: str, what: str) -> InputError:
    return InputError(
        f"{where}: not a text file, it holds {what}.\n"
        "Copy it again, save it as UTF-8, or give it the suffix of its true format."
    )
