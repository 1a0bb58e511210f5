"""A model that many clouds meet: prepared once with its index, then searched."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxreg.cloud import PointCloud, centroid, rms_radius
from jaxreg.geometry import lie
from jaxreg.matching import PointToPoint
from jaxreg.neighbours import AbstractIndex, VoxelTable
from jaxreg.particle import (
    AbsoluteEnergy,
    AbstractSearch,
    GaussianPrior,
    ParticleFilter,
)
from jaxreg.robust import L1, GemanMcClure


def ours() -> ParticleFilter:
    """Forty particles around the centred clouds, with a redescending kernel.

    Its width falls from a third of the radius: wide enough to descend from 60 degrees
    away, and noise stops counting near the end.
    """
    return ParticleFilter(
        num_prior=40,
        num_particles=40,
        num_times=2,
        prior_steps=5,
        inner_steps=3,
        num_points=64,
        num_modes=1,
        refine_steps=10,
        prior=GaussianPrior(0.1, 0.6),
        energy=AbsoluteEnergy(),
        residual=PointToPoint(),
        kernel=GemanMcClure(),
        width_start=0.4,
        width_end=0.1,
        batch_size=40,
    )


def with_l1() -> ParticleFilter:
    """The same with the paper's own suggestion of section 6."""
    return eqx.tree_at(
        lambda m: (m.kernel, m.width_start, m.width_end),
        ours(),
        (L1(), jnp.asarray(0.05), jnp.asarray(0.02)),
    )


class Model(NamedTuple):
    """A target prepared for many sources, in the unit of its own radius."""

    cloud: PointCloud
    closest: AbstractIndex
    centre: Array
    radius: Array


@eqx.filter_jit
def prepare(method: AbstractSearch, target: Array) -> Model:
    """Of `(m, 3)` points."""
    mask = jnp.ones(len(target), bool)
    centre, radius = centroid(target, mask), rms_radius(target, mask)
    cloud = method.prepare((target - centre) / radius, mask)
    index = VoxelTable.build(cloud.points, cloud.mask)
    return Model(cloud, index, centre, radius)


@eqx.filter_jit
def search(method: AbstractSearch, model: Model, sources: Array, key: Array) -> Array:
    """Poses of `(b, n, 3)` sources in turn; their normals are not used."""

    def one(args: tuple[Array, Array]) -> Array:
        points, key = args
        mask = jnp.ones(len(points), bool)
        centre = centroid(points, mask)
        points = (points - centre) / model.radius
        cloud = PointCloud(points, jnp.zeros_like(points), mask)
        found = method.solve_indexed(cloud, model.cloud, model.closest, None, key)
        R = lie.rotation(found.T_target_source)
        t = lie.translation(found.T_target_source)
        t = model.radius * t + model.centre - R @ centre
        return lie.compose(R, t)

    return lax.map(one, (sources, jax.random.split(key, len(sources))))
