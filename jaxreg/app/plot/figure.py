"""The picture of a result: scans before and after, and a cut through the model."""

import io
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from jaxreg.app.colors import scan_colors
from jaxreg.app.plot.render import render_points
from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import MissingExtraError


_MAX_POINTS = 600_000
_MAX_MODELS = 4


def draw_reconstruction(
    scans: Sequence[np.ndarray],
    T_world_i: np.ndarray,
    names: Sequence[str],
    component: Sequence[int] | np.ndarray | None = None,
) -> Any:
    """Draws the scans as given, the scans in one frame, and a cross-section.

    Each scan has one colour. The cross-section is a thin slab through the middle of the
    model, as in Fig. 1 of the MCC paper: where scans agree, their outlines coincide.
    2D scans have no cross-section. Components beside the model have rows of their own,
    up to four rows.

    Args:
        scans: `(n_i, d)` arrays; rows with NaN or inf are left out.
        T_world_i: `(v, d+1, d+1)` poses.
        names: of the scans, for the legend.
        component: `(v,)` number of each scan's component, -1 for scans without a pose,
            which are left out after "before"; None if all are of one.

    Returns:
        A `matplotlib.figure.Figure`.

    Raises:
        MissingExtraError: if matplotlib is not installed.
    """
    return draw_points(thinned(scans), T_world_i, names, component)


def thinned(scans: Sequence[np.ndarray]) -> list[np.ndarray]:
    """What is drawn of scans: finite points, of very many some."""
    stride = 1 + sum(len(s) for s in scans) // _MAX_POINTS
    return [s[np.isfinite(s).all(axis=1)][::stride].astype(float) for s in scans]


def draw_points(
    before: list[np.ndarray],
    T_world_i: np.ndarray,
    names: Sequence[str],
    component: Sequence[int] | np.ndarray | None = None,
) -> Any:
    """`draw_reconstruction` of what `thinned` gives."""
    component = np.zeros(len(before), int) if component is None else component
    component = np.asarray(component)
    after = [
        x @ T[:-1, :-1].T + T[:-1, -1]
        for x, T in zip(before, np.asarray(T_world_i, float), strict=True)
    ]
    colors = scan_colors(len(before))
    solid = before[0].shape[1] == 3
    rows = min(int(component.max()) + 1, _MAX_MODELS)
    height = 3.9 * rows + 1
    figure = new_figure(figsize=(13 if solid else 10, height), dpi=130)
    axes = figure.subplots(rows, 3 if solid else 2, squeeze=False)
    draw = _draw_solid if solid else _draw_flat
    for k, panels in enumerate(axes):
        draw(panels, before, after, component == k, colors, first=k == 0)
        if k:
            panels[1].set_title(f"after: component {k}, in a frame of its own")
    for axis in axes.flat:
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_axis_off()
    _legend(figure, names, component, colors)
    figure.subplots_adjust(
        left=0.01,
        right=0.99,
        top=1 - 0.44 / height,
        bottom=0.64 / height,
        wspace=0.04,
        hspace=0.1,
    )
    return figure


def save_figure(path: str | Path, figure: Any) -> None:
    """Writes a figure as a PNG file, which appears whole or not at all.

    Raises:
        InputError: if the file cannot be written.
    """
    with atomic_write(path, "wb") as file:
        file.write(_png(figure))


def _draw_solid(
    axes: Any,
    before: list[np.ndarray],
    after: list[np.ndarray],
    keep: np.ndarray,
    colors: np.ndarray,
    first: bool,
) -> None:
    """One row: what was given, if it is the first, the model and a cut through it."""
    model = [x for x, k in zip(after, keep, strict=True) if k]
    model_colors = colors[keep]
    axes_of_model, centre = principal_axes(np.concatenate(model))
    camera = tilt(20.0, 25.0) @ axes_of_model
    views = {1: ([(x - centre) @ camera.T for x in model], model_colors)}
    axes[1].set_title("after: one frame")
    if first:
        # The first panel sees the frames as they came, about their common middle.
        middle = np.median(np.concatenate(before), axis=0)
        views[0] = [(x - middle) @ camera.T for x in before], colors
        axes[0].set_title("before: as given")
    with ThreadPoolExecutor() as pool:  # NumPy works on several cores that way
        images = list(pool.map(_rendered, *zip(*views.values(), strict=True)))
    for panel, (image, extent) in zip(views, images, strict=True):
        axes[panel].imshow(image, extent=extent, interpolation="antialiased")
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
    first: bool,
) -> None:
    # Of many scans smaller ones: walls of a floor are lines, not bars.
    size = float(np.clip(250 / np.sqrt(sum(map(len, before)) / 2), 1.5, 7))
    for k, color in enumerate(colors):
        # Later ones smaller, so that points which coincide are both seen.
        s = size * (1.3 - 0.7 * k / max(len(colors) - 1, 1))
        style = {"color": color, "markersize": s, "markeredgewidth": 0}
        if first:
            axes[0].plot(*before[k].T, "o", **style)
        if keep[k]:
            axes[1].plot(*after[k].T, "o", **style)
    if first:
        axes[0].set_title("before: as given")
    axes[1].set_title("after: one frame")


def _rendered(parts: list[np.ndarray], colors: np.ndarray) -> tuple[np.ndarray, Any]:
    """The image and its extent; scans in their colours."""
    group = np.repeat(np.arange(len(parts)), [len(x) for x in parts])
    return render_points(np.concatenate(parts), group, colors)


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
    figure: Any, names: Sequence[str], component: np.ndarray, colors: np.ndarray
) -> None:
    if len(names) > 24:
        return
    lines = _matplotlib_lines()
    handles = [
        lines.Line2D([], [], color=c, marker="o", linestyle="", markersize=5)
        for c in colors
    ]
    labels = [
        n + (f" (component {k})" if k > 0 else "" if k == 0 else " (not placed)")
        for n, k in zip(names, component, strict=True)
    ]
    legend = figure.legend(
        handles,
        labels,
        loc="lower center",
        ncols=min(len(names), 12 if max(map(len, labels)) < 10 else 6),
        frameon=False,
        fontsize=8,
        handletextpad=0.1,
        columnspacing=1.2,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)  # a name may hold $


def new_figure(**settings: Any) -> Any:
    """A matplotlib figure without global state, which notebooks show as a picture.

    Raises:
        MissingExtraError: if matplotlib is not installed.
    """
    try:
        import matplotlib.figure
    except ModuleNotFoundError as err:
        raise MissingExtraError("matplotlib", "Drawing figures") from err

    class Picture(matplotlib.figure.Figure):
        def _repr_png_(self) -> bytes:
            return _png(self, dpi=90)

    return Picture(**settings)


def _png(figure: Any, dpi: int | str = "figure") -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def _matplotlib_lines() -> ModuleType:
    import matplotlib.lines

    return matplotlib.lines
