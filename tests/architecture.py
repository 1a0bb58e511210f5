"""The floors of the package, and who imports whom: `python tests/architecture.py`.

A room is a folder or a file of `jaxreg`. It imports from its own room and from strictly
lower floors; the command draws every arrow, and marks those that climb.
"""

import ast
from pathlib import Path


PACKAGE = Path(__file__).parents[1] / "jaxreg"

#: Rooms by floor, the lowest first. A module belongs to the longest name that fits.
FLOORS: tuple[tuple[str, ...], ...] = (
    ("_core",),
    ("linear", "batching", "robust"),
    ("geometry",),
    ("neighbours", "graph"),
    ("cloud", "averaging.trace", "datasets", "metrics"),
    ("matching", "features", "averaging.measures"),
    ("registrar", "averaging.likelihood"),
    ("averaging.base",),
    ("local", "averaging.steps", "averaging.relaxation"),
    ("correlation", "particle", "averaging.start"),
    ("registration", "averaging.methods"),
    ("averaging",),
    ("multiview",),
    ("io.errors", "io.printable", "io.quaternions"),
    ("io.files",),
    ("io.extras", "io.rows", "io.atomic"),
    ("io.points",),
    ("io.poses", "io.graphs", "io.moved"),
    ("io",),
    ("__init__",),
    ("testing",),
    (
        "app.advice",
        "app.colors",
        "app.describe",
        "app.aligned",
        "app.folder",
        "app.pair_log",
        "app.trajectories",
        "app.versions",
    ),
    ("app.merge",),
    ("app.result",),
    ("app.plot",),
    ("app.views",),
    ("app",),
    ("__main__",),
)
FLOOR = {room: k for k, rooms in enumerate(FLOORS) for room in rooms}


def module_of(path: Path) -> str:
    """The dotted name of a file below the package."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)


def room_of(module: str) -> str | None:
    """The room of a module, None if no floor has it."""
    parts = module.split(".")
    names = (".".join(parts[:k]) for k in range(len(parts), 0, -1))
    return next((name for name in names if name in FLOOR), None)


def imported(path: Path) -> set[str]:
    """Modules of the package that a file imports, the package itself as `__init__`.

    A stub names what is imported at its first use, by relative imports.
    """
    found, stub = set(), path.suffix == ".pyi"
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == stub, f"{path}: relative import"
            home = [*path.parent.relative_to(PACKAGE.parent).parts] if stub else []
            module = ".".join([*home, *([node.module] if node.module else [])])
            names = [f"{module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        found |= {
            name.removeprefix("jaxreg").removeprefix(".") or "__init__"
            for name in names
            if name.split(".")[0] == "jaxreg"
        }
    return found


def arrows() -> dict[tuple[str, str], list[str]]:
    """The files that make each arrow between two rooms."""
    found: dict[tuple[str, str], list[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py*")):
        if path.suffix not in (".py", ".pyi"):
            continue
        source = room_of(module_of(path))
        for module in imported(path):
            # Only names of the package's own `__init__` belong to no room below it.
            target = room_of(module) or "__init__"
            if source is not None and target != source:
                files = found.setdefault((source, target), [])
                files.append(path.relative_to(PACKAGE).as_posix())
    return found


def climbs(source: str, target: str) -> bool:
    """Whether an arrow does not point to a strictly lower floor."""
    return FLOOR[target] >= FLOOR[source]


def main() -> None:
    """Draws the floors, the highest first, with the arrows of each room."""
    found = arrows()
    for number, rooms in reversed(list(enumerate(FLOORS))):
        for room in rooms:
            down = sorted((t for s, t in found if s == room), key=lambda t: -FLOOR[t])
            marked = [f"^{t}^" if climbs(room, t) else t for t in down]
            print(f"{number:3d}  {room:18s} -> {', '.join(marked)}")  # noqa: T201
    wrong = [pair for pair in found if climbs(*pair)]
    print(f"{len(found)} arrows, {len(wrong)} climb")  # noqa: T201


if __name__ == "__main__":
    main()
