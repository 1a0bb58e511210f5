"""Normals from the moments of cells: no search for neighbours.

Every cell keeps the number, mean and spread of its points. The moments around a place
are those of its 2^d nearest cells with multilinear weights, so the window of about two
cells moves with the place; the direction of least spread is the normal (Hoppe et al.
1992). Where the window holds too little to span a plane, cells of two and four times
the size answer. One sort, O(n) memory.

Derivatives hold which cell a point is in, and which level answers a place; places,
points and the size of the cells move. They are those of the eigenvectors at the levels
that answered, which are not searched for again.
"""

import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg._core.arrays import place_among
from jaxreg._core.platforms import by_platform
from jaxreg._core.typing import Scalar
from jaxreg.cloud.cells import UNUSED, bits_per_axis, morton_keys
from jaxreg.geometry.eigen import least_eigenvectors
from jaxreg.neighbours.sorting import rows_in_order


# Windows are made of cells of at last 8 times the size that keys were made with.
_COARSEST = 3
# The second least spread of a window, in cells, below which it does not span a plane.
# A window full of a plane has 0.25.
_SPAN_SQ = 0.03
_MIN_POINTS = 5
# Places that are answered at once.
_BLOCK = 256


def normals_from_cells(
    places: Float[Array, "p d"],
    mask: Bool[Array, " p"],
    points: Float[Array, "n d"],
    keys: Int[Array, " n"],
    size: Scalar,
    finest: int | Int[Array, ""],
) -> tuple[Float[Array, "p d"], "Windows"]:
    """Unit normals of either sign at `places`; zero where undefined.

    And the windows that they come from, which their derivatives are of.

    Args:
        places: where normals are wanted, relative to the corner of the cells.
        mask: False for places that are not.
        points: the samples, in the order of their keys, relative to that corner.
        keys: ascending Morton numbers of the points' cells.
        size: side of those cells.
        finest: windows are made of cells of 2^finest times that size first, then of
            twice as large ones.

    Gradients: those of the windows; the normals as they are returned are cut.
    """
    frozen = lax.stop_gradient((places, mask, points, keys, size, finest))
    normals, level = _search(*frozen)
    return normals, Windows(level, places, points, keys, size)


class Windows(eqx.Module):
    """What normals depend on. Outside of loops: JAX drops their rules in those.

    (In jax 0.10.2 the derivative of a reverse pass through `lax.map` knows no more of
    the `custom_jvp` inside.)

    Attributes:
        level: of the cells that a place is answered by; -1 of none.
        places, points, keys, size: as of `normals_from_cells`.

    Gradients: of normals exact by places, points and size, in O(p + n) memory.
    """

    level: Int[Array, " p"]
    places: Float[Array, "p d"]
    points: Float[Array, "n d"]
    keys: Int[Array, " n"]
    size: Scalar

    def follow(self, normals: Float[Array, "p d"]) -> Float[Array, "p d"]:
        """The same normals, with derivatives."""
        return _with_slopes(lax.stop_gradient(normals), self)

    def again(self) -> Float[Array, "p d"]:
        """The normals by the levels that are known; zero of places without."""

        def at_level(normals: Array, level: Array) -> Array:
            cells = _moments_of_cells(self.points, self.keys, self.size, level)
            vectors = _least_spread(self.places, cells, self.size, level)[0]
            return jnp.where((self.level == level)[None], vectors, normals)

        @jax.checkpoint
        def fill(normals: Array, level: Array) -> tuple[Array, None]:
            used = jnp.any(self.level == level)
            return control.cond(used, at_level, lambda x, _: x, normals, level), None

        levels = jnp.arange(_COARSEST + 1, dtype=jnp.int32)
        return control.scan(fill, jnp.zeros_like(self.places.T), levels)[0].T


@eqx.filter_custom_jvp
def _with_slopes(normals: Float[Array, "p d"], at: Windows) -> Float[Array, "p d"]:
    """The normals; nothing is computed for their derivatives until those are asked."""
    return normals


@_with_slopes.def_jvp
def _with_slopes_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    normals = _with_slopes(*primals)
    slope = eqx.filter_jvp(lambda at: at.again(), primals[1:], tangents[1:])[1]
    return normals, jnp.zeros_like(normals) if slope is None else slope


