import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg import metrics
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from jaxreg.io.graphs.g2o import read_g2o
from tests.helpers import data_dir


def random_poses(seed: int, num: int = 7) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (num, 1, 1))
    T[:, :3, :3] = Rotation.from_quat(rng.normal(size=(num, 4))).as_matrix()
    T[:, :3, 3] = rng.normal(size=(num, 3))
    return T


def test_errors_are_those_of_the_paper():
    true, est = random_poses(0), random_poses(1)
    relative = Rotation.from_matrix(est[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2))
    args = (jnp.asarray(est), jnp.asarray(true), "none")
    np.testing.assert_allclose(
        metrics.rotation_errors(*args), relative.magnitude(), rtol=1e-4
    )
    np.testing.assert_allclose(
        metrics.rotation_error(*args), relative.magnitude().mean(), rtol=1e-4
    )
    gap = np.linalg.norm(est[:, :3, 3] - true[:, :3, 3], axis=1)
    np.testing.assert_allclose(metrics.translation_error(*args), gap.mean(), rtol=1e-5)
    mask = jnp.arange(7) < 3
    np.testing.assert_allclose(
        metrics.translation_error(*args, mask=mask), gap[:3].mean(), rtol=1e-5
    )


@pytest.mark.parametrize("align", ["first", "best"])
def test_a_common_motion_is_no_error(align):
    true = random_poses(0)
    moved = jnp.asarray(random_poses(5)[0] @ true)
    np.testing.assert_allclose(
        metrics.rotation_errors(moved, jnp.asarray(true), align), 0, atol=2e-6
    )
    np.testing.assert_allclose(
        metrics.translation_errors(moved, jnp.asarray(true), align), 0, atol=5e-6
    )


def test_best_alignment_forgives_a_bad_first_frame_and_masks():
    true = random_poses(0)
    est = true.copy()
    est[0] = random_poses(9)[0]
    mask = jnp.arange(7) > 0
    args = (jnp.asarray(est), jnp.asarray(true))
    assert metrics.rotation_error(*args, "first") > 0.1
    elsewhere = jnp.asarray(random_poses(5)[0] @ est), args[1]
    for poses in (args, elsewhere):
        assert metrics.rotation_error(*poses, "best", mask) < 1e-5
        assert metrics.translation_error(*poses, "best", mask) < 1e-5


def test_gradients_are_finite_at_the_truth():
    true = jnp.asarray(random_poses(0))

    def error(T, align):
        return metrics.translation_error(T, true, align)

    for align in ("first", "best"):
        assert np.isfinite(jax.grad(error)(true, align)).all()


def test_chordal_objective_against_numpy():
    T = random_poses(2).astype(np.float32)
    half = np.random.default_rng(0).normal(size=(6, 6, 6)).astype(np.float32)
    info = half @ half.swapaxes(1, 2) + np.eye(6, dtype=np.float32)
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5], [5, 6]])
    noise = np.asarray(lie.exp(jnp.full((6, 6), 0.1)))
    motions = np.linalg.inv(T[:-1]) @ T[1:] @ noise
    graph = PoseGraph.from_edges(edges, motions.astype(np.float32), information=info)
    total = 0.0
    for (i, j), X, M in zip(edges, motions, info.astype(np.float64), strict=True):
        tau = 3 / np.trace(np.linalg.inv(M[:3, :3]))
        kappa = 3 / (2 * np.trace(np.linalg.inv(M[3:, 3:])))
        turn = T[j, :3, :3] - T[i, :3, :3] @ X[:3, :3]
        shift = T[j, :3, 3] - T[i, :3, 3] - T[i, :3, :3] @ X[:3, 3]
        total += kappa * (turn**2).sum() + tau * (shift**2).sum()
    value = metrics.chordal_objective(graph.padded(9), jnp.asarray(T))
    np.testing.assert_allclose(value, total, rtol=1e-4)


@pytest.mark.data
def test_known_objective_of_a_public_file():
    with jax.enable_x64(True):
        graph = read_g2o(data_dir("pose_graphs", "tinyGrid3D.g2o"))
        eye = lie.identity(3, jnp.float64, (graph.num_poses,))
        assert metrics.chordal_objective(graph, eye) > 18.5194
