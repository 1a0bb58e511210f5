"""What is shown of a solution: reprs, figures, pages."""

import sys
import webbrowser
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import blob, motion, move

import jaxreg
from jaxreg import AveragedPairs, Status
from jaxreg.app import views
from jaxreg.registrar import Modes


SHAPE = blob(60, 3)
T_WORLD = np.stack([motion(k, 3) for k in range(3)]).astype(np.float32)
SCANS = [move(np.linalg.inv(T), SHAPE) for T in T_WORLD]
EDGES = np.array([(0, 1), (0, 2), (1, 2)])
GRAPH = jaxreg.PoseGraph.from_edges(
    EDGES, np.linalg.inv(T_WORLD[EDGES[:, 0]]) @ T_WORLD[EDGES[:, 1]]
)


def _registration(status: int = 0) -> jaxreg.RegistrationSolution:
    T = jnp.asarray(motion(1, 3), jnp.float32)
    one, six = jnp.ones(()), jnp.eye(6)
    return jaxreg.RegistrationSolution(
        T_target_source=T,
        status=jnp.asarray(status, jnp.int32),
        fitness=one,
        inlier_rmse=0.01 * one,
        num_inliers=jnp.asarray(60, jnp.int32),
        overlap=one,
        log_evidence=4 * one,
        num_steps=jnp.asarray(5, jnp.int32),
        H=six,
        b=six[0],
        error=one,
        covariance=1e-4 * six,
        modes=Modes.alone(T, one, one, 0.01 * one, 4 * one, 1e-4 * six),
    )


def _reconstruction() -> jaxreg.ReconstructionSolution:
    ones = jnp.ones(3)
    one = [x * ones[:, None] for x in (0.5, 4.0, 0.01)]
    return jaxreg.ReconstructionSolution(
        T_world_i=jnp.asarray(T_WORLD),
        status=jnp.asarray(Status.DISCONNECTED, jnp.int32),
        scan_status=jnp.array([0, 0, Status.LOW_OVERLAP], jnp.int32),
        placed=jnp.array([True, True, False]),
        component=jnp.array([0, 0, -1], jnp.int32),
        graph=GRAPH,
        overlap=0.5 * ones,
        edge_weight=ones.at[1:].set(0),
        inlier_rmse=0.01 * ones,
        mode=jnp.zeros(3, jnp.int32),
        motions=jaxreg.RelativeMotions(GRAPH.edges, GRAPH.T_i_j[:, None], *one),
        averaged=AveragedPairs(GRAPH.edges, 0.5 * ones),
        num_dropped=jnp.zeros(3, jnp.int32),
    )


TREE = jaxreg.average(GRAPH, jaxreg.SpanningTree())


@pytest.mark.parametrize(
    ("solution", "data", "panels"),
    [
        (_registration(), (SCANS[1], SCANS[0]), 3),
        (_registration(), (), 3),
        (_reconstruction(), (SCANS,), 3),
        (_reconstruction(), (), 3),
        (TREE, (GRAPH,), 2),
    ],
)
def test_solutions_are_drawn(
    tmp_path: Path, solution: jaxreg.RegistrationSolution, data: tuple, panels: int
):
    picture = views.draw(solution, *data)
    assert len(picture.axes) == panels
    assert picture._repr_png_().startswith(b"\x89PNG")
    views.write_page(tmp_path / "a.html", solution, *data)
    assert 'id="data"' in (tmp_path / "a.html").read_text("utf-8")


def test_data_that_do_not_fit_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="wanted source and target, found 1 arrays"):
        views.draw(_registration(), SCANS[0])
    with pytest.raises(ValueError, match="wanted a list of 3 scans, found 2 arrays"):
        views.write_page(tmp_path / "a.html", _reconstruction(), SCANS[:2])
    with pytest.raises(ValueError, match="wanted the PoseGraph that was averaged"):
        views.draw(TREE)
    many = jax.tree.map(lambda x: jnp.stack([x, x]), _registration())
    with pytest.raises(ValueError, match=r"batch of \(2,\); jax.tree.map"):
        views.draw(many, SCANS[1], SCANS[0])
    assert list(tmp_path.iterdir()) == []


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxreg\[app\]'"):
        views.draw(_registration())


def test_without_a_screen_the_page_is_still_written(monkeypatch: pytest.MonkeyPatch):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert views.show(TREE, GRAPH).exists()
    assert opened == []
    monkeypatch.setenv("DISPLAY", ":0")
    page = views.show(TREE, GRAPH)
    assert opened == [page.as_uri()]


def test_reprs_take_a_line_or_two():
    points, mask = jnp.ones((50, 3)), jnp.ones(50, bool)
    shown = [
        jaxreg.ParticleFilter(),
        jaxreg.sandhu2010(3),
        jaxreg.ICP(kernel=jaxreg.robust.Huber()),
        jaxreg.MCC(alpha=2.0),
        jaxreg.BruteForce.build(points, mask),
        _registration(),
        _registration().modes,
        _reconstruction(),
        _reconstruction().motions,
        TREE,
        GRAPH,
    ]
    for thing in shown:
        assert len(repr(thing)) <= 2 * 100
        assert repr(thing).count("\n") <= 1
    assert repr(jaxreg.ICP(kernel=jaxreg.robust.Huber())) == "ICP(kernel=Huber())"
    assert repr(jaxreg.MCC(alpha=2.0)) == "MCC(alpha=2)"
