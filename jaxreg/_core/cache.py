"""Programs kept on disk, so that the next process need not make them."""

import os
from pathlib import Path
from typing import Any

import jax

from jaxreg._core.programs import keep_programs


# Programs that compile in less are compiled again. By itself JAX keeps those that take
# a second: three of the fifteen of `jaxreg average`.
_LEAST_SECONDS = 0.05
_LEAST = "jax_persistent_cache_min_compile_time_secs"


def cache(folder: str | Path | None = None) -> Path:
    """Keeps programs in a folder and takes them from there.

    Compiled ones in JAX's own cache, and traced ones beside it where `flatbuffers` is
    installed (`jaxreg[app]` has it): then a call is neither traced nor compiled. Those
    of methods with parts of other code than this package are compiled ones only.

    What a process asked for after its first program, the next one loads in threads as
    soon as it asks for that one.

    Call it before the first program is compiled. It sets JAX's configuration for the
    whole process, and so nothing but a call of it does. Kept is what takes 50 ms or
    more to compile, unless `JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS` says otherwise.

    Args:
        folder: made if needed. By default `JAX_COMPILATION_CACHE_DIR` of the
            environment, else `jaxreg` in `XDG_CACHE_HOME`, else in `~/.cache`.

    Returns:
        The folder.

    Raises:
        ValueError: if the folder belongs to another user or others may write to it, as
            programs run as they lie there. One that `JAX_COMPILATION_CACHE_DIR` names
            is used as it is.
        OSError: if it cannot be made.
    """
    named = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    least = {} if _LEAST.upper() in os.environ else {_LEAST: _LEAST_SECONDS}
    if folder is None and named:  # JAX keeps them there without being told again
        folder = Path(named).absolute()
        _configure(least)
        keep_programs(folder / "programs" if _may_keep(folder) else None)
        return Path(named)
    if folder is None:
        root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(root) / "jaxreg"
    folder = Path(folder).absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    if not _is_mine(folder):
        raise ValueError(
            f"{folder}: others may write there, compiled programs are not kept. Remove "
            "it, or make it yours alone."
        )
    _configure({"jax_compilation_cache_dir": str(folder)} | least)
    keep_programs(folder / "programs")
    return folder


def _configure(settings: dict[str, Any]) -> None:
    for name, value in settings.items():
        jax.config.update(name, value)


def _may_keep(folder: Path) -> bool:
    """Whether a folder is there for this user alone, or can be made."""
    try:
        return not folder.exists() or _is_mine(folder)
    except OSError:
        return False


def _is_mine(folder: Path) -> bool:
    if not hasattr(os, "getuid"):  # Windows: profiles are their user's
        return True
    found = folder.stat()
    return found.st_uid == os.getuid() and not found.st_mode & 0o022
