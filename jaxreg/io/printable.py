"""Text from files and their names, made safe for a terminal."""

import re


# Also what turns the direction of writing.
_CONTROL = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]"
)


def printable(text: str) -> str:
    r"""With control characters spelled out: they could move the cursor, or hide text.

    >>> print(printable("scan\x1b[2J.ply"))
    scan\x1b[2J.ply
    """
    return _CONTROL.sub(lambda m: m[0].encode("unicode_escape").decode("ascii"), text)
