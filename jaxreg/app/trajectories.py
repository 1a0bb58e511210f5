"""Poses from files of every kind that is read here, told apart by name and content."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxreg._core.checks import check_rigid
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.io.errors import InputError
from jaxreg.io.files import reading, require_regular
from jaxreg.io.graphs.g2o import read_g2o_poses
from jaxreg.io.graphs.redwood import read_log
from jaxreg.io.poses.kitti import read_kitti
from jaxreg.io.poses.stanford import read_conf
from jaxreg.io.poses.tum import read_tum
from jaxreg.io.rows import numbers, read_lines


_KINDS = "result.json, TUM, KITTI, g2o, .conf, .log, or one 4 x 4 matrix"


class Trajectory(NamedTuple):
    """Poses, and what the file calls them.

    Attributes:
        T_world_i: `(v, d+1, d+1)` float64.
        names: of the scans, None for files that know numbers alone.
        stamps: `(v,)` float64: timestamps, ids, or 0, 1, 2, ... where there are none.
        timed: whether the stamps are in the file.
        pairs: the motions `T_i_j`, of a file of these: poses are then empty.
    """

    T_world_i: np.ndarray
    names: tuple[str, ...] | None
    stamps: np.ndarray
    timed: bool = False
    pairs: PoseGraph | None = None


def read_trajectory(path: Path) -> Trajectory:
    """Reads poses or, from a `.log` of pairs, motions.

    Of a result.json those of its model, component 0. A `.log` whose blocks are all of
    one frame each (`i i n`) holds poses, as those of Redwood do.

    Raises:
        InputError: if the file cannot be read, or holds no poses.
    """
    require_regular(path)
    suffix = path.suffix.lower()
    if suffix == ".json":
        return _of_json(path)
    if suffix == ".conf":
        found = read_conf(path)
        return _numbered(np.stack(list(found.values())), names=tuple(found))
    if suffix == ".g2o":
        ids, poses = read_g2o_poses(path)
        if poses is None:
            raise InputError(f"{path}: not every vertex has a pose.\nGive poses.")
        stamps = np.asarray(ids, np.float64)
        return Trajectory(np.asarray(poses, np.float64), None, stamps, True)
    if suffix == ".log":
        return _of_log(path)
    if suffix == ".npy":
        with reading(path, "NumPy", "Save poses of shape (v, 4, 4)."):
            return _numbered(_checked(np.load(path, allow_pickle=False), path))
    return _of_text(path)


def _numbered(T: np.ndarray, names: tuple[str, ...] | None = None) -> Trajectory:
    return Trajectory(T, names, np.arange(len(T), dtype=np.float64))


def _checked(T: Any, path: Path) -> np.ndarray:
    found = np.asarray(T, np.float64)
    found = found[None] if found.ndim == 2 else found
    if found.ndim != 3 or found.shape[1:] not in ((3, 3), (4, 4)) or not len(found):
        raise InputError(f"{path}: wanted poses (v, 4, 4), found {found.shape}.")
    try:
        check_rigid(found, str(path), scaled=True)
    except ValueError as err:
        raise InputError(str(err)) from err
    return found


def _of_json(path: Path) -> Trajectory:
    with reading(path, "result.json", "Give a result.json that jaxreg wrote."):
        document = json.loads(path.read_text(encoding="utf-8"))
        poses = document["T_world_i"]
        names = [str(name) for name in document["names"]]
        scans = document.get("scans") or [{}] * len(poses)
        keep = [
            k
            for k, (T, scan) in enumerate(zip(poses, scans, strict=True))
            if T is not None and scan.get("component", 0) == 0
        ]
        if not keep:
            raise InputError(f"{path}: holds no poses: {document.get('status')}.")
        T = _checked([poses[k] for k in keep], path)
        return Trajectory(
            T, tuple(names[k] for k in keep), np.array(keep, np.float64), True
        )


def _of_log(path: Path) -> Trajectory:
    graph_like = [words[:2] for _, words in read_lines(path)[::5]]
    if all(len(pair) == 2 and pair[0] == pair[1] for pair in graph_like):
        lines = read_lines(path)
        rows = [numbers(path, row, 4, "a row") for k, row in enumerate(lines) if k % 5]
        T = _checked(np.array(rows).reshape(-1, 4, 4), path)
        stamps = np.array([float(pair[0]) for pair in graph_like])
        return Trajectory(T, None, stamps, True)
    graph = read_log(path)
    return Trajectory(np.zeros((0, 4, 4)), None, np.zeros(0), pairs=graph)


def _of_text(path: Path) -> Trajectory:
    lines = read_lines(path)
    widths = {len(" ".join(words).replace(",", " ").split()) for _, words in lines}
    if widths == {8}:
        stamps, poses = read_tum(path)
        return Trajectory(np.asarray(poses, np.float64), None, stamps, True)
    if widths == {12}:
        return _numbered(np.asarray(read_kitti(path), np.float64))
    if len(lines) in (3, 4) and widths == {len(lines)}:
        rows = [numbers(path, line, len(lines), "a row") for line in lines]
        return _numbered(_checked(np.array(rows), path))
    raise InputError(f"{path}: holds no poses that are read here.\nWanted {_KINDS}.")
