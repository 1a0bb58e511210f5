"""Control points: points that frames see and that are known in the world.

A point seen from frame i at u lies at q in the world. Its misfit
a = R_i' (T_world_i u - q) changes with the right tangent of the pose by [I, -[u]x]. So
it is an edge from the world to (R_i, q - R_i u), whose error is (a, 0), of information
J' W J with J = [I, -[u + a / 2]x] (the half: the logarithm of a motion turns its
translation back by half of its turn). It says nothing of what one point leaves free.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg.averaging.world.levels import turned
from jaxreg.geometry import lie
from jaxreg.graph.anchored import KnownPoses
from jaxreg.linear.small import product


class ControlPoints(eqx.Module):
    """Points that frames see and that are known in the world.

    Attributes:
        frame: `(c,)` the frame that sees each.
        mask: `(c,)` False for rows that are padding.
        in_frame: `(c, d)` where it sees it.
        in_world: `(c, d)` where it lies.
        information: `(c, d, d)` of that position, in the axes of the world, or None:
            all alike, as good as the fit shows.
    """

    frame: Int[Array, " c"]
    mask: Bool[Array, " c"]
    in_frame: Float[Array, "c d"]
    in_world: Float[Array, "c d"]
    information: Float[Array, "c d d"] | None

    def seen(self, T_world_i: Float[Array, "v D D"]) -> Float[Array, "c d"]:
        """Where the poses put them."""
        return jax.vmap(lie.act)(T_world_i[self.frame], self.in_frame)

    def misfit(self, T_world_i: Float[Array, "v D D"]) -> Float[Array, " c"]:
        """In standard deviations, or in lengths if none are known."""
        off = self.seen(T_world_i) - self.in_world
        if self.information is None:
            return jnp.linalg.norm(off, axis=-1)
        sq = jnp.sum(off * turned(self.information, off), axis=-1)
        return jnp.sqrt(jnp.maximum(sq, 0))

    def as_poses(
        self, T_world_i: Float[Array, "v D D"], deviation: Float[Array, ""]
    ) -> KnownPoses:
        """As edges from the world, near poses.

        Args:
            T_world_i: the poses.
            deviation: of each coordinate, where none is known.
        """
        R = lie.rotation(T_world_i[self.frame])
        R_inv = jnp.swapaxes(R, -1, -2)
        off = jax.lax.stop_gradient(turned(R_inv, self.seen(T_world_i) - self.in_world))
        J = _by_tangent(self.in_frame + off / 2)
        W, d = self.information, self.in_frame.shape[-1]
        if W is None:
            W = jnp.eye(d, dtype=R.dtype) / deviation**2
            W = jnp.broadcast_to(W, R.shape)
        W = product(product(R_inv, W), R)
        eye = jnp.eye(d + 1, dtype=R.dtype)
        return KnownPoses(
            frame=self.frame,
            mask=self.mask,
            T_world_prior=lie.compose(R, self.in_world - turned(R, self.in_frame)),
            information=product(product(jnp.swapaxes(J, -1, -2), W), J),
            fixed=jnp.zeros(len(T_world_i), bool),
            T_world_fixed=jnp.broadcast_to(eye, T_world_i.shape),
        )


def _by_tangent(u: Float[Array, "c d"]) -> Float[Array, "c d k"]:
    """[I, -[u]x]: a point of a frame, by the right tangent of its pose."""
    num, d = u.shape
    eye = jnp.broadcast_to(jnp.eye(d, dtype=u.dtype), (num, d, d))
    if d == 2:
        turn = jnp.stack([-u[:, 1], u[:, 0]], axis=-1)[..., None]
    else:
        x, y, z = u.T
        o = jnp.zeros_like(x)
        turn = jnp.stack(
            [jnp.stack(row, -1) for row in ((o, z, -y), (-z, o, x), (y, -x, o))], -2
        )
    return jnp.concatenate([eye, turn], axis=-1)
