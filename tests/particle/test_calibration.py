"""Whether answers err as much as their covariances say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import motion, move
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import jaxreg as jr
from jaxreg.registrar import Modes


pytestmark = pytest.mark.usefixtures("fully_compiled")


N = 600
ROUND = 8  # pairs in a call; more would compile another program
_contains = jax.jit(jax.vmap(Modes.contains, (0, 0, 0, None)))


def _lump(rng: np.random.Generator, kind: int) -> np.ndarray:
    """`(N, 3)` random points on a smooth closed surface, one for each kind."""
    shape = np.random.default_rng(1000 + kind)
    waves, height = 1.8 * shape.normal(size=(5, 3)), 0.15 * shape.normal(size=5)
    phase = shape.uniform(0, 2 * np.pi, 5)
    x = rng.normal(size=(N, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return (1 + np.sin(x @ waves.T + phase) @ height)[:, None] * x


def _trials(num: int, noise: float):
    """Sources, targets and true poses; noise in sample spacings."""
    sources, targets, truth = [], [], []
    for i in range(num):
        rng = np.random.default_rng(i)
        clouds = [_lump(rng, (1, 3, 5, 6)[i % 4]) for _ in range(2)]
        spacing = np.median(KDTree(clouds[0]).query(clouds[0], 5)[0][:, -1])
        clouds = [x + noise * spacing * rng.normal(size=x.shape) for x in clouds]
        T = motion(i, 3)
        sources.append(clouds[0])
        targets.append(move(T, clouds[1]))
        truth.append(T)
    return tuple(np.stack(x).astype(np.float32) for x in (sources, targets, truth))


def _share(source, target, truth, method, init) -> float:
    """Of truths within the region of 95 %."""
    inside = []
    for first in range(0, len(source), ROUND):
        rows = slice(first, first + ROUND)
        guess = None if init is None else init[rows]
        sol = jr.register(
            source[rows], target[rows], method, guess, key=jax.random.key(first)
        )
        centroid = source[rows].mean(axis=1)
        inside.append(_contains(sol.modes, truth[rows], centroid, 0.95))
    return float(np.mean(np.concatenate(inside)))


@pytest.mark.parametrize("noise", [0.0, 0.4])
def test_the_truth_is_in_the_region_of_icp_as_often_as_it_says(noise):
    source, target, truth = _trials(96, noise)
    near = [motion(500 + i, 3, angle=0.2, shift=0.1) @ T for i, T in enumerate(truth)]
    init = np.stack(near).astype(np.float32)
    assert 0.9 <= _share(source, target, truth, jr.ICP(), init) <= 0.99


def test_the_truth_is_in_the_region_of_the_search_as_often_as_it_says():
    source, target, truth = _trials(24, 0.3)
    assert 0.9 <= _share(source, target, truth, None, None)


def test_a_region_against_scipy():
    rng = np.random.default_rng(0)
    unit = np.array([100.0] * 3 + [0.1] * 3)
    A = rng.normal(size=(6, 6))
    covariance = 0.01 * unit[:, None] * (A @ A.T + np.eye(6)) * unit
    T, other, centroid = motion(1, 3), motion(2, 3), np.array([1.0, 2.0, 3.0])
    weight = np.array([0.03, 0.97, 0.0])
    poses = np.stack([other, T, other])
    given = poses, *(weight for _ in range(5)), [covariance] * 3
    modes = Modes(*map(jnp.asarray, given))
    error = np.linalg.cholesky(covariance) @ rng.normal(size=6)
    true = np.eye(4)
    true[:3, :3] = Rotation.from_rotvec(error[3:]).as_matrix() @ T[:3, :3]
    image = T[:3, :3] @ centroid + T[:3, 3] + error[:3]
    true[:3, 3] = image - true[:3, :3] @ centroid
    level = chi2.cdf(error @ np.linalg.solve(covariance, error), 6)
    for probability in (float(level) - 0.02, float(level) + 0.02):
        found = modes.contains(jnp.asarray(true), jnp.asarray(centroid), probability)
        assert bool(found) == (probability > level)
    # The second mode is in the region only where the first does not suffice.
    there = jnp.asarray(other), jnp.asarray(centroid)
    assert not modes.contains(*there, 0.95)
    assert modes.contains(*there, 0.98)
