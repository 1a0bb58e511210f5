"""Where the time of a command goes, compiling and with kept programs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.records import Row
from jaxreg.app.plot.figure import new_figure, save_figure


#: What a command reports of its time, in order. The rest are imports, mostly, and the
#: picture and the page, which are done after it has reported.
PARTS = ("read", "trace", "load", "compile", "run", "write")
REST = "rest: imports, page"


def draw(rows: list[Row], path: Path, colors: Sequence[str]) -> Path | None:
    """A bar for each command of jaxreg, one on another as the report has them."""
    rows = [r for r in rows if r.library == "jaxreg" and "run" in r.metrics]
    if not rows:
        return None
    names = [f"{r.key.method}\n{r.key.case}" for r in rows]
    seconds = [bar(row) for row in rows]
    figure = new_figure(
        figsize=(9, 0.42 * len(rows) + 1.2), dpi=110, layout="constrained"
    )
    axis, left = figure.subplots(), np.zeros(len(rows))
    for part, color in zip((REST, *PARTS), colors, strict=False):
        here = np.array([s[part] for s in seconds])
        axis.barh(names, here, left=left, color=color, label=part)
        left += here
    axis.set_xlim(0, 1.03 * left.max())
    axis.margins(y=0.02)
    axis.invert_yaxis()
    axis.tick_params(labelsize=7)
    axis.grid(axis="x", alpha=0.3)
    axis.set_xlabel("wall time, s", fontsize=9)
    figure.legend(loc="outside right center", fontsize=8, frameon=False)
    save_figure(path, figure)
    return path


def bar(row: Row) -> dict[str, float]:
    """Seconds by part; the rest has what older rows leave out."""
    told = {part: row.value(part) or 0.0 for part in PARTS}
    wall = (row.value("wall_ms") or 0.0) / 1e3
    return {REST: max(wall - sum(told.values()), 0.0), **told}
