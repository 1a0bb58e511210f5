"""Programs are dropped before the system ends a process that holds too many."""

import logging
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg._core import program_room
from jaxreg._core.programs import kept_program


num_traced = 0


@kept_program
def _doubled(x: jax.Array) -> jax.Array:
    global num_traced
    num_traced += 1
    return 2 * x


def _traced(num: int) -> int:
    """How often the function is traced for so many numbers."""
    before = num_traced
    np.testing.assert_array_equal(_doubled(jnp.arange(num)), 2 * np.arange(num))
    return num_traced - before


def test_where_there_is_room_programs_stay():
    assert [_traced(num) for num in (3, 4, 3, 4)] == [1, 1, 0, 0]


def test_where_there_is_none_they_are_dropped_and_it_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    caplog.set_level(logging.WARNING, "jaxreg")
    assert [_traced(num) for num in (5, 6)] == [1, 1]
    monkeypatch.setattr(program_room, "share_used", lambda: 0.7)
    assert _traced(5) == 1
    assert "70 % of the memory maps" in caplog.text
    # Counted once after something was compiled, not at each call.
    monkeypatch.setattr(program_room, "share_used", lambda: 0.5)
    assert [_traced(num) for num in (5, 6, 5)] == [0, 1, 0]
    monkeypatch.setattr(program_room, "share_used", lambda: pytest.fail("counted"))
    assert _traced(6) == 0


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is that of Linux")
def test_what_is_compiled_takes_room():
    before = program_room.share_used()
    jax.jit(lambda x: jnp.sort(x) + jnp.cumsum(x))(jnp.ones(1000)).block_until_ready()
    assert 0 < before < program_room.share_used() < 1


def test_what_the_system_does_not_tell_is_no_reason(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(program_room, "_MAPS", program_room.Path("/no/such/file"))
    assert program_room.share_used() == 0
