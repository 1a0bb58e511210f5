"""Parts: scans that hang together, each told by the lowest number of its scans."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


def part_sizes(part: Int[Array, " v"]) -> Int[Array, " v"]:
    """How many scans are of each scan's part."""
    return jnp.zeros_like(part).at[part].add(1)[part]


def first_where(part: Int[Array, " v"], holds: Bool[Array, " v"]) -> Int[Array, " v"]:
    """The first scan of each scan's part for which something holds; v where none."""
    num = part.shape[0]
    ids = jnp.arange(num, dtype=part.dtype)
    least = jnp.full_like(part, num).at[part].min(jnp.where(holds, ids, num))
    return least[part]


def in_main_body(body: Int[Array, " v"], part: Int[Array, " v"]) -> Bool[Array, " v"]:
    """Whether each scan's body is the largest in its part, the first of equal ones."""
    size = part_sizes(body)
    largest = jnp.zeros_like(size).at[part].max(size)[part]
    return body == body[first_where(part, size == largest)]


def part_numbers(part: Int[Array, " v"], world: Int[Array, ""]) -> Int[Array, " v"]:
    """`(v,)` number of each scan's part, the largest first; -1 of scans alone.

    Where every scan is alone, the first of them is the largest part. The part that lies
    in a known world comes before all.

    Args:
        part: of each scan.
        world: the part in a known world, -1 if there is none.
    """
    num = part.shape[0]
    ids = jnp.arange(num, dtype=part.dtype)
    size = part_sizes(part)
    rank = jnp.where(part == world, num + size, size)
    rank = jnp.where(part == ids, rank, 0)  # of each part its first scan alone
    order = jnp.lexsort((ids, -rank))
    number = jnp.zeros_like(part).at[order].set(ids)[part]
    return jnp.where((size > 1) | (number == 0), number, -1).astype(jnp.int32)
