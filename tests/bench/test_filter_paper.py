"""The paper's experiments as rows: its columns, and pictures of the first trials."""

from pathlib import Path

import numpy as np
import pytest

from bench import plots, trial_plot
from bench.measure import finite
from bench.records import Key, Metric, Row
from bench.workloads.filter_data import cube, horse, horse_model, letter
from bench.workloads.filter_paper import judge, judge_table


def test_columns_of_table_1_are_those_of_known_errors():
    trials = horse(4, 0.05, horse_model(None))
    theta, shift = [1.0, -3.0, 2.0, -12.0], [1.0, 2.0, 6.0, 3.0]
    away = np.linalg.inv(trials.T_target_source)
    for pose, angle, x in zip(away, np.deg2rad(theta), shift, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        pose[:3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]] @ pose[:3, :3]
        pose[0, 3] += x
    judged = judge_table(trials, list(np.linalg.inv(away)))
    found = {m.key: m.value for m in judged.metrics}
    assert found == pytest.approx(
        {
            "success": 50,  # one is too far off, one turned too far
            "t_mean": 3,
            "t_dev": np.std(shift),
            "t_max": 6,
            "theta_mean": -3,
            "theta_dev": np.std(theta),
            "theta_max": 12,
            "e_rot": 2.5,
        }
    )


def test_a_pose_that_looks_the_same_is_told_apart_from_the_right_one():
    trials = cube(5)
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, -1], [1, 0]]
    truth = trials.T_target_source
    judged = judge(trials, [*truth[:2], *(quarter @ truth[2:4]), np.eye(4)])
    found = {m.key: m.value for m in judged.metrics}
    assert (found["success"], found["as_shape"]) == (40, 80)


def test_pictures_show_the_first_trial_of_the_rows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    trials = letter(5)
    judged = judge(trials, list(trials.T_target_source))
    samples = {key: finite(values) for key, values in judged.samples.items()}

    def row(method: str, success: float) -> Row:
        metrics = {"success": Metric("success", success, "%", "up")}
        key = Key("full", "filter_paper", "letter", method)
        return Row(key, "jaxreg", "ok", trials=5, metrics=metrics, samples=samples)

    figure, drawn = trial_plot.trial_figure, []
    monkeypatch.setattr(
        trial_plot, "trial_figure", lambda *args: drawn.append(args) or figure(*args)
    )
    rows = [row("a filter", 97), row("kernel correlation, 1", 1)]
    rows.append(row("kernel correlation, 2", 3))
    (path,) = plots.draw("filter_paper", "full", rows, tmp_path)
    assert path.name == "filter_paper_letter.png"
    assert path.read_bytes()[:4] == b"\x89PNG"
    ((_, source, _, panels),) = drawn
    np.testing.assert_array_equal(source, trials.source[0])
    assert [panel.title for panel in panels] == [
        "as given",
        "a filter\nfound; found in 97 % of trials",
        "kernel correlation, 2\nfound; found in 3 % of trials",
    ]
    for panel in panels[1:]:
        np.testing.assert_allclose(
            panel.T_target_source, trials.T_target_source[0], rtol=1e-3, atol=1e-2
        )
