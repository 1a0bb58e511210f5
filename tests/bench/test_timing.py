"""Calls that never end are ended."""

import time

import pytest

from bench.timing import within


def test_a_call_in_a_process_of_its_own_answers_or_is_ended():
    assert within(60, abs, -2) == 2
    begin = time.monotonic()
    with pytest.raises(TimeoutError, match="no answer in 0.5 s"):
        within(0.5, time.sleep, 60)
    assert time.monotonic() - begin < 30
    with pytest.raises(ZeroDivisionError):
        within(60, divmod, 1, 0)
