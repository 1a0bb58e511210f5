"""How many of a batch are worked on at once."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax import lax

from jaxreg._core.platforms import default_platform, platform_of


Tree = TypeVar("Tree")

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


def map_side_by_side(one: Callable[[Any], Tree], items: Any, num_rows: int) -> Tree:
    """`lax.map`: one after another on a CPU, on an accelerator many at once.

    Args:
        one: works on an item.
        items: arrays with a leading axis.
        num_rows: of points, of one item.
    """
    num = len(jax.tree.leaves(items)[0])
    lanes = min(side_by_side(None, num_rows, items), num)
    return lax.map(one, items, batch_size=lanes if lanes > 1 else None)
