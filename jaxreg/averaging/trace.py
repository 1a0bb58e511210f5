"""How an averaging method came to rest: one row a step."""

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.brief import BriefModule


class AveragingTrace(BriefModule):
    """The steps of an averaging method; of no influence on the answer.

    `Correntropy()` on a graph of more than `DENSE_LIMIT` frames has a row for each
    kernel width, under which it takes many steps.

    Attributes:
        num_rows: int32, rows in use; the others are zero.
        change: `(s,)` the largest rotation of a frame in the step, in radians, or shift
            as a share of the size of the scene; 0 for a step that was refused.
        kernel_width: `(s, 2)` for translation (unit of the input) and rotation
            (radians); inf without such a kernel.
        trust: `(s,)` mean trust of the edges in the step, by prior weight. What it
            falls short of one is the loss under a Gaussian kernel.

    Gradients: none.
    """

    num_rows: Int[Array, "*b"]
    change: Float[Array, "*b s"]
    kernel_width: Float[Array, "*b s 2"]
    trust: Float[Array, "*b s"]

    @classmethod
    def of(
        cls, rows: Float[Array, "s 4"], num_rows: Int[Array, ""]
    ) -> "AveragingTrace":
        """From rows that `with_row` has filled in."""
        return cls(num_rows, rows[:, 0], rows[:, 1:3], rows[:, 3])

    def in_unit(self, length: Float[Array, ""]) -> "AveragingTrace":
        """With kernel widths in another unit of length, which is `1 / length`."""
        unit = jnp.stack([length, jnp.ones_like(length)])
        return dataclasses.replace(self, kernel_width=self.kernel_width * unit[None])


def no_rows(num: int, dtype: jnp.dtype) -> Float[Array, "s 4"]:
    """Room for the rows of a trace; an array of its own is cheap to carry in a loop."""
    return jnp.zeros((num, 4), dtype)


def with_row(
    rows: Float[Array, "s 4"],
    row: Int[Array, ""],
    change: Float[Array, ""],
    kernel_width: Float[Array, "2"],
    trust: Float[Array, ""],
) -> Float[Array, "s 4"]:
    """With one more row."""
    new = jnp.stack([change, *kernel_width, trust])
    return lax.dynamic_update_index_in_dim(rows, new, row, 0)
