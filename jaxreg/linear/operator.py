"""Graph Laplacians with k x k weights as linear operators of lineax.

The Laplacian of weights W_e is the matrix of sum_e (x_j - x_i)' W_e (x_j - x_i): scalar
weights in motion averaging (the stacked system D A = dV of the MCC paper, Eq. 17-20,
has D = B (x) I_k with B the weighted incidence matrix), k x k ones in Gauss-Newton
steps with left tangents. It is never formed beyond its blocks, unless asked for.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.platforms import once
from jaxreg.linear.carried import carried, carried_back, stiffness_carried_back
from jaxreg.linear.small import product


class GraphLaplacian(lx.AbstractLinearOperator):
    """sum_e (x_j - C_ij x_i)' W_e (x_j - C_ij x_i) + sum_i x_i' own_i x_i, a matrix.

    It maps `(v, k, c)`, c columns that it treats alike and apart.

    Attributes:
        edges: `(e, 2)` frames i and j.
        weight: `(e, k, k)` symmetric positive semidefinite, at the point of j.
        own: `(v, k, k)` what ties each frame to the ground.
        origin: `(v, d)` the point of each frame; None where all x are taken at the same
            one, or are no velocities: C_ij is 1.
        columns: c (static).
    """

    edges: Int[Array, "e 2"]
    weight: Float[Array, "e k k"]
    own: Float[Array, "v k k"]
    origin: Float[Array, "v d"] | None = None
    columns: int = eqx.field(static=True, default=1)

    @classmethod
    def anchored(
        cls,
        edges: Int[Array, "e 2"],
        weight: Float[Array, "e k k"],
        num_poses: int,
        damping: Float[Array, ""] | float = 0.0,
        origin: Float[Array, "v d"] | None = None,
        columns: int = 1,
        anchor: Int[Array, ""] | int = 0,
    ) -> "GraphLaplacian":
        """With `damping` times its diagonal, and one frame tied to the ground.

        Without damping, and for right-hand sides that sum to 0, the tie bears nothing:
        solutions are those with x = 0 of the anchor.
        """
        none = jnp.zeros((num_poses, *weight.shape[1:]), weight.dtype)
        blocks = cls(edges, weight, none, origin).blocks()
        own = (damping * blocks).at[anchor].add(blocks[anchor])
        return cls(edges, weight, own, origin, columns)

    def mv(self, vector: Float[Array, "v k c"]) -> Float[Array, "v k c"]:
        """The product, one pass over the edges."""
        strain = once(self.strain, vector, true=self._true)
        flow = once(product, self.weight, strain, true=self._true)
        return product(self.own, vector) + self.divergence(flow)

    def strain(self, vector: Float[Array, "v k c"]) -> Float[Array, "e k c"]:
        """B x: the difference on each edge, seen from the point of j."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        seen = vector[i] if self.origin is None else carried(vector[i], self.levers)
        return vector[j] - seen

    def divergence(self, flow: Float[Array, "e k c"]) -> Float[Array, "v k c"]:
        """B' flow: the forces of the edges on their frames."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        back = flow if self.origin is None else carried_back(flow, self.levers)
        out = jnp.zeros((len(self.own), *flow.shape[1:]), flow.dtype)
        return out.at[j].add(flow).at[i].add(-back)

    @property
    def _true(self) -> Bool[Array, ""]:
        return self.edges[0, 0] >= 0

    @property
    def levers(self) -> Float[Array, "e d"]:
        """From the point of i to that of j."""
        assert self.origin is not None
        return self.origin[self.edges[:, 1]] - self.origin[self.edges[:, 0]]

    def weight_at_i(self) -> Float[Array, "e k k"]:
        """The weights seen from the points of i."""
        if self.origin is None:
            return self.weight
        return once(stiffness_carried_back, self.weight, self.levers, true=self._true)

    def blocks(self) -> Float[Array, "v k k"]:
        """The blocks of the diagonal."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        return self.own.at[i].add(self.weight_at_i()).at[j].add(self.weight)

    def across(self) -> Float[Array, "e k k"]:
        """What frame i does to frame j: minus the block in row j, column i."""
        if self.origin is None:
            return self.weight
        return jnp.swapaxes(carried_back(self.weight, self.levers), -1, -2)

    def dense(self) -> Float[Array, "n n"]:
        """`(v k, v k)`, for few frames: the matrix of one column."""
        num, k = self.own.shape[:2]
        i, j = self.edges[:, 0], self.edges[:, 1]
        across = self.across()
        frame = jnp.arange(num)
        full = jnp.zeros((num, num, k, k), self.own.dtype)
        full = full.at[frame, frame].add(self.blocks())
        full = full.at[j, i].add(-across).at[i, j].add(-jnp.swapaxes(across, -1, -2))
        return full.transpose(0, 2, 1, 3).reshape(num * k, num * k)

    def as_matrix(self) -> Float[Array, "n n"]:
        """`(v k c, v k c)`."""
        return jnp.kron(self.dense(), jnp.eye(self.columns, dtype=self.own.dtype))

    def transpose(self) -> "GraphLaplacian":
        """Itself: it is symmetric."""
        return self

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """`(v, k, c)`."""
        shape = (*self.own.shape[:2], self.columns)
        return jax.ShapeDtypeStruct(shape, self.own.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """`(v, k, c)`."""
        return self.in_structure()


def divergence(
    edges: Int[Array, "e 2"], flow: Float[Array, "e k"], num_poses: int
) -> Float[Array, "v k"]:
    """B' flow: what arrives at each frame minus what leaves it."""
    out = jnp.zeros((num_poses, *flow.shape[1:]), flow.dtype)
    return out.at[edges[:, 1]].add(flow).at[edges[:, 0]].add(-flow)


# What lineax asks of an operator.
for _is_so, _answer in {
    lx.is_symmetric: True,
    lx.is_positive_semidefinite: True,
    lx.is_negative_semidefinite: False,
    lx.is_diagonal: False,
    lx.is_tridiagonal: False,
    lx.is_lower_triangular: False,
    lx.is_upper_triangular: False,
    lx.has_unit_diagonal: False,
}.items():
    _is_so.register(GraphLaplacian)(lambda _, answer=_answer: answer)
for _unchanged in (lx.linearise, lx.materialise, lx.conj):
    _unchanged.register(GraphLaplacian)(lambda operator: operator)


@lx.diagonal.register
def _(operator: GraphLaplacian) -> Array:
    diagonal = jnp.diagonal(operator.blocks(), axis1=-2, axis2=-1)
    return jnp.repeat(diagonal.reshape(-1), operator.columns)
