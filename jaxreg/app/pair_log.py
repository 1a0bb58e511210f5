"""Pairs of scans kept on disk as they are found, so that a run can be taken up again.

A JSON line that tells the runs apart, then a line for each pair. A line that was cut
off, as by a crash while it was written, counts as not there.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import InputError


_FORMAT = "jaxreg pairs 2"


class Pairs(NamedTuple):
    """The modes of pairs: `(e, 2)` ids, `(e, m, d+1, d+1)`, `(e, m)` and `(e, m)`."""

    edges: np.ndarray
    T_i_j: np.ndarray
    overlap: np.ndarray
    inlier_rmse: np.ndarray


class PairLog:
    """A file of pairs that grows.

    Args:
        path: of the file. It appears with the first pair.
        run: what the pairs depend on, as JSON values: scans, seed, version.
        resume: whether to keep the pairs of an earlier run that are there already.

    Raises:
        InputError: if `resume` and the file is of another run.
    """

    def __init__(
        self, path: str | Path, run: Mapping[str, object], *, resume: bool
    ) -> None:
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
        head, *lines = self.path.read_text(encoding="utf-8").split("\n")
        if head != self._head:
            raise InputError(
                f"{self.path}: holds pairs of other scans, another seed, budget or "
                "version.\n"
                "Remove it, choose another --out, or leave out --resume to start anew."
            )
        return lines[:-1]  # behind the last line end: nothing, or a line cut off
