"""Poses that local features of two clouds propose."""

import jax.numpy as jnp

from jaxreg._core.arrays import on_both
from jaxreg._core.typing import Scalar
from jaxreg.cloud import Described, PointCloud, levelled
from jaxreg.features.consistent import Agreed, consistent_poses
from jaxreg.features.correspond import mutual
from jaxreg.features.fpfh import described


# Points of each cloud that are described, the nearest others that are looked at, and
# how far, in spacings of all the points.
_POINTS, _NEIGHBOURS, _RADIUS = 1536, 48, 8.0
# Correspondences, and how far they may be off, in those spacings.
_PAIRS, _TOLERANCE = 512, 1.25


def features_of(cloud: PointCloud, spacing: Scalar) -> Described:
    """Features of some points of a cloud, for all pairs that it enters.

    Args:
        cloud: in 3D.
        spacing: between samples of the coarser cloud of a pair.
    """
    few = cloud.spread(_POINTS)
    few = PointCloud(few.points, few.normals, few.mask)
    return described(few, _RADIUS * spacing, _NEIGHBOURS)


def propose(source: PointCloud, target: PointCloud, spacing: Scalar) -> Agreed:
    """A pose for each of up to 512 points that look alike, and who agrees with it.

    Points without normals, or in a surrounding without, are not asked. Of clouds that
    have none, and of those whose surroundings are all alike, few agree.

    The numbers were chosen on half of the pairs of sensors (bench/studies/features.md).

    Args:
        source: in 3D; some of its points are described, if they are not yet.
        target: likewise.
        spacing: between samples of the coarser cloud.
    """
    here, there = source.described, target.described
    if here is None or there is None:
        clouds = levelled(source, target)
        here, there = on_both(lambda cloud: features_of(cloud, spacing), *clouds)
    pairs = mutual(here, there, min(_PAIRS, len(here.mask)))
    return consistent_poses(pairs, jnp.asarray(_TOLERANCE * spacing))
