"""Compiled programs kept on disk, so that the next process need not compile them."""

import os
from pathlib import Path

import jax


# Programs that compile in less are compiled again.
_LEAST_SECONDS = 0.05


def cache(folder: str | Path | None = None) -> Path:
    """Keeps compiled programs in a folder and takes them from there: JAX's own cache.

    Call it before the first program is compiled. It sets JAX's configuration for the
    whole process, and so nothing but a call of it does.

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
    if folder is None and named:  # JAX keeps them there without being told again
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
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", _LEAST_SECONDS)
    return folder


def _is_mine(folder: Path) -> bool:
    if not hasattr(os, "getuid"):  # Windows: profiles are their user's
        return True
    found = folder.stat()
    return found.st_uid == os.getuid() and not found.st_mode & 0o022
