"""Poses that local features of two clouds propose."""

import jax.numpy as jnp

from jaxreg._core.arrays import on_both
from jaxreg._core.typing import Scalar
from jaxreg.cloud import PointCloud, levelled
from jaxreg.features.consistent import Agreed, consistent_poses
from jaxreg.features.correspond import mutual
from jaxreg.features.fpfh import described


# Points of each cloud that are described, the nearest others that are looked at, and
# how far, in spacings of all the points.
_POINTS, _NEIGHBOURS, _RADIUS = 1536, 48, 8.0
# Correspondences, and how far they may be off, in those spacings.
_PAIRS, _TOLERANCE = 512, 1.25


def propose(source: PointCloud, target: PointCloud, spacing: Scalar) -> Agreed:
    """A pose for each of up to 512 points that look alike, and who agrees with it.

    Points without normals, or in a surrounding without, are not asked. Of clouds that
    have none, and of those whose surroundings are all alike, few agree.

    The numbers were chosen on half of the pairs of sensors (bench/studies/features.md).

    Args:
        source: in 3D; some of its points are described.
        target: likewise.
        spacing: between samples of the coarser cloud.
    """
    few = (cloud.spread(_POINTS) for cloud in levelled(source, target))
    few = (PointCloud(x.points, x.normals, x.mask) for x in few)
    features = on_both(lambda x: described(x, _RADIUS * spacing, _NEIGHBOURS), *few)
    pairs = mutual(*features, min(_PAIRS, len(features[0].mask)))
    return consistent_poses(pairs, jnp.asarray(_TOLERANCE * spacing))
