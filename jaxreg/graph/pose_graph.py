"""`PoseGraph`: relative motions between frames, the input of motion averaging."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.checks import (
    as_float_array,
    check_count,
    check_mask,
    is_concrete,
    shown,
)
from jaxreg._core.quantile import nearest_rank
from jaxreg._core.typing import ArrayLike
from jaxreg.geometry import lie
from jaxreg.graph.edge_checks import (
    check_extra,
    check_ids,
    check_ids_values,
    check_information,
    check_motions,
    check_weights,
    count_poses,
)
from jaxreg.linear.small import product


class PoseGraph(eqx.Module):
    """Edges (i, j) that hold `T_i_j`, which maps frame j into frame i.

    A pytree of arrays with a static number of poses; build it with `from_edges`.
    Padded edges have `mask` False and count for nothing. Several edges between the
    same two frames, in any direction and order, are several measurements.

    Attributes:
        edges: `(e, 2)` int32, the frames i and j of each edge.
        T_i_j: `(e, d+1, d+1)` relative motions, `inv(T_world_i) @ T_world_j`.
        weight: `(e,)` prior weight of each edge, at least 0; 0 where masked.
        mask: `(e,)` True for real edges.
        information: `(e, k, k)` information matrix, or None, of the right tangent
            error `log(inv(T_i_j) inv(T_world_i) T_world_j)`, translation first: the
            frame and order of g2o.
        num_poses: number of frames, static.
    """

    edges: Int[Array, "e 2"]
    T_i_j: Float[Array, "e D D"]
    weight: Float[Array, " e"]
    mask: Bool[Array, " e"]
    information: Float[Array, "e k k"] | None
    num_poses: int = eqx.field(static=True)

    @classmethod
    def from_edges(
        cls,
        edges: ArrayLike,
        T_i_j: ArrayLike,
        num_poses: int | None = None,
        weight: ArrayLike | None = None,
        information: ArrayLike | None = None,
        mask: ArrayLike | None = None,
    ) -> "PoseGraph":
        """Checks relative motions and makes a graph of them.

            >>> import jaxreg as jr
            >>> T_0_1 = [[0, -1, 2], [1, 0, 0], [0, 0, 1]]
            >>> jr.PoseGraph.from_edges([(0, 1)], [T_0_1])
            PoseGraph(2 poses in 2D, 1 edges, float32)

        Args:
            edges: `(e, 2)` integers, the frames i and j, counted from 0.
            T_i_j: `(e, d+1, d+1)` motions that map frame j into frame i, float32 or
                float64; the graph has their dtype.
            num_poses: number of frames; None for the largest id plus one.
            weight: `(e,)` prior weights of at least 0, or None for all one.
            information: `(e, k, k)` positive semidefinite matrices, or None.
            mask: `(e,)` False for padding, whose other values do not matter.

        Raises:
            ValueError: for wrong shapes; and, where the values are known (not while
                tracing), for ids out of range, self-edges, numbers that are not finite,
                negative weights, indefinite information, and matrices that are further
                than 1e-2 from a motion. Nearer ones are projected onto SE(d). The
                message names the first such edge.
        """
        motions = as_float_array(T_i_j, "T_i_j")
        if motions.ndim != 3 or motions.shape[1:] not in ((3, 3), (4, 4)):
            raise ValueError(
                f"T_i_j: wanted shape (e, 3, 3) or (e, 4, 4), found {motions.shape}."
            )
        num, dtype = motions.shape[0], motions.dtype
        ids = check_ids(edges, num)
        valid = check_mask(mask, (num,), "mask")
        weights = check_extra(weight, (num,), "weight", dtype)
        k = lie.tangent_dim(motions.shape[-1] - 1)
        info = check_extra(information, (num, k, k), "information", dtype)
        if num_poses is None:
            num_poses = count_poses(ids, valid)
        check_count(num_poses, "num_poses")
        check_ids_values(ids, valid, num_poses)
        motions = check_motions(motions, ids, valid)
        check_weights(weights, ids, valid)
        check_information(info, ids, valid)
        graph = cls(
            edges=ids,
            T_i_j=motions,
            weight=jax.device_put(np.ones(num, dtype)) if weights is None else weights,
            mask=valid,
            information=info,
            num_poses=num_poses,
        )
        return graph._cleaned() if num else graph.padded(1)

    def _cleaned(self) -> "PoseGraph":
        """The graph with harmless values in the masked rows."""
        # On the host if it can be: another number of edges compiles nothing.
        on_host = all(map(is_concrete, jax.tree.leaves(self)))
        put, host = (jax.device_put, np.asarray) if on_host else (jnp.asarray,) * 2
        mask = host(self.mask)
        keep = mask[:, None, None]

        def where(real: Any, x: Array, other: Any) -> Array:
            return put((np if on_host else jnp).where(real, host(x), other))

        eye = np.eye(self.T_i_j.shape[-1], dtype=self.T_i_j.dtype)[None]
        info = self.information
        return PoseGraph(
            edges=where(mask[:, None], self.edges, 0),
            T_i_j=where(keep, self.T_i_j, eye),
            weight=where(mask, self.weight, 0),
            mask=self.mask,
            information=None if info is None else where(keep, info, 0),
            num_poses=self.num_poses,
        )

    def padded(self, num_edges: int) -> "PoseGraph":
        """The same graph with masked edges appended up to `num_edges`.

        Args:
            num_edges: the new number of rows, at least the present one.
        """
        extra = num_edges - self.edges.shape[0]
        if extra < 0:
            raise ValueError(
                f"num_edges: wanted at least {self.edges.shape[0]}, found {num_edges}."
            )

        def pad(x: Array) -> Array:
            return jnp.pad(x, [(0, extra)] + [(0, 0)] * (x.ndim - 1))

        return jax.tree.map(pad, self)._cleaned()

    @property
    def num_edges(self) -> int:
        """Rows of `edges`, padding included (static)."""
        return self.edges.shape[-2]

    @property
    def dim(self) -> int:
        """The dimension d of space, 2 or 3."""
        return self.T_i_j.shape[-1] - 1

    @property
    def successive(self) -> Bool[Array, " e"]:
        """Which edges join frames of successive numbers, as the steps of a sequence."""
        return jnp.abs(self.edges[:, 0] - self.edges[:, 1]) == 1

    @property
    def length_scale(self) -> Float[Array, ""]:
        """The length that stands for one radian: the mean |t_i_j| of the middle half.

        It comes from the data, so that another unit of length gives the same answer.
        Half of the edges may be wrong without moving it far. 1 if there is no length.

        Gradients: none (cut).
        """
        shift = lie.translation(jax.lax.stop_gradient(self.T_i_j))
        length, valid = jnp.linalg.norm(shift, axis=-1), self.weight > 0
        quarters = jnp.asarray([0.25, 0.75], length.dtype)
        low, high = jax.vmap(lambda q: nearest_rank(length, valid, q))(quarters)
        middle = valid & (length >= low) & (length <= high)
        count = jnp.maximum(jnp.sum(middle), 1).astype(length.dtype)
        mean = jnp.sum(jnp.where(middle, length, 0)) / count
        return jnp.where(mean > 0, mean, 1)

    @property
    def held(self) -> Bool[Array, " v"]:
        """Which frames edges hold; padding is not held."""
        w = self.weight
        most = jnp.zeros((self.num_poses,), w.dtype)
        return most.at[self.edges.T.reshape(-1)].max(jnp.concatenate([w, w])) > 0

    @property
    def num_held(self) -> Float[Array, ""]:
        """The number of frames that edges hold, at least one."""
        return jnp.maximum(jnp.sum(self.held, dtype=self.weight.dtype), 1)

    def predicted(self, T_world_i: Float[Array, "v D D"]) -> Float[Array, "e D D"]:
        """What poses make of each motion: `inv(T_world_i) T_world_j`."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        return lie.between(T_world_i[i], T_world_i[j])

    def residual_motions(
        self, T_world_i: Float[Array, "v D D"]
    ) -> Float[Array, "e D D"]:
        """`T_world_i T_i_j inv(T_world_j)` of each edge (MCC paper, Eq. 14)."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        half = product(T_world_i[i], self.T_i_j)
        return product(half, lie.inverse(T_world_i)[j])

    def differences(
        self, T_world_i: Float[Array, "v D D"]
    ) -> tuple[Float[Array, " e"], Float[Array, " e"]]:
        """Squared Frobenius norms of `T_i_j - inv(T_world_i) T_world_j` by block.

        Returns:
            Of the rotation (about 2 angle^2) and of the translation (length^2); 0 where
            masked.
        """
        return self.differences_from(self.predicted(T_world_i))

    def differences_from(
        self, T_i_j: Float[Array, "e D D"]
    ) -> tuple[Float[Array, " e"], Float[Array, " e"]]:
        """`differences` of poses that make T_i_j of the motions (`predicted`)."""
        gap = self.T_i_j - T_i_j
        gap = jnp.where(self.mask[:, None, None], gap, 0)
        return (
            jnp.sum(lie.rotation(gap) ** 2, axis=(-2, -1)),
            jnp.sum(lie.translation(gap) ** 2, axis=-1),
        )

    def tangent_errors(self, T_world_i: Float[Array, "v D D"]) -> Float[Array, "e k"]:
        """`log(inv(T_i_j) inv(T_world_i) T_world_j)`, the error of g2o and GTSAM."""
        return lie.log(lie.between(self.T_i_j, self.predicted(T_world_i)))

    def __repr__(self) -> str:
        batch = self.edges.shape[:-2]
        of = f"batch {batch} of " if batch else ""
        return (
            f"PoseGraph({of}{self.num_poses} poses in {self.dim}D, "
            f"{self.num_edges} edges, {self.T_i_j.dtype})"
        )


def check_graph(graph: object, name: str) -> PoseGraph:
    """Requires one PoseGraph."""
    if not isinstance(graph, PoseGraph):
        raise TypeError(
            f"{name}: wanted a PoseGraph (see PoseGraph.from_edges), "
            f"found {shown(graph)}."
        )
    if graph.edges.ndim != 2:
        raise ValueError(
            f"{name}: wanted one graph, found leading axes {graph.edges.shape[:-2]}. "
            "Use a list of graphs, or jax.vmap."
        )
    return graph


def check_poses(T: object, name: str, graph: PoseGraph) -> Float[Array, "v D D"]:
    """Requires a pose for each frame of a graph, in its dtype."""
    wanted = (graph.num_poses, graph.dim + 1, graph.dim + 1)
    found = as_float_array(T, name).astype(graph.T_i_j.dtype)
    if found.shape != wanted:
        raise ValueError(f"{name}: wanted shape {wanted}, found {found.shape}.")
    return found
