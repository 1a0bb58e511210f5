"""The files of a result: result.json, and of each component poses, graph, points.

A `Result` is what a reconstruction or registration found, on the host and in float64,
in the frames and unit of the files that were read.
"""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxreg._core.status import Status
from jaxreg.app.advice import terminal_advice
from jaxreg.app.merge import Look, write_merged
from jaxreg.app.versions import versions
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.io.atomic import atomic_write
from jaxreg.io.graphs.g2o import write_g2o
from jaxreg.io.poses.tum import write_tum


_ROW = re.compile(r"\[[-+.,\d\seE]*\]")
#: Described by result.schema.json beside this file; a new number where keys change.
RESULT_FORMAT = "jaxreg result 1"
_PER_COMPONENT = ("poses.tum", "graph.g2o", "merged.ply")


@dataclass(frozen=True)
class Result:
    """Poses of scans and the pairs that they rest on.

    Attributes:
        names: of the `v` scans.
        T_world_i: `(v, d+1, d+1)` float64 poses, in a frame of each component's own.
        component: `(v,)` number of each scan's component: 0 is the model, others are
            models of their own, -1 means that the pose means nothing.
        status: of the whole.
        scan_status: `(v,)` of each scan.
        num_points: `(v,)` rows read.
        num_dropped: `(v,)` rows with NaN or inf, which were left out.
        edges: `(e, 2)` the pairs i, j that were evaluated.
        T_i_j: `(e, d+1, d+1)` float64, maps scan j into the frame of scan i.
        overlap: `(e,)` share of the points that have a partner.
        weight: `(e,)` final trust, 0 to 1.
        inlier_rmse: `(e,)` in the unit of the scans.
        trace: of the solution, for the page.
        units: `(v,)` what coordinates of the files were multiplied by, None for one.
        attempt: whether the poses are shown, but not believed.
        aligned: files of whole scans in the common frame.
        fixed: names of scans whose poses were held.
        known: of each control point or level `kind`, `frame`, `weight`, and how far it
            is off, `translation` or `rotation`, as result.schema.json says; None where
            the frame is that of the first scan.
        covariances: `(v, k, k)` of the poses relative to the first scan of their
            component, as `scan_covariances` gives them; None if there are too many.
    """

    names: list[str]
    T_world_i: np.ndarray
    component: np.ndarray
    status: Status
    scan_status: np.ndarray
    num_points: np.ndarray
    num_dropped: np.ndarray
    edges: np.ndarray
    T_i_j: np.ndarray
    overlap: np.ndarray
    weight: np.ndarray
    inlier_rmse: np.ndarray
    trace: Any = None
    units: np.ndarray | None = None
    attempt: bool = False
    aligned: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    known: list[dict[str, Any]] | None = None
    covariances: np.ndarray | None = None

    @property
    def placed(self) -> np.ndarray:
        """`(v,)` the scans of the model, component 0."""
        return self.component == 0

    @property
    def num_components(self) -> int:
        """At least one."""
        return int(self.component.max(initial=0)) + 1

    @property
    def files(self) -> list[str]:
        """Names of the files of the result, the picture and the page included."""
        if not self.believed:
            shown = ["figure.png", "report.html"] if self.to_show() else []
            return ["result.json", *shown]
        more = [
            file_of(name, k)
            for k in range(1, self.num_components)
            for name in _PER_COMPONENT
        ]
        return [
            "result.json",
            *_PER_COMPONENT,
            "figure.png",
            "report.html",
            *more,
            *self.aligned,
        ]

    @property
    def believed(self) -> bool:
        """Whether two scans are joined."""
        return int(self.placed.sum()) >= 2

    @property
    def T_file(self) -> np.ndarray:
        """`T_world_i` of the coordinates that the files have, in their own units."""
        out = np.array(self.T_world_i, np.float64)
        if self.units is not None:
            out[:, :-1, :-1] *= self.units[:, None, None]
        return out

    def to_show(self) -> "Result | None":
        """Itself; where no scans are joined the two that overlap most, if any."""
        finite = np.isfinite(self.T_i_j).all(axis=(1, 2)) & (self.overlap > 0)
        if self.believed or self.attempt:
            return self
        if not finite.any():
            return None
        row = int(np.argmax(np.where(finite, self.overlap, -1)))
        i, j = self.edges[row]
        T = np.array(self.T_world_i)
        T[i], T[j] = np.eye(T.shape[-1]), self.T_i_j[row]
        component = np.full(len(self.names), -1)
        component[[i, j]] = 0
        return replace(self, T_world_i=T, component=component, attempt=True, known=None)

    def best_pair(self, scan: int) -> int | None:
        """The row of the pair of this scan that overlaps most, None without pairs."""
        rows = np.flatnonzero((self.edges == scan).any(axis=1))
        return int(rows[np.argmax(self.overlap[rows])]) if len(rows) else None

    def partner(self, scan: int, row: int) -> int:
        """The other scan of a pair."""
        i, j = self.edges[row]
        return int(j if i == scan else i)


