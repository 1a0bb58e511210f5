"""Pictures drawn by a process of their own, which has imported what that needs by then.

Matplotlib takes 0.3 s to import and up to 0.7 to draw, and keeps Python's lock: in a
thread nothing is gained. Where there is no such process, or it fails, the picture is
drawn in this one.
"""

import contextlib
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jaxreg._core.cores import num_cores


# Found where this process finds it; nothing of the folder that it runs in.
_RUN = f"""
import sys
sys.path.append({str(Path(__file__).parents[3])!r})
from jaxreg.app.plot.drawing import draw_what_is_asked
draw_what_is_asked()
"""


class _Waiting:
    process: subprocess.Popen[bytes] | None = None


@contextlib.contextmanager
def expecting_a_picture() -> Iterator[None]:
    """A process waits during the block to draw one.

    Not where this one has imported Matplotlib already, or cannot start another, nor on
    one core: there a start takes 0.4 s more by it.
    """
    if num_cores() > 1 and "matplotlib.figure" not in sys.modules:
        with contextlib.suppress(OSError):
            _Waiting.process = subprocess.Popen(
                [sys.executable or "python", "-P", "-c", _RUN],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # an interruption is this process's to answer
            )
    try:
        yield
    finally:
        process, _Waiting.process = _Waiting.process, None
        if process is not None:  # nothing was drawn
            _end(process)


class Drawing:
    """A picture that is being drawn.

    Args:
        path: of the PNG file, which appears whole or not at all.
        draw: a function of a module, which returns a figure.
        args: what it is given; NumPy arrays and what Python has.
    """

    def __init__(self, path: Path, draw: Callable[..., Any], *args: Any):
        self._asked = path, draw, args
        self._process, _Waiting.process = _Waiting.process, None
        if self._process is not None and self._process.stdin is not None:
            # Where it has ended: see `finish`.
            with contextlib.suppress(OSError), self._process.stdin as told:
                pickle.dump(self._asked, told)

    def finish(self) -> None:
        """Waits until the file is there.

        Raises:
            InputError: if it cannot be written.
        """
        if self._process is None or self._process.wait() != 0:
            _draw(*self._asked)

    def stop(self) -> None:
        """Nothing is written any more."""
        if self._process is not None:
            _end(self._process)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    if process.stdin is not None:
        with contextlib.suppress(OSError):  # what it has not read
            process.stdin.close()


def draw_what_is_asked() -> None:
    """What the process does: imports, reads what to draw, draws it."""
    import matplotlib.backends.backend_agg
    import matplotlib.figure  # noqa: F401

    import jaxreg.app.plot.graph  # noqa: F401

    try:
        path, draw, args = pickle.load(sys.stdin.buffer)
    except EOFError:  # who would have asked has ended
        return
    _draw(path, draw, args)


def _draw(path: Path, draw: Callable[..., Any], args: tuple[Any, ...]) -> None:
    from jaxreg.app.plot.figure import save_figure  # at use: the process starts first

    save_figure(path, draw(*args))
