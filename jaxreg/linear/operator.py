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
from jaxtyping import Array, Float, Int

from jaxreg.linear.small import product


class GraphLaplacian(lx.AbstractLinearOperator):
    """sum_e (x_j - x_i)' W_e (x_j - x_i) + sum_i x_i' own_i x_i, as a matrix.

    It maps `(v, k, c)`, c columns that it treats alike and apart.

    Attributes:
        edges: `(e, 2)` frames i and j.
        weight: `(e, k, k)` symmetric positive semidefinite.
        own: `(v, k, k)` what ties each frame to the ground.
        columns: c (static).
    """

    edges: Int[Array, "e 2"]
    weight: Float[Array, "e k k"]
    own: Float[Array, "v k k"]
    columns: int = eqx.field(static=True, default=1)

    @classmethod
    def anchored(
        cls,
        edges: Int[Array, "e 2"],
        weight: Float[Array, "e k k"],
        num_poses: int,
        damping: Float[Array, ""] | float = 0.0,
        columns: int = 1,
    ) -> "GraphLaplacian":
        """With `damping` times its diagonal, and frame 0 tied to the ground.

        Without damping, and for right-hand sides that sum to 0, the tie bears nothing:
        solutions are those with x_0 = 0.
        """
        none = jnp.zeros((num_poses, *weight.shape[1:]), weight.dtype)
        blocks = cls(edges, weight, none).blocks()
        return cls(edges, weight, (damping * blocks).at[0].add(blocks[0]), columns)

    def mv(self, vector: Float[Array, "v k c"]) -> Float[Array, "v k c"]:
        """The product, one pass over the edges."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        flow = product(self.weight, vector[j] - vector[i])
        return product(self.own, vector).at[j].add(flow).at[i].add(-flow)

    def blocks(self) -> Float[Array, "v k k"]:
        """The blocks of the diagonal."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        return self.own.at[i].add(self.weight).at[j].add(self.weight)

    def dense(self) -> Float[Array, "n n"]:
        """`(v k, v k)`, for few frames: the matrix of one column."""
        num, k = self.own.shape[:2]
        i, j = self.edges[:, 0], self.edges[:, 1]
        frame = jnp.arange(num)
        full = jnp.zeros((num, num, k, k), self.own.dtype)
        full = full.at[frame, frame].add(self.blocks())
        full = full.at[i, j].add(-self.weight).at[j, i].add(-self.weight)
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
