"""The folder of compiled programs is used only if it is the user's alone."""

import os
from pathlib import Path

import jax
import pytest

from jaxreg.app.cli.runtime import keep_compiled_programs


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
    keep_compiled_programs()
    assert used == {}
