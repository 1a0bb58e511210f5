"""What the pages of scans and of graphs have in common."""

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxreg._core.status import Status
from jaxreg.app.advice import terminal_advice
from jaxreg.app.versions import versions


# The chi-squared law's, in the plane and in space: SciPy takes 0.14 s to import.
_CHI2_95 = {2: 5.9915, 3: 7.8147}


def status_entry(status: Status, at_terminal: bool = False) -> dict[str, str]:
    """Name and advice, which for commands names options."""
    advice = terminal_advice(status) if at_terminal else status.advice
    return {"name": status.name, "advice": advice}


def deviations(covariances: Any, num: int) -> np.ndarray:
    """`(v, 2)` standard deviations: of the position, and of the rotation in radians."""
    if covariances is None:
        return np.full((num, 2), np.nan)
    C = np.asarray(covariances, np.float64)
    variance = np.diagonal(C, axis1=1, axis2=2)
    d = 2 if C.shape[-1] == 3 else 3
    return np.sqrt(
        np.stack([variance[:, :d].sum(axis=1), variance[:, d:].sum(axis=1)], axis=1)
    )


def error_ellipsoid(
    covariance: np.ndarray, T_world_i: np.ndarray, points: np.ndarray
) -> dict[str, Any]:
    """Where the middle of a scan may lie with 95 %: `middle` and `axes`, in the world.

    Args:
        covariance: `(k, k)` as `scan_covariances` gives it.
        T_world_i: the pose.
        points: `(n, d)` the scan.
    """
    d = points.shape[1]
    R, t = T_world_i[:d, :d], T_world_i[:d, d]
    middle = points[np.isfinite(points).all(axis=1)].mean(axis=0)
    value, vector = np.linalg.eigh(covariance[:d, :d])
    reach = np.sqrt(_CHI2_95[d] * np.maximum(value, 0))
    return {
        "middle": (R @ middle + t).tolist(),
        "axes": (R @ vector * reach).T.tolist(),
    }


def control_rows(
    known: Sequence[Mapping[str, Any]] | None, names: Sequence[Any]
) -> list[dict[str, Any]]:
    """The control points of `known`, numbered from 1.

    Args:
        known: as result.json has it, see `Result`.
        names: of the frames, by which `known` tells them.
    """
    frame = {name: i for i, name in enumerate(names)}
    points = [entry for entry in known or () if entry["kind"] == "control"]
    return [
        {
            "number": n,
            "name": entry.get("name", ""),
            "i": frame[entry["frame"]],
            "point": entry["point"],
            "surveyed": entry["surveyed"],
            "residual": entry["residual"],
            "length": entry["translation"],
            "normalised": entry["normalised_residual"],
            "weight": entry["weight"],
        }
        for n, entry in enumerate(points, 1)
    ]


def prior_rows(
    known: Sequence[Mapping[str, Any]] | None, names: Sequence[Any]
) -> list[dict[str, Any]]:
    """The priors and levels of `known`, numbered from 1 by their kinds.

    Args:
        known: as result.json has it, see `Result`.
        names: of the frames, by which `known` tells them.
    """
    frame = {name: i for i, name in enumerate(names)}
    return [
        {
            "kind": kind,
            "number": n,
            "i": frame[entry["frame"]],
            "length": entry.get("translation"),
            "angle": entry.get("rotation"),
            "normalised": entry.get("normalised_residual"),
            "weight": entry["weight"],
        }
        for kind in ("prior", "level")
        for n, entry in enumerate((x for x in known or () if x["kind"] == kind), 1)
    ]


def details_entry(details: Mapping[str, Any] | None) -> dict[str, Any]:
    """How a result was made, the versions of this process by default."""
    return {"versions": versions(), **({} if details is None else details)}


def floats(x: np.ndarray) -> str:
    """Float32 numbers as text."""
    return raw(x.astype("<f4"))


def raw(x: np.ndarray) -> str:
    """The bytes of an array as text."""
    return base64.b64encode(np.ascontiguousarray(x).tobytes()).decode("ascii")
