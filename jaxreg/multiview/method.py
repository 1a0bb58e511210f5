"""What the pipeline asks of a method of registration, beyond its contract."""

from dataclasses import replace

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxreg._core.typing import Key, Motion, Scalar
from jaxreg.cloud import PointCloud
from jaxreg.features import features_of
from jaxreg.local import GaussNewton, LocalOptimiser
from jaxreg.matching import LIKELY, PointToPlane
from jaxreg.neighbours import AbstractIndex, VoxelTable
from jaxreg.particle import AbstractSearch
from jaxreg.registrar import (
    AbstractIndexedRegistrar,
    AbstractRegistrar,
    RegistrationSolution,
)
from jaxreg.robust import GemanMcClure


# Modes of a pair that are kept; most pairs have no second one.
_MOST_MODES = 4
# The kernel width of the first step, in radii, of methods that do not say: that of
# `ParticleFilter()`.
_WIDEST = 0.3


def num_kept(method: AbstractRegistrar) -> int:
    """Modes of a pair that `relative_motions` keeps, m."""
    if isinstance(method, AbstractIndexedRegistrar):
        return min(_MOST_MODES, method.num_modes)
    return 1


def min_log_evidence(method: AbstractRegistrar) -> Array | float:
    """The least evidence of a pair that is believed on its own."""
    if isinstance(method, AbstractIndexedRegistrar):
        return method.min_log_evidence
    return LIKELY


def index_of(method: AbstractRegistrar, cloud: PointCloud) -> AbstractIndex:
    """The index of a scan, for the method and for what follows it."""
    if isinstance(method, AbstractIndexedRegistrar):
        return method.index_of(cloud)
    return VoxelTable.build(cloud.points, cloud.mask)


def describes(method: AbstractRegistrar, d: int) -> bool:
    """Whether the search of pairs in so many dimensions asks for local features."""
    return isinstance(method, AbstractSearch) and method.proposes(d)


def with_features(
    method: AbstractRegistrar, cloud: PointCloud, spacing: Scalar
) -> PointCloud:
    """With the local features that the search of its pairs asks for, if it does.

    Args:
        method: of registration.
        cloud: a prepared scan.
        spacing: between samples of the coarser scans.
    """
    if not describes(method, cloud.points.shape[1]):
        return cloud
    described = lax.stop_gradient(features_of(cloud.as_judged, spacing))
    if cloud.judged is None:
        return replace(cloud, described=described)
    return replace(cloud, judged=replace(cloud.judged, described=described))


def without_features(cloud: PointCloud) -> PointCloud:
    """The other way."""
    if cloud.judged is None:
        return replace(cloud, described=None)
    return replace(cloud, judged=replace(cloud.judged, described=None))


def solve(
    method: AbstractRegistrar,
    clouds: tuple[PointCloud, PointCloud],
    target_index: AbstractIndex,
    key: Key,
) -> RegistrationSolution:
    """Registers the first of two prepared scans to the second, in their frames."""
    if isinstance(method, AbstractIndexedRegistrar):
        return method.solve_indexed(*clouds, target_index, None, key)
    return method.solve(*clouds, None, key)


def follower(method: AbstractRegistrar) -> tuple[LocalOptimiser, Scalar | float]:
    """The local optimiser of descents from a guess, and its first kernel width."""
    if isinstance(method, AbstractSearch):
        parts = method.residual, method.kernel, method.step
        return LocalOptimiser(*parts), method.width_start
    parts = PointToPlane(0.2), GemanMcClure(), GaussNewton()
    return LocalOptimiser(*parts), _WIDEST


def log_prior(method: AbstractRegistrar, T_target_source: Motion) -> Scalar:
    """What is known beforehand against a pose, in the frames of the method."""
    if isinstance(method, AbstractSearch) and method.prior is not None:
        return method.prior.log_density(T_target_source)
    return jnp.zeros((), T_target_source.dtype)
