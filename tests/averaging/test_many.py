"""Lists of graphs of unequal sizes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import compiled

import jaxreg as jr
from jaxreg import Status
from jaxreg.averaging import many
from jaxreg.averaging.gauge import average_graph
from jaxreg.averaging.start.cycle_consensus import _noise
from tests.averaging.graphs import motions, random_graph, rotations


# Right motions of each frame outnumber wrong ones: rounding decides if they do not.
SIZES = [(9, 24), (10, 30), (7, 15)]
PLAIN = jr.MotionAveraging()


def _graphs(sizes, outliers: float = 0.1, d: int = 3):
    cases = [random_graph(n, e, outliers, k, d=d) for k, (n, e) in enumerate(sizes)]
    return [
        jr.PoseGraph.from_edges(edges, T.astype(np.float32), len(X))
        for X, edges, T, _ in cases
    ]


@pytest.mark.parametrize(
    "method", [PLAIN, jr.Correntropy()], ids=lambda m: type(m).__name__
)
def test_padding_changes_an_answer_by_rounding_only(method):
    graphs = _graphs(SIZES[:2])
    padded = jr.average(graphs, method)[0]  # to the poses and edges of the other
    alone = average_graph(graphs[0], method, None, None)
    assert int(padded.status) == int(alone.status) == Status.CONVERGED
    assert padded.T_world_i.shape == alone.T_world_i.shape
    np.testing.assert_allclose(padded.T_world_i, alone.T_world_i, atol=1e-4)
    np.testing.assert_allclose(padded.edge_weight, alone.edge_weight, atol=1e-3)
    np.testing.assert_array_equal(padded.placed, alone.placed)
    np.testing.assert_array_equal(padded.component, alone.component)


def test_a_hundred_sizes_compile_once_a_bucket_and_settings_never():
    sizes = [(10 + k % 4, 16 + k // 4) for k in range(100)]
    graphs = _graphs(sizes, outliers=0.0, d=2)
    programs, other = many._average_lanes, jr.MotionAveraging(tolerance=1e-5)
    with compiled() as names:
        found = jr.average(graphs, PLAIN)
        first = len(names)
        jr.average(graphs, other)
    # 10, 12 and 14 poses.
    assert len([name for name in names if programs.__name__ in name]) == 3
    assert not names[first:]
    assert first < 20
    assert {int(sol.status) for sol in found} == {Status.CONVERGED}


def test_single_graphs_of_similar_sizes_share_programs_and_keep_their_answers():
    # 16 poses and 32 edges.
    graphs = _graphs([(12, 24), (9, 17), (10, 22), (11, 20)], outliers=0.0)
    starts = [_some_way_off(*n) for n in enumerate((12, 9, 10, 11))]
    jr.average(graphs[0], PLAIN, starts[0])
    jr.average(graphs[1], PLAIN, starts[1])
    with compiled() as names:
        found = [
            jr.average(*gx) for gx in zip(graphs, [PLAIN] * 4, starts, strict=True)
        ]
    assert not names
    for graph, start, sol in zip(graphs, starts, found, strict=True):
        alone = average_graph(graph, PLAIN, start, None)
        assert sol.T_world_i.shape == alone.T_world_i.shape
        assert sol.edge_weight.shape == alone.edge_weight.shape
        assert int(sol.status) == Status.CONVERGED
        np.testing.assert_allclose(sol.T_world_i, alone.T_world_i, atol=1e-5)
        np.testing.assert_allclose(sol.log_evidence, alone.log_evidence, rtol=1e-4)
        assert sol.trace is not None
        assert alone.trace is not None
        steps = sol.trace.change[:2], alone.trace.change[:2]
        np.testing.assert_allclose(*steps, rtol=1e-3, atol=1e-6)


def test_six_single_graphs_of_two_octaves_compile_three_times():
    # To 32, 64 and 128 poses.
    sizes = [(20, 29), (30, 44), (45, 67), (60, 89), (80, 119), (100, 149)]
    graphs = _graphs(sizes, outliers=0.0, d=2)
    with compiled() as names:
        for graph in graphs:
            assert jr.average(graph, PLAIN).status == Status.CONVERGED
    assert len([name for name in names if "solve" in name]) == 3


def _some_way_off(seed: int, num: int) -> jax.Array:
    """Poses of a graph of `_graphs`, with errors of 6 degrees."""
    rng = np.random.default_rng(seed)
    X = random_graph(num, 2 * num, 0.0, seed)[0]
    off = motions(rotations(rng, num, 3, 0.1), 0.1 * rng.normal(size=(num, 3)))
    return jnp.asarray(X @ off, jnp.float32)


def test_what_a_search_draws_for_an_edge_does_not_depend_on_others():
    few, more = (
        _noise(jax.random.key(3), n, 5, jnp.dtype(jnp.float32)) for n in (7, 16)
    )
    np.testing.assert_array_equal(few, more[:, :, :7])
    assert np.unique(more).size == more.size


def test_a_graph_without_valid_edges_has_its_status_and_the_others_their_poses():
    graphs = _graphs(SIZES[:3])
    nothing = np.zeros(graphs[1].num_edges, bool)
    edges, T = np.asarray(graphs[1].edges), np.asarray(graphs[1].T_i_j)
    graphs[1] = jr.PoseGraph.from_edges(edges, T, 10, mask=nothing)
    found = jr.average(graphs, PLAIN)
    assert [int(sol.status) for sol in found] == [
        Status.CONVERGED,
        Status.DISCONNECTED,
        Status.CONVERGED,
    ]
    alone = jr.average(graphs[2], PLAIN)
    np.testing.assert_allclose(found[2].T_world_i, alone.T_world_i, atol=1e-5)


def test_memory_grows_with_the_batch_that_is_asked_for():
    graphs = _graphs([(10, 30)] * 32, outliers=0.0)
    lanes = many._padded(graphs, None, 10, 32)

    def size(batch_size: int) -> int:
        def run(graph, present, init):
            lanes = graph, present, init, None
            found = many._average_lanes(PLAIN, lanes, batch_size, None)
            return found.T_world_i

        memory = jax.jit(run).lower(*lanes).compile().memory_analysis()
        assert memory is not None
        return memory.temp_size_in_bytes

    one, four, all_at_once = size(1), size(4), size(32)
    assert one < four < all_at_once
    # 100 kB a graph of 10 poses and 30 edges in a batch.
    assert all_at_once < 32 * 1e5


def test_pieces_of_a_list_report_progress_and_keep_the_answers(
    monkeypatch: pytest.MonkeyPatch,
):
    graphs = _graphs([(7, 15), (10, 30), (8, 15), (7, 14)])
    whole = jr.average(graphs, PLAIN)
    monkeypatch.setattr(many, "_PIECE", 2)
    calls = []
    found = jr.average(graphs, PLAIN, progress=lambda *call: calls.append(call))
    assert calls == [("averaging graphs", done, 4) for done in (0, 2, 3, 4)]
    for one, other in zip(found, whole, strict=True):
        np.testing.assert_allclose(one.T_world_i, other.T_world_i, atol=1e-5)


def test_lists_stand_inside_jit():
    graphs, calls = _graphs(SIZES[:2]), []

    @jax.jit
    def poses(graphs):
        found = jr.average(graphs, PLAIN, progress=lambda *call: calls.append(call))
        return [sol.T_world_i for sol in found]

    found = poses(graphs)
    assert not calls
    for T, sol in zip(found, jr.average(graphs, PLAIN), strict=True):
        np.testing.assert_allclose(T, sol.T_world_i, atol=1e-5)


def test_wrong_lists_are_named():
    graphs = _graphs(SIZES[:2])
    X, edges, T, _ = random_graph(7, 15, 0.0, 2, d=2)
    flat = jr.PoseGraph.from_edges(edges, T.astype(np.float32))
    with pytest.raises(ValueError, match=r"graph\[2\]: wanted dimension 3"):
        jr.average([*graphs, flat])
    with pytest.raises(ValueError, match="init: wanted a list of 2"):
        jr.average(graphs, init=np.eye(4))
    with pytest.raises(ValueError, match="batch_size"):
        jr.average(graphs, batch_size=0)
