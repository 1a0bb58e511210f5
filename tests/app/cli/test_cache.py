"""The folder of compiled programs is used only if it is the user's alone."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import jaxreg
from jaxreg._core import programs_ahead
from jaxreg._core.programs_ahead import THREAD, _Loading
from jaxreg.app.cli import runtime
from jaxreg.app.cli.runtime import Clock, keep_compiled_programs


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="modes of files")
def test_a_folder_that_others_may_write_to_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    used: dict[str, object] = {}
    monkeypatch.setattr(jax.config, "update", used.__setitem__)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "cache" / "jaxreg"
    keep_compiled_programs()
    assert used["jax_compilation_cache_dir"] == str(folder)
    assert folder.stat().st_mode & 0o077 == 0
    used.clear()
    folder.chmod(0o777)
    keep_compiled_programs()
    assert used == {}
    assert "others may write there" in capsys.readouterr().err
    folder.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(ValueError, match="others may write there"):
        jaxreg.cache()
    assert used == {}


def test_programs_are_kept_where_one_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    used: dict[str, object] = {}
    monkeypatch.setattr(jax.config, "update", used.__setitem__)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "named"))
    least = "jax_persistent_cache_min_compile_time_secs"
    monkeypatch.delenv(least.upper(), raising=False)
    assert jaxreg.cache() == tmp_path / "named"
    assert used == {least: 0.05}
    used.clear()
    monkeypatch.setenv(least.upper(), "2")
    assert jaxreg.cache() == tmp_path / "named"
    assert used == {}
    assert jaxreg.cache(tmp_path / "a" / "given") == tmp_path / "a" / "given"
    assert used["jax_compilation_cache_dir"] == str(tmp_path / "a" / "given")
    assert (tmp_path / "a" / "given").is_dir()


def test_damaged_programs_are_compiled_anew_and_told_of_once(tmp_path: Path):
    code = """
import pathlib, sys
import jax, jax.numpy as jnp
import jaxreg
from jaxreg.app.cli.runtime import keep_compiled_programs

keep_compiled_programs()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

def both():
    jax.clear_caches()
    return jax.jit(lambda x: x * 3)(2.0), jax.jit(lambda x: x + 5)(2.0)

both()
kept = sorted(pathlib.Path(sys.argv[1]).glob("*-cache"))
kept[0].write_bytes(kept[0].read_bytes()[:99])
for path in kept[1:]:
    path.write_bytes(bytes(range(256)))
print(len(kept) > 1, *map(float, both()))
"""
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    folder = tmp_path / "jaxreg"
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder)],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert done.stdout == "True 6.0 7.0\n"
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith(f"jaxreg: {folder}: programs kept there cannot be")


def test_a_cache_that_cannot_be_made_is_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    used: dict[str, object] = {}
    monkeypatch.setattr(jax.config, "update", used.__setitem__)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    keep_compiled_programs()
    assert used == {}


def test_what_is_loaded_ahead_counts_as_long_as_it_is_waited_for(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(programs_ahead, "has_room", lambda: True)
    clock = Clock()
    read = "/jax/compilation_cache/cache_retrieval_time_sec"
    thread = threading.Thread(target=clock.hear, args=(read, 5.0), name=THREAD)
    thread.start()
    thread.join()
    assert clock.seconds(since=-np.inf) == {}
    loading = _Loading(["a"], lambda name: time.sleep(0.2) or name)
    while not loading._begun:
        time.sleep(0.01)
    assert loading.take("a") == "a"
    assert 0 < clock.seconds(since=-np.inf)["load"] < 5


def test_programs_are_counted_once_by_how_they_were_made(
    monkeypatch: pytest.MonkeyPatch,
):
    # A clock that is told the time: a busy machine's pauses would count as programs'.
    now = [1000.0]
    monkeypatch.setattr(runtime, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    clock = Clock()
    lower, trace = "jaxpr_to_mlir_module_duration", "jaxpr_trace_duration"
    compiled = "/jax/core/compile/backend_compile_duration"
    for passed, event, seconds in [
        (1, f"/jax/core/compile/{trace}", 1.0),  # of a function within the next
        (29, f"/jax/core/compile/{trace}", 30.0),
        (5, "/jax/another/event", 5.0),
        (2, f"/jax/core/compile/{lower}", 2.0),
        (3, "/jax/compilation_cache/cache_retrieval_time_sec", 3.0),
        (1, compiled, 4.0),  # read, not compiled
    ]:
        now[0] += passed
        clock.hear(event, seconds)
    assert clock.seconds(since=-np.inf) == {"trace": 32.0, "load": 4.0}
    now[0] += 10
    clock.hear(compiled, 8.0)
    assert clock.seconds(since=-np.inf)["compile"] == 8.0
    assert clock.seconds(since=now[0]) == {}
