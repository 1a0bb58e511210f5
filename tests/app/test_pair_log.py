"""Pairs on disk, as a run finds them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxreg.app.pair_log import PairLog, Pairs
from jaxreg.io import InputError


RUN = {"seed": 0, "version": "1"}


def _log(path: Path, run: Any = RUN, *, resume: bool) -> PairLog:
    return PairLog(path, run, resume=resume, num_scans=9, dim=3)


def _pairs(first: int, num: int) -> Pairs:
    rng = np.random.default_rng(first)
    T = rng.normal(size=(num, 2, 4, 4)).astype(np.float32)
    ids = np.arange(first, first + num)
    shape = num, 2
    told = (rng.random(shape) for _ in range(3))
    return Pairs(np.stack([ids, ids + 1], 1), T, *told)


def test_pairs_come_back_to_the_last_bit(tmp_path: Path):
    path = tmp_path / "new" / "pairs.jsonl"
    log = _log(path, resume=False)
    assert log.pairs is None
    assert not path.exists()
    log.add(_pairs(0, 3))
    log.add(_pairs(3, 2))
    again = _log(path, resume=True)
    assert len(again) == 5
    assert again.pairs is not None
    for one, a, b in zip(again.pairs, _pairs(0, 3), _pairs(3, 2), strict=True):
        np.testing.assert_array_equal(one, np.concatenate([a, b]))


def test_a_line_cut_off_is_dropped_and_written_anew(tmp_path: Path):
    path = tmp_path / "pairs.jsonl"
    _log(path, resume=False).add(_pairs(0, 3))
    path.write_text(path.read_text()[:-40])
    log = _log(path, resume=True)
    assert len(log) == 2
    log.add(_pairs(2, 1))
    assert len(_log(path, resume=True)) == 3


def test_pairs_of_another_run_are_refused_and_stay(tmp_path: Path):
    path = tmp_path / "pairs.jsonl"
    _log(path, resume=False).add(_pairs(0, 3))
    with pytest.raises(InputError, match="another seed"):
        _log(path, {**RUN, "seed": 1}, resume=True)
    assert len(_log(path, resume=True)) == 3


def test_without_resume_a_run_starts_anew(tmp_path: Path):
    path = tmp_path / "pairs.jsonl"
    _log(path, resume=False).add(_pairs(0, 3))
    log = _log(path, resume=False)
    assert len(log) == 0
    log.add(_pairs(5, 1))
    assert len(_log(path, resume=True)) == 1
    log.remove()
    assert not path.exists()


def _changed(**changes: Any) -> bytes:
    row = {"pair": [2, 3], "T_i_j": [np.eye(4).tolist()] * 2}
    row |= {"overlap": [0.5, 0.1], "log_evidence": [5.0, -2.0]}
    row |= {"inlier_rmse": [0.1, 0.1]} | changes
    return json.dumps(row).encode()


DAMAGE = {
    "cut": _changed()[:50],
    "binary": bytes(range(200, 256)) * 3,
    "nan": _changed(T_i_j=[np.full((4, 4), np.nan).tolist()] * 2),
    "ids of no scan": _changed(pair=[2, 99]),
    "ids that are no numbers": _changed(pair=["2", True]),
    "one scan twice": _changed(pair=[2, 2]),
    "a pair again": _changed(pair=[1, 0]),
    "another dimension": _changed(T_i_j=[np.eye(3).tolist()] * 2),
    "fewer modes": _changed(T_i_j=[np.eye(4).tolist()]),
    "words": _changed(overlap="none"),
    "a list": b"[1, 2]",
    "deep": b"[" * 100_000,
    "empty": b"",
}


@pytest.mark.parametrize("kind", list(DAMAGE))
def test_pairs_before_the_damage_are_kept(tmp_path: Path, kind: str):
    path = tmp_path / "pairs.jsonl"
    _log(path, resume=False).add(_pairs(0, 5))
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join([*lines[:3], DAMAGE[kind], *lines[4:]]))
    log = _log(path, resume=True)
    assert log.damage is not None
    assert log.damage.startswith("damaged from line 4 on; 2 pairs before it are kept")
    assert log.pairs is not None
    np.testing.assert_array_equal(log.pairs.T_i_j, _pairs(0, 5).T_i_j[:2])
    log.add(_pairs(6, 1))
    again = _log(path, resume=True)
    assert (len(again), again.damage) == (3, None)


@pytest.mark.parametrize("head", [b"", b"\0\xff\xfe", b"[]", b"{}", b'{"form'])
def test_a_log_without_its_first_line_starts_anew(tmp_path: Path, head: bytes):
    path = tmp_path / "pairs.jsonl"
    _log(path, resume=False).add(_pairs(0, 3))
    path.write_bytes(head + b"\n" + path.read_bytes().split(b"\n", 1)[1])
    log = _log(path, resume=True)
    assert (len(log), log.pairs) == (0, None)
    assert log.damage == "damaged from its first line on, all pairs are new"
