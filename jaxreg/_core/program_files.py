"""A file for each traced program: beside and renamed, checked, of limited size."""

import contextlib
import dataclasses
import hashlib
import io
import os
import pickle
import tempfile
from pathlib import Path
from typing import Any


_MAGIC = b"jaxreg program 1\n"
_HEAD = len(_MAGIC) + hashlib.sha256().digest_size
# Of all programs, which take up to half a megabyte each; the oldest go first.
_MOST_BYTES = 2**28
# Whose objects can be part of a key: their code is that of a version, or of the package
# itself, which is part of the key.
_KNOWN = {"jaxreg", "jax", "jaxlib", "equinox", "optimistix", "lineax"}
_KNOWN |= {"numpy", "ml_dtypes", "builtins", "copyreg", "collections", "functools"}


@dataclasses.dataclass(frozen=True)
class Hole:
    """Stands for an array where only the structure matters."""

    shape: tuple[int, ...] = ()
    dtype: str = ""
    weak: bool = False


def digest(*parts: str | bytes) -> str:
    """A name for them."""
    found = hashlib.sha256()
    for part in parts:
        part = part.encode() if isinstance(part, str) else part
        found.update(len(part).to_bytes(8, "little") + part)
    return found.hexdigest()[:40]


def pickled(x: Any) -> bytes:
    """Bytes of what consists of objects of this package and its libraries.

    Raises:
        pickle.PicklingError: for those of other code.
    """
    file = io.BytesIO()
    _Pickler(file, protocol=5).dump(x)
    return file.getvalue()


def write(path: Path, exported: Any, skeleton: Any) -> None:
    """Writes a program and the skeleton of its answer, if they can be written.

    Raises:
        OSError: if the folder takes nothing.
    """
    try:
        parts = pickled(skeleton), bytes(exported.serialize())
    except Exception:  # noqa: BLE001  whatever objects and JAX raise: not kept then
        return
    body = len(parts[0]).to_bytes(8, "little") + b"".join(parts)
    _make_room(path.parent, len(body))
    replace(path, _MAGIC + hashlib.sha256(body).digest() + body)


def replace(path: Path, content: bytes) -> None:
    """Writes a file beside another and puts it in its place.

    Raises:
        OSError: if the folder takes nothing.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        try:
            file.write(content)
            file.close()
            os.replace(file.name, path)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(file.name)
            raise


def read(path: Path) -> tuple[Any, Any] | None:
    """A program and the skeleton of its answer, if they are there and whole."""
    from jax import export

    try:
        content = path.read_bytes()
        body = content[_HEAD:]
        if content[:_HEAD] != _MAGIC + hashlib.sha256(body).digest():
            return None
        size = 8 + int.from_bytes(body[:8], "little")
        skeleton = _Unpickler(io.BytesIO(body[8:size])).load()
        exported = export.deserialize(bytearray(body[size:]))
        with contextlib.suppress(OSError):  # it was asked for now
            os.utime(path)
    except Exception:  # noqa: BLE001  whatever reading raises: it is traced again
        return None
    return exported, skeleton


def _make_room(folder: Path, num_bytes: int) -> None:
    """Removes the programs that were not asked for longest."""
    found = []
    for path in folder.glob("*.program"):
        with contextlib.suppress(OSError):  # another process removed it
            about = path.stat()
            found.append((about.st_mtime, about.st_size, path))
    total = sum(size for _, size, _ in found) + num_bytes
    for _, size, path in sorted(found):
        if total <= _MOST_BYTES:
            break
        path.unlink(missing_ok=True)
        path.with_suffix(".then").unlink(missing_ok=True)
        total -= size


class _Pickler(pickle.Pickler):
    def reducer_override(self, obj: Any) -> Any:
        """Refuses what other code defines: a key cannot tell when it changes."""
        if isinstance(obj, type) or callable(obj):
            module = getattr(obj, "__module__", None) or type(obj).__module__
            if module.split(".")[0] not in _KNOWN:
                raise pickle.PicklingError(f"{obj} is not of this package")
        return NotImplemented


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """A class of this package, never a function that a changed file could call."""
        found = super().find_class(module, name)
        if module.split(".")[0] != "jaxreg" or not isinstance(found, type):
            raise pickle.UnpicklingError(f"{module}.{name}")
        return found