def result_document(
    result: Result,
    *,
    command: str,
    seed: int,
    times: dict[str, float],
    errors: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """What result.json holds: plain lists and numbers, null for what has no value.

    Args:
        result: poses and pairs.
        command: the command line that made it.
        seed: of the random numbers.
        times: seconds by name.
        errors: against a known truth, or None.
    """
    document = {
        "format": RESULT_FORMAT,
        "command": command,
        "seed": seed,
        "status": result.status.name,
        "advice": terminal_advice(result.status),
        "names": result.names,
        "T_world_i": [
            T.tolist() if ok else None
            for T, ok in zip(result.T_file, result.component >= 0, strict=True)
        ],
        "scans": [_scan_entry(result, i) for i in range(len(result.names))],
        "pairs": [_pair_entry(result, e) for e in range(len(result.edges))],
        "times_s": times,
        "versions": versions(),
        "files": result.files,
    }
    if result.known is not None:
        document |= {"fixed": list(result.fixed), "known": result.known}
    return document if errors is None else {**document, "errors": errors}


def write_json(path: str | Path, document: dict[str, Any]) -> None:
    """Writes a document as JSON; numbers that are not finite become null."""
    text = json.dumps(without_nan(document), indent=1, allow_nan=False)
    # Rows of matrices on one line, so that a person can read them.
    text = _ROW.sub(lambda row: " ".join(row[0].split()), text)
    with atomic_write(path) as file:
        file.write(text + "\n")


def write_result(
    folder: str | Path,
    result: Result,
    scans: Sequence[np.ndarray],
    document: dict[str, Any],
    look: Look | None = None,
) -> None:
    """Writes result.json, poses.tum, graph.g2o and merged.ply into an existing folder.

    Components beside the model have files of their own, see `file_of`; scans alone are
    in result.json only, as is a result that joins no two of them. In poses.tum the
    timestamp, in graph.g2o the id is the number of the scan. graph.g2o holds the pairs
    that are trusted, the information being the trust times the identity.

    Raises:
        InputError: if a file cannot be written.
        MissingExtraError: if plyfile is not installed.
    """
    folder = Path(folder)
    write_json(folder / "result.json", document)
    if not result.believed:
        return
    for k in range(result.num_components):
        member = result.component == k
        model = folder / file_of("merged.ply", k)
        write_merged(model, scans, result.T_world_i, member, look)
        ids = np.flatnonzero(member)
        graph = _trusted_graph(result, ids)
        # Files keep the digits of float64 whatever the precision of the computation.
        with jax.enable_x64(True):
            T_world_i = jax.device_put(_rigid(result.T_world_i[ids]))
            write_tum(folder / file_of("poses.tum", k), T_world_i, timestamps=ids)
            write_g2o(folder / file_of("graph.g2o", k), graph, T_world_i, ids)


def file_of(name: str, component: int) -> str:
    """The name of a component's file: merged.ply, merged_1.ply, ..."""
    stem, _, suffix = name.rpartition(".")
    return f"{stem}_{component}.{suffix}" if component else name


def _scan_entry(result: Result, i: int) -> dict[str, Any]:
    status = Status(int(result.scan_status[i]))
    row = result.best_pair(i)
    best = None if row is None else _pair_entry(result, row, motion=False)
    entry = {
        "name": result.names[i],
        "placed": bool(result.placed[i]),
        "component": int(result.component[i]),
        "status": status.name,
        "advice": terminal_advice(status),
        "num_points": int(result.num_points[i]),
        "num_dropped": int(result.num_dropped[i]),
        "best_pair": best,
    }
    if result.covariances is not None:
        known = np.isfinite(result.covariances[i]).all()
        entry["covariance"] = result.covariances[i].tolist() if known else None
    return entry


def _pair_entry(result: Result, e: int, motion: bool = True) -> dict[str, Any]:
    i, j = (int(k) for k in result.edges[e])
    entry: dict[str, Any] = {
        "i": result.names[i],
        "j": result.names[j],
        "overlap": float(result.overlap[e]),
        "weight": float(result.weight[e]),
        "inlier_rmse": float(result.inlier_rmse[e]),
    }
    if not motion:
        return entry
    T = np.array(result.T_i_j[e], np.float64)
    if result.units is not None:  # between coordinates as the files have them
        T[:-1] /= result.units[i]
        T[:-1, :-1] *= result.units[j]
    return {**entry, "T_i_j": T.tolist()}


def _trusted_graph(result: Result, ids: np.ndarray) -> PoseGraph:
    number = np.full(len(result.names), -1)
    number[ids] = np.arange(len(ids))
    edges = number[result.edges]
    keep = (edges >= 0).all(axis=1) & (result.weight > 1e-6)
    return PoseGraph.from_edges(
        edges[keep],
        _rigid(result.T_i_j[keep]),
        num_poses=len(ids),
        weight=result.weight[keep],
    )


def _rigid(T: np.ndarray) -> np.ndarray:
    """Motions without the factor of their rotations, which pose files do not know."""
    out = np.array(T, np.float64)
    d = out.shape[-1] - 1
    size = np.abs(np.linalg.det(out[:, :d, :d])) ** (1 / d)
    scaled = np.abs(size - 1) > 1e-6
    out[scaled, :d, :d] /= size[scaled, None, None]
    return out


def without_nan(value: Any) -> Any:
    """Dicts and lists for JSON: numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(k): without_nan(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
