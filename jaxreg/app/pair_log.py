"""Pairs of scans kept on disk as they are found, so that a run can be taken up again.

A JSON line that tells the runs apart, then a line for each pair. A line that was cut
off, as by a crash while it was written, counts as not there; so do a damaged line and
all behind it.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import InputError
from jaxreg.io.files import reading, require_regular


_FORMAT = "jaxreg pairs 3"


class Pairs(NamedTuple):
    """The modes of pairs: `(e, 2)` ids, `(e, m, d+1, d+1)`, and three of `(e, m)`."""

    edges: np.ndarray
    T_i_j: np.ndarray
    overlap: np.ndarray
    log_evidence: np.ndarray
    inlier_rmse: np.ndarray


class PairLog:
    """A file of pairs that grows.

    Args:
        path: of the file. It appears with the first pair.
        run: what the pairs depend on, as JSON values: scans, seed, version.
        resume: whether to keep the pairs of an earlier run that are there already.
        num_scans: whose pairs they are, which bounds their ids.
        dim: of the scans.

    Attributes:
        damage: what is wrong with the file that was to be gone on with, or None.

    Raises:
        InputError: if `resume` and the file is of another run.
    """

    def __init__(
        self,
        path: str | Path,
        run: Mapping[str, object],
        *,
        resume: bool,
        num_scans: int,
        dim: int,
    ) -> None:
        self._num_scans, self._dim = num_scans, dim
        self.damage: str | None = None
        self.path = Path(path)
        self._head = json.dumps({"format": _FORMAT, "run": dict(run)})
        self._lines: list[str] = []
        if resume and self.path.exists():
            self._lines = self._read()
        self._begun = False

    def __len__(self) -> int:
        """Pairs that are kept."""
        return len(self._lines)

    @property
    def pairs(self) -> Pairs | None:
        """All that are kept, None if there are none."""
        if not self._lines:
            return None
        rows = [json.loads(line) for line in self._lines]
        return Pairs(
            np.array([row["pair"] for row in rows], np.int32),
            np.array([row["T_i_j"] for row in rows]),
            np.array([row["overlap"] for row in rows]),
            np.array([row["log_evidence"] for row in rows]),
            np.array([row["inlier_rmse"] for row in rows]),
        )

    def add(self, found: Pairs) -> None:
        """Appends pairs; they are on disk when this returns."""
        new = [
            json.dumps(
                {
                    "pair": found.edges[e].tolist(),
                    "T_i_j": found.T_i_j[e].tolist(),
                    "overlap": found.overlap[e].tolist(),
                    "log_evidence": found.log_evidence[e].tolist(),
                    "inlier_rmse": found.inlier_rmse[e].tolist(),
                }
            )
            for e in range(len(found.edges))
        ]
        self._lines += new
        if not self._begun:
            # Whole again, without a line that was cut off.
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(self.path) as file:
                file.write("\n".join([self._head, *self._lines, ""]))
            self._begun = True
            return
        with open(self.path, "a", encoding="utf-8") as file:
            file.write("\n".join([*new, ""]))
            file.flush()
            os.fsync(file.fileno())

    def remove(self) -> None:
        """Deletes the file, if there is one."""
        self.path.unlink(missing_ok=True)

    def _read(self) -> list[str]:
        with reading(self.path, "log of pairs", "Leave out --resume to start anew."):
            require_regular(self.path)
            text = self.path.read_bytes().decode("utf-8", "replace")
        head, *lines = text.split("\n")
        if head != self._head:
            if _is_head(head):
                raise InputError(
                    f"{self.path}: holds pairs of other scans, another seed, budget or "
                    "version.\nRemove it, choose another --out, or leave out --resume "
                    "to start anew."
                )
            self.damage = "damaged from its first line on, all pairs are new"
            return []
        kept: list[str] = []
        pairs: set[frozenset[int]] = set()
        num_modes = None
        for number, line in enumerate(lines[:-1], start=2):  # the last: empty or cut
            try:
                pair, modes = _checked(line, self._num_scans, self._dim)
                if pair in pairs or modes != (num_modes or modes):
                    raise ValueError
            except (ValueError, LookupError, TypeError, RecursionError):
                lost = len(lines) - number
                self.damage = (
                    f"damaged from line {number} on; {len(kept)} pairs before it are "
                    f"kept, {lost} lines are not"
                )
                break
            num_modes = modes
            pairs.add(pair)
            kept.append(line)
        return kept


def _is_head(line: str) -> bool:
    """Whether a line is the first one of a log of some run or version."""
    try:
        return str(json.loads(line)["format"]).startswith("jaxreg pairs")
    except (ValueError, LookupError, TypeError, RecursionError):
        return False


def _checked(line: str, num_scans: int, dim: int) -> tuple[frozenset[int], int]:
    """The pair of a line and the number of its modes.

    Raises:
        ValueError, LookupError, TypeError: if the line holds none.
    """
    row = json.loads(line)
    i, j = row["pair"]
    if type(i) is not int or type(j) is not int:
        raise TypeError("ids are integers")
    T, *told = (
        np.array(row[k], np.float64)
        for k in ("T_i_j", "overlap", "log_evidence", "inlier_rmse")
    )
    known = all(0 <= k < num_scans for k in (i, j)) and i != j
    shaped = T.shape == (len(T), dim + 1, dim + 1) and len(T) > 0
    finite = all(np.isfinite(x).all() for x in (T, *told[:2]))
    if not (known and shaped and finite and all(x.shape == (len(T),) for x in told)):
        raise ValueError("no pair of these scans")
    return frozenset((i, j)), len(T)
