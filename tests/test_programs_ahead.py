"""Programs loaded ahead: those that followed, as far as they are asked for again."""

import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg._core import programs_ahead
from jaxreg._core.program_files import digest
from jaxreg._core.programs import keep_programs, kept_program
from jaxreg._core.programs_ahead import THREAD, ProgramsAhead


A, B, C, D, E = (digest(x) for x in "abcde")


@pytest.fixture(autouse=True)
def _with_room(monkeypatch: pytest.MonkeyPatch) -> None:
    # Whatever other tests of this process have compiled.
    monkeypatch.setattr(programs_ahead, "has_room", lambda: True)


class Loader:
    """Loads what it is told of as its name, when it may."""

    def __init__(self) -> None:
        self.loaded: list[str] = []
        self.may = threading.Event()
        self.may.set()
        self.begun = threading.Event()

    def __call__(self, name: str) -> str:
        self.begun.set()
        self.may.wait()
        self.loaded.append(name)
        if name == E:
            raise OSError(name)
        return name


def _finished() -> None:
    for thread in threading.enumerate():
        if thread.name == THREAD:
            thread.join()


def _ran(folder: Path, names: list[str], load: Loader) -> list[str | None]:
    """What a process is given that asks for these; all is loaded after the first."""
    ahead = ProgramsAhead(folder, load)
    given = []
    for name in names:
        given.append(ahead.ask(name))
        _finished()
    return given


def test_what_followed_is_loaded_and_given_once(tmp_path: Path):
    load = Loader()
    assert _ran(tmp_path, [A, B, C], load) == [None, None, None]
    assert load.loaded == []
    assert _ran(tmp_path, [A, B, C], load) == [None, B, C]
    assert sorted(load.loaded) == sorted([B, C])
    # Of another first one nothing is known.
    assert _ran(tmp_path, [B, C, A], load) == [None, None, None]
    assert _ran(tmp_path, [A, C, C], load) == [None, C, None]


def test_the_last_process_tells_what_follows(tmp_path: Path):
    load = Loader()
    for names in ([A, B, C], [A, B, D], [A, B]):
        _ran(tmp_path, names, load)
    load.loaded.clear()
    assert _ran(tmp_path, [A, B, D], load) == [None, B, D]
    assert sorted(load.loaded) == sorted([B, D])


def _loading_the_second(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[ProgramsAhead, Loader]:
    """One thread, which is held up by the second of four programs."""
    monkeypatch.setattr(programs_ahead, "_THREADS", 1)
    load = Loader()
    _ran(folder, [A, B, C, D], load)
    load.may.clear()
    ahead = ProgramsAhead(folder, load)
    ahead.ask(A)
    load.begun.wait()
    return ahead, load


def test_loading_ends_where_another_program_is_asked_for(tmp_path: Path, monkeypatch):
    ahead, load = _loading_the_second(tmp_path, monkeypatch)
    assert ahead.ask(E) is None
    load.may.set()
    _finished()
    assert load.loaded == [B]


def test_what_has_not_begun_is_left_to_who_asks_for_it(tmp_path: Path, monkeypatch):
    ahead, load = _loading_the_second(tmp_path, monkeypatch)
    assert ahead.ask(C) is None
    load.may.set()
    _finished()
    assert load.loaded == [B, D]


def test_what_is_being_loaded_is_waited_for(tmp_path: Path):
    load = Loader()
    _ran(tmp_path, [A, B, C], load)
    load.may.clear()
    ahead = ProgramsAhead(tmp_path, load)
    ahead.ask(A)
    threading.Timer(0.1, load.may.set).start()
    load.begun.wait()
    assert ahead.ask(B) == B
    _finished()


def test_bad_files_and_programs_that_fail_are_left_to_the_caller(tmp_path: Path):
    load = Loader()
    _ran(tmp_path, [A, E, B], load)
    assert _ran(tmp_path, [A, E, B], load) == [None, None, B]
    for content in (b"", b"../../etc", b"\xff", b"a" * 10_000):
        (tmp_path / f"{A}.then").write_bytes(content)
        assert _ran(tmp_path, [A, B], load) == [None, None]
    assert set(load.loaded) == {E, B}
    folder = tmp_path / "file" / "programs"
    (tmp_path / "file").write_text("")
    assert _ran(folder, [A, B], load) == [None, None]


def test_where_there_is_no_room_nothing_is_loaded(tmp_path: Path, monkeypatch):
    load = Loader()
    _ran(tmp_path, [A, B], load)
    monkeypatch.setattr(programs_ahead, "has_room", lambda: False)
    assert _ran(tmp_path, [A, B], load) == [None, None]
    assert load.loaded == []


def _halved(x: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    return x / 2, key


def _drawn(x: jax.Array, key: jax.Array) -> jax.Array:
    return x + jax.random.normal(key, x.shape)


_halved.__module__ = _drawn.__module__ = "jaxreg.of_a_test"


@pytest.mark.parametrize("wide", [False, True])
def test_a_program_that_was_loaded_ahead_runs_without_being_made_again(
    tmp_path: Path, wide: bool
):
    compiled: list[str] = []

    def hear(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(threading.current_thread().name)

    def answer() -> tuple[np.ndarray, list[str]]:
        keep_programs(tmp_path)
        with jax.enable_x64(wide):
            between = kept_program(_halved)(jnp.ones(5), jax.random.key(3))
            _finished()
            count = len(compiled)
            found = kept_program(_drawn)(*between)
        assert found.dtype == (jnp.float64 if wide else jnp.float32)
        return np.asarray(found), compiled[count:]

    jax.monitoring.register_event_duration_secs_listener(hear)
    try:
        first, made = answer()
        assert made
        again, made = answer()
    finally:
        keep_programs(None)
        jax.monitoring.unregister_event_duration_listener(hear)
    assert not made
    assert THREAD in compiled
    np.testing.assert_array_equal(first, again)
