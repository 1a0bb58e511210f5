"""Kept programs: the same answers, of what was asked, whatever happens to the files."""

import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg as jr
from jaxreg._core import program_files, programs
from jaxreg._core.programs import keep_programs, kept_program
from jaxreg.robust import Huber


class Told(eqx.Module):
    """An answer with arrays, nothing, and something static."""

    value: Any
    none: Any
    name: str = eqx.field(static=True)


num_traced = 0


def _scaled(x: Any, method: Any, factor: float, name: str = "a") -> Told:
    global num_traced
    num_traced += 1
    if x.ndim != 1:
        raise ValueError(f"x: wanted a vector, found {x.shape}.")
    return Told({"x": factor * x, "n": jnp.sum(x)}, None, name)


# Of this package, as far as a key can tell.
_scaled.__module__ = Told.__module__ = "jaxreg.of_a_test"


@pytest.fixture(autouse=True)
def _of_this_package(monkeypatch: pytest.MonkeyPatch) -> None:
    module = type(sys)("jaxreg.of_a_test")
    module.Told = Told  # pyright: ignore[reportAttributeAccessIssue]
    module._scaled = _scaled  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "jaxreg.of_a_test", module)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "programs"
    keep_programs(folder)
    yield folder
    keep_programs(None)


def _traced(*args: Any, **kwargs: Any) -> tuple[Told, int]:
    """The answer of a process that has met nothing, and how often it traced."""
    before = num_traced
    if programs._STORE is not None:
        keep_programs(programs._STORE.folder)
    answer = kept_program(_scaled)(*args, **kwargs)
    return answer, num_traced - before


def _files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.program"))


def test_the_next_process_does_not_trace(store: Path):
    x = jnp.arange(3.0)
    first, traced = _traced(x, Huber(), 2.0)
    assert traced == 1
    again, traced = _traced(x + 1, Huber(), 2.0)
    assert traced == 0
    assert len(_files(store)) == 1
    np.testing.assert_array_equal(first.value["x"], [0, 2, 4])
    np.testing.assert_array_equal(again.value["x"], [2, 4, 6])
    assert float(again.value["n"]) == 6
    assert again.none is None
    assert again.name == "a"


def test_answers_are_on_a_device_for_good_where_what_was_given_is(store: Path):
    usual, put = jnp.arange(3.0), jax.device_put(jnp.arange(3.0), jax.devices()[0])
    told, _ = _traced(usual, Huber(), 2.0)
    assert not told.value["x"].committed
    assert told.value["x"].dtype == usual.dtype
    told, _ = _traced(put, Huber(), 2.0)
    assert told.value["x"].committed


def test_whatever_the_answer_depends_on_has_its_own_program(store: Path):
    x = jnp.arange(3, dtype=jnp.int32)
    calls: list[Any] = [
        ((x, Huber(), 2), {}),
        ((x, Huber(), True), {}),
        ((x, Huber(), 2.0), {}),
        ((x, jr.robust.Welsch(), 2), {}),
        ((x.astype(float), Huber(), 2), {}),
        ((x[:2], Huber(), 2), {}),
        ((x, Huber(), 2), {"name": "b"}),
    ]
    for count, (args, kwargs) in enumerate(calls, start=1):
        for traced in (1, 0):
            answer, found = _traced(*args, **kwargs)
            assert found == traced
            np.testing.assert_array_equal(answer.value["x"], args[2] * args[0])
            assert answer.name == kwargs.get("name", "a")
        assert len(_files(store)) == count
    with jax.enable_x64(True):
        assert _traced(jnp.arange(3, dtype=jnp.int32), Huber(), 2)[1] == 1


def test_transformations_see_the_function_itself(store: Path):
    scaled = kept_program(_scaled)
    x = jnp.arange(3.0)
    slope = jax.grad(lambda x: scaled(x, Huber(), 3.0).value["x"][1])(x)
    np.testing.assert_array_equal(slope, [0, 3, 0])
    many = jax.vmap(lambda x: scaled(x, Huber(), 3.0).value["n"])(x[:, None])
    np.testing.assert_array_equal(many, x)
    inside = jax.jit(lambda: scaled(x, Huber(), 3.0).value["n"])()
    assert float(inside) == 3
    spread = jax.device_put(x, jax.devices()[1])
    assert scaled(spread, Huber(), 3.0).value["x"].devices() == spread.devices()


