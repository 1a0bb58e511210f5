"""From solutions to results in the frames of the files; the tables on the screen."""

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.table import Table

from jaxreg._core.status import Status
from jaxreg.app.advice import terminal_advice
from jaxreg.app.aligned import write_aligned
from jaxreg.app.cli.inputs import Scans, look_of
from jaxreg.app.cli.options import ModelOptions, Register
from jaxreg.app.cli.runtime import Session
from jaxreg.app.folder import result_folder
from jaxreg.app.plot import write_report
from jaxreg.app.plot.drawing import Drawing
from jaxreg.app.plot.figure import draw_points, thinned
from jaxreg.app.result import Result, result_document, write_result
from jaxreg.io.errors import MissingExtraError
from jaxreg.io.printable import printable
from jaxreg.metrics import rotation_errors, translation_errors


#: The exit code where a computation ended, and its answer is not believed.
NOT_BELIEVED = 3


def uncentre(
    T: np.ndarray,
    to_middle: np.ndarray,
    from_middle: np.ndarray,
    scaled: bool = False,
) -> np.ndarray:
    """Motions between centred scans as motions between the scans themselves.

    Args:
        T: `(b, d+1, d+1)` maps one centred frame into another.
        to_middle: `(b, d)` or `(d,)` middle of the scan that it maps to.
        from_middle: `(b, d)` or `(d,)` middle of the scan that it maps from.
        scaled: whether rotations are times a factor, which they keep.

    Returns:
        `(b, d+1, d+1)` float64, the rotations orthonormal to float64; NaN where `T` is
        not finite.
    """
    out = np.array(T, dtype=np.float64)
    finite = np.isfinite(out).all(axis=(1, 2))
    out[~finite] = np.eye(out.shape[-1])
    U, sizes, Vt = np.linalg.svd(out[:, :-1, :-1])
    R = U @ Vt
    if scaled:
        R *= sizes.mean(axis=1)[:, None, None]
    out[:, :-1, :-1] = R
    turned = np.einsum(
        "bij,bj->bi", R, np.broadcast_to(from_middle, out[:, :-1, -1].shape)
    )
    out[:, :-1, -1] += to_middle - turned
    out[~finite] = np.nan
    return out


def write_files(
    session: Session,
    result: Result,
    scans: Sequence[np.ndarray],
    errors: dict[str, Any] | None = None,
    modes: tuple[np.ndarray, ...] | None = None,
    covariances: np.ndarray | None = None,
    read: Scans | None = None,
) -> Result:
    """Writes all files of a result into the folder of `--out`, or none.

    Where no two scans are joined the picture and the page show the likeliest pair.

    Args:
        session: the command.
        result: poses and pairs.
        scans: `(n_i, d)` arrays.
        errors: against a known truth, see `pose_errors`.
        modes: other poses of the second of two scans, for the page.
        covariances: `(v, k, k)` of the poses, for the page.
        read: where the scans are whole, if they are files.

    Returns:
        The result, which knows the files of whole scans.
    """
    shown = result.to_show()
    with result_folder(session.options.out) as staging, contextlib.ExitStack() as drawn:
        if shown is not None:
            with session.timed("write"):
                few = thinned(scans)
            told = few, shown.T_world_i, list(shown.names), shown.component
            file = staging / "figure.png"
            drawn.enter_context(drawn_beside(session, file, draw_points, *told))
        look = None
        if isinstance(session.options, ModelOptions) and read is not None:
            with session.timed("write"):
                look = look_of(read, session.options) if result.believed else None
                result = _with_aligned(session, staging, result, read)
        document = result_document(
            result,
            command=session.command,
            seed=session.options.seed,
            times={k: round(v, 3) for k, v in session.times.items()},
            errors=errors,
        )
        if isinstance(session.options, Register):
            T = result.T_file[1]
            document["T_target_source"] = T.tolist() if result.believed else None
        write_result(staging, result, scans, document, look)
        if shown is None:
            return result
        with page_or_message(session):
            write_report(
                staging / "report.html",
                scans,
                shown,
                modes=modes,
                covariances=covariances,
                errors=errors,
                details=page_details(session, document),
            )
    return result


