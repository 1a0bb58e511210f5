"""Pictures of how far poses are from true ones."""

from typing import Any

import numpy as np

from jaxreg.app.plot.figure import new_figure


def draw_pose_errors(
    T_world_i: np.ndarray, T_true_i: np.ndarray, e_R: np.ndarray, e_t: np.ndarray
) -> Any:
    """Positions seen along their thinnest direction, and the errors by frame.

    Args:
        T_world_i: `(v, d+1, d+1)` estimated poses in the frame of the truth.
        T_true_i: `(v, d+1, d+1)` true poses.
        e_R: `(v,)` angles in radians.
        e_t: `(v,)` distances.

    Returns:
        A `matplotlib.figure.Figure`.
    """
    figure = new_figure(figsize=(12, 4.6), dpi=130)
    path, angles, lengths = figure.subplots(1, 3)
    true, found = T_true_i[:, :-1, -1], T_world_i[:, :-1, -1]
    middle = true.mean(axis=0)
    _, _, axes = np.linalg.svd(true - middle, full_matrices=True)
    (tx, ty), (fx, fy) = (((x - middle) @ axes[:2].T).T for x in (true, found))
    path.plot(tx, ty, "-o", color="0.6", ms=3, lw=1.2, label="truth")
    path.plot(fx, fy, "-o", color="#1f6fb4", ms=3, lw=1.0, label="estimate")
    path.plot([tx, fx], [ty, fy], color="#c8442e", lw=0.8)
    path.set_aspect("equal", adjustable="datalim")
    path.set_title("positions, errors in red")
    path.legend(frameon=False)
    for axis, values, what in (
        (lengths, e_t, "distance, in the unit of the poses"),
        (angles, np.degrees(e_R), "angle [degrees]"),
    ):
        axis.plot(values, "-o", color="#1f6fb4", ms=3, lw=1)
        axis.set_ylim(bottom=0)
        axis.set_title(what)
        axis.set_xlabel("frame")
    figure.tight_layout()
    return figure


def draw_pair_errors(
    e_R: np.ndarray, e_t: np.ndarray, rmse: np.ndarray | None, threshold: float
) -> Any:
    """Share of the true pairs below each error; infinite ones are those not found.

    Args:
        e_R: `(e,)` angles in radians.
        e_t: `(e,)` distances.
        rmse: `(r,)` distances of coinciding points, None if they are unknown.
        threshold: up to which a motion is right.
    """
    shown = [(np.degrees(e_R), "angle [degrees]"), (e_t, "distance")]
    shown += [] if rmse is None else [(rmse, "distance of coinciding points, rms")]
    figure = new_figure(figsize=(4 * len(shown), 4.2), dpi=130)
    panels = figure.subplots(1, len(shown))
    for axis, (values, what) in zip(panels, shown, strict=True):
        finite = np.sort(values[np.isfinite(values) & (values > 0)])
        share = np.arange(1, len(finite) + 1) / max(len(values), 1)
        axis.step(finite, share, where="post", color="#1f6fb4")
        axis.set_xscale("log")
        axis.set_ylim(0, 1)
        axis.set_xlabel(what)
        axis.set_ylabel("share of the true pairs")
    if rmse is not None:
        panels[-1].axvline(threshold, color="#c8442e", lw=1)
    figure.tight_layout()
    return figure
