"""The folder in which the tests of commands run."""

from pathlib import Path
from typing import Any

import pytest

import jaxreg


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder, and solvers that must not be reached."""
    monkeypatch.chdir(tmp_path)

    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("bad input reached the computation")

    monkeypatch.setattr(jaxreg, "reconstruct", never)
    monkeypatch.setattr(jaxreg, "register", never)
    return tmp_path
