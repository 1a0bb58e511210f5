"""The contract of every index of closest points.

Build once from the target points, then query any number of times:

    index = VoxelTable.build(target, mask)
    found = index.query(points)         # Neighbours(index, sq_distance, valid): (n,)
    found = index.query(points, k=5)    # the five closest, ascending: (n, 5)

An index is a pytree: it passes through `jit` and `vmap`. Which target is closest
carries no gradient; the squared distance is differentiable in queries and targets.
Hot loops call `lookup` with coordinates as rows `(d, n)`: XLA on CPU answers a voxel
table five times faster from that layout.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.brief import BriefModule
from jaxreg._core.typing import Mask, Points, Scalar


class Neighbours(BriefModule):
    """The closest target points of each query: `(n,)`, or `(n, k)` for k > 1.

    Attributes:
        index: int32 row in the target; 0 where there are too few valid targets.
        sq_distance: squared distance to it, in the target's unit squared. Ascending
            along k, up to rounding; inf where there are fewer than k valid targets.
        valid: False where there are too few valid targets, where the point found is
            farther than the radius, and where the query is not finite.
    """

    index: Int[Array, " n *k"]
    sq_distance: Float[Array, " n *k"]
    valid: Bool[Array, " n *k"]


class AbstractIndex(BriefModule):
    """Closest points of one target set."""

    points: eqx.AbstractVar[Array]
    mask: eqx.AbstractVar[Array]

    @classmethod
    @abc.abstractmethod
    def build(cls, points: Points, mask: Mask | None = None) -> "AbstractIndex":
        """Prepares the search among `(m, d)` points of which `mask` are valid."""

    @abc.abstractmethod
    def lookup(
        self, columns: Float[Array, "d n"], num: Int[Array, ""] | None = None
    ) -> Int[Array, " n"]:
        """The row of the closest valid target of each query, given as `(d, n)`.

        Any row where no target is valid or the query is not finite, and for queries
        beyond the first `num`, which save their time.
        """

    def lookup_staged(
        self,
        columns: Float[Array, "d n"],
        coarse: Bool[Array, ""],
        num: Int[Array, ""] | None = None,
    ) -> Int[Array, " n"]:
        """`lookup`, or where `coarse` is True an approximation if that is quicker."""
        return self.lookup(columns, num)

    def lookup_nearest(self, columns: Float[Array, "d n"], k: int) -> Int[Array, "k n"]:
        """The rows of the k closest valid targets, nearest first; -1 for surplus."""
        raise ValueError(
            f"{type(self).__name__} finds the closest point only (k=1), not k={k}; "
            "BruteForce takes any k"
        )

    def query(
        self, points: Points, k: int = 1, radius: Scalar | float | None = None
    ) -> Neighbours:
        """The k closest valid target points of each query.

        Args:
            points: `(n, d)` queries.
            k: static. The result has shapes `(n,)` for k = 1 and `(n, k)` for more.
            radius: farther targets are flagged invalid, in the unit of the points.

        Raises:
            ValueError: if k < 1, or more than this index can find.
        """
        if k < 1:
            raise ValueError(f"k must be at least 1, got k={k}")
        if k == 1:
            index = self.lookup(points.T)
            found = jnp.broadcast_to(jnp.any(self.mask), index.shape)
        else:
            index = self.lookup_nearest(points.T, k).T
            index, found = jnp.maximum(index, 0), index >= 0
            points = points[:, None]
        delta = points - self.points[index]
        sq = jnp.sum(delta * delta, axis=-1)
        valid = found & jnp.all(jnp.isfinite(points), axis=-1)
        if radius is not None:
            valid = valid & (sq <= jnp.asarray(radius, sq.dtype) ** 2)
        return Neighbours(index, jnp.where(found, sq, jnp.inf) if k > 1 else sq, valid)


def in_tiles(columns: Float[Array, "d n"], most: int) -> Float[Array, "a d t"]:
    """Tiles of at most so many queries, the last filled up with the last query."""
    d, n = columns.shape
    tile = min(most, n)
    padded = jnp.pad(columns, ((0, 0), (0, -n % tile)), mode="edge")
    return jnp.swapaxes(padded.reshape(d, -1, tile), 0, 1)


def map_first(
    find: Callable[[Array], Array],
    tiles: Float[Array, "a d t"],
    num: Int[Array, ""] | None,
) -> Int[Array, "a *k t"]:
    """`find` of each tile; only of those that hold the first `num` columns, if given.

    The others are zero.
    """
    if num is None:
        return lax.map(find, tiles)
    out = jax.eval_shape(find, jax.ShapeDtypeStruct(tiles.shape[1:], tiles.dtype))

    def one(at: Array, found: Array) -> Array:
        return found.at[at].set(find(tiles[at]))

    first = -(-num // tiles.shape[2])
    start = jnp.zeros((tiles.shape[0], *out.shape), out.dtype)
    return lax.fori_loop(0, first, one, start)
