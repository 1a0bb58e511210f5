import chex
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph


EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 1]])


def motions(seed: int = 0, num: int = 4) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (num, 1, 1))
    T[:, :3, :3] = Rotation.from_quat(rng.normal(size=(num, 4))).as_matrix()
    T[:, :3, 3] = rng.normal(size=(num, 3))
    return T


def test_a_graph_of_lists_and_arrays():
    graph = PoseGraph.from_edges(EDGES.tolist(), motions().tolist())
    assert (graph.num_poses, graph.num_edges, graph.dim) == (3, 4, 3)
    assert graph.T_i_j.dtype == jnp.float32
    assert graph.edges.dtype == jnp.int32
    assert graph.information is None
    assert repr(graph) == "PoseGraph(3 poses in 3D, 4 edges, float32)"


def with_value(name: str, at: int, value: object) -> dict:
    kwargs: dict = {
        "edges": EDGES.copy(),
        "T_i_j": motions(),
        "weight": np.ones(4),
        "information": np.tile(np.eye(6), (4, 1, 1)),
    }
    kwargs[name][at] = value
    return kwargs


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("edges", [1, 1], r"edge 2 \(1, 1\): joins a frame with itself"),
        ("edges", [1, 5], r"edge 2 \(1, 5\): ids must lie between 0 and 2"),
        ("T_i_j", np.full((4, 4), np.nan), r"edge 2 \(2, 0\): T_i_j is not finite"),
        ("T_i_j", np.diag([1, 1, -1, 1]), "edge 2 .*reflection"),
        ("T_i_j", np.diag([1, 1, 1.1, 1]), "edge 2 .*not orthonormal"),
        ("T_i_j", np.diag([1, 1, 1, 2]), "edge 2 .*last row"),
        ("weight", -1, "edge 2 .*weight is negative"),
        ("weight", np.inf, "edge 2 .*weight is not finite"),
        ("information", np.nan, "edge 2 .*information is not finite"),
        ("information", np.diag([1, 1, 1, 1, 1, -1]), "edge 2 .*indefinite"),
        ("information", np.triu(np.ones((6, 6))), "edge 2 .*not symmetric"),
    ],
)
def test_bad_values_name_the_edge_unless_masked(name, value, message):
    kwargs = with_value(name, 2, value)
    with pytest.raises(ValueError, match=message):
        PoseGraph.from_edges(**kwargs, num_poses=3)
    mask = np.array([True, True, False, True])
    graph = PoseGraph.from_edges(**kwargs, num_poses=3, mask=mask)
    chex.assert_tree_all_finite(graph)
    assert graph.weight[2] == 0


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"edges": EDGES[:3]}, r"edges: wanted shape \(4, 2\).*found \(3, 2\)"),
        ({"T_i_j": np.eye(4)}, r"T_i_j: wanted shape .*found \(4, 4\)"),
        ({"weight": np.ones(3)}, r"weight: wanted shape \(4,\), found \(3,\)"),
        ({"information": np.ones((4, 3, 3))}, r"information: wanted shape \(4, 6, 6\)"),
        ({"mask": np.ones(3, bool)}, r"mask: wanted shape \(4,\)"),
        ({"num_poses": 0}, "num_poses: wanted an integer of at least 1"),
        ({"edges": -EDGES}, "edges: ids must lie between"),
    ],
)
def test_wrong_shapes_are_named(kwargs, message):
    good: dict = {"edges": EDGES, "T_i_j": motions()}
    with pytest.raises(ValueError, match=message):
        PoseGraph.from_edges(**(good | kwargs))


def test_wrong_types_are_named():
    with pytest.raises(TypeError, match="edges: wanted integers"):
        PoseGraph.from_edges(EDGES * 1.0, motions())
    for dtype in (np.float16, complex):
        with pytest.raises(TypeError, match="T_i_j: wanted float32 or float64"):
            PoseGraph.from_edges(EDGES, motions().astype(dtype))
    with pytest.raises(TypeError, match="mask: wanted a boolean"):
        PoseGraph.from_edges(EDGES, motions(), mask=np.ones(4))


