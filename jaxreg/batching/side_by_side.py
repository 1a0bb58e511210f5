"""How many of a batch are worked on at once."""

from typing import Any

from jaxreg._core.platforms import default_platform, platform_of


# Rows of points or edges that keep an accelerator busy, in some hundred MB to some GB.
_ROWS = 1 << 20


def side_by_side(asked: int | None, num_rows: int, *inputs: Any) -> int:
    """Those that the caller asks for, else what suits where the inputs are.

    Args:
        asked: the caller's number.
        num_rows: of one of the batch.
        inputs: arrays of the computation.
    """
    if asked is not None:
        return asked
    platform = platform_of(inputs) or default_platform()
    return 1 if platform == "cpu" else max(_ROWS // max(num_rows, 1), 1)
