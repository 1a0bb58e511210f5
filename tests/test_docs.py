"""The documentation site builds without a warning; skipped without the extra `docs`."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest


ROOT = Path(__file__).parents[1]


def test_the_site_builds_without_warnings(tmp_path: Path):
    for package in ("material", "mkdocstrings", "mkdocs_jupyter"):
        pytest.importorskip(package)
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict"]
        + ["-f", str(ROOT / "docs" / "mkdocs.yml"), "-d", str(tmp_path / "site")],
        capture_output=True,
        text=True,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "site/reference/entry_points.html").read_text(encoding="utf-8")
    assert "without an initial guess" in page


def test_names_on_the_page_of_equations_exist():
    text = (ROOT / "docs/pages/equations.md").read_text(encoding="utf-8")
    for name in sorted(set(re.findall(r"`(jaxreg\.[\w.]+)`", text))):
        module, _, last = name.rpartition(".")
        try:
            importlib.import_module(name)
        except ModuleNotFoundError:
            owner, _, inner = module.rpartition(".")
            try:
                holder = importlib.import_module(module)
            except ModuleNotFoundError:
                holder = getattr(importlib.import_module(owner), inner)
            assert hasattr(holder, last), name
