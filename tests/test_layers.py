"""The layout is the architecture: imports point downward."""

import ast
import subprocess
import sys
from pathlib import Path

import jaxreg


PACKAGE = Path(jaxreg.__file__).parent

# A room imports from itself and from strictly lower layers. EDGE rooms are leaves:
# nothing below the command line imports them.
LAYERS = {
    "_core": 0,
    "geometry": 1,
    "robust": 1,
    "neighbours": 2,
    "graph": 2,
    "cloud": 3,
    "averaging": 3,
    "local": 4,
    "correlation": 5,
    "particle": 5,
    "registration": 6,
    "multiview": 7,
}
EDGES = {
    "metrics": {"_core", "geometry", "graph"},
    "io": {"_core", "geometry", "graph"},
    "datasets": {"_core"},
    "plot": {"_core", "io"},
    "cli": {
        "_core",
        "averaging",
        "datasets",
        "geometry",
        "graph",
        "io",
        "metrics",
        "plot",
    },
}
FACADE = {"__init__", "__main__"}


def _room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def _imported_rooms(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        rooms |= {n.split(".")[1] for n in names if n.startswith("jaxreg.")}
    return rooms - {_room(path)}


def test_imports_point_downward():
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        room = _room(path)
        if room in FACADE:
            continue
        for other in _imported_rooms(path):
            if room in EDGES:
                allowed = other in EDGES[room]
            else:
                allowed = other in LAYERS and LAYERS[other] < LAYERS[room]
            if not allowed:
                wrong.append(f"{path.relative_to(PACKAGE)} imports {other}")
    assert not wrong, "\n".join(wrong)


def test_every_room_has_a_layer():
    rooms = {_room(path) for path in PACKAGE.rglob("*.py")}
    assert rooms == set(LAYERS) | set(EDGES) | FACADE


def test_pictures_are_loaded_when_one_is_asked_for():
    # The one way up, by name, for the methods of solutions.
    by_name = [
        path.relative_to(PACKAGE).as_posix()
        for path in sorted(PACKAGE.rglob("*.py"))
        if _room(path) in LAYERS and "importlib" in path.read_text()
    ]
    assert by_name == ["_core/solution.py"]
    heavy = "{'matplotlib', 'plotly', 'rich', 'tyro', 'jaxreg.plot'}"
    code = f"import sys, jaxreg; sys.exit(str(set(sys.modules) & {heavy} or ''))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent
    )
    assert done.stderr.strip() == ""


def test_jaxlie_lives_behind_one_module():
    users = [
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if "jaxlie" in {n for n in _top_imports(path)}
    ]
    assert users == ["geometry/lie.py"]


def _top_imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names
