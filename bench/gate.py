"""Compares a run with a baseline: accuracy, and time beside a peer in the same run.

Absolute times are never compared: machines differ, and so do their minutes.
"""

from typing import NamedTuple

from bench.records import Key, Metric, Records, Row


#: By how much the ratio of CPU times to the reference may grow over the baseline's.
#: Machines differ in it, too: the same programs had 0.66 to 1.85 times the baseline's
#: ratios on one that is slower (BruteForce 1.75, ICP 1.85).
SLACK = 2.5


class Verdict(NamedTuple):
    """Losses, what could not be compared, and how many numbers were."""

    losses: list[str]
    notes: list[str]
    compared: int

    @property
    def passed(self) -> bool:
        """Something was compared, and nothing lost."""
        return not self.losses and self.compared > 0


def compare(
    now: Records, baseline: Records, mode: str, workloads: list[str]
) -> Verdict:
    """Every row of jaxreg in the baseline, against the one measured now."""
    losses, notes, compared = [], [], 0
    for key, old in baseline.rows.items():
        asked = key.mode == mode and key.workload in workloads
        if not asked or old.library != "jaxreg" or old.status != "ok":
            continue
        where = f"{key.workload}, {key.case}, {key.method}"
        new = now.rows.get(key)
        if new is None or new.status != "ok":
            why = "not measured" if new is None else f"{new.status}: {new.why}"
            losses.append(f"{where}: {why}")
            continue
        if new.data != old.data:
            notes.append(f"{where}: other data ({new.data}), not compared")
            continue
        found, count = _accuracy(new, old)
        compared += count
        losses += [f"{where}: {text}" for text in found]
        ratio = _ratio(now, new)
        before = _ratio(baseline, old)
        if ratio is None or before is None:
            if old.reference:
                notes.append(f"{where}: no time of {old.reference} to compare with")
            continue
        compared += 1
        if ratio > SLACK * before:
            losses.append(
                f"{where}: {ratio:.2f} x the time of {old.reference}, in the baseline "
                f"{before:.2f} x (up to {SLACK:g} times that is allowed)"
            )
    return Verdict(losses, notes, compared)


def _accuracy(new: Row, old: Row) -> tuple[list[str], int]:
    """What was lost, and how many metrics were compared."""
    losses, compared = [], 0
    for key, metric in old.metrics.items():
        if metric.tolerance is None:
            continue
        compared += 1
        value = new.metrics.get(key)
        if value is None:
            losses.append(f"{key} is missing")
        elif value.worse_than(metric):
            losses.append(
                f"{key} {value.value:.4g} {value.unit}, in the baseline "
                f"{metric.value:.4g} (tolerance {metric.tolerance:.2g})"
            )
    return losses, compared


def _ratio(records: Records, row: Row) -> float | None:
    """CPU time over that of the reference; wall time where work is in processes.

    Of each the lower quartile: other work on the machine adds to some calls.
    """
    if not row.reference:
        return None
    key = Key(*row.key[:3], row.reference)
    other = records.rows.get(key)
    if other is None or other.status != "ok" or other.run != row.run:
        return None
    for name in ("cpu_ms", "wall_ms"):
        own, peer = row.metrics.get(name), other.metrics.get(name)
        if own is not None and peer is not None:
            return _low(own) / max(_low(peer), 1e-9)
    return None


def _low(metric: Metric) -> float:
    return metric.value if metric.spread is None else metric.spread[0]


def text(verdict: Verdict) -> str:
    """For the terminal."""
    lines = [f"  lost: {x}" for x in verdict.losses]
    lines += [f"  note: {x}" for x in verdict.notes]
    state = "passed" if verdict.passed else "FAILED"
    lines.append(
        f"gate {state}: {verdict.compared} numbers compared, "
        f"{len(verdict.losses)} lost, {len(verdict.notes)} not compared"
    )
    return "\n".join(lines)