def _search(
    places: Float[Array, "p d"],
    mask: Bool[Array, " p"],
    points: Float[Array, "n d"],
    keys: Int[Array, " n"],
    size: Scalar,
    finest: int | Int[Array, ""],
) -> tuple[Float[Array, "p d"], Int[Array, " p"]]:
    """The normals, and the levels of the cells that they come from; -1 of none."""
    d, p = points.shape[1], places.shape[0]

    def unfinished(state: tuple[Array, ...]) -> Array:
        level, _, _, done = state
        return (level <= _COARSEST) & ~jnp.all(done)

    def fill(state: tuple[Array, ...]) -> tuple[Array, ...]:
        level, normals, levels, done = state
        cells = _moments_of_cells(points, keys, size, level)
        # Few places need the coarser levels: those without a normal come first.
        rows = rows_in_order(done.astype(jnp.int32), 1)

        def block(b: Array, state: tuple[Array, ...], width: int) -> tuple[Array, ...]:
            normals, levels, done = state
            at = lax.dynamic_slice_in_dim(rows, b * width, width)
            vectors, spans = _least_spread(places[at], cells, size, level)
            new = spans & ~done[at]
            vectors = jnp.where(new[None], vectors, normals[:, at])
            return (
                normals.at[:, at].set(vectors),
                levels.at[at].set(jnp.where(new, level, levels[at])),
                done.at[at].set(done[at] | spans),
            )

        def by_blocks(width: int) -> tuple[Array, ...]:
            blocks, of_one = -(-jnp.sum(~done) // width), partial(block, width=width)
            return control.fori_loop(0, blocks, of_one, (normals, levels, done))

        # An accelerator waits for each turn of a loop.
        out = by_platform(
            lambda: by_blocks(min(_BLOCK, p)),
            lambda: block(jnp.zeros((), jnp.int32), (normals, levels, done), p),
        )
        return level + 1, *out

    level, none = jnp.asarray(finest, jnp.int32), jnp.full(p, -1, jnp.int32)
    start = level, jnp.zeros((d, p), points.dtype), none, ~mask
    _, normals, levels, _ = control.while_loop(unfinished, fill, start)
    return normals.T, levels


def _least_spread(
    places: Array, cells: tuple[Array, Array], size: Array, level: Array
) -> tuple[Float[Array, "d p"], Bool[Array, " p"]]:
    d = places.shape[1]
    size = size * (1 << level).astype(size.dtype)
    cell_key, moments = cells
    at = (places / size).T - 0.5
    base = jnp.floor(at)
    offset = at - base
    last = (1 << (bits_per_axis(d) - level)) - 1
    corners = np.array(list(itertools.product((0, 1), repeat=d)))
    cell = base.astype(jnp.int32)[None] + corners[:, :, None]  # (2^d, d, p)
    inside = jnp.all((cell >= 0) & (cell <= last), axis=1)
    key = morton_keys(jnp.swapaxes(jnp.clip(cell, 0, last), 0, 1))
    row = jnp.minimum(place_among(cell_key, key), len(cell_key) - 1)
    far, offset = corners[:, :, None] == 1, offset[None]
    weight = jnp.prod(jnp.where(far, offset, 1 - offset), axis=1)
    weight = jnp.where(inside & (cell_key[row] == key), weight, 0)
    num = jnp.sum(jnp.where(weight > 0, moments[0, row], 0), axis=0)
    near = (weight[None] * moments[:, row]).reshape(-1, places.shape[0])
    shift = jnp.asarray(_shift_to_base(corners), at.dtype)
    total = jnp.matmul(shift, near, precision=lax.Precision.HIGHEST)
    count = jnp.where(total[0] > 0, total[0], 1)
    mean = total[1 : d + 1] / count[None]
    spread = [
        [total[_place_of(i, j, d)] / count - mean[i] * mean[j] for j in range(d)]
        for i in range(d)
    ]
    vectors, second, _ = least_eigenvectors(jnp.stack([jnp.stack(r) for r in spread]))
    return vectors, (num >= _MIN_POINTS) & (second > _SPAN_SQ)


def _moments_of_cells(
    points: Array, keys: Array, size: Array, level: Array
) -> tuple[Int[Array, " n"], Float[Array, "r n"]]:
    """Ascending numbers of filled cells, and sums of (1, x, x x') about their centres.

    Lengths are in cells. Rows beyond the last filled cell are `UNUSED` and zero.
    """
    n, d = points.shape
    size = size * (1 << level).astype(size.dtype)
    key = jnp.where(keys == UNUSED, UNUSED, keys >> (d * level))
    new = jnp.concatenate(
        [jnp.zeros(1, jnp.int32), (key[1:] != key[:-1]).astype(jnp.int32)]
    )
    cell = jnp.cumsum(new)
    cell_key = jnp.full(n, UNUSED, jnp.int32).at[cell].set(key)
    x = (points / size).T
    x = x - jnp.floor(x) - 0.5
    rows = [jnp.ones_like(x[0]), *x]
    rows += [x[i] * x[j] for i in range(d) for j in range(i, d)]
    rows = jnp.where((key == UNUSED)[None], 0, jnp.stack(rows))
    sums = jax.ops.segment_sum(rows.T, cell, n, indices_are_sorted=True)
    return cell_key, sums.T


def _shift_to_base(corners: np.ndarray) -> np.ndarray:
    """`(r, r * 2^d)`: sums moments of cells, given about each corner's own centre.

    With y = x + c, the sums of 1, y, y y' are linear in those of 1, x, x x'.
    """
    d = corners.shape[1]
    num_rows = 1 + d + d * (d + 1) // 2
    out = np.zeros((num_rows, num_rows, len(corners)))
    for at, corner in enumerate(corners):
        out[range(num_rows), range(num_rows), at] = 1
        out[1 : d + 1, 0, at] = corner
        for i in range(d):
            for j in range(i, d):
                row = _place_of(i, j, d)
                out[row, 0, at] = corner[i] * corner[j]
                out[row, 1 + j, at] += corner[i]
                out[row, 1 + i, at] += corner[j]
    return out.reshape(num_rows, -1)


def _place_of(i: int, j: int, d: int) -> int:
    """The row of the second moment of axes i and j."""
    pairs = [(a, b) for a in range(d) for b in range(a, d)]
    return 1 + d + pairs.index((min(i, j), max(i, j)))
