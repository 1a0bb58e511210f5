"""The workload of the MCC paper's tables measures what it says."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.motion_scans import Motions
from bench.workloads.averaging_paper import (
    agreeing,
    edge_sets,
    graphs,
    motion_errors,
    pose_errors,
)
from tests.helpers import motion


NUM = 10


@pytest.fixture
def exact() -> Motions:
    T_true = np.stack([motion(s, 3, shift=100.0) for s in range(NUM)])
    edges = np.stack(np.triu_indices(NUM, 1), axis=1)
    overlap = np.linspace(1, 0, len(edges))
    return Motions(
        name="made",
        edges=edges,
        T_i_j=np.linalg.inv(T_true[edges[:, 0]]) @ T_true[edges[:, 1]],
        overlap=overlap,
        trusted=overlap > 0.5,
        T_true=T_true,
    )


def test_errors_of_motions_are_those_put_in(exact: Motions) -> None:
    angle = np.linspace(0, np.pi, len(exact.edges))
    error = np.tile(np.eye(4), (len(angle), 1, 1))
    error[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * [0, 0.6, 0.8]).as_matrix()
    T_i_j = exact.T_i_j @ error
    T_i_j[:, 0, 3] += 3
    found = motion_errors(exact._replace(T_i_j=T_i_j))
    np.testing.assert_allclose(found[0], angle, atol=1e-7)
    np.testing.assert_allclose(found[1], 3, rtol=1e-9)


def test_sets_of_edges_have_the_sizes_of_the_paper(exact: Motions) -> None:
    sets = edge_sets("bunny", exact)
    assert len(sets["share"]) == round(46 / 90 * 45)
    assert exact.overlap[sets["share"]].min() > exact.overlap.mean() - 0.02
    assert len(sets["all"]) == 45
    np.testing.assert_array_equal(sets["trusted"], np.flatnonzero(exact.trusted))


def test_graphs_hold_true_motions_in_use(exact: Motions) -> None:
    plain, weighted = graphs(exact, np.arange(20))
    T = jnp.asarray(exact.T_true, jnp.float32)
    assert agreeing(plain, T) == 20
    assert float(jnp.max(plain.differences(T)[1])) < 1e-2
    np.testing.assert_allclose(weighted.weight[:20], exact.overlap[:20], rtol=1e-6)
    assert not np.any(weighted.weight[20:])
    assert max(pose_errors(exact.T_true, exact)) < 1e-3
