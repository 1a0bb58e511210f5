"""Two programs in a row: the answer of both, each compiled once, side by side."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg._core import programs_in_a_row
from jaxreg._core.program_room import drop_programs
from jaxreg._core.programs import keep_programs
from jaxreg._core.programs_ahead import THREAD
from jaxreg._core.programs_in_a_row import WAITED, kept_programs


class Told:
    """What JAX tells: where what was compiled, and how often one waited."""

    def __init__(self) -> None:
        self.compiled: list[tuple[str, bool]] = []
        self.waited: list[int] = []  # when how many were compiled

    def __call__(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        beside = threading.current_thread().name == THREAD
        if event == "/jax/core/compile/backend_compile_duration":
            self.compiled.append((str(kwargs["fun_name"]), beside))
        if event == WAITED:
            self.waited.append(len(self.compiled))


@pytest.fixture
def told() -> Iterator[Told]:
    told = Told()
    jax.monitoring.register_event_duration_secs_listener(told)
    yield told
    jax.monitoring.unregister_event_duration_listener(told)


@pytest.fixture(params=["kept", "not kept"])
def _store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[None]:
    if request.param == "kept":
        keep_programs(tmp_path)
    yield
    keep_programs(None)


@pytest.fixture(autouse=True)
def _with_room(monkeypatch: pytest.MonkeyPatch) -> None:
    # Whatever other tests of this process have compiled.
    monkeypatch.setattr(programs_in_a_row, "has_room", lambda: True)


def _doubled(x: Any, name: str) -> tuple[Any, dict[str, Any], str]:
    if x.ndim != 1:
        raise ValueError(f"x: wanted a vector, found {x.shape}.")
    return 2 * x, {"n": jnp.sum(x > 0)}, name


def _cubed(given: tuple[Any, dict[str, Any], str]) -> tuple[Any, Any, str]:
    x, more, name = given
    return x**3, more["n"], name + "!"


# Of this package, as far as a key can tell.
_doubled.__module__ = _cubed.__module__ = "jaxreg.of_a_test"


def _numbers(num: int) -> jax.Array:
    return jax.device_put(np.arange(num, dtype=np.float32))


def _both() -> Any:
    return kept_programs(_doubled, _cubed)


@pytest.mark.usefixtures("_store")
def test_both_are_compiled_once_the_first_in_a_thread(told: Told):
    call, x = _both(), _numbers(3)
    for _ in range(2):
        cubed, num, name = call(x, "a")
        np.testing.assert_array_equal(cubed, [0, 8, 64])
        assert (int(num), name) == (2, "a!")
    assert sorted(beside for _, beside in told.compiled) == [False, True]
    assert told.waited == [2]  # the second did not wait to be compiled
    call(_numbers(4), "a")
    assert len(told.compiled) == 4
    assert call(x, "b")[2] == "b!"
    drop_programs()
    told.compiled.clear()
    assert call(x, "a")[2] == "a!"
    assert sorted(beside for _, beside in told.compiled) == [False, True]


def test_what_is_kept_is_only_loaded(tmp_path: Path, told: Told):
    for _ in range(2):
        keep_programs(tmp_path)
        np.testing.assert_array_equal(_both()(_numbers(3), "a")[0], [0, 8, 64])
    keep_programs(None)
    assert len(told.waited) == 1


def test_transformed_they_are_as_any_function():
    call = _both()

    def summed(x: jax.Array) -> jax.Array:
        return jnp.sum(call(x, "a")[0])

    x = _numbers(3)
    np.testing.assert_allclose(jax.grad(summed)(x), [0, 24, 96])
    np.testing.assert_allclose(jax.jit(summed)(x), 72)
    batch = jnp.stack([x, 2 * x])
    np.testing.assert_allclose(jax.vmap(summed)(batch), [72, 576])


@pytest.mark.usefixtures("_store")
def test_a_mistake_is_told_as_it_is():
    with pytest.raises(ValueError, match=r"wanted a vector, found \(1, 3\)"):
        _both()(jnp.ones((1, 3)), "a")


def test_without_room_or_on_a_device_for_good_one_follows_the_other(
    told: Told, monkeypatch: pytest.MonkeyPatch
):
    x = jax.device_put(_numbers(3), jax.devices()[0])
    np.testing.assert_array_equal(_both()(x, "a")[0], [0, 8, 64])
    monkeypatch.setattr(programs_in_a_row, "has_room", lambda: False)
    np.testing.assert_array_equal(_both()(_numbers(3), "a")[0], [0, 8, 64])
    assert not told.waited
    assert not any(beside for _, beside in told.compiled)


def test_keys_between_them_are_compiled_for_when_they_are_there(told: Told):
    def key_of(x: Any) -> Any:
        return jax.random.key(x[0].astype(int)), x

    def drawn(given: Any) -> Any:
        return jax.random.uniform(given[0]) + jnp.sum(given[1])

    found = kept_programs(key_of, drawn)(_numbers(3))
    np.testing.assert_allclose(found, 3 + jax.random.uniform(jax.random.key(0)))
    assert len(told.waited) == 1


def test_a_program_that_cannot_be_compiled_beside_is_compiled_by_the_call(
    told: Told, monkeypatch: pytest.MonkeyPatch
):
    class Broken:
        def compile(self) -> None:
            raise RuntimeError("no")

    compiled_beside = programs_in_a_row._compiled_beside
    monkeypatch.setattr(
        programs_in_a_row, "_compiled_beside", lambda _: compiled_beside(Broken())
    )
    np.testing.assert_array_equal(_both()(_numbers(3), "a")[0], [0, 8, 64])
    assert len(told.waited) == 1
