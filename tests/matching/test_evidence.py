"""How likely two surfaces are to coincide at a pose."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evidence_clouds import (
    EYE,
    SPACING,
    UP,
    as_cloud,
    evidence,
    floor,
    thinned,
    witness,
)
from helpers import blob, half_noise, motion
from scipy.spatial import KDTree
from scipy.stats import norm

from jaxreg.cloud import PointCloud
from jaxreg.datasets import sculpture_scans
from jaxreg.matching import NO_EVIDENCE, Evidence


def _told(source: np.ndarray, normals: np.ndarray = UP) -> Evidence:
    return evidence(as_cloud(source, normals), as_cloud(floor(0), UP), EYE)


@pytest.fixture(scope="module")
def views() -> list[np.ndarray]:
    """Two views of a sculpture that share two thirds, in one frame."""
    points, T_world_i = sculpture_scans(12, seed=0)
    return [
        (x @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        for x, T in zip(points[:2], T_world_i, strict=False)
    ]


@pytest.fixture(scope="module")
def scans(views: list[np.ndarray]) -> list[PointCloud]:
    """The same with 1024 points, whose spacing is not known."""
    clouds = [thinned(x, 1024, len(max(views, key=len))) for x in views]
    return [PointCloud(x.points, x.normals, x.mask) for x in clouds]


def test_the_share_within_a_spacing_overlaps_and_points_beyond_do_not():
    assert float(_told(floor(0)).overlap) == 1
    half = _told(floor(0, shift=8 * SPACING))
    assert float(half.overlap) == pytest.approx(9 / 16, abs=0.01)  # a spacing more
    assert float(_told(floor(4 * SPACING)).overlap) == 0


def test_less_fits_less_likely():
    told = [_told(floor(0))]
    rng = np.random.default_rng(0)
    for noise in (0.02, 0.05, 0.1, 0.2):
        told.append(_told(floor(0) + [0, 0, 1] * rng.normal(0, noise, (256, 1))))
    contact = [float(x.contact) for x in told]
    assert contact == sorted(contact, reverse=True)
    assert contact[-1] < 0 < contact[0]


def test_points_over_and_under_the_other_surface_speak_against_a_pose():
    parted = np.concatenate([floor(0)[:128], floor(0.2)[128:]])
    alone = floor(0)[:128]
    both = float(_told(parted).contact)
    assert both < 0 < float(_told(alone, UP[:128]).contact)


def test_normals_that_cross_are_chance():
    across = np.tile([1.0, 0.0, 0.0], (256, 1))
    assert float(_told(floor(0), across).log_evidence) < 0
    assert float(_told(floor(0), across).fitness) < 0.5


def test_a_change_of_unit_and_of_frame_changes_nothing(scans):
    plain = evidence(*scans, EYE)
    T = motion(3, 3)
    R, t = T[:3, :3], T[:3, 3]
    moved = [
        as_cloud(50 * (points @ R.T + t), normals @ R.T, 1024)
        for points, normals in map(_valid, scans)
    ]
    other = evidence(*moved, EYE)
    np.testing.assert_allclose(other.overlap, plain.overlap, atol=0.02)
    np.testing.assert_allclose(other.log_evidence, plain.log_evidence, atol=0.3)


def test_a_pair_is_as_likely_the_other_way_round():
    # Beside what coincides, one cloud has points that lie a little off the other.
    rng = np.random.default_rng(0)
    off = floor(0)[:96] + [0, 0, 1] * rng.uniform(0.05, 0.15, (96, 1))
    clouds = (
        as_cloud(np.concatenate([floor(0), off]), np.tile(UP[:1], (352, 1))),
        as_cloud(floor(0), UP),
    )
    there = evidence(*clouds, EYE)
    back = evidence(*clouds[::-1], EYE)
    np.testing.assert_allclose(there.log_evidence, back.log_evidence, atol=1e-4)
    assert abs(float(there.fitness - back.fitness)) > 0.05


def test_thinning_changes_neither_verdict_nor_overlap(views):
    rows = len(max(views, key=len))
    overlap, log_evidence = [], []
    for capacity in (256, 512, 1024, 2048):
        told = evidence(*(thinned(x, capacity, rows) for x in views), EYE)
        overlap.append(float(told.overlap))
        log_evidence.append(float(told.log_evidence))
    assert max(overlap[1:]) - min(overlap[1:]) < 0.05
    assert min(log_evidence) > 1


def test_wrong_poses_have_little_evidence(scans):
    right = float(evidence(*scans, EYE).log_evidence)
    assert right > 4
    for seed in range(5):
        T = jnp.asarray(motion(seed, 3, angle=1.0, shift=0.0).astype(np.float32))
        assert float(evidence(*scans, T).log_evidence) < 0


def test_noise_on_noise_is_chance_and_a_surface_in_noise_is_not():
    def told(clouds: list[np.ndarray]) -> float:
        some = [thinned(x.astype(np.float32), 1024, 1024) for x in clouds]
        return float(evidence(*some, EYE).log_evidence)

    for seed in range(4):
        rng = np.random.default_rng(seed)
        assert told([rng.uniform(-1, 1, (600, 3)) for _ in range(2)]) < 0
        assert told([half_noise(blob(600, 3, seed + 4 * k), k) for k in (0, 1)]) > 1


def _valid(cloud: PointCloud) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals."""
    mask = np.asarray(cloud.mask)
    return np.asarray(cloud.points)[mask], np.asarray(cloud.normals)[mask]


