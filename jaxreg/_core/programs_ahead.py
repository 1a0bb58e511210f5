"""Programs that followed the first one when it was asked for before, loaded ahead.

A start whose programs are kept loads one after another, on one core: XLA reads and
links each, without Python's lock. So another core loads what will be asked for next:
`jaxreg demo` is over in 10.3 s for 12.2. (To begin before the first one is asked for,
by the name of the command, while modules are imported, brought nothing.)
"""

import contextlib
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import jax

from jaxreg._core.program_files import replace
from jaxreg._core.program_room import has_room


# Of a whole command, `jaxreg demo`, 38 are asked for.
_MOST = 64
# The main thread waits for the first of them, as a rule.
_THREADS = 2
_NAME = re.compile("[0-9a-f]{40}")
#: The name of threads that load, and an event of `jax.monitoring`: the seconds that the
#: main thread waited for them.
THREAD, WAITED = "jaxreg programs ahead", "/jaxreg/programs_ahead_waited_for"
#: Loads the program of a name; None if it is not there.
Load = Callable[[str], Any]


class ProgramsAhead:
    """The programs of a process in the order in which it asks for them.

    A file beside the first one names those that followed in the last process. They are
    loaded from then on, until one is asked for that is not among them.
    """

    def __init__(self, folder: Path, load: Load):
        self.folder = folder
        self._load = load
        self._asked: list[str] = []
        self._expected: list[str] = []
        self._as_before = True
        self._loading: _Loading | None = None

    def ask(self, name: str) -> Any:
        """The program if it was loaded ahead, or is being loaded; else None."""
        self._asked.append(name)
        if len(self._asked) == 1:
            self._expected = _read(self._then)
            if self._expected:
                self._loading = _Loading(self._expected, self._load)
            return None
        self._note()
        if self._loading is None:
            return None
        if name not in self._expected:
            self._loading.stop()
        return self._loading.take(name)

    @property
    def _then(self) -> Path:
        return self.folder / f"{self._asked[0]}.then"

    def _note(self) -> None:
        """What is asked for, where it is not as it was before."""
        followed = self._asked[1:]
        self._as_before &= followed == self._expected[: len(followed)]
        if not self._as_before and len(followed) <= _MOST:
            with contextlib.suppress(OSError):  # who keeps programs says so
                replace(self._then, "\n".join(followed).encode())


class _Loading:
    """Loads some programs side by side, as long as the main thread lives."""

    def __init__(self, names: Sequence[str], load: Load):
        self._waiting = deque(names)
        self._begun: dict[str, Future[Any]] = {}
        self._lock = threading.Lock()
        self._load = load
        for _ in range(_THREADS):
            # No daemon: Python must not be taken down while XLA works in a thread.
            threading.Thread(target=self._run, name=THREAD).start()

    def _run(self) -> None:
        while threading.main_thread().is_alive() and has_room():
            with self._lock:
                if not self._waiting:
                    return
                name = self._waiting.popleft()
                future = self._begun[name] = Future()
            found = None
            try:
                found = self._load(name)
            except Exception:  # noqa: BLE001  who needs it finds out what is wrong
                pass
            finally:
                future.set_result(found)

    def take(self, name: str) -> Any:
        """The program, if its loading has begun; else it is left to the caller."""
        with self._lock:
            future = self._begun.pop(name, None)
            if future is None and name in self._waiting:
                self._waiting.remove(name)
        if future is None:
            return None
        start = time.perf_counter()
        found = future.result()
        waited = time.perf_counter() - start
        jax.monitoring.record_event_duration_secs(WAITED, waited)
        return found

    def stop(self) -> None:
        """After the one that is being loaded."""
        with self._lock:
            self._waiting.clear()


def _read(path: Path) -> list[str]:
    """The names in a file; none if it is not one of these."""
    try:
        names = path.read_text().split()
    except (OSError, ValueError):
        return []
    whole = len(names) <= _MOST and all(map(_NAME.fullmatch, names))
    return names if whole else []
