"""What a start imports: seconds of it are seconds of every command."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize("command", ["register", "multiview", "average"])
def test_commands_start_without_what_only_pictures_need(command: str):
    slow = ["scipy.stats", "scipy.spatial", "scipy.optimize", "scipy.special"]
    slow += ["plotly", "viser", "torch"]
    if command == "register":
        slow.append("jaxreg.averaging")
    if command == "average":  # no scans are read, none searched for
        slow += ["jaxreg.particle", "jaxreg.matching", "jaxreg.local"]
    code = f"""
import sys
import jaxreg.app.cli.{command}
print(*(name for name in {slow} if name in sys.modules))
"""
    told = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert told.stdout.split() == []


def test_imports_start_no_backend():
    code = """
import importlib, pkgutil
import jax
import jaxreg
for module in pkgutil.walk_packages(jaxreg.__path__, "jaxreg."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
print(len(jax._src.xla_bridge._backends))
"""
    told = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert told.stdout.split() == ["0"]
