"""Rows of text, moved: the cells of coordinates and normals change, others do not."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from jaxreg.io.moved.motion import Moving


_BLOCK = 50_000  # lines that are in memory at a time
#: Of float32 and of float64 in text.
NARROW, WIDE = "%.9g", "%.16g"


def move_cells(
    rows: Iterable[list[str]],
    moving: Moving,
    places: Sequence[int],
    normals: Sequence[int] | None,
    form: Callable[[float], str],
) -> Iterator[list[str]]:
    """Rows of cells with numbers at these places.

    Cells that are empty or not finite stay as they are, as do the others of their row.
    """
    rows = iter(rows)
    while block := list(itertools.islice(rows, _BLOCK)):
        _change(block, places, moving.points, form)
        if normals is not None:
            _change(block, normals, moving.directions, form)
        yield from block


def _change(
    block: list[list[str]],
    places: Sequence[int],
    change: Callable[[np.ndarray], np.ndarray],
    form: Callable[[float], str],
) -> None:
    old = np.array([[_number(row, k) for k in places] for row in block])
    new = change(old)
    finite = np.all(np.isfinite(old), axis=1).tolist()
    for row, values, ok in zip(block, new.tolist(), finite, strict=True):
        if ok:
            for k, value in zip(places, values, strict=True):
                row[k] = form(value)


def _number(row: list[str], k: int) -> float:
    return float(row[k]) if k < len(row) and row[k] else np.nan
