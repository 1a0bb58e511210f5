"""The layout is the architecture: imports point downward."""

import subprocess
import sys

from architecture import FLOOR, PACKAGE, arrows, climbs, module_of, room_of


def test_imports_point_downward():
    wrong = [
        f"{source} imports {target}: {', '.join(files)}"
        for (source, target), files in arrows().items()
        if climbs(source, target)
    ]
    assert not wrong, "\n".join(wrong)


def test_every_module_has_a_floor_and_every_room_a_module():
    modules = {module_of(path) for path in PACKAGE.rglob("*.py")}
    rooms = {module: room_of(module) for module in modules}
    assert [m for m, room in rooms.items() if room is None] == []
    assert set(rooms.values()) == set(FLOOR)


def test_linear_algebra_knows_arrays_alone():
    below = {target for source, target in arrows() if source == "linear"}
    assert below <= {"_core"}


def test_what_solves_loads_nothing_that_draws_or_parses():
    heavy = "{'matplotlib', 'plotly', 'rich', 'tyro', 'optimistix', 'jaxreg.app'}"
    code = (
        "import sys; from jaxreg import *; from jaxreg.io import *; "
        f"sys.exit(str(set(sys.modules) & {heavy} or ''))"
    )
    assert _said(code) == ""


def test_names_are_imported_when_they_are_used():
    heavy = "{'jax', 'numpy', 'scipy', 'equinox'}"
    code = (
        "import sys, jaxreg, jaxreg.io; "
        f"sys.exit(str(set(sys.modules) & {heavy} or ''))"
    )
    assert _said(code) == ""


def _said(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent
    )
    return done.stderr.strip()
