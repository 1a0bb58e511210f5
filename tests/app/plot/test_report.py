"""The page report.html: what it holds, and how it behaves in a real browser."""

import base64
import builtins
import dataclasses
import gzip
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from browser import Page, browser
from helpers import blob, motion, move
from scipy.spatial.distance import cdist

import jaxreg
from jaxreg import Status
from jaxreg.app.plot import report_points, write_graph_report, write_report
from jaxreg.app.plot.report_points import MAX_POINTS, encode_points, page_points
from jaxreg.app.result import Result
from jaxreg.io import MissingExtraError


EVIL = ["</script><script>alert(1)</script>", "<img src=x onerror=alert(1)>", "a&b"]


def _result(d: int, v: int, names: list[str]) -> tuple[list[np.ndarray], Result]:
    """Scans of one shape, the last pair of them distrusted."""
    shape = blob(700, d)
    T = np.stack([motion(i, d, angle=0.9 * i, shift=2.0 * (i > 0)) for i in range(v)])
    scans = [move(np.linalg.inv(T[i]), shape[i::2]) for i in range(v)]
    edges = np.array([(i, j) for i in range(v) for j in range(i + 1, v)])
    weight = np.ones(len(edges))
    weight[-1] = 0.0 if v > 2 else 1.0
    return scans, Result(
        names=names,
        T_world_i=T,
        component=np.zeros(v, int),
        status=Status.CONVERGED,
        scan_status=np.zeros(v, int),
        num_points=np.array([len(x) for x in scans]),
        num_dropped=np.zeros(v, int),
        edges=edges,
        T_i_j=np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]],
        overlap=np.full(len(edges), 0.8),
        weight=weight,
        inlier_rmse=np.full(len(edges), 0.01),
    )


def _data(path: Path) -> dict[str, Any]:
    text = path.read_text("utf-8")
    found = re.search(r'<script type="text/plain" id="data">(.*?)</script>', text)
    assert found is not None
    return json.loads(gzip.decompress(base64.b64decode(found[1])))


def test_the_page_is_one_file_and_text_in_it_stays_text(tmp_path: Path):
    scans, result = _result(3, 3, EVIL)
    path = tmp_path / "report.html"
    write_report(path, scans, result, details={"command": f"jaxreg {EVIL[0]}"})
    text = path.read_text("utf-8")
    assert len(text) < 2_500_000
    assert EVIL[0] not in text
    assert EVIL[1] not in text
    head = text.split("<script", 1)[0]
    assert "default-src 'none'" in head
    assert re.search(r"<(script|link|img)[^>]*(src|href)=[\"']?http", text) is None
    data = _data(path)
    assert [s["name"] for s in data["scans"]] == EVIL
    assert data["details"]["command"] == f"jaxreg {EVIL[0]}"


def test_points_keep_their_place_and_distance():
    scans, result = _result(3, 3, list("abc"))
    scans[0][3] = np.nan
    points = page_points(scans, result.T_world_i, result.component, np.eye(3))
    assert [len(x) for x in points.local] == [349, 350, 349]
    code = encode_points(points)
    steps = np.frombuffer(base64.b64decode(code["xyz"]), "<i2").reshape(-1, 3)
    first = code["offset"][0] + code["scale"][0] * np.cumsum(steps[:349], axis=0)
    np.testing.assert_allclose(first, points.local[0], atol=0.51 * code["scale"][0])
    others = np.concatenate(points.world[1:])
    wanted = cdist(points.world[0], others).min(axis=1)
    found = points.distance[0].astype(float)
    near = wanted < points.far
    np.testing.assert_allclose(
        found[near] * points.far / 254, wanted[near], atol=points.far / 250
    )
    assert (found[~near] == 255).all()


