"""Entry point of the command `jaxreg`: parses, dispatches, and speaks of errors.

Exit codes: 0 done, 2 bad input (a message of one or two lines), 3 computed, but the
answer is not believed (its best attempt is written), 130 interrupted, 143 ended by
SIGTERM, 129 by SIGHUP, 141 when nobody reads the output any more.
"""

import _thread
import contextlib
import difflib
import gc
import io
import itertools
import os
import shlex
import signal
import sys
import threading
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, NoReturn, get_args

from jaxreg.app.folder import held
from jaxreg.app.versions import version
from jaxreg.io.errors import InputError, MissingExtraError
from jaxreg.io.printable import printable


if TYPE_CHECKING:
    from jaxreg.app.cli.options import Options

_COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")
_INTERRUPTED, _UNREAD = 130, 141


def command() -> NoReturn:
    """The process `jaxreg`: runs the command of its arguments and ends."""
    # Tracing makes much garbage, which is young: to look at all of it took a quarter.
    gc.set_threshold(50_000, 20, 50)
    sys.unraisablehook = _heard_again
    ended: list[int] = []

    def end(number: int, _: object) -> None:
        ended.append(number)
        raise KeyboardInterrupt

    for name in ("SIGTERM", "SIGHUP"):  # nohup has the latter ignored
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, end)
    code = main()
    if code == _INTERRUPTED:
        code = 128 + ended[0] if ended else code
    # All is written. To take down JAX and its programs takes half a second, and threads
    # that still compute after an interruption crash as Python takes down what they use.
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):  # nobody reads any more
            stream.flush()
    os._exit(code)


def _heard_again(lost: "sys.UnraisableHookArgs") -> None:
    """Interrupts again if Python dropped it, as in callbacks of garbage collection."""
    if isinstance(lost.exc_value, KeyboardInterrupt):
        threading.Timer(0.1, _interrupt).start()
    else:
        sys.__unraisablehook__(lost)


def _interrupt() -> None:
    """As Ctrl-C does: wakes the main thread from a system call, too."""
    main_thread = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main_thread is not None:
        signal.pthread_kill(main_thread, signal.SIGINT)
    else:
        _thread.interrupt_main()


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        argv: arguments without the program's name; None for those of the process.

    Returns:
        The exit code.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    arguments = arguments or ["--help"]
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller
            setattr(sys, name, open(os.devnull, "w"))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names need not be UTF-8
    try:
        try:
            return _run(arguments)
        finally:  # help exits, too, and what is not written now fails at Python's end
            sys.stdout.flush()
    except (InputError, MissingExtraError) as err:
        sys.stderr.write(f"jaxreg: {printable(str(err))}\n")
        return 2
    except BrokenPipeError:  # as in `jaxreg ... | head`: nobody reads on
        _drop_output()
        return _UNREAD
    except OSError as err:
        where = f"{err.filename}: " if err.filename else ""
        sys.stderr.write(
            f"jaxreg: {printable(where)}{err.strerror or err}; no results were "
            "written.\n"
        )
        _drop_output()
        return 2
    except KeyboardInterrupt as err:
        kept = str(err) or "no results were written"
        sys.stderr.write(f"jaxreg: interrupted; {kept}.\n")
        return _INTERRUPTED


def _drop_output() -> None:
    """What standard output cannot take is not tried again at Python's end."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(arguments: list[str]) -> int:
    if arguments in (["--version"], ["-V"]):
        sys.stdout.write(f"jaxreg {version('jaxreg')}\n")
        return 0
    # All of them now: nobody wants to learn it when the results are to be written.
    for package in ("tyro", "shtab", "rich", "plyfile", "matplotlib"):
        if find_spec(package) is None:
            raise MissingExtraError(package, "The command line")
    if any(word.startswith(_COMPLETION) for word in arguments):
        # Of tyro's two generators this one, by shtab, completes names of scans too.
        os.environ["PYTHON_TYRO_BACKEND"] = "argparse"
    import tyro

    from jaxreg.app.cli.options import COMMANDS, Options

    _require_command(
        arguments[0], [get_args(x)[0].__name__.lower() for x in get_args(COMMANDS)]
    )
    _require_two_scans(arguments)
    command = tyro.cli(
        COMMANDS,
        prog="jaxreg",
        description=(
            "Registers 2D and 3D point sets rigidly, without an initial guess, and "
            "brings many scans into one frame."
        ),
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    if not isinstance(command, Options):
        return _module_of(command).run(command)
    from jaxreg.app.plot.drawing import expecting_a_picture

    with expecting_a_picture():
        return _run_with_results(command, arguments)


def _run_with_results(command: "Options", arguments: list[str]) -> int:
    """A command that computes what it writes into a folder."""
    module = _module_of(command)
    from jaxreg.app.cli import runtime

    runtime.keep_compiled_programs()
    line = os.fsencode(shlex.join(["jaxreg", *arguments]))
    session = runtime.Session(command, line.decode("utf-8", "backslashreplace"))
    with held(command.out), runtime.computing(command):
        code = module.run(command, session)
        if command.json:
            text = (command.out / "result.json").read_text(encoding="utf-8")
            sys.stdout.write(text)
    return code


def _module_of(command: object) -> ModuleType:
    """What a command needs is imported when it is known which one it is."""
    return import_module(f"jaxreg.app.cli.{type(command).__name__.lower()}")


def _require_command(word: str, commands: list[str]) -> None:
    """Refuses a first word that is none, and names the one that is meant."""
    if word.startswith("-") or word in commands:
        return
    near = difflib.get_close_matches(word, commands, n=1)
    meant = f" Did you mean {near[0]}?" if near else ""
    raise InputError(
        f"{word}: no such command.{meant}\nCommands: {', '.join(commands)}."
    )


def _require_two_scans(arguments: list[str]) -> None:
    """Refuses more of them to `register`, and names who takes many."""
    scans = list(itertools.takewhile(lambda x: not x.startswith("-"), arguments[1:]))
    if arguments[0] == "register" and len(scans) > 2:
        raise InputError(
            f"register: wanted two scans, found {len(scans)}.\n"
            "Many scans go to: jaxreg multiview"
        )