@contextlib.contextmanager
def drawn_beside(
    session: Session, path: Path, draw: Callable[..., Any], *args: Any
) -> Iterator[None]:
    """A picture, drawn while the block writes other files; see `Drawing`."""
    with session.timed("write"):
        drawing = Drawing(path, draw, *args)
    try:
        yield
        with session.timed("write"):
            drawing.finish()
    except BaseException:
        drawing.stop()
        raise


def _with_aligned(
    session: Session, staging: Path, result: Result, read: Scans
) -> Result:
    """The result, its scans written whole: folders aligned, aligned_1, ...

    A file that has changed since it was read is left out, and named: what is in it now
    may lie elsewhere.
    """
    options = session.options
    assert isinstance(options, ModelOptions)
    if not (options.save_aligned and result.believed):
        return result
    same = np.array([scan.is_as_read for scan in read.files])
    for name in (scan.name for scan in read.files if not scan.is_as_read):
        session.console.print(f"{name}: has changed since it was read, not aligned.")
    names: list[str] = []
    for k in range(result.num_components):
        ids = np.flatnonzero((result.component == k) & same)
        folder = staging / (f"aligned_{k}" if k else "aligned")
        folder.mkdir()
        motions = {int(i): result.T_file[i] for i in ids}
        written = write_aligned(folder, read.files, motions)
        names += [f"{folder.name}/{name}" for name in written]
    return dataclasses.replace(result, aligned=tuple(names))


@contextlib.contextmanager
def page_or_message(session: Session) -> Iterator[None]:
    """Says that the page was left out if its library is missing: files go on."""
    try:
        yield
    except MissingExtraError as err:
        session.console.print(str(err))


def page_details(session: Session, document: dict[str, Any]) -> dict[str, Any]:
    """What the page tells of how a result was made: part of the document, settings."""
    options = dataclasses.asdict(session.options)
    unshown = ("seed", "quiet", "json", "out")
    settings = {k: _setting(v) for k, v in options.items() if k not in unshown}
    keys = ("command", "seed", "times_s", "versions")
    unit = options.get("unit") or ""
    if isinstance(unit, tuple):  # of a pair: that of the target
        unit = unit[-1]
    return {k: document[k] for k in keys} | {"settings": settings, "unit": unit}


def _setting(value: Any) -> str:
    parts = value if isinstance(value, tuple) else (value,)
    return ", ".join("none" if v is None else str(v) for v in parts)


def pose_errors(
    result: Result, names: Sequence[str], T_true_i: np.ndarray
) -> dict[str, Any] | None:
    """Errors against true poses, the first scan of a component being brought to its.

    Args:
        result: poses.
        names: the scans of which the truth is known.
        T_true_i: `(len(names), d+1, d+1)` true poses.

    Returns:
        Of the scans that have a pose and a known truth, by component: `names`,
        `component`, `e_R` (radians) and `e_t` (unit of the scans); their means
        `mean_e_R`, `mean_e_t` as in the MCC paper. None if there is no such scan.
    """
    row = {name: k for k, name in enumerate(names)}
    found: dict[str, list[Any]] = {k: [] for k in ("names", "component", "e_R", "e_t")}
    for component in range(result.num_components):
        known = [
            i
            for i, name in enumerate(result.names)
            if result.component[i] == component and name in row
        ]
        if not known:
            continue
        truth = T_true_i[[row[result.names[i]] for i in known]]
        # Relative to the first of them, so that float32 meets no large common offset.
        T_est = jnp.asarray(_relative(result.T_world_i[known]), float)
        T_true = jnp.asarray(_relative(truth), float)
        found["names"] += [result.names[i] for i in known]
        found["component"] += [component] * len(known)
        found["e_R"] += rotation_errors(T_est, T_true).tolist()
        found["e_t"] += translation_errors(T_est, T_true).tolist()
    if not found["names"]:
        return None
    means = {f"mean_{k}": float(np.mean(found[k])) for k in ("e_R", "e_t")}
    return {**found, **means}