def test_code_of_the_user_is_traced_each_time(store: Path):
    class Mine(Huber):
        pass

    assert _traced(jnp.arange(3.0), Mine(), 2.0)[1] == 1
    assert _traced(jnp.arange(3.0), lambda x: x, 2.0)[1] == 1
    assert _traced(jnp.arange(3.0), [lambda x: x], 2.0)[1] == 1
    assert not _files(store)


def test_what_a_user_did_wrong_is_said_as_before(store: Path):
    with pytest.raises(ValueError, match="wanted a vector"):
        kept_program(_scaled)(jnp.zeros((2, 2)), Huber(), 2.0)


@pytest.mark.parametrize("damage", ["cut", "turned", "empty", "other", "foreign"])
def test_a_damaged_file_is_traced_anew(store: Path, damage: str):
    x = jnp.arange(3.0)
    _traced(x, Huber(), 2.0)
    (path,) = _files(store)
    whole = path.read_bytes()
    turned = bytearray(whole)
    turned[len(turned) // 2] ^= 255
    content = {
        "cut": whole[: len(whole) // 2],
        "turned": bytes(turned),
        "empty": b"",
        "other": b"jaxreg program 0\n" + whole[17:],
    }
    if damage == "foreign":  # whole, but calls a function as it is read
        _write_foreign(path)
    else:
        path.write_bytes(content[damage])
    answer, traced = _traced(x, Huber(), 2.0)
    assert traced == 1
    np.testing.assert_array_equal(answer.value["x"], [0, 2, 4])
    assert _traced(x, Huber(), 2.0)[1] == 0  # it was written again


def _write_foreign(path: Path) -> None:
    class Exported:
        def serialize(self) -> bytes:
            return b""

    class Evil:
        def __reduce__(self) -> tuple:
            return os._exit, (1,)

    plain = program_files.pickled
    program_files.pickled = lambda x: __import__("pickle").dumps(x)
    try:
        program_files.write(path, Exported(), Evil())
    finally:
        program_files.pickled = plain


def test_a_folder_that_takes_nothing_is_told_of_once(tmp_path: Path):
    (tmp_path / "file").write_text("")
    keep_programs(tmp_path / "file" / "programs")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scaled = kept_program(_scaled)
        for n in (2, 3):
            answer = scaled(jnp.arange(float(n)), Huber(), 2.0)
            assert len(answer.value["x"]) == n
    assert len([w for w in caught if "programs cannot be kept" in str(w.message)]) == 1


def test_the_oldest_programs_make_room(store: Path, monkeypatch: pytest.MonkeyPatch):
    for n in range(2, 5):
        _traced(jnp.arange(float(n)), Huber(), 2.0)
    for age, path in enumerate(_files(store)):
        os.utime(path, (age, age))
    oldest, *others = _files(store)
    size = sum(p.stat().st_size for p in _files(store))
    monkeypatch.setattr(program_files, "_MOST_BYTES", size)
    _traced(jnp.arange(9.0), Huber(), 2.0)
    assert not oldest.exists()
    assert set(others) < set(_files(store))


def test_another_process_takes_what_one_has_traced(tmp_path: Path):
    code = """
import pathlib, sys
import jax, numpy as np
import jaxreg as jr
from jaxreg._core.programs import keep_programs

keep_programs(pathlib.Path(sys.argv[1]))
count = 0
plain = jax.monitoring.register_event_duration_secs_listener
def hear(event, seconds, **more):
    global count
    count += event.endswith("jaxpr_trace_duration") and seconds > 0.05
plain(hear)
graph = jr.PoseGraph.from_edges(
    [(0, 1), (1, 2), (0, 2)], np.tile(np.eye(3, dtype=np.float32), (3, 1, 1))
)
sol = jr.average(graph, jr.MotionAveraging())
print(count, np.asarray(sol.T_world_i).tobytes().hex(), repr(sol))
"""
    command = [sys.executable, "-c", code, str(tmp_path)]
    first, second = (
        subprocess.run(command, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert int(first.split()[0]) > 0
    assert int(second.split()[0]) == 0
    assert first.split()[1:] == second.split()[1:]
