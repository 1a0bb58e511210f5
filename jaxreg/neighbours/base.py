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

from jaxreg._core import control
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

    points: eqx.AbstractVar[Float[Array, "m d"]]
    mask: eqx.AbstractVar[Bool[Array, " m"]]

    @classmethod
    @abc.abstractmethod
    def build(cls, points: Points, mask: Mask | None = None) -> "AbstractIndex":
        """Prepares the search among `(m, d)` points of which `mask` are valid."""

    @property
    @abc.abstractmethod
    def reach(self) -> Scalar:
        """`query` calls targets farther than this invalid; inf if it finds them, too.

        In the unit of the points.
        """

    @abc.abstractmethod
    def lookup(
        self,
        columns: Float[Array, "d n"],
        num: Int[Array, ""] | None = None,
        coarse: Bool[Array, ""] | None = None,
    ) -> Int[Array, " n"]:
        """The row of the closest valid target of each query.

        Any row where no target is valid or the query is not finite.

        Args:
            columns: `(d, n)` queries, neighbours in space next to each other where
                that saves time.
            num: queries beyond the first so many get any row, and may save their time.
            coarse: where True, a near point will do if it is found quicker.
        """

    @abc.abstractmethod
    def lookup_nearest(self, columns: Float[Array, "d n"], k: int) -> Int[Array, "k n"]:
        """The rows of the k closest valid targets, nearest first; -1 for surplus.

        Args:
            columns: `(d, n)` queries in any order.
            k: static, at least 1.

        Raises: ValueError for more than this index can find.
        """

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
        index = self.lookup_nearest(points.T, k)
        index, points = (index[0], points) if k == 1 else (index.T, points[:, None])
        index, found = jnp.maximum(index, 0), index >= 0
        delta = points - self.points[index]
        sq = jnp.sum(delta * delta, axis=-1)
        reach = self.reach
        if radius is not None:
            reach = jnp.minimum(jnp.asarray(radius, sq.dtype), reach)
        near = jnp.all(jnp.isfinite(points), axis=-1) & (sq <= reach * reach)
        return Neighbours(index, jnp.where(found, sq, jnp.inf), found & near)


def closest_only(
    index: AbstractIndex, columns: Float[Array, "d n"], k: int
) -> Int[Array, "1 n"]:
    """`lookup_nearest` of an index that finds the closest point alone, by `lookup`."""
    if k > 1:
        raise ValueError(
            f"{type(index).__name__} finds the closest point only (k=1), not k={k}; "
            "BruteForce takes any k"
        )
    return jnp.where(jnp.any(index.mask), index.lookup(columns), -1)[None]


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
    return control.fori_loop(0, first, one, start)