def show_scans(session: Session, result: Result) -> None:
    """Prints a line for each scan and one for the whole."""
    table = Table(title="Scans", title_justify="left")
    for name in ("scan", "points", "dropped", "status", "best pair", "overlap"):
        table.add_column(name, justify="left" if "s" == name[0] else "right")
    for i, name in enumerate(result.names):
        row = result.best_pair(i)
        pair = "" if row is None else result.names[result.partner(i, row)]
        overlap = "" if row is None else f"{result.overlap[row]:.2f}"
        status = Status(int(result.scan_status[i])).name
        table.add_row(
            printable(name),
            f"{result.num_points[i]:,}",
            f"{result.num_dropped[i]:,}",
            status + _whereabouts(int(result.component[i])),
            printable(pair),
            overlap,
        )
    session.console.print(table)
    trusted = int(np.sum(result.weight > 0.5))
    session.console.print(
        f"{result.status.name}: {int(result.placed.sum())} of {len(result.names)} "
        f"scans placed, {trusted} of {len(result.edges)} pairs trusted."
    )
    for k in range(1, result.num_components):
        session.console.print(
            f"Component {k}: {int(np.sum(result.component == k))} scans that fit each "
            "other, but not the others: a model of its own."
        )
    if result.status != Status.CONVERGED:
        session.console.print(terminal_advice(result.status))


def _whereabouts(component: int) -> str:
    if component < 0:
        return ", not placed"
    return f", component {component}" if component else ""


def show_errors(session: Session, errors: dict[str, Any]) -> None:
    """Prints the errors against the truth, lengths in millimetres (scans in metres)."""
    table = Table(title="Errors against the truth", title_justify="left")
    table.add_column("scan")
    table.add_column("e_R [rad]", justify="right")
    table.add_column("e_t [mm]", justify="right")
    keys = ("names", "component", "e_R", "e_t")
    for name, k, e_R, e_t in zip(*(errors[key] for key in keys), strict=True):
        where = f"{printable(name)}{_whereabouts(k)}"
        table.add_row(where, f"{e_R:.5f}", f"{1e3 * e_t:.3f}")
    table.add_section()
    table.add_row(
        "mean", f"{errors['mean_e_R']:.5f}", f"{1e3 * errors['mean_e_t']:.3f}"
    )
    session.console.print(table)


def tell_failure(session: Session, result: Result, what: str, status: Status) -> int:
    """Says on standard error that nothing is believed; returns the exit code.

    Args:
        session: the command.
        result: whose files are written.
        what: the scans, for the message.
        status: why.
    """
    page = session.options.out / "report.html"
    look = f"\nThe best attempt, to look at: {page}" * page.exists()
    sys.stderr.write(f"jaxreg: {printable(what)}.\n{terminal_advice(status)}{look}\n")
    return NOT_BELIEVED


def show_end(session: Session, files: Sequence[str], folder: Path) -> None:
    """Prints what took how long and what was written, of the files there may be."""
    files = [name for name in files if (folder / name).exists()]
    whole = [name.partition("/")[0] for name in files if "/" in name]
    files = [name for name in files if "/" not in name]
    files += [f"{name}/ ({whole.count(name)} files)" for name in dict.fromkeys(whole)]
    parts = ", ".join(f"{name} {s:.1f} s" for name, s in session.times.items())
    session.console.print(f"Times: {parts}.")
    session.console.print(f"Written to {folder}: {', '.join(files)}.")


def _relative(T: np.ndarray) -> np.ndarray:
    return np.linalg.inv(T[0]) @ T
