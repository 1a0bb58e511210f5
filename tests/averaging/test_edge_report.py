"""Residuals, chi-square and redundancy numbers of an adjustment."""

import jax
import numpy as np
import pytest

from jaxreg.averaging import MCC, PoseGraphLM, average, edge_report
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import random_graph


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("d", [2, 3])
def test_redundancy_numbers_sum_to_the_degrees_of_freedom(d: int):
    k = 6 if d == 3 else 3
    _, edges, T, _ = random_graph(6, 12, 0.0, 1, d=d)
    deviation = np.deg2rad(0.5) if d == 3 else np.deg2rad(0.5)
    info = np.diag([0.005**-2] * d + [deviation**-2] * (k - d))
    graph = PoseGraph.from_edges(edges, T, 6, information=np.tile(info, (12, 1, 1)))
    report = edge_report(graph, average(graph, PoseGraphLM()))
    assert report.degrees_of_freedom == k * (12 - 5)
    assert k * report.redundancy.sum() == pytest.approx(report.degrees_of_freedom)
    assert np.all((report.redundancy >= -1e-9) & (report.redundancy <= 1))
    assert 0.5 < report.variance_factor < 2  # the information is that of the noise
    assert 1e-3 < report.p_value <= 1
    assert report.normalised[report.worst[0]] == report.normalised.max()


def test_a_lone_edge_is_checked_by_nothing():
    _, edges, T, _ = random_graph(5, 10, 0.0, 2)
    edges = np.concatenate([edges, [[0, 5]]])
    graph = PoseGraph.from_edges(edges, np.concatenate([T, T[:1]]), 6)
    report = edge_report(graph, average(graph, PoseGraphLM()))
    assert report.redundancy[-1] == pytest.approx(0, abs=1e-6)
    assert report.normalised[-1] == pytest.approx(0, abs=1e-6)
    assert not report.prior_noise


def test_wrong_edges_stand_out_and_count_for_nothing():
    X, edges, T, bad = random_graph(12, 40, 0.2, 3)
    graph = PoseGraph.from_edges(edges, T, 12)
    sol = average(graph, MCC(), init=X)
    report = edge_report(graph, sol)
    assert not report.trusted[bad].any()
    assert report.normalised[bad].min() > report.normalised[~bad].max()
    assert set(report.worst) <= set(np.flatnonzero(report.trusted))
    assert "degrees of freedom" in repr(report)


def test_equations_without_a_solution_are_told():
    _, edges, T, _ = random_graph(5, 10, 0.0, 2)
    T[:, :-1, -1] *= 1e200  # whose squares are not finite
    graph = PoseGraph.from_edges(edges, T, 5)
    with np.errstate(over="ignore"):
        report = edge_report(graph, average(graph, PoseGraphLM()))
    assert report.trusted.any()
    assert np.isnan(report.redundancy[report.trusted]).all()


def test_a_solution_of_another_graph_is_refused():
    _, edges, T, _ = random_graph(5, 10, 0.0, 2)
    graph = PoseGraph.from_edges(edges, T, 5)
    other = PoseGraph.from_edges(edges[:4], T[:4], 6)
    with pytest.raises(ValueError, match="solution"):
        edge_report(other, average(graph, PoseGraphLM()))
