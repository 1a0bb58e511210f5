"""Poses proposed for clouds that share half, and none where nothing tells."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg as jr
from jaxreg.cloud import PointCloud, thin
from jaxreg.datasets import sculpture_scans
from jaxreg.features import Agreed, propose
from jaxreg.geometry import lie
from jaxreg.multiview.method import with_features
from jaxreg.neighbours import BruteForce
from jaxreg.particle import UniformPrior, sandhu2010
from jaxreg.particle.pair import Pair
from jaxreg.particle.proposals import propose_modes


APART = jnp.float32(0.3)
CAPACITY = 1024
YES, NO = jnp.asarray(True), jnp.asarray(False)


@pytest.fixture(scope="module")
def clouds() -> tuple[PointCloud, PointCloud, np.ndarray, jax.Array]:
    """Two scans 60 degrees apart, in decimetres; the true pose, the spacing."""
    scans, T_world_i = sculpture_scans(6, seed=0, points_per_scan=2500)
    truth = np.linalg.inv(T_world_i[0]) @ T_world_i[1]
    truth[:3, 3] *= 10
    num = max(map(len, scans[:2]))

    def cloud(points: np.ndarray) -> PointCloud:
        padded = np.zeros((num, 3), np.float32)
        padded[: len(points)] = 10 * points
        mask = jnp.arange(num) < len(points)
        return jax.jit(thin, static_argnums=(2, 3))(padded, mask, CAPACITY, 10)

    target, source = map(cloud, scans[:2])
    assert source.spacing is not None
    return source, target, truth, jnp.median(source.spacing[source.mask])


def errors(T: jax.Array, truth: np.ndarray, at: jax.Array) -> tuple[float, float]:
    """Radians, and length at a point of the source."""
    R = np.asarray(T[:3, :3], float) @ truth[:3, :3].T
    delta = (np.asarray(T, float) - truth)[:3] @ np.append(np.asarray(at, float), 1)
    return float(lie.rotation_angle(jnp.asarray(R))), float(np.linalg.norm(delta))


@jax.jit
def looked_for(
    source: PointCloud, target: PointCloud, spacing: jax.Array, wanted: jax.Array
) -> tuple[Agreed, tuple[jax.Array, jax.Array]]:
    """All that is agreed on, and the modes."""
    modes = propose_modes(source, target, spacing, 3, apart=APART, wanted=wanted)
    return propose(source, target, spacing), modes


def test_the_most_agreed_pose_is_right(clouds):
    source, target, truth, spacing = clouds
    agreed, (T, used) = looked_for(source, target, spacing, YES)
    assert jnp.max(agreed.num_agreeing) >= 8
    best = agreed.T_target_source[jnp.argmax(agreed.num_agreeing)]
    middle = source.points[source.mask].mean(0)
    turn, shift = errors(best, truth, middle)
    assert turn < 0.15
    assert shift < 3 * spacing
    assert used[0]
    # The same poses by a copy of the program, which may round otherwise.
    np.testing.assert_allclose(T[0], best, atol=1e-5)


def test_clouds_described_before_propose_the_same(clouds):
    source, target, _, spacing = clouds
    wanted = looked_for(source, target, spacing, YES)[0]
    describe = eqx.filter_jit(with_features)
    here, there = (describe(jr.ParticleFilter(), x, spacing) for x in (source, target))
    assert here.described is not None
    found = jax.jit(propose)(here, there, spacing)
    # Correspondences that are as good as each other may change their places.
    np.testing.assert_array_equal(
        np.sort(found.num_agreeing), np.sort(wanted.num_agreeing)
    )
    for method in (jr.ICP(), jr.ParticleFilter(num_proposals=0), sandhu2010(3)):
        assert with_features(method, source, spacing).described is None


def test_modes_are_distinct_and_only_where_wanted(clouds):
    source, target, _, spacing = clouds
    T, used = looked_for(source, target, spacing, YES)[1]
    for i in np.flatnonzero(used):
        for j in np.flatnonzero(used)[:i]:
            turn = lie.rotation_angle(T[i, :3, :3] @ T[j, :3, :3].T)
            shift = jnp.linalg.norm(T[i, :3, 3] - T[j, :3, 3])
            assert i == j or turn > APART or shift > APART
    assert not np.any(looked_for(source, target, spacing, NO)[1][1])


def test_masked_rows_change_nothing(clouds):
    source, target, _, spacing = clouds
    masked = eqx.tree_at(lambda x: x.mask, source, source.mask.at[::9].set(False))
    moved = jnp.where(masked.mask[:, None], masked.points, 0)
    other = eqx.tree_at(lambda x: x.points, masked, moved)
    a, b = (looked_for(x, target, spacing, YES)[0] for x in (masked, other))
    np.testing.assert_array_equal(a.num_agreeing, b.num_agreeing)


def test_without_normals_nothing_is_proposed(clouds):
    source, target, _, spacing = clouds
    bare = eqx.tree_at(lambda x: x.normals, source, 0 * source.normals)
    agreed, (_, used) = looked_for(bare, target, spacing, YES)
    assert not np.any(agreed.num_agreeing)
    assert not np.any(used)


@pytest.mark.parametrize(
    ("method", "guess"),
    [
        (jr.ParticleFilter(num_proposals=0), False),
        (jr.ParticleFilter(refine_steps=0), False),
        (jr.ParticleFilter(prior=UniformPrior()), False),
        (jr.ParticleFilter(), True),
        (jr.MultiStart(), False),
        (jr.sandhu2010(3), False),
    ],
)
def test_who_says_where_to_look_gets_no_proposals(clouds, method, guess):
    pair = _pair(*clouds[:2])
    init = jnp.eye(4) if guess else None
    assert method._proposals(pair, NO, init) is None


def test_in_the_plane_there_are_none():
    points = jnp.asarray(np.random.default_rng(0).normal(size=(64, 2)), jnp.float32)
    cloud = PointCloud(points, jnp.zeros_like(points), jnp.ones(64, bool))
    pair = _pair(cloud, cloud)
    assert jr.ParticleFilter()._proposals(pair, NO, None) is None


def _pair(source: PointCloud, target: PointCloud) -> Pair:
    return Pair.of(source, target, BruteForce.build(target.points, target.mask))
