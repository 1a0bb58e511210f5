"""Scans for the commands: read, checked, and moved near the origin."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxreg.app.aligned import ScanFile, scan_file, state_of
from jaxreg.app.cli.options import ModelOptions
from jaxreg.app.merge import Look
from jaxreg.cloud import OTHER_UNIT
from jaxreg.io.errors import InputError
from jaxreg.io.points.attributes import read_attributes
from jaxreg.io.points.read import (
    notes_on_skipped,
    point_files,
    read_named,
    split_key,
    unique_names,
)
from jaxreg.io.rows import numbers, read_lines


# Registration draws some thousand points of a scan, pictures some hundred thousand.
_MAX_POINTS = 2_000_000


@dataclass(frozen=True)
class Scans:
    """Scans as they were read, and where each came from.

    Attributes:
        names: unique names.
        points: `(n_i, d)` arrays, rows with NaN or inf included.
        places: file, and key or file name within, for messages.
        notes: what was left out of them.
        files: where each is whole, with its key in an archive.
        fields: names of the columns of each file.
        steps: of how many rows of each one was read.
    """

    names: list[str]
    points: list[np.ndarray]
    places: list[str]
    notes: tuple[str, ...] = ()
    files: tuple[ScanFile, ...] = ()
    fields: tuple[tuple[str, ...], ...] = ()
    steps: tuple[int, ...] = ()

    def centred(self) -> tuple[list[np.ndarray], np.ndarray]:
        """Scans moved to their own middles, and these, `(v, d)` float64.

        The former in the precision that JAX computes in. Map coordinates of seven
        digits before the point are thereby cut to float32 without loss: the
        subtraction is in float64.
        """
        dtype = jnp.result_type(float)
        middles = [
            np.median(x[np.isfinite(x).all(axis=1)].astype(np.float64), axis=0)
            for x in self.points
        ]
        moved = [
            (x.astype(np.float64) - c).astype(dtype)
            for x, c in zip(self.points, middles, strict=True)
        ]
        return moved, np.stack(middles)

    def check_viewpoint(
        self, viewpoint: tuple[float, ...] | None, units: Sequence[float] | None = None
    ) -> None:
        """Requires a place that is none of the points, or none.

        Args:
            viewpoint: `--viewpoint`, in the unit of each file.
            units: as in `load_scans`.
        """
        check_point(viewpoint, self.points[0].shape[1], "--viewpoint")
        if viewpoint is None:
            return
        units = [1.0] * len(self.points) if units is None else units
        for points, place, unit in zip(self.points, self.places, units, strict=True):
            if np.any(np.all(points == unit * np.asarray(viewpoint), axis=1)):
                raise InputError(
                    f"{place}: has points at --viewpoint.\n"
                    "Leave out rows that stand for missing returns."
                )


def load_scans(
    paths: Sequence[Path],
    units: Sequence[float] | None = None,
    *,
    any_size: bool = False,
) -> Scans:
    """Reads the scans of a command line and refuses what cannot be registered.

    Args:
        paths: files, folders, archives.
        units: a factor for each path, which its coordinates are multiplied by.
        any_size: the scans may be of any sizes, as their scale is looked for.

    Raises:
        InputError: if a file cannot be read, there are fewer than two scans, 2D and 3D
            are mixed, a scan is far larger or smaller than the others, or has fewer
            than d + 1 distinct finite points.
    """
    names: list[str] = []
    points: list[np.ndarray] = []
    places: list[str] = []
    notes: list[str] = []
    files: list[ScanFile] = []
    fields: list[tuple[str, ...]] = []
    steps: list[int] = []
    for path, unit in zip(paths, units or [1.0] * len(paths), strict=True):
        notes += notes_on_skipped(path)
        found = [
            (file, state, *item)
            for file in point_files(path)
            for state in [state_of(split_key(file)[0])]
            for item in read_named(file, _MAX_POINTS).items()
        ]
        alone = len(found) == 1 and not path.is_dir()
        for file, state, name, scan in found:
            names.append(name)
            files.append(scan_file(file, name, state))
            fields.append(scan.fields)
            steps.append(scan.step)
            points.append(scan.points if unit == 1 else unit * scan.points)
            places.append(str(path) if alone else f"{path} ({name})")
            if scan.step > 1:
                notes.append(
                    f"{places[-1]}: large, one of {scan.step} points is used, "
                    f"{len(scan.points):,} in all."
                )
    names = unique_names(names)
    named = (x._replace(name=n) for x, n in zip(files, names, strict=True))
    more = tuple(notes), tuple(named), tuple(fields), tuple(steps)
    scans = Scans(names, points, places, *more)
    _require_two(scans)
    _require_one_dimension(scans)
    if not any_size:
        _require_one_unit(scans)
    for place, array in zip(scans.places, scans.points, strict=True):
        _require_points(place, array)
    return scans


def look_of(scans: Scans, options: ModelOptions) -> Look:
    """Colours and normals of the points that were read, as the options want them."""
    found = [
        read_attributes(file.file, fields if file.is_as_read else (), step, file.key)
        for file, fields, step in zip(
            scans.files, scans.fields, scans.steps, strict=True
        )
    ]
    fits = [
        [x is not None and len(x) == len(points) for x in some]
        for some, points in zip(found, scans.points, strict=True)
    ]
    own = options.color == "own"
    return Look(
        [
            a.colors if own and ok[1] else None
            for a, ok in zip(found, fits, strict=True)
        ],
        [a.normals if ok[0] else None for a, ok in zip(found, fits, strict=True)],
        options.voxel,
    )


def _require_two(scans: Scans) -> None:
    if len(scans.names) < 2:
        raise InputError(
            f"{scans.places[0]}: this is one scan alone.\n"
            "Give two or more: several files, a folder, or an NPZ file of scans."
        )


def _require_one_dimension(scans: Scans) -> None:
    first = scans.points[0].shape[1]
    for place, array in zip(scans.places, scans.points, strict=True):
        if array.shape[1] != first:
            raise InputError(
                f"{place}: is {array.shape[1]}D, but {scans.places[0]} is {first}D.\n"
                "Register 2D scans and 3D scans apart."
            )


def _require_one_unit(scans: Scans) -> None:
    extents = np.array([_extent(x) for x in scans.points])
    usual = np.median(extents) if len(extents) > 2 else extents.max()
    for place, extent in zip(scans.places, extents, strict=True):
        ratio = extent / usual if usual > 0 else 1.0
        if ratio > OTHER_UNIT or 0 < ratio < 1 / OTHER_UNIT:
            if len(extents) == 2:
                others = f"the other {usual:.4g}"
                advice = "Name both units: register --unit mm m."
            else:
                others = f"the others about {usual:.4g}"
                advice = "Scale it to the unit of the others, or leave it out."
            raise InputError(
                f"{place}: spans {extent:.4g}, {others}: is it in another unit?\n"
                f"{advice}"
            )


def _extent(points: np.ndarray) -> float:
    finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    return float(np.linalg.norm(np.ptp(finite, axis=0))) if len(finite) else 0.0


def _require_points(place: str, array: np.ndarray) -> None:
    finite = array[np.isfinite(array).all(axis=1)]
    wanted = array.shape[1] + 1
    distinct = len(np.unique(finite[:10_000], axis=0))
    if distinct < wanted:
        distinct = len(np.unique(finite, axis=0))
    if distinct < wanted:
        raise InputError(
            f"{place}: holds {distinct} distinct finite points of {len(array)} rows, "
            f"at least {wanted} are needed.\nExport the scan again, or leave it out."
        )


def check_point(found: tuple[float, ...] | None, dim: int, option: str) -> None:
    """Requires as many finite numbers as the scans have dimensions, or none."""
    if found is None:
        return
    if len(found) != dim or not np.all(np.isfinite(found)):
        numbers = " ".join(map(str, found))
        raise InputError(f"{option}: wanted {dim} finite numbers, found {numbers}.")


def read_positions(path: Path, scans: Scans) -> np.ndarray:
    """Lines `NAME X Y [Z]`, one for each scan; `(v, d)` float64 in their order.

    Raises:
        InputError: for a file that cannot be read, a line that makes no sense, and a
            scan that has none.
    """
    dim = scans.points[0].shape[1]
    found: dict[str, np.ndarray] = {}
    for number, (name, *words) in read_lines(path):
        found[name] = numbers(path, (number, words), dim, f"the position of {name}")
    missing = [name for name in scans.names if name not in found]
    if missing:
        raise InputError(
            f"{path}: has no position of {', '.join(missing[:3])}"
            f"{', ...' if len(missing) > 3 else ''}.\n"
            f"Give a line NAME {' '.join('XYZ'[:dim])} for each scan."
        )
    return np.stack([found[name] for name in scans.names])
