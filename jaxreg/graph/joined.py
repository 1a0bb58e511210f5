"""Which edges join the same two frames, and which close a loop of three, inside jit.

Work and memory follow the edges, not the square of the frames.

Gradients: none; all is topology.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxreg._core import control


# Frames whose neighbours fit one word of the loops' bits.
_WORD = 32


class Joined(NamedTuple):
    """Edges by the two frames that they join, in either direction.

    Attributes:
        row: `(e,)` int32, one number below e for all edges of the same two frames.
        first: `(e,)` whether an edge is the first of those.
    """

    row: Int[Array, " e"]
    first: Bool[Array, " e"]


def joined(edges: Int[Array, "e 2"]) -> Joined:
    """Sorts edges by their frames."""
    low, high = jnp.min(edges, axis=1), jnp.max(edges, axis=1)
    order = jnp.lexsort((high, low))
    low, high = low[order], high[order]
    new = (low != jnp.roll(low, 1)) | (high != jnp.roll(high, 1))
    new = new.at[0].set(True)
    row = jnp.cumsum(new.astype(jnp.int32)) - 1
    return Joined(
        jnp.zeros_like(row).at[order].set(row), jnp.zeros_like(new).at[order].set(new)
    )


def in_loops_of_three(
    edges: Int[Array, "e 2"], present: Bool[Array, " e"], num_frames: int
) -> Bool[Array, " e"]:
    """Whether some third frame is joined to both ends of an edge.

    Neighbours are bits, of as many frames at a time as a word has.

    Args:
        edges: frames i and j.
        present: those that there are, no two of the same frames.
        num_frames: V.
    """
    i, j = edges[:, 0], edges[:, 1]

    def bit(frame: Array, word: Array) -> Array:
        here = present & (frame // _WORD == word)
        one = jnp.uint32(1) << (frame % _WORD).astype(jnp.uint32)
        return jnp.where(here, one, jnp.uint32(0))

    def of_word(word: Array, found: Array) -> Array:
        beside = jnp.zeros(num_frames, jnp.uint32)
        beside = beside.at[i].add(bit(j, word)).at[j].add(bit(i, word))
        return found | (present & (beside[i] & beside[j] > 0))

    none = jnp.zeros_like(present)
    return control.fori_loop(0, -(-num_frames // _WORD), of_word, none)
