import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, half_noise
from scipy.spatial import KDTree

from jaxreg.cloud import (
    centroid,
    estimate_normals,
    median_spacing,
    rms_radius,
    thin,
    without_noise,
)


N = 6000
_thin = jax.jit(thin, static_argnums=2)
_without_noise = jax.jit(without_noise)


def _sphere(d: int) -> np.ndarray:
    x = np.random.default_rng(1).standard_normal((N, d))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("d", [2, 3])
def test_thinned_points_stay_on_the_surface_evenly_with_radial_normals(d):
    points = _sphere(d)
    mask = np.arange(N) < N - 1000
    points[~mask] = np.nan
    cloud = _thin(jnp.asarray(np.nan_to_num(points)), jnp.asarray(mask), 512)
    kept = np.asarray(cloud.points)[np.asarray(cloud.mask)]
    assert 450 <= len(kept) <= 512
    np.testing.assert_allclose(np.linalg.norm(kept, axis=1), 1, atol=0.02)
    normals = np.asarray(cloud.normals)[np.asarray(cloud.mask)]
    cosine = np.abs(np.sum(kept * normals, axis=1) / np.linalg.norm(kept, axis=1))
    assert np.quantile(cosine, 0.02) > 0.97
    gap = KDTree(kept).query(kept, 2)[0][:, 1]
    assert gap.min() > 0.2 * np.median(gap)


def test_a_cloud_that_fits_is_kept_as_it_is():
    points = jnp.asarray(blob(200, 3))
    cloud = _thin(points, jnp.ones(200, bool), 512)
    order = np.lexsort(np.asarray(cloud.points).T)
    expected = np.asarray(points)[np.lexsort(np.asarray(points).T)]
    np.testing.assert_allclose(np.asarray(cloud.points)[order], expected, atol=1e-6)
    np.testing.assert_array_equal(cloud.normals != 0, True)


def test_thinning_far_from_the_origin_keeps_the_shape():
    points = _sphere(3)
    here = _thin(jnp.asarray(points), jnp.ones(N, bool), 512)
    there = _thin(jnp.asarray(points + np.float32(1000)), jnp.ones(N, bool), 512)
    distance = KDTree(here.points).query(np.asarray(there.points) - 1000)[0]
    assert np.quantile(distance, 0.9) < 0.1


def test_median_spacing_is_that_of_a_grid_and_ignores_duplicates():
    x = np.stack(np.meshgrid(*[np.arange(16.0)] * 2), -1).reshape(-1, 2)
    doubled = jnp.asarray(np.repeat(0.25 * x, 2, axis=0), jnp.float32)
    assert float(
        jax.jit(median_spacing)(doubled, jnp.ones(512, bool))
    ) == pytest.approx(0.25)
    assert float(jax.jit(median_spacing)(doubled, jnp.zeros(512, bool))) == 0


@pytest.mark.parametrize("d", [2, 3])
def test_median_spacing_is_to_the_second_other_point_and_in_space_the_fourth(d):
    points = blob(60, d)  # every one is asked
    mask = np.arange(60) < 50
    others = KDTree(points[mask]).query(points[mask], 2 * (d - 1) + 1)[0][:, -1]
    found = jax.jit(median_spacing)(jnp.asarray(points), jnp.asarray(mask))
    assert float(found) == pytest.approx(np.median(others), rel=1e-4)


def test_normals_of_a_line_in_space_are_undefined():
    line = jnp.linspace(0, 1, 64)[:, None] * jnp.asarray([1.0, 2.0, 3.0])
    normals = jax.jit(estimate_normals)(line, jnp.ones(64, bool))
    np.testing.assert_array_equal(normals, 0)


def test_moments_ignore_masked_rows_and_survive_an_offset():
    points = blob(300, 3).astype(np.float64) + 1e5
    mask = np.arange(300) < 250
    with jax.enable_x64(True):
        args = jnp.asarray(points), jnp.asarray(mask)
        np.testing.assert_allclose(centroid(*args), points[:250].mean(0), rtol=1e-12)
        offset = points[:250] - points[:250].mean(0)
        expected = np.sqrt(np.mean(np.sum(offset**2, 1)))
        assert float(rms_radius(*args)) == pytest.approx(expected)


@pytest.mark.parametrize("d", [2, 3])
def test_noise_that_fills_the_box_is_dropped_and_the_surface_kept(d):
    clean = np.concatenate([blob(N, d)] * 2)[:10_000] * [1, 1, 0.5][:d]
    clean = clean + 1e-3 * np.random.default_rng(0).standard_normal(clean.shape)
    points = half_noise(clean.astype(np.float32), seed=1)
    real = np.all(points == clean.astype(np.float32), axis=1)
    mask = np.arange(10_000) < 9_000
    points[~mask] = np.nan
    points = jnp.asarray(np.nan_to_num(points, nan=50.0))
    keep = np.asarray(_without_noise(points, jnp.asarray(mask)))
    assert not np.any(keep & ~mask)
    assert keep[mask & real].mean() > 0.9
    assert keep[mask & ~real].mean() < 0.2


def _clean() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    x, y, z = rng.uniform(-1, 1, (3, N))
    turn, ring = 40 * np.pi * x, np.floor(12 * np.abs(y)) ** 2
    return {
        "blob": blob(N, 3),
        "curve": blob(N, 2),
        "wall": np.stack([x, y, 0.002 * z], 1),
        "corner of a room, one wall sparse": np.stack(
            [np.where(z < 0.8, x, -1), y, np.where(z < 0.8, 0.01 * x, z * x)], 1
        ),
        "rings of a lidar": np.stack(
            [ring * np.cos(turn), ring * np.sin(turn), 0.02 * ring * np.abs(z)], 1
        ),
        "one place": np.ones((N, 3)),
    }


@pytest.mark.parametrize("name", list(_clean()))
def test_scans_without_noise_are_kept_whole(name):
    points = jnp.asarray(_clean()[name], jnp.float32)
    keep = _without_noise(points, jnp.ones(N, bool))
    assert np.mean(keep) > 0.999


def test_points_that_nothing_stands_out_from_are_kept():
    points = jax.random.uniform(jax.random.key(0), (N, 3))
    assert np.all(_without_noise(points, jnp.ones(N, bool)))
