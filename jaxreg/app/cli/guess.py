"""The initial guess of `jaxreg register --init`: a file, or the numbers themselves."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxreg._core.checks import check_rigid
from jaxreg.io.errors import InputError
from jaxreg.io.files import reading, require_regular
from jaxreg.io.rows import read_lines


def read_guess(
    text: str, names: tuple[str, str], dim: int, scaled: bool, of: str = "--init"
) -> np.ndarray:
    """`T_target_source`, `(d+1, d+1)` float64, between the frames of the files.

    Args:
        text: the numbers of the matrix by rows, its last one left out or not; or the
            name of a file that holds them as text or NPY, or of a result.json.
        names: of target and source, by which a result.json of many scans is asked.
        dim: of the scans.
        scaled: whether its rotation may be times a factor.
        of: the option that it belongs to.

    Raises:
        InputError: if there is no such file, or it holds no such motion.
    """
    words = text.replace(",", " ").split()
    try:
        found = np.array(words, dtype=np.float64)
        place = of
    except ValueError:
        found, place = _of_file(Path(text), names), f"{of} {text}"
    wanted = {dim * (dim + 1), (dim + 1) ** 2}
    if found.size not in wanted or not np.isfinite(found).all():
        raise InputError(
            f"{place}: wanted {(dim + 1) ** 2} finite numbers, found {found.size}.\n"
            f"Give the rows of the {dim + 1} x {dim + 1} matrix that maps source to "
            "target, in quotes, or a file of them."
        )
    T = np.eye(dim + 1)
    rows = found.reshape(-1, dim + 1)
    T[: len(rows)] = rows
    if not np.array_equal(T[-1], np.eye(dim + 1)[-1]):
        raise InputError(f"{place}: the last row of the matrix must be 0 ... 0 1.")
    try:
        check_rigid(T, place, scaled)
    except ValueError as err:
        more = "" if scaled else " --scale allows a factor."
        raise InputError(f"{err}{more}") from err
    return T


def _of_file(path: Path, names: tuple[str, str]) -> np.ndarray:
    require_regular(path)
    with reading(path, "motion", "Give a matrix as text, NPY, or a result.json."):
        if path.suffix == ".npy":
            return np.asarray(np.load(path, allow_pickle=False), np.float64).ravel()
        if path.suffix == ".json":
            document = json.loads(path.read_text(encoding="utf-8"))
            return _of_document(document, names, path).ravel()
        rows = [word.replace(",", " ") for _, row in read_lines(path) for word in row]
        return np.array(" ".join(rows).split(), np.float64)


def _of_document(document: Any, names: tuple[str, str], path: Path) -> np.ndarray:
    """From the poses of the two scans, or from the one motion that it holds."""
    if not isinstance(document, dict):
        return np.asarray(document, np.float64)
    poses = dict(zip(document["names"], document["T_world_i"], strict=True))
    target, source = (poses.get(name) for name in names)
    if target is not None and source is not None:
        return np.linalg.inv(np.asarray(target)) @ np.asarray(source)
    if document.get("T_target_source") is None:
        raise InputError(
            f"{path}: holds no poses of {names[0]} and {names[1]}.\n"
            f"It knows {', '.join(document['names'][:8])}."
        )
    return np.asarray(document["T_target_source"], np.float64)
