"""What a file of points or poses holds: counts, extent, spacing, a word on units.

Libraries are imported where they are used: a scan needs no JAX, a graph no k-d tree.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.graphs.g2o_file import KINDS, parse
from jaxreg.io.points.columns import COLORS, NORMALS, named
from jaxreg.io.points.read import NamedPoints, read_named


_MAX_POINTS = 5_000_000
#: All distances among so many points take less than the import of SciPy, 0.2 s.
_FEW = 2000
GRAPHS = (".g2o", ".g2o.gz", ".graph")


@dataclass(frozen=True)
class ScanFacts:
    """One scan.

    Attributes:
        name: of the file, or the key within an archive.
        num_points: rows, those with NaN or inf included; about, if `step` is over 1.
        step: of how many rows of a large file one was looked at.
        dim: 2 or 3.
        dtype: float32 or float64, as `read_points` has it.
        fields: names of the columns or properties, empty if the file names none.
        low: `(d,)` least coordinates of the finite rows; empty without such rows.
        high: `(d,)` largest.
        spacing: median distance to the nearest other point, on a part of the points;
            of a large file larger than in it; None with fewer than two distinct points.
        non_finite: share of the rows with NaN or inf.
        has_normals: whether the fields hold normals.
        has_colors: whether the fields hold colours.
        hint: what the numbers say about the unit; may be empty.
    """

    name: str
    num_points: int
    step: int
    dim: int
    dtype: str
    fields: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    spacing: float | None
    non_finite: float
    has_normals: bool
    has_colors: bool
    hint: str

    @property
    def extent(self) -> tuple[float, ...]:
        """Length per axis."""
        return tuple(b - a for a, b in zip(self.low, self.high, strict=True))


@dataclass(frozen=True)
class GraphFacts:
    """A pose graph: poses named, edges, dimension, and lines that mean nothing here."""

    num_poses: int
    num_edges: int
    dim: int
    has_initial_poses: bool
    unknown_lines: dict[str, int]


def describe(path: str | Path) -> list[ScanFacts] | GraphFacts:
    """Reads a file and tells what is in it; lengths in the unit of the file.

    Of scans with more than five million points some are looked at.

    Raises:
        InputError: if the file cannot be read or its kind is unknown.
        MissingExtraError: if a package that is needed for it is not installed.
    """
    if str(path).lower().endswith(GRAPHS):
        return _graph(Path(path))
    return [_scan(name, scan) for name, scan in read_named(path, _MAX_POINTS).items()]


def unit_notes(facts: Sequence[tuple[str, ScanFacts]]) -> list[str]:
    """Names two scans whose extents and spacings differ by about 1000: mm beside m.

    Args:
        facts: place (for the message) and facts of each scan.
    """
    sizes = [(place, max(f.extent), f.spacing) for place, f in facts if f.spacing]
    for (one, a, gap_a), (other, b, gap_b) in combinations(sizes, 2):
        ratios = (a / b, gap_a / gap_b)
        if all(500 < max(r, 1 / r) < 2000 for r in ratios):
            return [
                f"{one} and {other} have extents {a:.4g} and {b:.4g}: perhaps the same "
                "scans in metres and in millimetres. Bring all scans to one unit."
            ]
    return []


def _scan(name: str, scan: NamedPoints) -> ScanFacts:
    points = scan.points
    finite = points[np.isfinite(points).all(axis=1)]
    low, high = (
        (finite.min(axis=0).astype(float), finite.max(axis=0).astype(float))
        if len(finite)
        else (np.zeros(0), np.zeros(0))
    )
    spacing = _spacing(finite)
    return ScanFacts(
        name=name,
        num_points=len(points) * scan.step,
        step=scan.step,
        dim=points.shape[1],
        dtype=str(points.dtype),
        fields=scan.fields,
        low=tuple(low.tolist()),
        high=tuple(high.tolist()),
        spacing=spacing,
        non_finite=1 - len(finite) / len(points),
        has_normals=named(scan.fields, NORMALS) is not None,
        has_colors=named(scan.fields, COLORS) is not None,
        hint=_hint(low, high, spacing, points.dtype) if spacing else "",
    )


def _spacing(points: np.ndarray, parts: int = 5, size: int = 40_000) -> float | None:
    """Median distance to the nearest neighbour, from slices along the longest axis.

    The queries lie in the middle of a slice, so that their neighbours lie in it too.
    """
    if len(points) < 2:
        return None
    order = np.argsort(points[:, np.argmax(np.ptp(points, axis=0))])
    if len(points) <= parts * size:
        slices = [order]
    else:
        starts = np.linspace(0, len(points) - size, parts).astype(int)
        slices = [order[k : k + size] for k in starts]
    found = []
    for rows in slices:
        part = points[rows].astype(np.float64)
        margin = 0 if len(slices) == 1 else len(part) // 4
        middle = part[margin : len(part) - margin]
        queries = middle[:: max(1, len(middle) * len(slices) // 4000)]
        distinct = np.unique(part, axis=0)
        if len(distinct) > 1:
            found.append(_next_nearest(queries, distinct))
    return float(np.median(np.concatenate(found))) if found else None


def _next_nearest(queries: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances to the nearest but one, the queries being among the points."""
    if len(points) > _FEW:
        from scipy.spatial import KDTree

        return KDTree(points).query(queries, k=2)[0][:, 1]
    # By hand: what a small file holds is told before SciPy has been imported.
    sq = np.zeros((len(queries), len(points)))
    for a, b in zip(queries.T, points.T, strict=True):
        sq += (a[:, None] - b) ** 2
    return np.sqrt(np.partition(sq, 1, axis=1)[:, 1])


def _hint(low: np.ndarray, high: np.ndarray, spacing: float, dtype: np.dtype) -> str:
    extent, far = float((high - low).max()), float(np.abs([low, high]).max())
    parts = []
    if far > 1e5 and far > 10 * extent:
        parts.append("far from the origin, as map coordinates in metres are")
    elif 150 <= extent <= 5000 and 0.05 <= spacing <= 20:
        parts.append(
            f"millimetres, if this is an object {extent / 1000:.2g} m large; metres, "
            f"if it is a site {extent:.0f} m wide"
        )
    elif 0.01 <= extent <= 10 and spacing < 0.1:
        parts.append("metres, if this is an object or a room")
    if dtype == np.float32 and np.spacing(np.float32(far)) > 0.1 * spacing:
        parts.append(
            f"float32 holds steps of {np.spacing(np.float32(far)):.2g} here: too "
            "coarse for these points, export them as float64"
        )
    return "; ".join(parts)


def _graph(path: Path) -> GraphFacts:
    if path.suffix == ".graph":
        from jaxreg.io.graphs.toro import read_toro

        graph = read_toro(path)
        return GraphFacts(graph.num_poses, graph.num_edges, graph.dim, False, {})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it counts the lines that are counted below
        file = parse(path)
    if not len(file.edges.line):
        raise InputError(f"{path}: holds no EDGE_SE2 or EDGE_SE3:QUAT line.")
    counts = {tag: len(rows) for tag, rows in file.lines.found.items()}
    return GraphFacts(
        num_poses=len(file.ids),
        num_edges=len(file.edges.line),
        dim=file.dim,
        has_initial_poses=file.places() is not None,
        unknown_lines={tag: n for tag, n in counts.items() if n and tag not in KINDS},
    )
