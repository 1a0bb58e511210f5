"""What both papers leave open, varied one at a time: see `docs/pages/readings.md`."""

from collections.abc import Iterator

from bench.case import Case, Options
from bench.workloads import readings_averaging, readings_filter


def cases(options: Options) -> Iterator[Case]:
    """The best of each paper with what stands beside it, then the horse's others."""
    yield from readings_filter.cases(options)
    yield from readings_averaging.cases(options)
    yield from readings_filter.other_cases(options)
