"""How near a cloud's samples any point beside them is, without being on its surface.

Around a surface, places up to three sample spacings over or under it are within one
spacing of it in one case of three. Where samples fill a volume, as noise does, any
place inside is near some sample: that a point is near says nothing there.
"""

import jax.numpy as jnp

from jaxreg._core.typing import Scalar
from jaxreg.cloud import PointCloud
from jaxreg.matching.problem import Problem, known, match
from jaxreg.neighbours import AbstractIndex


#: Heights that are beside a surface, in local spacings.
ZONE = 3.0
#: The share of these that is near a single surface.
OF_SURFACES = 1 / ZONE
# Samples whose surroundings are looked at: the share is known to 0.03.
_SAMPLES = 256
# Shares up to this are of surfaces that lie close to others: 0.34 to 0.62 in clouds of
# lidars, depth cameras and objects, and in generated streets. Noise that fills a box, a
# ball or a normal distribution has 0.83 to 0.97, of 300 to 20,000 points.
_OF_SCANS = 0.62
# Of a volume some heights remain that are not near.
_MOST = 0.97
# Heights that follow each other are spread evenly (the golden ratio).
_STEP = (5**0.5 - 1) / 2


def near_by_chance(cloud: PointCloud, index: AbstractIndex) -> Scalar:
    """Of the heights beside the samples, the share that is near by chance.

    A third for scans; more, where more of the room around the samples is near them
    than in any scan in hand, up to 0.97. The samples are moved along their normals, by
    heights spread evenly over the zone, and looked up.

    Args:
        cloud: with its spacing, in 3D; of 2D clouds, which may be filled shapes, and of
            those without normals a third.
        index: of its points.

    Gradients: none.
    """
    dtype = cloud.points.dtype
    surfaces = jnp.asarray(OF_SURFACES, dtype)
    if cloud.points.shape[1] != 3 or cloud.spacing is None:
        return surfaces
    every = slice(None, None, max(1, len(cloud.mask) // _SAMPLES))
    some, spacing = cloud.of_rows(every), cloud.spacing[every]
    step = jnp.arange(len(some.mask), dtype=dtype) * _STEP
    height = ZONE * (2 * (step - jnp.floor(step)) - 1)
    away = (height * spacing)[:, None] * some.normals
    flat = some.mask & known(some.normals.T)
    room = PointCloud(some.points + away, some.normals, flat)
    found = match(Problem.of(room, cloud, index), jnp.eye(4, dtype=dtype))
    reach = jnp.maximum(spacing, cloud.spacing[found.row])
    over = jnp.abs(found.plane_residual)
    along = found.sq_residual - over**2
    beside = flat & (along < reach**2) & (over < ZONE * reach)
    near = jnp.sum(beside & (over < reach)) / jnp.maximum(jnp.sum(beside), 1)
    beyond = jnp.clip((near - _OF_SCANS) / (1 - _OF_SCANS), 0, 1)
    chance = surfaces + beyond * (1 - surfaces)
    return jnp.minimum(chance, _MOST).astype(dtype)
