"""What is known of poses: lines of a graph's file, `--control`, `--level`, `--fix`."""

from typing import Any

import equinox as eqx
import numpy as np
from rich.table import Table

from jaxreg.app.cli.guess import read_guess
from jaxreg.app.cli.known_files import (
    frame_of,
    names_of_control,
    read_control,
    read_levels,
)
from jaxreg.app.cli.options import Average, KnownOptions, Multiview
from jaxreg.app.cli.runtime import Session
from jaxreg.app.result import Result
from jaxreg.averaging import AveragingSolution, EdgeReport
from jaxreg.graph import PoseGraph
from jaxreg.io.errors import InputError
from jaxreg.io.graphs.g2o import read_g2o_known
from jaxreg.io.graphs.g2o_known import KnownOfGraph
from jaxreg.io.printable import printable


# So many loops tell a deviation within an eighth, 1 / sqrt(2 * 3 * 10).
_LOOPS = 10
#: Of no graph and no scan.
NOTHING = KnownOfGraph([], [], [])


def read_known(command: Average, ids: np.ndarray, d: int) -> KnownOfGraph:
    """All that is known; a pose of `--fix` takes the place of the file's."""
    known = NOTHING
    if command.graph.suffix.lower() != ".log":
        known = read_g2o_known(command.graph)
    return _with_options(known, command, ids, d)


def read_known_scans(command: Multiview, names: list[str], d: int) -> KnownOfGraph:
    """What the options tell of scans."""
    return _with_options(NOTHING, command, np.array(names), d)


def _with_options(
    known: KnownOfGraph, command: KnownOptions, ids: np.ndarray, d: int
) -> KnownOfGraph:
    fixed = dict(known.fixed)
    for words in command.fix:
        name, _, pose = words.partition("=")
        if not (name and pose):
            raise InputError(f"--fix {words}: wanted NAME=POSE.")
        frame = frame_of(name, ids, f"--fix {words}")
        fixed[frame] = read_guess(pose, ("", name), d, scaled=False, of="--fix")
    control = known.control
    if command.control is not None:
        control = control + read_control(command.control, ids, d)
    levels = [] if command.level is None else read_levels(command.level, ids, d)
    least = 2 if levels else d
    held = known.priors or fixed
    if (control or levels) and not held and len(control) < least:
        beside = " beside --level" if levels else ""
        raise InputError(
            f"--control: wanted at least {least} points{beside}, or a fixed pose, "
            f"found {len(control)}."
        )
    return KnownOfGraph(known.priors, list(fixed.items()), control, levels)


def of_middles(known: KnownOfGraph, middles: np.ndarray) -> KnownOfGraph:
    """Of scans that were moved to their middles."""
    fixed = []
    for frame, T in known.fixed:
        moved = np.array(T, np.float64)
        moved[:-1, -1] += moved[:-1, :-1] @ middles[frame]
        fixed.append((frame, moved))
    control = [(frame, p - middles[frame], *rest) for frame, p, *rest in known.control]
    return KnownOfGraph([], fixed, control, known.levels)


def with_shown_noise(graph: PoseGraph) -> tuple[PoseGraph, str]:
    """The graph, and a note if its edges tell no deviations: all have the identity.

    A metre and a radian would let any edge bend to what is known. What they show among
    each other is taken in place of it, if there are loops enough.
    """
    info = graph.information
    if info is None or np.any(np.asarray(info) != np.eye(info.shape[-1])):
        return graph, ""
    said = "All edges have the identity for their information: "
    if np.sum(graph.mask) - (graph.num_poses - 1) < _LOOPS:
        return graph, (
            f"{said}a deviation of 1 each way, so that they bend to whatever is known, "
            "also where it is wrong. Better deviations in the file mend that."
        )
    graph = eqx.tree_at(lambda g: g.information, graph, None)
    return graph, f"{said}in place of it their deviations are what their loops show."


def known_of_scans(
    known: KnownOfGraph, result: Result, trust: Any
) -> list[dict[str, Any]]:
    """How far control points and levels are off, and their trust, for result.json."""
    entries = []
    # Other components do not lie in the world.
    T_world_i = np.where(result.placed[:, None, None], result.T_world_i, np.nan)
    rows = [("control", *row) for row in known.control]
    rows += [("level", *row) for row in known.levels]
    for weight, (kind, frame, x, *told) in zip(np.asarray(trust), rows, strict=True):
        T = T_world_i[frame]
        if kind == "control":
            off = control_entry(T, x, *told)
        else:
            off = {"rotation": tilt(T[:-1, :-1], x)}
        name = result.names[frame]
        entries.append({"kind": kind, "frame": name, "weight": float(weight)} | off)
    return entries


def with_names(
    entries: list[dict[str, Any]], command: KnownOptions
) -> list[dict[str, Any]]:
    """The entries, control points of `--control` by the names that the file has."""
    names = [] if command.control is None else names_of_control(command.control)
    # Those that the graph's own file knows come before.
    before = sum(entry["kind"] == "control" for entry in entries) - len(names)
    told = iter([""] * before + names)
    each = ((x, next(told) if x["kind"] == "control" else "") for x in entries)
    return [x | {"name": name} if name else x for x, name in each]


