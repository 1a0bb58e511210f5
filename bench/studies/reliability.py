"""Predicted probability of being right against the share that is."""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.app.plot.figure import new_figure
from jaxreg.io.atomic import atomic_write


_COLOR, _EDGE = "#0072b2", "#8a8f98"


class Reliability(NamedTuple):
    """Answers in bins of equal width of their predicted probability.

    Attributes:
        num: `(b,)` answers.
        predicted: `(b,)` mean probability of each bin; NaN of an empty one.
        right: `(b,)` share of right answers.
    """

    num: np.ndarray
    predicted: np.ndarray
    right: np.ndarray

    @classmethod
    def of(
        cls, probability: np.ndarray, right: np.ndarray, bins: int = 10
    ) -> "Reliability":
        """Of answers, `(n,)` each."""
        row = np.minimum((probability * bins).astype(int), bins - 1)
        num = np.bincount(row, minlength=bins)
        with np.errstate(invalid="ignore"):
            predicted = np.bincount(row, probability, bins) / num
            share = np.bincount(row, right, bins) / num
        return cls(num, predicted, share)

    @property
    def error(self) -> float:
        """Expected calibration error: mean distance of both, each answer counted."""
        some = self.num > 0
        apart = np.abs(self.predicted - self.right)[some]
        return float(np.average(apart, weights=self.num[some]))


def draw(found: dict[str, Reliability], path: Path) -> None:
    """A panel for each, with how many answers a bin has."""
    figure = new_figure(figsize=(3.4 * len(found), 3.6), dpi=100, layout="constrained")
    axes = figure.subplots(1, len(found), squeeze=False)[0]
    for axis, (title, reliability) in zip(axes, found.items(), strict=True):
        some = reliability.num > 0
        x, y = reliability.predicted[some], reliability.right[some]
        axis.plot([0, 1], [0, 1], color=_EDGE, linestyle="--", linewidth=1)
        axis.plot(x, y, color=_COLOR, linewidth=1.6, marker="o", markersize=5)
        for a, b, num in zip(x, y, reliability.num[some], strict=True):
            beside = (6, -10) if b > 0.5 else (-4, 8)
            axis.annotate(
                f"{num}", (a, b), beside, textcoords="offset points", fontsize=7
            )
        axis.set_title(f"{title}: error {reliability.error:.3f}", fontsize=9)
        axis.set_xlabel("predicted probability of being right", fontsize=9)
        axis.set_ylabel("share that is right", fontsize=9)
        axis.set_xlim(-0.05, 1.08)
        axis.set_ylim(-0.05, 1.08)
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    with atomic_write(path, "wb") as file:
        file.write(buffer.getvalue())
