"""Room for compiled programs, of which a process on Linux holds only so many.

XLA maps a piece of memory for each kernel, some thousand for a search. At a limit of
the system's (`vm.max_map_count`, 65,530 by default) it ends the process without a word
to Python: twelve to eighteen searches of clouds of different sizes are enough.
"""

from pathlib import Path

import jax

from jaxreg._core.log import LOGGER


# A program that is compiled next may take an eighth of all, another half of that beside
# it in a thread.
_MOST = 0.6
_MAPS, _LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_COMPILED = "/jax/core/compile/backend_compile_duration"


class _Watch:
    """Whether anything was compiled since maps were counted; how often all went."""

    compiled = False
    num_drops = 0

    @classmethod
    def hear(cls, event: str, duration_secs: float, **kwargs: str | int) -> None:
        """An event of JAX."""
        if event == _COMPILED:
            cls.compiled = True


jax.monitoring.register_event_duration_secs_listener(_Watch.hear)


def make_room() -> None:
    """Drops all compiled programs where there is hardly room for another.

    Those that are needed again are compiled again, or loaded where they are kept.
    """
    if not _Watch.compiled:
        return
    _Watch.compiled = False
    used = share_used()
    if used > _MOST:
        drop_programs()
        LOGGER.warning(
            "%.0f %% of the memory maps that a process may have were used by compiled "
            "programs: all were dropped, and are compiled again when needed. Clouds of "
            "few sizes, or lists of them, need fewer.",
            100 * used,
        )


def drop_programs() -> None:
    """Drops all compiled programs of the process."""
    jax.clear_caches()
    _Watch.num_drops += 1


def num_drops() -> int:
    """How often all programs were dropped; what was compiled before is no more."""
    return _Watch.num_drops


def has_room() -> bool:
    """Whether there is room for programs that may be needed, beside one that is."""
    return share_used() < _MOST / 2


def share_used() -> float:
    """Of the maps that this process may have; zero where that is not told."""
    try:
        with _MAPS.open("rb") as lines:
            return sum(1 for _ in lines) / int(_LIMIT.read_text())
    except (OSError, ValueError):  # no Linux
        return 0.0