def _oracle(source: PointCloud, target: PointCloud) -> tuple[float, float]:
    """Gain and share near of one way in float64, with the definitions spelled out."""
    (p, n), (q, m) = ((x.astype(float) for x in _valid(c)) for c in (source, target))
    own = KDTree(p).query(p, 5)[0][:, 1:].mean(1)
    other = KDTree(q).query(q, 5)[0][:, 1:].mean(1)
    distance, row = KDTree(q).query(p)
    reach = np.maximum(own, other[row])
    height = np.abs(np.sum(m[row] * (q[row] - p), axis=1))
    along = np.sqrt(np.maximum(distance**2 - height**2, 0))
    u, cosine = height / reach, np.abs(np.sum(n * m[row], axis=1))
    beside = (along < reach) & (u < 3)
    u, cosine = u[beside], np.maximum(cosine[beside], 1e-3)
    balance = _balance(n)[beside]
    w, s, k = 0.5, 0.2, 4.0
    for _ in range(16):
        on = w * norm.pdf(u, scale=s) * (k + 1) * cosine**k
        part = balance * on / (on + (1 - w) / 6)
        w = part.sum() / balance.sum()
        s = np.sqrt(np.sum(part * u**2) / part.sum())
        k = min(-1 - part.sum() / np.sum(part * np.log(cosine)), 200.0)
    ratio = w * 6 * norm.pdf(u, scale=s) * (k + 1) * cosine**k + 1 - w
    return np.sum(balance * np.log(ratio)) / balance.sum(), np.mean(u < 1)


def _balance(normals: np.ndarray) -> np.ndarray:
    """One over the density of directions, smoothed over axes on a half sphere."""
    step = np.arange(128) + 0.5
    z, turn = step / 128, np.pi * (1 + 5**0.5) * step
    axes = np.stack([np.sqrt(1 - z * z) * f(turn) for f in (np.cos, np.sin)] + [z], 1)
    kernel = (normals @ axes.T) ** 16
    density = kernel @ kernel.mean(0) / kernel.sum(1)
    return 1 / np.maximum(density, 1 / len(normals))


def _firmness(source: PointCloud, target: PointCloud) -> float:
    """The looser of both ways in float64, of the points that lie within a fifth."""
    clouds = [_valid(x) for x in (source, target)]
    radius = min(np.median(np.linalg.norm(p - p.mean(0), axis=1)) for p, _ in clouds)
    found = []
    for (p, _), (q, m) in (clouds, clouds[::-1]):
        distance, row = KDTree(q).query(p)
        reach = KDTree(q).query(q, 5)[0][:, 1:].mean(1)[row]
        height = np.abs(np.sum(m[row] * (q[row] - p), axis=1))
        on = (distance < reach) & (height < 0.2 * reach)
        x = (p[on] - p[on].mean(0)) / radius
        J = np.concatenate([m[row][on], np.cross(x, m[row][on])], axis=1)
        moved = np.linalg.eigvalsh(J.T @ J / len(J)) + 0.02**2
        most = np.array([1 / 3] * 3 + [2 / 9] * 3)
        found.append(np.log(moved / most).sum() / 2)
    return min(found)


def test_evidence_agrees_with_an_oracle_in_float64(scans):
    source, target = scans
    gain_a, near_a = _oracle(source, target)
    gain_b, near_b = _oracle(target, source)
    log_gain = np.log((gain_a + gain_b) / 2)
    found = evidence(source, target, EYE)
    firm = _firmness(source, target)
    expected = 4 * log_gain + 28 * np.sqrt(near_a * near_b) + 1.8 * firm - 23.3
    np.testing.assert_allclose(found.log_evidence, expected, atol=0.1)
    expected = 2.3 * log_gain + 38 * np.sqrt(near_a * near_b) - 34.8
    np.testing.assert_allclose(found.contact, expected, atol=0.1)


def test_a_wall_on_a_wall_is_in_contact_and_tells_no_pose():
    told = _told(floor(0, shift=SPACING / 2))
    assert float(told.log_evidence) < 0 < float(told.contact)


def test_masked_points_say_nothing():
    cloud, target = as_cloud(floor(0), UP), as_cloud(floor(0), UP)
    mask = jnp.asarray(np.arange(len(cloud.mask)) < 100)
    found = evidence(PointCloud(cloud.points, cloud.normals, mask), target, EYE)
    assert int(found.num_inliers) == 100
    assert float(found.overlap) == 1


def test_poses_not_in_use_have_none(scans):
    T, use = np.stack([EYE, EYE]), np.array([True, False])
    told = jax.jit(lambda *x: witness(*scans).of_poses(*x))(T, use)
    assert float(told.log_evidence[1]) == NO_EVIDENCE
    assert float(told.log_evidence[0]) > 0


def test_points_that_the_other_scanner_looked_through_speak_against_a_pose():
    wall, ahead = as_cloud(floor(0), UP), np.concatenate([floor(0), floor(1)[100:104]])
    eye = np.array([0.75, 0.75, 3.0], np.float32)
    source = as_cloud(ahead, np.tile([0.0, 0.0, 1.0], (260, 1)))
    looked = jax.jit(lambda cloud, eye: cloud.seen_from(eye))(wall, eye)
    plain, seen = (
        float(evidence(source, target, EYE).contact) for target in (wall, looked)
    )
    assert seen < 0 < plain


def test_the_gradient_free_answer_is_finite_where_nothing_is_near():
    far = _told(floor(100.0))
    chex.assert_tree_all_finite(far)
    assert float(far.log_evidence) < 0
