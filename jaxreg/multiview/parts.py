"""Parts: scans that hang together, each told by the lowest number of its scans."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg.graph.joined import in_loops_of_three, joined
from jaxreg.graph.trees import components


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


def confirmed_parts(
    pairs: Int[Array, "e 2"],
    weight: Float[Array, " e"],
    num_scans: int,
    strong: Bool[Array, " e"],
) -> Int[Array, " v"]:
    """Components joined by strong pairs, or by pairs that agree and are confirmed.

    Pairs confirm each other that join the same two parts, or three parts in a loop:
    that wrong ones agree with the poses by chance is far less likely than any one of
    them being wrong. What they join is one part from then on.
    """
    ones = jnp.ones(len(weight), jnp.int32)

    def merged(state: tuple[Array, Array]) -> tuple[Array, Array]:
        part, _ = state
        ends = part[pairs]
        within = ends[:, 0] == ends[:, 1]
        present = (weight > 0) & ~within
        # Pairs that do not count are of no two parts.
        ends = jnp.where(present[:, None], ends, num_scans - 1)
        same = joined(ends)
        twice = jax.ops.segment_sum(ones, same.row, len(ones))[same.row] >= 2
        loop = in_loops_of_three(ends, present & same.first, num_scans)
        loop = jax.ops.segment_max(loop.astype(jnp.int32), same.row, len(ones))
        confirmed = within | twice | (loop[same.row] > 0)
        new = components(pairs, jnp.where(confirmed, weight, 0), num_scans)
        return new, jnp.any(new != part)

    core = components(pairs, jnp.where(strong, weight, 0), num_scans)
    return control.while_loop(lambda s: s[1], merged, (core, jnp.asarray(True)))[0]
