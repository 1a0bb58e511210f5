"""The documentation site builds without a warning; skipped without the extra `docs`."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob

import jaxreg as jr
from jaxreg.cloud import OTHER_UNIT
from jaxreg.correlation import ascent
from jaxreg.local import curvature
from jaxreg.multiview import which_join
from jaxreg.particle import conclude


ROOT = Path(__file__).parents[1]
#: What the table of statuses says of thresholds.
THRESHOLDS = {
    jr.Status.DEGENERATE: (curvature._DEGENERATE, ascent._FREE),
    jr.Status.LOW_OVERLAP: (float(jnp.asarray(jr.ParticleFilter().min_log_evidence)),),
    jr.Status.AMBIGUOUS: (conclude.LEAST_ODDS,),
    jr.Status.DISCONNECTED: (which_join._MIN_TRUST,),
    jr.Status.UNIT_DIFFERS: (OTHER_UNIT,),
}


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


def test_the_code_of_extending_keeps_its_promises(monkeypatch):
    text = (ROOT / "docs/pages/extending.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    module = ModuleType("extending")  # of which classes can be pickled
    monkeypatch.setitem(sys.modules, "extending", module)
    names = vars(module)
    for block in blocks:
        exec(compile(block, "extending.md", "exec"), names)
    # Checked, and of use: every part runs in a method.
    checks = {name for name in names if name.startswith("check_")}
    assert checks == {
        "check_averager",
        "check_kernel",
        "check_resampler",
        "check_residual",
    }
    target = blob(200, 3)
    method = jr.ICP(names["Height"](), names["PseudoHuber"](), max_steps=20)
    sol = jr.register(target + np.float32(0.02), target, method)
    np.testing.assert_allclose(sol.T_target_source[:3, 3], -0.02, atol=1e-3)


def test_tables_name_every_status_and_contract():
    text = (ROOT / "docs/pages/words.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([A-Z_]+) \| (\d+) \| (.*?) \|", text, re.MULTILINE)
    table = {name: int(value) for name, value, meaning in rows if meaning}
    assert table == {status.name: int(status) for status in jr.Status}
    for status, thresholds in THRESHOLDS.items():
        row = next(x for x in text.splitlines() if x.startswith(f"| {status.name} |"))
        for value in thresholds:
            assert re.search(rf"(?<![\d.]){value:g}(?![\d.]*\d)", row), (status, value)
    text = (ROOT / "docs/pages/extending.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(Abstract\w+)` \|[^|]*\| ([^|]*) \|", text, re.MULTILINE)
    contracts = {name for name in jr.__all__ if name.startswith("Abstract")}
    assert {name for name, _ in rows} == contracts
    for name, wanted in rows:
        cls = getattr(jr, name)
        methods = set(cls.__abstractmethods__)
        fields = set(cls.__abstractvars__) | set(cls.__abstractclassvars__)
        kinds = cls.__annotations__.items()
        open_to_all = {key for key, kind in kinds if "ClassVar" in str(kind)}
        fields |= {key for key in open_to_all if key not in vars(cls)}
        assert set(re.findall(r"`(\w+)`", wanted)) == methods | fields, name