def test_large_scans_are_thinned_and_small_ones_are_not(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(report_points, "MAX_POINTS", 1000)
    rng = np.random.default_rng(0)
    large, small = rng.normal(size=(9000, 2)), rng.normal(size=(100, 2))
    T = np.tile(np.eye(3), (2, 1, 1))
    points = page_points([large, small], T, np.zeros(2, int))
    assert 500 < len(points.local[0]) <= 900
    assert len(points.local[1]) == 100


def test_a_page_full_of_points_is_small(tmp_path: Path):
    rng = np.random.default_rng(0)
    scans, result = _result(3, 3, list("abc"))
    for i in range(3):
        shell = rng.normal(size=(MAX_POINTS, 3))
        shell *= rng.normal(1, 0.01, (len(shell), 1)) / np.linalg.norm(
            shell, axis=1, keepdims=True
        )
        scans[i] = shell
    write_report(tmp_path / "report.html", scans, result)
    assert sum(_data(tmp_path / "report.html")["points"]["count"]) > 0.6 * MAX_POINTS
    assert (tmp_path / "report.html").stat().st_size < 2_500_000


def test_scans_without_points_or_poses_do_not_break_the_page(tmp_path: Path):
    scans, result = _result(3, 3, list("abc"))
    scans[2] = np.full((5, 3), np.nan, np.float32)
    result.component[2] = -1
    write_report(tmp_path / "a.html", scans, result)
    data = _data(tmp_path / "a.html")
    assert data["points"]["count"][2] == 0
    assert data["scans"][2]["component"] == -1
    with pytest.raises(ValueError, match="scans: wanted 3 like the poses, found 2"):
        write_report(tmp_path / "b.html", scans[:2], result)


def test_without_plotly_the_package_to_install_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("plotly"):
            raise ModuleNotFoundError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    scans, result = _result(2, 2, list("ab"))
    with pytest.raises(MissingExtraError, match="plotly"):
        write_report(tmp_path / "report.html", scans, result)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with browser() as opened:
        yield opened


def _ink(page: Page, path: Path, selector: str = "#scene") -> float:
    """The share of an element that is drawn on, as it is seen."""
    page.run(f"document.querySelector('{selector}').scrollIntoView({{block: 'end'}})")
    page.settle()
    box = page.run(
        f"(() => {{ const b = document.querySelector('{selector}')"
        ".getBoundingClientRect(); return [b.left, b.top, b.right, b.bottom]; })()"
    )
    page.picture(path)
    left, top, right, bottom = (max(int(x), 0) for x in box)
    image = matplotlib.image.imread(path)[top + 2 : bottom - 2, left + 2 : right - 2]
    colors = image[..., :3]
    return float(np.mean(np.abs(colors - colors[2, 2]).max(axis=-1) > 0.1))


def _drawn(page: Page) -> int:
    return page.run(
        "document.getElementById('scene')._fullData.filter(t => t.visible).length"
    )


def _quiet(page: Page) -> None:
    assert page.errors == []
    assert page.requests == []


def test_scans_in_a_browser(page: Page, tmp_path: Path):
    scans, result = _result(3, 3, EVIL)
    errors = {"names": EVIL, "e_R": [0.0, 0.1, 0.2], "e_t": [0.0, 1.0, 2.0]}
    errors |= {"mean_e_R": 0.1, "mean_e_t": 1.0}
    result.T_i_j[-1] = motion(7, 3)
    path, shot = tmp_path / "report.html", tmp_path / "shot.png"
    write_report(path, scans, result, errors=errors)
    page.open(path)
    after = _ink(page, shot)
    assert after > 0.02
    assert _ink(page, shot, "#slab") > 0.001
    assert page.run("document.querySelectorAll('img, b > script').length") == 0
    assert (
        page.run("document.querySelectorAll('#list .name')[1].textContent") == EVIL[1]
    )
    assert _drawn(page) == 4  # three scans and the outline of the cut
    page.click('#when [data-value="before"]')
    assert _drawn(page) == 3
    assert _ink(page, shot) > 0.02
    page.click('#when [data-value="after"]')
    page.click('#color [data-value="distance"]')
    assert page.run("!document.getElementById('scale').hidden")
    page.click("#list input")
    assert _drawn(page) == 3
    page.click("#none")
    assert _drawn(page) == 1
    assert _ink(page, shot) < after / 4
    page.click("#all")
    # A distrusted pair: the two scans alone, as the pair has them, and back.
    page.click(".edge.off")
    assert page.run("document.querySelector('#only').textContent").startswith(EVIL[1])
    assert _drawn(page) == 3
    x = "document.getElementById('scene').data[2].x[0]"
    by_poses = page.run(x)
    page.click("#own")
    assert page.run(x) != by_poses
    page.click("#every")
    assert _drawn(page) == 4
    at = "document.getElementById('cut-at').textContent"
    earlier = page.run(at)
    page.run(
        "(() => { const c = document.getElementById('cut'); c.value = 800;"
        "c.dispatchEvent(new Event('input')); })()"
    )
    page.settle()
    assert page.run(at) != earlier
    assert "mean" in page.run("document.getElementById('poses').textContent")
    _quiet(page)


def test_errors_of_the_poses_are_drawn_as_ellipsoids(page: Page, tmp_path: Path):
    scans, result = _result(3, 4, list("abcd"))
    C = np.zeros((4, 6, 6))
    C[1:] = np.diag([4e-6, 1e-6, 1e-6, 1e-8, 1e-8, 1e-8])
    path = tmp_path / "report.html"
    write_report(path, scans, dataclasses.replace(result, covariances=C))
    first, second = _data(path)["scans"][:2]
    assert "axes" not in first
    R, t = result.T_world_i[1][:3, :3], result.T_world_i[1][:3, 3]
    np.testing.assert_allclose(second["middle"], R @ scans[1].mean(axis=0) + t)
    longest = max(second["axes"], key=np.linalg.norm)
    # The root of the 95 % quantile of chi-square of three degrees of freedom.
    np.testing.assert_allclose(np.linalg.norm(longest), 2e-3 * 2.796, rtol=1e-3)
    assert abs(np.dot(longest, R[:, 0])) == pytest.approx(np.linalg.norm(longest))
    page.open(path)
    assert "Ellipsoids" in page.run("document.getElementById('hint').textContent")
    _quiet(page)


def test_components_are_shown_in_turn(page: Page, tmp_path: Path):
    scans, result = _result(3, 5, list("abcde"))
    result.component[:] = [0, 0, 0, 1, 1]
    between = result.component[result.edges].min(axis=1) == 0
    result.weight[between & (result.edges[:, 1] > 2)] = 0
    result.weight[-1] = 1
    path = tmp_path / "report.html"
    write_report(path, scans, result)
    data = _data(path)
    # The poses of three scans close a cycle, those of two are not known so well.
    sigma = np.array([s["sigma"] for s in data["scans"]], float)
    assert np.isfinite(sigma[:3]).all()
    assert (sigma[1:3] >= 0).all()
    assert np.isnan(sigma[3:]).all()
    assert data["pairs"][2]["angle"] is None
    page.open(path)
    assert _drawn(page) == 4
    page.click('#model [data-value="1"]')
    assert _drawn(page) == 3
    assert _ink(page, tmp_path / "shot.png") > 0.02
    # Scans of two components are shown as their pair has them.
    page.click(".edge.off")
    assert "by the motion of the pair" in page.run(
        "document.querySelector('#only').textContent"
    )
    assert _drawn(page) == 3
    page.click('#model [data-value="0"]')
    assert _drawn(page) == 4
    assert "component 1" in page.run("document.getElementById('poses').textContent")
    _quiet(page)


def test_modes_on_a_dark_phone(page: Page, tmp_path: Path):
    scans, result = _result(3, 2, ["target", "source"])
    flip = result.T_world_i[1] @ motion(5, 3, angle=2.0, shift=0.0)
    modes = (np.stack([result.T_world_i[1], flip]), np.array([0.7, 0.3]), np.ones(2))
    covariances = np.stack([np.zeros((6, 6)), 1e-6 * np.eye(6)])
    rows = jnp.array([0.5, 0.2, 0.1])
    trace = jaxreg.SearchTrace(
        jnp.asarray(2), jnp.array([96, 16, 0]), rows, 2 * rows, 9 * rows, rows
    )
    path = tmp_path / "report.html"
    result = dataclasses.replace(result, trace=trace)
    write_report(path, scans, result, modes=modes, covariances=covariances)
    page.open(path, width=390, height=844, dark=True)
    assert "96" in page.run("document.getElementById('curves-note').textContent")
    drawn = "document.getElementById('curves').data.map(line => line.y.length)"
    assert page.run(drawn) == [2, 2, 2, 2]  # two energies, sample size, width
    assert page.run("document.documentElement.scrollWidth") <= 390
    assert "pinch to zoom" in page.run("document.getElementById('hint').textContent")
    assert page.run("document.querySelectorAll('#modes button').length") == 2
    assert "σ" in page.run("document.getElementById('poses').textContent")
    x = "document.getElementById('scene').data[1].x[0]"
    first = page.run(x)
    page.click('#modes [data-mode="1"]')
    assert page.run(x) != first
    assert _ink(page, tmp_path / "shot.png") > 0.02
    _quiet(page)


def test_flat_scans_from_a_solution(page: Page, tmp_path: Path):
    target = blob(60, 2)
    source = move(motion(1, 2, angle=0.05, shift=0.02), target)
    sol = jaxreg.register(source, target, method=jaxreg.ICP())
    path = tmp_path / "report.html"
    write_report(path, [target, source], sol, details={"unit": "mm"})
    page.open(path)
    assert (
        page.run("document.getElementById('title').textContent") == "source onto target"
    )
    text = page.run("document.body.innerText")
    assert "translation in mm," in text
    assert "tx [mm]" in text
    assert page.run("document.getElementById('section-card').hidden")
    assert page.run("document.getElementById('curves-card').hidden")
    assert _ink(page, tmp_path / "shot.png") > 0.005
    _quiet(page)


@pytest.mark.parametrize("d", [2, 3])
def test_graphs_in_a_browser(page: Page, tmp_path: Path, d: int):
    T = np.stack([motion(i, d, shift=3.0) for i in range(8)])
    edges = np.array([(i, i + 1) for i in range(7)] + [(0, 4), (1, 6), (2, 7)])
    T_i_j = np.linalg.inv(T[edges[:, 0]]) @ T[edges[:, 1]]
    T_i_j[-1] = motion(99, d)
    graph = jaxreg.PoseGraph.from_edges(edges, T_i_j.astype(np.float32))
    before = jaxreg.average(graph, method=jaxreg.SpanningTree())
    path = tmp_path / "report.html"
    change, width = jnp.array([0.3, 0.0, 1e-6, 0.0]), jnp.full((4, 2), 0.1)
    trace = jaxreg.AveragingTrace(jnp.asarray(3), change, width, 0.9 - change)
    after = eqx.tree_at(
        lambda s: (s.kernel_width, s.edge_weight, s.trace),
        before,
        (jnp.array([0.1, 0.05]), before.edge_weight.at[-1].set(0), trace),
        is_leaf=lambda x: x is None,
    )
    write_graph_report(path, graph, after, before)
    page.open(path)
    assert _ink(page, tmp_path / "shot.png", "#residuals") > 0.001
    assert "kernel width" in page.run("document.getElementById('tiles').textContent")
    assert _ink(page, tmp_path / "shot.png", "#curves") > 0.001
    curve = "document.getElementById('curves').data[0].y"
    assert page.run(f"{curve}[1]") is None  # a step that was refused
    assert page.run(f"{curve}[2]") == pytest.approx(1e-6)
    lines = "document.getElementById('residuals').layout.shapes.length"
    assert page.run(lines) == 2
    assert _ink(page, tmp_path / "shot.png") > 0.002
    page.click('#when [data-value="before"]')
    page.click("#list input")
    drawn = "document.getElementById('scene')._fullData.map(t => t.visible)"
    assert page.run(drawn)[0] is False
    page.click("#modes button")
    assert page.run(drawn)[3] is True
    assert "8 poses from 10 edges" in page.run("document.title")
    _quiet(page)
