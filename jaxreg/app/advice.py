"""Advice on statuses to who sits at a terminal: options of commands, not arguments."""

from jaxreg._core.status import Status


_AT_TERMINAL = {
    Status.MAX_STEPS: (
        "The steps ran out before the answer stood still. Raise --budget, or give a "
        "nearer start (register --init)."
    ),
    Status.LOW_OVERLAP: (
        "No pose was found at which enough of the two point sets agree. They may not "
        "overlap; else draw more poses (--budget 6000), or give what is known: "
        "register --init, --upright, --viewpoint, --position, multiview --positions."
    ),
    Status.AMBIGUOUS: (
        "Several poses agree about equally well (a symmetric object?), or surfaces "
        "that agree can slip along each other. report.html shows the other poses; "
        "--upright, --viewpoint 0 0 0, register --init and --position, multiview "
        "--positions tell which is meant."
    ),
    Status.DIVERGED: (
        "The steps led to a worse pose than the initial guess, which is returned. "
        "Give a nearer --init, or leave --method out: the filter searches."
    ),
    Status.NON_FINITE: (
        "A number overflowed or was not finite in the input. Check the unit of the "
        "coordinates with jaxreg info."
    ),
    Status.TOO_FEW_POINTS: (
        "Fewer distinct finite points than d + 1. Check the file with jaxreg info."
    ),
    Status.DISCONNECTED: (
        "Not all hang together by motions that are trusted: those that do with the "
        "first, or the most, are placed, others in parts of their own. Add scans "
        "between them, tell where the scanner stood in its scans (--viewpoint 0 0 0, "
        "in 2D 0 0), or trust motions that you have looked at (jaxreg average "
        "--force I,J)."
    ),
    Status.UNIT_DIFFERS: (
        "The scan is more than 50 times larger or smaller than the other or others, "
        "and does not fit. Is it in another unit? Name both: register --unit mm m."
    ),
}


def terminal_advice(status: Status) -> str:
    """`Status.advice` with the remedies that the command line has."""
    return _AT_TERMINAL.get(status, status.advice)