def test_doubles_are_singles_where_jax_has_no_doubles():
    assert PoseGraph.from_edges(EDGES, motions().astype(float)).weight.dtype == "f4"


def test_nearly_orthonormal_rotations_are_projected():
    T = motions()
    skewed = T + 1e-3 * np.random.default_rng(0).normal(size=T.shape)
    skewed[:, 3] = [0, 0, 0, 1]
    R = np.asarray(PoseGraph.from_edges(EDGES, skewed).T_i_j)[:, :3, :3]
    np.testing.assert_allclose(
        R @ R.swapaxes(1, 2), np.eye(3)[None].repeat(4, 0), atol=1e-6
    )
    U, _, Vt = np.linalg.svd(skewed[:, :3, :3])
    np.testing.assert_allclose(R, U @ Vt, atol=1e-6)


def test_a_graph_without_edges_has_one_masked_row():
    graph = PoseGraph.from_edges([], np.zeros((0, 4, 4)), num_poses=2)
    assert graph.num_edges == 1
    assert not graph.mask.any()
    with pytest.raises(ValueError, match="num_poses: must be given"):
        PoseGraph.from_edges([], np.zeros((0, 4, 4)))


def test_padding_and_its_limits():
    graph = PoseGraph.from_edges(EDGES, motions(), information=np.ones((4, 6, 6)))
    padded = graph.padded(6)
    assert padded.num_edges == 6
    np.testing.assert_array_equal(padded.mask, [1, 1, 1, 1, 0, 0])
    np.testing.assert_array_equal(padded.T_i_j[4:], np.eye(4)[None].repeat(2, 0))
    np.testing.assert_array_equal(padded.weight, [1, 1, 1, 1, 0, 0])
    with pytest.raises(ValueError, match="num_edges: wanted at least 4"):
        graph.padded(3)


def test_graphs_are_built_while_tracing():
    @jax.jit
    def build(edges, T):
        with pytest.raises(ValueError, match="num_poses: must be given while tracing"):
            PoseGraph.from_edges(edges, T)
        return PoseGraph.from_edges(edges, T, num_poses=3)

    graph = build(EDGES, jnp.asarray(motions()))
    np.testing.assert_allclose(graph.T_i_j, motions(), atol=1e-6)


def test_residuals_against_numpy():
    X, T = motions(1, 3), motions()
    graph = PoseGraph.from_edges(EDGES, T)
    poses = jnp.asarray(X)
    eq14, errors = graph.residual_motions(poses), graph.tangent_errors(poses)
    rotation, translation = graph.differences(poses)
    masked = eqx.tree_at(lambda g: g.mask, graph, jnp.arange(len(EDGES)) > 0)
    for some, every in zip(
        masked.differences(poses), (rotation, translation), strict=True
    ):
        np.testing.assert_array_equal(some, every.at[0].set(0))
    for e, (i, j) in enumerate(EDGES):
        np.testing.assert_allclose(
            eq14[e], X[i] @ T[e] @ np.linalg.inv(X[j]), atol=1e-5
        )
        gap = T[e] - np.linalg.inv(X[i]) @ X[j]
        np.testing.assert_allclose(rotation[e], (gap[:3, :3] ** 2).sum(), rtol=1e-4)
        np.testing.assert_allclose(translation[e], (gap[:3, 3] ** 2).sum(), rtol=1e-4)
        log = np.real(logm(np.linalg.inv(T[e]) @ np.linalg.inv(X[i]) @ X[j]))
        tangent = [*log[:3, 3], log[2, 1], log[0, 2], log[1, 0]]
        np.testing.assert_allclose(errors[e], tangent, atol=1e-4)
    np.testing.assert_allclose(
        lie.exp(errors)[0], np.linalg.inv(T[0]) @ np.linalg.inv(X[0]) @ X[1], atol=1e-5
    )
