"""The gate fails on lost accuracy and on lost time beside a peer, and on no other."""

from dataclasses import replace

import pytest

from bench.gate import SLACK, compare, text
from bench.records import Key, Metric, Records, Row


KEYS = {
    name: Key("quick", "local_pairs", "500 points", name) for name in ("ours", "peer")
}


def _row(name: str, library: str, cpu_ms: float, e_rot: float) -> Row:
    metrics = {
        "e_rot": Metric("e_rot", e_rot, "deg", "down", 0.01),
        "cpu_ms": Metric("cpu_ms", cpu_ms, "ms", "down"),
    }
    reference = "peer" if name == "ours" else ""
    return Row(KEYS[name], library, "ok", data="made", reference=reference,
               metrics=metrics, run="r")  # fmt: skip


def _records(cpu_ms=10.0, peer_ms=20.0, e_rot=0.1, **changes) -> Records:
    ours = replace(_row("ours", "jaxreg", cpu_ms, e_rot), **changes)
    peer = _row("peer", "small_gicp", peer_ms, 0.2)
    return Records({row.key: row for row in (ours, peer)}, {})


def _verdict(now: Records):
    return compare(now, _records(), "quick", ["local_pairs"])


def test_equal_results_pass():
    verdict = _verdict(_records())
    assert verdict.passed
    assert verdict.compared == 2


def test_loss_of_accuracy_fails():
    assert _verdict(_records(e_rot=0.109)).passed
    verdict = _verdict(_records(e_rot=0.12))
    assert not verdict.passed
    assert "e_rot 0.12 deg, in the baseline 0.1" in text(verdict)


def test_loss_beside_the_peer_fails_and_a_slower_machine_does_not():
    assert _verdict(_records(cpu_ms=100, peer_ms=200)).passed
    assert _verdict(_records(cpu_ms=10 * SLACK * 0.99)).passed
    verdict = _verdict(_records(cpu_ms=10 * SLACK * 1.01))
    assert not verdict.passed
    assert "x the time of peer" in text(verdict)


@pytest.mark.parametrize("status", ["failed", "absent"])
def test_a_row_of_ours_that_is_not_there_fails(status):
    assert not _verdict(_records(status=status, why="broken")).passed
    peer_alone = Records({KEYS["peer"]: _row("peer", "small_gicp", 1, 1)}, {})
    verdict = _verdict(peer_alone)
    assert not verdict.passed
    assert "not measured" in text(verdict)


def test_times_of_different_runs_are_not_compared():
    assert "no time of peer" in text(_verdict(_records(cpu_ms=1000.0, run="other")))


def test_other_data_are_not_compared_and_nothing_compared_is_no_pass():
    verdict = _verdict(_records(data="other", e_rot=9.0))
    assert not verdict.losses
    assert not verdict.passed
