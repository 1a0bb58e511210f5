"""How a method came to rest, as curves of the page."""

from typing import Any

import jax
import numpy as np

import jaxreg


def trace_curves(
    trace: "jaxreg.AveragingTrace | jaxreg.SearchTrace | None",
    num_steps: int | None = None,
) -> dict[str, Any] | None:
    """The curves of a solution; None where it took no steps.

    Args:
        trace: of the solution.
        num_steps: of an averaging method, if known: a row may stand for many.
    """
    if trace is None or not int(trace.num_rows):
        return None
    if isinstance(trace, jaxreg.SearchTrace):
        return _of_search(trace)
    return _of_averaging(jax.device_get(trace), num_steps)


def _of_averaging(
    trace: "jaxreg.AveragingTrace", num_steps: int | None
) -> dict[str, Any]:
    """Changes, kernel widths, trust."""
    num = int(trace.num_rows)
    width = np.asarray(trace.kernel_width, float)[:num]
    many = num_steps is not None and num_steps > num
    panels = [
        _panel("largest change of a pose", True, change=trace.change[:num]),
    ]
    if np.isfinite(width).all():
        shift, turn = width[:, 0], np.rad2deg(width[:, 1])
        names = {"translation [unit]": shift, "rotation [°]": turn}
        panels.append(_panel("kernel width", True, **names))
        panels.append(_panel("mean trust of the edges", False, trust=trace.trust[:num]))
    return {
        "note": "Of the averaging. The change is in radians, or a share of the size of "
        "the scene, whichever is larger"
        + (f"; a point stands for some of the {num_steps} steps." if many else "."),
        "x": "kernel width, from the first to the last" if many else "step",
        "first": 1,
        "panels": panels,
    }


def _of_search(trace: "jaxreg.SearchTrace") -> dict[str, Any]:
    """Energies, effective sample size, kernel widths."""
    num = int(trace.num_rows)
    least, middle, size, width, count = (
        np.asarray(x)[:num]
        for x in (
            trace.least_energy,
            trace.median_energy,
            trace.effective_size,
            trace.kernel_width,
            trace.num_measured,
        )
    )
    if num == 1:
        note = (
            f"The filter was sure after its first {count[0]:,} particles: energies "
            f"from {least[0]:.3g}, half of them below {middle[0]:.3g}; kernel width "
            f"{width[0]:.3g}."
        )
        return {"note": note, "panels": []}
    energies = {"least": least, "median": middle}
    return {
        "note": f"Of the particle filter, {count[0]:,} particles at first and then "
        f"{count[-1]:,}. The energy depends on the kernel width.",
        "x": "time t",
        "first": 0,
        "panels": [
            _panel("energy", False, **energies),
            _panel("effective sample size", False, size=size),
            _panel("kernel width [unit of the input]", True, width=width),
        ],
    }


def _panel(title: str, powers: bool, **lines: Any) -> dict[str, Any]:
    return {
        "title": title,
        "log": powers,
        "lines": [
            {"name": name, "y": np.asarray(y, float).tolist()}
            for name, y in lines.items()
        ],
    }
