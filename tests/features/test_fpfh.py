"""Features against their definition, and what they must not depend on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.cloud import Described, PointCloud
from jaxreg.features import described


RADIUS, NEIGHBOURS, BINS = 0.5, 24, 11
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def scene(n: int = 160, seed: int = 0) -> Arrays:
    """A wavy surface with normals of random signs; some points without, some masked."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1, 1, (2, n))
    slopes = 0.9 * np.cos(3 * x) * np.sin(2 * y), 0.6 * np.sin(3 * x) * np.cos(2 * y)
    points = np.stack([x, y, 0.3 * np.sin(3 * x) * np.sin(2 * y)], axis=1)
    normals = np.stack([-slopes[0], -slopes[1], np.ones(n)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= rng.choice([-1, 1], (n, 1))
    normals[:5] = 0
    return points, normals, rng.uniform(size=n) > 0.1


@jax.jit
def _described(cloud: PointCloud, radius: jax.Array) -> Described:
    return described(cloud, jnp.asarray(radius), NEIGHBOURS)


def features(points: np.ndarray, normals: np.ndarray, mask: np.ndarray) -> Described:
    cloud = PointCloud(jnp.asarray(points), jnp.asarray(normals), jnp.asarray(mask))
    return _described(cloud, RADIUS)


def histograms(found: Described) -> np.ndarray:
    """With the normals' signs as they are."""
    return np.asarray(found.even + found.odd)


def spread(value: float) -> np.ndarray:
    """A value in [-1, 1] shared by the two nearest of the bins."""
    out = np.zeros(BINS)
    at = np.clip((value + 1) / 2 * BINS - 0.5, 0, BINS - 1)
    low = int(np.floor(at))
    out[low] += 1 - (at - low)
    if low + 1 < BINS:
        out[low + 1] += at - low
    return out


def naive(points: np.ndarray, normals: np.ndarray, mask: np.ndarray):
    """Rusu, Blodow, Beetz 2009, point by point; and which have a feature."""
    n = len(points)
    flat = mask & np.any(normals != 0, axis=1)
    near = []
    for i in range(n):
        distance = np.where(mask, np.linalg.norm(points - points[i], axis=1), np.inf)
        order = [j for j in np.argsort(distance) if j != i][:NEIGHBOURS]
        near.append([j for j in order if flat[j] and flat[i] and distance[j] < RADIUS])

    def simplified(i: int, u: np.ndarray) -> np.ndarray:
        out = np.zeros((3, BINS))
        for j in near[i]:
            m = normals[j] * (1 if normals[j] @ u >= 0 else -1)
            line = (points[j] - points[i]) / np.linalg.norm(points[j] - points[i])
            v = np.cross(line, u)
            v /= np.linalg.norm(v)
            w = np.cross(u, v)
            out[0] += spread(float(v @ m))
            out[1] += spread(float(u @ line))
            out[2] += spread(float(np.arctan2(w @ m, u @ m) / (np.pi / 2)))
        return out.ravel() / max(len(near[i]), 1)

    out = np.zeros((n, 3 * BINS))
    for i in range(n):
        out[i] = simplified(i, normals[i])
        weight = np.array([1 / np.linalg.norm(points[j] - points[i]) for j in near[i]])
        for j, share in zip(near[i], weight / weight.sum(), strict=True):
            sign = 1 if normals[j] @ normals[i] >= 0 else -1
            out[i] += share * simplified(j, sign * normals[j])
    return out, flat & (np.array([len(x) for x in near]) >= 5)


def test_features_are_those_of_the_definition():
    points, normals, mask = scene()
    expected, known = naive(points, normals, mask)
    found = features(points, normals, mask)
    np.testing.assert_array_equal(found.mask, known)
    assert 100 < known.sum() < len(points)
    np.testing.assert_allclose(histograms(found)[known], expected[known], atol=1e-9)


def test_a_rigid_motion_changes_no_feature():
    points, normals, mask = scene()
    R = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    here, there = (
        features(points, normals, mask),
        features(points @ R.T + [3.0, -2.0, 1.0], normals @ R.T, mask),
    )
    np.testing.assert_array_equal(here.mask, there.mask)
    known = np.asarray(here.mask)
    np.testing.assert_allclose(here.even[known], there.even[known], atol=1e-7)
    np.testing.assert_allclose(here.odd[known], there.odd[known], atol=1e-7)


def test_the_sign_of_a_normal_changes_that_of_the_odd_part_only():
    points, normals, mask = scene()
    sign = np.random.default_rng(2).choice([-1.0, 1.0], len(points))
    here, there = (
        features(points, x, mask) for x in (normals, sign[:, None] * normals)
    )
    known = np.asarray(here.mask)
    np.testing.assert_allclose(here.even[known], there.even[known], atol=1e-9)
    turned = sign[known, None] * there.odd[known]
    np.testing.assert_allclose(here.odd[known], turned, atol=1e-9)
    assert np.abs(here.odd[known]).max() > 0.1


def test_masked_points_are_in_no_feature():
    points, normals, mask = scene()
    moved = np.where(mask[:, None], points, 0.01 * points)
    here, there = (features(x, normals, mask) for x in (points, moved))
    np.testing.assert_array_equal(here.mask, there.mask)
    np.testing.assert_allclose(
        histograms(here)[here.mask], histograms(there)[here.mask], atol=1e-12
    )


def test_points_without_normals_have_no_feature():
    points, normals, mask = scene()
    found = features(points, 0 * normals, mask)
    assert not np.any(found.mask)
    assert np.all(np.isfinite(histograms(found)))
