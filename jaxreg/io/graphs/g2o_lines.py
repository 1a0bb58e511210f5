"""Lines of g2o files: numbers of a kind, read and written."""

import collections
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.io.errors import InputError
from jaxreg.io.files import text_lines
from jaxreg.io.quaternions import motions_from_xyzw, xyzw_from_rotations


class Rows(NamedTuple):
    """Lines of one kind: their numbers in the file, ids and values."""

    line: np.ndarray
    ids: np.ndarray
    values: np.ndarray

    def only(self, n: int) -> "Rows":
        """One of them."""
        return Rows(self.line[n : n + 1], self.ids[n : n + 1], self.values[n : n + 1])


class Lines:
    """The words of a file by the first of each line, with the numbers of the lines."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.found = collections.defaultdict[str, list[tuple[int, list[str]]]](list)
        for number, line in text_lines(path):
            words = line.split()
            if words and not words[0].startswith("#"):
                self.found[words[0]].append((number, words[1:]))

    def rows(self, tag: str, num_ids: int, num: int) -> Rows:
        """The numbers of all lines of a kind."""
        return _rows(self.path, tag, self.found[tag], num_ids, num)


def columns(T: np.ndarray) -> np.ndarray:
    """Poses as g2o writes them: x y angle, or x y z and a quaternion."""
    if T.shape[-1] == 3:
        angle = np.arctan2(T[:, 1, 0], T[:, 0, 0])
        return np.concatenate([T[:, :2, 2], angle[:, None]], axis=1)
    return np.concatenate([T[:, :3, 3], xyzw_from_rotations(T[:, :3, :3])], axis=1)


def lines_of(tag: str, ids: np.ndarray, values: np.ndarray, digits: int) -> list[str]:
    """A line for each row."""
    form = " ".join([f"%.{digits}g"] * values.shape[1])
    return [
        f"{tag} {' '.join(map(str, name))} {form % tuple(row)}"
        for name, row in zip(ids.tolist(), values.tolist(), strict=True)
    ]


def _rows(
    path: Path, tag: str, rows: list[tuple[int, list[str]]], num_ids: int, num: int
) -> Rows:
    for number, words in rows:
        if len(words) != num_ids + num:
            raise InputError(
                f"{path}, line {number}: {tag} wants {num_ids + num} numbers, "
                f"found {len(words)}. Is the file cut off?"
            )
    lines = np.array([number for number, _ in rows], dtype=np.int64)
    try:
        ids = np.array([words[:num_ids] for _, words in rows], dtype=np.int64)
        values = np.array([words[num_ids:] for _, words in rows], dtype=np.float64)
    except (ValueError, OverflowError):
        raise _first_bad_number(path, rows, num_ids) from None
    values = values.reshape(-1, num)
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}, line {lines[np.argmax(bad)]}: {tag} holds a number that is not "
            "finite."
        )
    return Rows(lines, ids.reshape(-1, num_ids), values)


def _first_bad_number(
    path: Path, rows: list[tuple[int, list[str]]], num_ids: int
) -> InputError:
    for number, words in rows:
        for at, word in enumerate(words):
            try:
                int(word) if at < num_ids else float(word)
            except ValueError:
                kind = "an integer id" if at < num_ids else "a number"
                return InputError(f"{path}, line {number}: {word!r} is not {kind}.")
    return InputError(f"{path}: an id does not fit into 64 bits.")


def motions(rows: Rows, d: int, path: str | Path) -> np.ndarray:
    """Poses, or motions, that begin the values."""
    values = rows.values
    if d == 3:
        short = np.linalg.norm(values[:, 3:7], axis=1) < 1e-6
        if short.any():
            raise InputError(
                f"{path}, line {rows.line[np.argmax(short)]}: the quaternion is zero."
            )
        return motions_from_xyzw(values[:, :3], values[:, 3:7])
    T = np.tile(np.eye(3), (len(values), 1, 1))
    c, s = np.cos(values[:, 2]), np.sin(values[:, 2])
    T[:, :2, :2] = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    T[:, :2, 2] = values[:, :2]
    return T
