"""What the readings of the papers are tried on is what they say it is."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.workloads.filter_data import Noise, horse_model, moved, noisy_horse
from bench.workloads.readings_filter import judge_columns
from bench.workloads.table_two import TABLE_II, drawn_graphs


NUM = 300
#: Mean and root mean square of Table II: radians, then millimetres.
PRINTED = {
    "armadillo": ((0.2871, 0.6101), (9.857, 21.5347)),
    "buddha": ((0.1655, 0.5280), (1.8631, 4.4277)),
    "bunny": ((0.0253, 0.0624), (2.4320, 6.1294)),
    "dragon": ((0.1157, 0.4459), (4.5063, 12.9122)),
}


@pytest.mark.parametrize("name", TABLE_II)
def test_drawn_motions_have_about_the_errors_of_table_2(name):
    line, drawn = TABLE_II[name], drawn_graphs(name, 1)
    graph = drawn.graphs[0]
    mask = np.asarray(graph.mask)
    edges, T = np.asarray(graph.edges)[mask], np.asarray(graph.T_i_j, float)[mask]
    assert len(edges) == line.motions
    assert edges.max() == line.scans - 1
    true = np.linalg.inv(drawn.T_world_i[edges[:, 0]]) @ drawn.T_world_i[edges[:, 1]]
    gap = np.swapaxes(true[:, :3, :3], 1, 2) @ T[:, :3, :3]
    errors = (
        Rotation.from_matrix(gap).magnitude(),
        np.linalg.norm((T - true)[:, :3, 3], axis=1),
    )
    for x, printed, median in zip(errors, PRINTED[name], line.median, strict=True):
        found = np.mean(x), np.sqrt(np.mean(x**2))
        np.testing.assert_allclose(found, printed, rtol=0.25)
        np.testing.assert_allclose(np.median(x), median, rtol=0.25)


@pytest.mark.parametrize("around", ["model", "points", "frame"])
def test_noise_lies_where_its_reading_says(around):
    noise = Noise(23.0, around, 1.0)
    trials = noisy_horse(2, noise, horse_model(None), NUM)
    home = moved(trials.T_target_source, trials.source.astype(float))
    middle = {"model": home, "points": home, "frame": trials.source}[around]
    np.testing.assert_allclose(middle.mean(axis=1), 0, atol=15)
    spread = middle.std(axis=1)
    # Points of the horse lie apart, too.
    least = 30 if around == "points" else 20
    assert np.all(spread[:, 1] > least)
    if around != "points":
        np.testing.assert_allclose(spread, 23, rtol=0.2)


def test_columns_of_table_1_are_the_angle_and_the_axis():
    noise = Noise(23.0, "model", 0.05)
    trials = noisy_horse(2, noise, horse_model(None), NUM)
    away = np.linalg.inv(trials.T_target_source)
    more = Rotation.from_euler("z", 3, degrees=True).as_matrix()
    away[0, :3, :3] = more @ away[0, :3, :3]  # a larger angle about the same axis
    away[1, :3, :3] = away[1, :3, :3].T  # the same angle about the opposite axis
    judged = judge_columns(trials, list(np.linalg.inv(away)))
    found = {m.key: m.value for m in judged.metrics}
    assert found["t_max"] == pytest.approx(0, abs=1e-6)
    assert found["theta_max"] == pytest.approx(3, abs=1e-4)
    assert found["theta_mean"] == pytest.approx(1.5, abs=1e-4)
    assert found["axis_max"] == pytest.approx(2, abs=1e-4)
    assert found["axis_mean"] == pytest.approx(1, abs=1e-4)
