"""What a scan saw from its viewpoint, and what lies before it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion, move

from jaxreg.cloud import RangeImage


def _wall(d: int) -> np.ndarray:
    """Points of x = 2 within one of the axis, seen from the origin."""
    side = np.linspace(-1, 1, 4096 if d == 2 else 64)
    across = np.stack(np.meshgrid(*(d - 1) * [side]), axis=-1).reshape(-1, d - 1)
    return np.c_[np.full(len(across), 2.0), across]


def _image(points: np.ndarray, viewpoint: np.ndarray) -> RangeImage:
    return RangeImage.of(
        jnp.asarray(points, jnp.float32),
        jnp.ones(len(points), bool),
        jnp.asarray(viewpoint, jnp.float32),
    )


@pytest.mark.parametrize("d", [2, 3])
def test_depth_before_a_wall_from_any_side(d):
    probes = np.array([[1.0, 0.1, 0.2], [1.9, 0.3, -0.2], [3.0, 0.2, 0.4]])[:, :d]
    ways = np.linalg.norm(probes, axis=1) * (2 / probes[:, 0] - 1)
    for seed in range(2):
        T = motion(seed, d)
        image = _image(move(T, _wall(d)), T[:d, d])
        depth = image.depth_before(jnp.asarray(move(T, probes).T, jnp.float32))
        # The least of neighbouring cells: a slanted wall is nearer there.
        np.testing.assert_allclose(depth, ways, atol=0.08)


def test_nothing_is_known_beside_a_scan_in_its_holes_and_without_a_viewpoint():
    wall = _wall(3)
    wall = wall[np.max(np.abs(wall[:, 1:]), axis=1) > 0.3]
    probes = jnp.array([[1.0, 0, 0], [1, 0.3, 0.3], [1, 0.8, 0], [-1, 0, 0]]).T
    depth = np.asarray(_image(wall, np.zeros(3)).depth_before(probes))
    np.testing.assert_array_equal(np.isfinite(depth), [False, True, False, False])
    unknown = _image(wall, np.full(3, np.nan)).depth_before(probes)
    assert np.all(np.asarray(unknown) == -np.inf)


def test_all_around_the_viewpoint():
    up = np.linspace(-1, 1, 6001)[1::2]
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(3000)
    out = np.sqrt(1 - up**2)
    ball = np.stack([out * np.cos(turn), out * np.sin(turn), up], axis=1)
    image = _image(ball, np.zeros(3))
    inside = jnp.asarray(0.6 * ball[::6].T, jnp.float32)
    depth = np.asarray(jax.jit(lambda i, x: i.depth_before(x))(image, inside))
    assert np.mean(np.isfinite(depth)) > 0.9
    np.testing.assert_allclose(depth[np.isfinite(depth)], 0.4, atol=1e-3)


@pytest.mark.parametrize("d", [2, 3])
def test_padding_changes_nothing(d):
    wall = _wall(d)[:: 10 if d == 2 else 1]
    probes = jnp.array([[1.0, 0.1, 0.2], [1.9, 0.3, -0.2], [3, 0.2, 0.4]])[:, :d].T
    padded = jnp.asarray(np.pad(wall, ((0, 2 * len(wall)), (0, 0))), jnp.float32)
    mask = jnp.arange(len(padded)) < len(wall)
    image = RangeImage.of(padded, mask, jnp.zeros(d, jnp.float32))
    alone = _image(wall, np.zeros(d)).depth_before(probes)
    assert np.all(np.isfinite(alone))
    np.testing.assert_allclose(image.depth_before(probes), alone, atol=1e-5)
