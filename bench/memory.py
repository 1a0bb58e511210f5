"""Peak memory of a call: how far the resident set of this process grows."""

import ctypes
import gc
import os
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any


_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def growth_mib(call: Callable[[], Any]) -> float:
    """MiB by which a call lifts the highest resident set above what is there before.

    Memory that is free is handed back to the system first, so that reused memory
    counts too. The system keeps the highest mark: nothing looks on while the call runs.
    Where it cannot be reset, the growth of the highest mark ever stands in, a lower
    bound.
    """
    gc.collect()
    _hand_back()
    try:
        _RESET.write_text("5")
    except OSError:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        call()
        return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    before = _kib("VmRSS")
    call()
    return max(_kib("VmHWM") - before, 0) / 1024


def _kib(name: str) -> int:
    for line in _STATUS.read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1])
    raise OSError(f"{_STATUS}: no {name}")


def _hand_back() -> None:
    if os.name == "posix":
        try:
            ctypes.CDLL(None).malloc_trim(0)
        except (OSError, AttributeError):  # another C library
            return