def control_entry(
    T_world_i: np.ndarray,
    point: np.ndarray,
    surveyed: np.ndarray,
    information: np.ndarray | None = None,
) -> dict[str, Any]:
    """How far a pose puts a point from where it was surveyed, for result.json.

    `residual` is along the axes of the world, None where the pose is NaN, and
    `normalised_residual`, in standard deviations, None where these are not known.
    """
    T = np.asarray(T_world_i, np.float64)
    off = T[:-1, :-1] @ point + T[:-1, -1] - surveyed
    normalised = None
    if information is not None:
        normalised = np.sqrt(off @ information @ off / len(off))
    placed = bool(np.isfinite(off).all())
    return {
        "point": np.asarray(point).tolist(),
        "surveyed": np.asarray(surveyed).tolist(),
        "residual": off.tolist() if placed else None,
        "translation": float(np.linalg.norm(off)),
        "normalised_residual": None if normalised is None else float(normalised),
    }


def tilt(R: np.ndarray, up: np.ndarray) -> float:
    """The angle between what is up in a frame and the vertical, in radians."""
    x, y, z = R @ up
    return float(np.arctan2(np.hypot(x, y), z))


def is_told(known: KnownOfGraph) -> bool:
    """Whether anything is known."""
    return any(known)


def writable(session: Session, known: KnownOfGraph, d: int) -> KnownOfGraph:
    """What graph.g2o can hold; the points and levels that it cannot are counted."""
    control = [
        row for row in known.control if len(row) > 3 and (d == 3 or not row[1].any())
    ]
    missing = len(known.control) - len(control)
    if missing:
        session.console.print(
            f"graph.g2o lacks {missing} control points: of no known deviation, or in "
            "2D beside the origin of their frame."
        )
    if known.levels:
        session.console.print(f"graph.g2o lacks {len(known.levels)} levels.")
    return known._replace(control=control, levels=())


def known_entries(
    known: KnownOfGraph, sol: AveragingSolution, report: EdgeReport, ids: np.ndarray
) -> list[dict[str, Any]]:
    """How far what is known is off, and its trust, for result.json."""
    if sol.prior_weight is None:
        return []
    rows = {"prior": known.priors, "control": known.control, "level": known.levels}
    kinds = [(kind, row) for kind, some in rows.items() for row in some]
    first = len(report.edges) - len(kinds)
    weights = np.asarray(sol.prior_weight)
    placed = np.asarray(sol.placed)[:, None, None]
    T_world_i = np.where(placed, np.asarray(sol.T_world_i), np.nan)
    entries = []
    for n, (kind, row) in enumerate(kinds):
        off = {"translation": float(report.translation[first + n])}
        if kind == "level":
            off = {"rotation": float(report.rotation[first + n])}
        if kind == "control":
            off = control_entry(T_world_i[row[0]], *row[1:])
        entry = {"kind": kind, "frame": int(ids[row[0]]), "weight": float(weights[n])}
        normalised = {"normalised_residual": float(report.normalised[first + n])}
        entries.append(entry | off | normalised)
    return entries


def show_known(
    session: Session,
    entries: list[dict[str, Any]],
    known: KnownOfGraph,
    report: EdgeReport,
    ids: np.ndarray,
) -> None:
    """What became of all that was known; what is not trusted first."""
    if known.fixed:
        session.console.print(f"Poses held as they were given: {len(known.fixed)}.")
    fixed = [frame for frame, _ in known.fixed]
    own = ~np.isin(report.edges, fixed).all(axis=1)
    for frame in fixed:
        beside = own & (report.edges == frame).any(axis=1)
        if beside.any() and not report.trusted[beside].any():
            session.console.print(
                f"Frame {ids[frame]} is held where none of its motions fits: is its "
                "pose right?"
            )
    show_entries(session, entries)


def show_entries(session: Session, entries: list[dict[str, Any]]) -> None:
    """A table of what is known; what is not trusted first."""
    if not entries:
        return
    table = Table(title="Priors, control points and levels")
    named = any("name" in entry for entry in entries)
    for head in ("", *["name"][: int(named)], "frame", "off", "normalised", "trusted"):
        table.add_column(head, justify="right")
    order = sorted(entries, key=lambda x: x["weight"])
    for entry in order[:20]:
        normalised = entry.get("normalised_residual")
        table.add_row(
            entry["kind"],
            *[printable(entry.get("name", ""))][: int(named)],
            printable(str(entry["frame"])),
            _off(entry),
            "" if normalised is None else f"{normalised:.2f}",
            "yes" if entry["weight"] > 0.5 else "no",
        )
    session.console.print(table)


def _off(entry: dict[str, Any]) -> str:
    """A length, or of a level an angle."""
    if "translation" in entry:
        return f"{entry['translation']:.4g}"
    return f"{np.rad2deg(entry['rotation']):.4g} deg"
