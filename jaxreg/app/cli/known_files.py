"""Tables of what is known: the files of `--control` and `--level`.

Rows begin with a frame. Words in the first row are the names of the columns.
"""

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.files import text_lines


#: Heads of a column of names behind that of frames.
_NAMES = {"name", "point", "target", "label", "id", "number"}


class _Row(NamedTuple):
    place: str  # for messages
    frame: str
    name: str
    numbers: np.ndarray


def read_control(path: Path, ids: np.ndarray, d: int) -> list[tuple[Any, ...]]:
    """Rows: a frame, a name or none, maybe a point in the frame, where it lies.

    And maybe a standard deviation. A name that is a number needs a head that says so.
    """
    out, told = [], None
    for place, word, _, numbers in _rows(path, named=True):
        deviation = len(numbers) in (d + 1, 2 * d + 1)
        if len(numbers) not in (d, d + 1, 2 * d, 2 * d + 1):
            raise InputError(
                f"{place}: wanted a frame, {d} coordinates in the world, or {d} in the "
                f"frame and {d} in the world, and a standard deviation if it is known; "
                f"found {len(numbers)} numbers."
            )
        if told not in (None, deviation):
            raise InputError(f"{place}: a standard deviation in some rows, not in all.")
        told = deviation
        if deviation and numbers[-1] <= 0:
            raise InputError(f"{place}: wanted a deviation above zero.")
        *places, sigma = numbers if deviation else np.append(numbers, 0)
        seen = places[:d] if len(places) == 2 * d else np.zeros(d)
        row = frame_of(word, ids, place), np.array(seen), np.array(places[-d:])
        out.append((*row, np.eye(d) / sigma**2) if deviation else row)
    if not out:
        raise InputError(f"{path}: holds no control points.")
    return out


def names_of_control(path: Path) -> list[str]:
    """Of each row of `read_control`; empty where it has none."""
    return [row.name for row in _rows(path, named=True)]


def read_levels(path: Path, ids: np.ndarray, d: int) -> list[tuple[Any, ...]]:
    """Rows: a frame, what points up in it, a deviation in radians."""
    if d != 3:
        raise InputError("--level: of what is 3D only, this is 2D.")
    out = []
    for place, word, _, numbers in _rows(path):
        if len(numbers) != 4 or not numbers[:3].any() or numbers[3] <= 0:
            raise InputError(
                f"{place}: wanted a frame, three numbers of the direction that points "
                "up in it, and a standard deviation above zero, in radians."
            )
        out.append((frame_of(word, ids, place), numbers[:3], numbers[3]))
    if not out:
        raise InputError(f"{path}: holds no levels.")
    return out


def frame_of(word: str, ids: np.ndarray, place: str) -> int:
    """Which frame a word names; `place` is for the message."""
    found = np.flatnonzero(ids.astype(str) == word.strip())
    if not len(found):
        raise InputError(
            f"{place}: no {word.strip()!r}; the first are "
            f"{', '.join(map(str, ids[:5]))}."
        )
    return int(found[0])


def _rows(path: Path, named: bool = False) -> Iterator[_Row]:
    """The rows below the heads; names only where there may be any."""
    headed = False
    for n, (line, text) in enumerate(text_lines(path)):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        frame, *words = next(csv.reader([text.replace(";", ",").replace("\t", ",")]))
        if n == 0 and words and not _is_number(words[-1]):
            headed = named and words[0].strip().lower() in _NAMES
            continue
        place, name = f"{path}, line {line}", ""
        if words and named and (headed or not _is_number(words[0])):
            name, *words = words
        if not all(map(_is_number, words)):
            raise InputError(f"{place}: not numbers after the frame: {text}")
        numbers = np.array([float(word) for word in words])
        if not np.isfinite(numbers).all():
            raise InputError(f"{place}: wanted finite numbers.")
        yield _Row(place, frame, name.strip(), numbers)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
