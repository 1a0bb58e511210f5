"""The picture of a result: scans before and after, and a cut through the model."""

import io
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from jaxreg.io.atomic import atomic_write
from jaxreg.io.colors import scan_colors
from jaxreg.io.errors import MissingExtraError
from jaxreg.plot.render import render_points


_MAX_POINTS = 600_000


def reconstruction_figure(
    path: str | Path,
    scans: Sequence[np.ndarray],
    T_world_i: np.ndarray,
    names: Sequence[str],
    placed: Sequence[bool] | np.ndarray | None = None,
) -> None:
    """Draws a PNG: the scans as given, the scans in one frame, and a cross-section.

    Each scan has one colour. The cross-section is a thin slab through the middle of the
    model, as in Fig. 1 of the MCC paper: where scans agree, their outlines coincide.
    2D scans have no cross-section.

    Args:
        path: the PNG file; it appears whole or not at all.
        scans: `(n_i, d)` arrays; rows with NaN or inf are left out.
        T_world_i: `(v, d+1, d+1)` poses.
        names: of the scans, for the legend.
        placed: which scans have a pose; the others are left out after "before".

    Raises:
        InputError: if the file cannot be written.
        MissingExtraError: if matplotlib is not installed.
    """
    module = figure_module()
    keep = np.ones(len(scans), bool) if placed is None else np.asarray(placed, bool)
    stride = 1 + sum(len(s) for s in scans) // _MAX_POINTS
    before = [s[np.isfinite(s).all(axis=1)][::stride].astype(float) for s in scans]
    after = [
        x @ T[:-1, :-1].T + T[:-1, -1]
        for x, T in zip(before, np.asarray(T_world_i, float), strict=True)
    ]
    colors = scan_colors(len(scans))
    solid = before[0].shape[1] == 3
    figure = module.Figure(figsize=(13, 4.9) if solid else (10, 4.9), dpi=130)
    axes = figure.subplots(1, 3 if solid else 2)
    if solid:
        _draw_solid(axes, before, after, keep, colors)
    else:
        _draw_flat(axes, before, after, keep, colors)
    for axis in axes:
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_axis_off()
    _legend(figure, names, keep, colors)
    figure.subplots_adjust(left=0.01, right=0.99, top=0.91, bottom=0.13, wspace=0.04)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    with atomic_write(path, "wb") as file:
        file.write(buffer.getvalue())


def _draw_solid(
    axes: Any,
    before: list[np.ndarray],
    after: list[np.ndarray],
    keep: np.ndarray,
    colors: np.ndarray,
) -> None:
    model = [x for x, k in zip(after, keep, strict=True) if k]
    model_colors = colors[keep]
    axes_of_model, centre = principal_axes(np.concatenate(model))
    camera = tilt(20.0, 25.0) @ axes_of_model
    # The first panel sees the frames as they came, about their common middle.
    middle = np.median(np.concatenate(before), axis=0)
    _show(axes[0], [(x - middle) @ camera.T for x in before], colors)
    axes[0].set_title("before: as given")
    _show(axes[1], [(x - centre) @ camera.T for x in model], model_colors)
    axes[1].set_title("after: one frame")
    section, width = _section([(x - centre) @ axes_of_model.T for x in model])
    # In random order, so that no scan hides the others.
    order = np.random.default_rng(0).permutation(sum(len(x) for x in section))
    tint = np.repeat(model_colors, [len(x) for x in section], axis=0)[order]
    axes[2].scatter(*np.concatenate(section)[order].T, s=4, c=tint, linewidths=0)
    axes[2].set_title(f"cross-section, {width:.2g} thick")


def _draw_flat(
    axes: Any,
    before: list[np.ndarray],
    after: list[np.ndarray],
    keep: np.ndarray,
    colors: np.ndarray,
) -> None:
    size = float(np.clip(400 / np.sqrt(max(len(x) for x in before)), 2, 7))
    for k, color in enumerate(colors):
        # Later ones smaller, so that points which coincide are both seen.
        s = size * (1.3 - 0.7 * k / max(len(colors) - 1, 1))
        style = {"color": color, "markersize": s, "markeredgewidth": 0}
        axes[0].plot(*before[k].T, "o", **style)
        if keep[k]:
            axes[1].plot(*after[k].T, "o", **style)
    axes[0].set_title("before: as given")
    axes[1].set_title("after: one frame")


def _show(axis: Any, parts: list[np.ndarray], colors: np.ndarray) -> None:
    group = np.repeat(np.arange(len(parts)), [len(x) for x in parts])
    image, extent = render_points(np.concatenate(parts), group, colors)
    axis.imshow(image, extent=extent, interpolation="antialiased")


def principal_axes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A rotation whose rows are right, up and towards the viewer, and the centre."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    _, vectors = np.linalg.eigh(np.cov(points.T))
    up, right = vectors[:, 2], vectors[:, 1]
    # Signs by the third moment, so that the picture does not flip between runs.
    up = up * (1 if np.mean(((points - centre) @ up) ** 3) > 0 else -1)
    right = right * (1 if np.mean(((points - centre) @ right) ** 3) > 0 else -1)
    return np.stack([right, up, np.cross(right, up)]), centre


def tilt(elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    """A rotation that turns an object about its up axis, then its top to the viewer."""
    a, e = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    nod = np.array([[1, 0, 0], [0, np.cos(e), -np.sin(e)], [0, np.sin(e), np.cos(e)]])
    return nod @ turn


def _section(parts: list[np.ndarray]) -> tuple[list[np.ndarray], float]:
    """The points of a slab normal to the third axis, and its thickness."""
    z = np.concatenate(parts)[:, 2]
    extent = float(np.ptp(z))
    # Thick enough for about 4000 points, thin enough to be a cut.
    width = float(np.clip(4000 / len(z), 0.004, 0.03)) * extent
    height = float(np.median(z))
    return [x[np.abs(x[:, 2] - height) < width / 2, :2] for x in parts], width


def _legend(
    figure: Any, names: Sequence[str], keep: np.ndarray, colors: np.ndarray
) -> None:
    if len(names) > 24:
        return
    lines = _matplotlib_lines()
    handles = [
        lines.Line2D([], [], color=c, marker="o", linestyle="", markersize=5)
        for c in colors
    ]
    labels = [n if k else f"{n} (not placed)" for n, k in zip(names, keep, strict=True)]
    figure.legend(
        handles,
        labels,
        loc="lower center",
        ncols=min(len(names), 12 if max(map(len, labels)) < 10 else 6),
        frameon=False,
        fontsize=8,
        handletextpad=0.1,
        columnspacing=1.2,
    )


def figure_module() -> ModuleType:
    """Matplotlib's figures, without its global state.

    Raises:
        MissingExtraError: if matplotlib is not installed.
    """
    try:
        import matplotlib.figure
    except ModuleNotFoundError as err:
        raise MissingExtraError("matplotlib", "Drawing figures") from err
    return matplotlib.figure


def _matplotlib_lines() -> ModuleType:
    import matplotlib.lines

    return matplotlib.lines
