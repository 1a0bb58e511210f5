"""Pairs on disk, as a run finds them."""

from pathlib import Path

import numpy as np
import pytest

from jaxreg.app.pair_log import PairLog, Pairs
from jaxreg.io import InputError


RUN = {"seed": 0, "version": "1"}


def _pairs(first: int, num: int) -> Pairs:
    rng = np.random.default_rng(first)
    T = rng.normal(size=(num, 2, 4, 4)).astype(np.float32)
    ids = np.arange(first, first + num)
    shape = num, 2
    return Pairs(np.stack([ids, ids + 1], 1), T, rng.random(shape), rng.random(shape))


def test_pairs_come_back_to_the_last_bit(tmp_path: Path):
    path = tmp_path / "new" / "pairs.jsonl"
    log = PairLog(path, RUN, resume=False)
    assert log.pairs is None
    assert not path.exists()
    log.add(_pairs(0, 3))
    log.add(_pairs(3, 2))
    again = PairLog(path, RUN, resume=True)
    assert len(again) == 5
    assert again.pairs is not None
    for one, a, b in zip(again.pairs, _pairs(0, 3), _pairs(3, 2), strict=True):
        np.testing.assert_array_equal(one, np.concatenate([a, b]))


def test_a_line_cut_off_is_dropped_and_written_anew(tmp_path: Path):
    path = tmp_path / "pairs.jsonl"
    PairLog(path, RUN, resume=False).add(_pairs(0, 3))
    path.write_text(path.read_text()[:-40])
    log = PairLog(path, RUN, resume=True)
    assert len(log) == 2
    log.add(_pairs(2, 1))
    assert len(PairLog(path, RUN, resume=True)) == 3


def test_pairs_of_another_run_are_refused_and_stay(tmp_path: Path):
    path = tmp_path / "pairs.jsonl"
    PairLog(path, RUN, resume=False).add(_pairs(0, 3))
    with pytest.raises(InputError, match="another seed"):
        PairLog(path, {**RUN, "seed": 1}, resume=True)
    assert len(PairLog(path, RUN, resume=True)) == 3


def test_without_resume_a_run_starts_anew(tmp_path: Path):
    path = tmp_path / "pairs.jsonl"
    PairLog(path, RUN, resume=False).add(_pairs(0, 3))
    log = PairLog(path, RUN, resume=False)
    assert len(log) == 0
    log.add(_pairs(5, 1))
    assert len(PairLog(path, RUN, resume=True)) == 1
    log.remove()
    assert not path.exists()
