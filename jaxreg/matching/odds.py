"""What the numbers of a pose are worth: odds of a right one against the best wrong one.

The numbers, of both ways (`jaxreg.matching.evidence`):

    gain    the mean of log p(u, c) / p(u, c; w = 0): how much better than chance the
            points lie, in nats a point,
    near    the share of the points beside that are within one spacing of the plane:
            surfaces that touch by chance part again,
    firm    how firmly the points on the surface hold the pose, the logarithm of a
            volume of motions (`Grip.firmness`), the looser of both ways: what holds
            loosely, a wall or a small patch, fits in many wrong poses,
    seen    the share of a cloud that the other saw, two thirds of the larger one and a
            third of the lesser.

The logarithm of the odds of a right pose against the best wrong one is taken to be
linear in them (logistic regression on pairs of scans), at equal odds before:

    3D    _GAIN log gain + _NEAR near + _FIRM firm - _OFFSET
    2D    near, firm and seen, and whether viewpoints are known

In 3D wrong surfaces that meet cross, and points beside tell. In 2D walls lie on walls
of another room, and points that match nothing are far from everything: what share of
the scans matches is what there is to go by. It is explained where it is known from
where the scans were taken, as points in what was seen to be free speak against a pose.

A wall on a wall, or a sphere on itself, coincides wherever it slips to: whether it does
is told by a regression on gain and near (`contact`). Nothing here is a length or a
density of points, so lidar, RGB-D and scanned objects share the weights. Those of 3D
were found on clouds thinned to 4,096 points, and searches judge by as many; how, and
what they say of data that they were not found on: bench/studies/evidence.md, and of 2D
bench/studies/evidence_in_2d.md.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


# `near` weighs like 20 independent places of which 95 % of those of a right pose are
# near and 80 % of those of a wrong one.
_GAIN, _NEAR, _FIRM, _OFFSET = 4.0, 28.0, 1.8, 23.3
# In 2D, where gain tells nothing beside the others.
_NEAR_2D, _FIRM_2D, _SEEN_2D, _VIEWED_2D, _OFFSET_2D = 6.0, 1.1, 13.7, 5.1, 13.1
# That without `firm`, on all data but views of a room, whose walls coincide at wrong
# poses, too.
_CONTACT_GAIN, _CONTACT_NEAR, _CONTACT_OFFSET = 2.3, 38.0, 34.8
# A gain so small is none: the mixture found nothing on the surface.
_LEAST_GAIN = 0.05


class Said(NamedTuple):
    """The numbers of poses, of both ways.

    Attributes:
        gain, near, firm: see above.
        seen: the shares of the source and of the target that the other saw.
        viewed: whether it is known where both were seen from.
    """

    gain: Float[Array, "*q"]
    near: Float[Array, "*q"]
    firm: Float[Array, "*q"]
    seen: tuple[Float[Array, "*q"], Float[Array, "*q"]]
    viewed: Bool[Array, ""]

    def log_odds(self, d: int) -> Float[Array, "*q"]:
        """In d dimensions."""
        if d == 3:
            told = _GAIN * self.log_gain + _NEAR * self.near
            return told + _FIRM * self.firm - _OFFSET
        told = _NEAR_2D * self.near + _FIRM_2D * self.firm
        told = told + _SEEN_2D * self.share_seen
        return told + jnp.where(self.viewed, _VIEWED_2D, 0) - _OFFSET_2D

    @property
    def share_seen(self) -> Float[Array, "*q"]:
        """Of both: a scan on a large map is seen whole, and of the map little is."""
        return (jnp.minimum(*self.seen) + 2 * jnp.maximum(*self.seen)) / 3

    def contact(self) -> Float[Array, "*q"]:
        """Of surfaces that coincide, whatever holds the pose."""
        told = _CONTACT_GAIN * self.log_gain + _CONTACT_NEAR * self.near
        return told - _CONTACT_OFFSET

    @property
    def log_gain(self) -> Float[Array, "*q"]:
        """Bounded below."""
        return jnp.log(jnp.maximum(self.gain, _LEAST_GAIN))
