"""Tilts that are known: where up is in a frame, as a levelled scanner tells."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg.geometry import lie
from jaxreg.graph.anchored import KnownPoses
from jaxreg.linear.small import product


class Levels(eqx.Module):
    """Directions of frames that point up, along the last axis of the world.

    Attributes:
        frame: `(l,)` the frame of each.
        mask: `(l,)` False for rows that are padding.
        up: `(l, 3)` of length 1, in the frame.
        deviation: `(l,)` of each of its two angles, in radians.
    """

    frame: Int[Array, " l"]
    mask: Bool[Array, " l"]
    up: Float[Array, "l 3"]
    deviation: Float[Array, " l"]

    def misfit(self, T_world_i: Float[Array, "v D D"]) -> Float[Array, " l"]:
        """The angle to the vertical, in standard deviations."""
        turn = _to_vertical(self.seen(T_world_i))
        return jnp.linalg.norm(turn, axis=-1) / self.deviation

    def seen(self, T_world_i: Float[Array, "v D D"]) -> Float[Array, "l 3"]:
        """Where the poses have them point."""
        return turned(lie.rotation(T_world_i[self.frame]), self.up)

    def as_poses(self, T_world_i: Float[Array, "v D D"]) -> KnownPoses:
        """As edges from the world, near poses: these, turned upright the shortest way.

        Their information is of rank two: it tells nothing of the place, nor of a turn
        about the vertical.
        """
        T = T_world_i[self.frame]
        turn = lie.rotation_exp(_to_vertical(self.seen(T_world_i)))
        across = jnp.eye(3, dtype=T.dtype) - self.up[:, :, None] * self.up[:, None]
        across = across / self.deviation[:, None, None] ** 2
        eye = jnp.eye(4, dtype=T.dtype)
        return KnownPoses(
            frame=self.frame,
            mask=self.mask,
            T_world_prior=lie.compose(
                product(turn, lie.rotation(T)), lie.translation(T)
            ),
            information=jnp.pad(across, ((0, 0), (3, 0), (3, 0))),
            fixed=jnp.zeros(len(T_world_i), bool),
            T_world_fixed=jnp.broadcast_to(eye, T_world_i.shape),
        )


def upright(up: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The least rotation that has a direction point up."""
    return lie.rotation_exp(_to_vertical(up[None]))[0]


def turned(R: Float[Array, "n d d"], x: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """R x of each."""
    return jnp.sum(R * x[:, None, :], axis=-1)


def _to_vertical(v: Float[Array, "l 3"]) -> Float[Array, "l 3"]:
    """Rotation vectors of the shortest turns that have v point up."""
    x, y, z = v.T
    sq = x**2 + y**2
    apart = sq > jnp.finfo(v.dtype).tiny
    sine = jnp.sqrt(jnp.where(apart, sq, 1))
    # Of what points down any horizontal axis does.
    ratio = jnp.where(apart, jnp.arctan2(sine, z) / sine, 1)
    down = jnp.where(~apart & (z < 0), jnp.pi, 0).astype(v.dtype)
    return jnp.stack([y * ratio + down, -x * ratio, jnp.zeros_like(z)], axis=-1)
