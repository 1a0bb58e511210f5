from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from jaxreg.app.colors import scan_colors
from jaxreg.app.plot import draw_graph, draw_reconstruction, save_figure
from jaxreg.app.plot.render import render_points


RNG = np.random.default_rng(0)


def _sphere(num: int) -> np.ndarray:
    x = RNG.normal(size=(num, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def _painted(path: Path) -> float:
    image = matplotlib.image.imread(path)
    return float(np.mean(np.any(image[..., :3] < 0.95, axis=-1)))


@pytest.mark.parametrize("d", [2, 3])
def test_reconstruction_figure_shows_points(tmp_path: Path, d: int):
    scans = [(_sphere(800) * [1, 2, 3])[:, :d].astype(np.float32) for _ in range(3)]
    scans[1][5] = np.nan
    T = np.tile(np.eye(d + 1), (3, 1, 1))
    T[2, :d, d] = 100.0
    path = tmp_path / "figure.png"
    figure = draw_reconstruction(scans, T, ["a", "b", "c"], component=[0, 0, -1])
    save_figure(path, figure)
    image = matplotlib.image.imread(path)
    width = image.shape[1]
    panels = 3 if d == 3 else 2
    for k in range(panels):
        panel = image[80:-90, k * width // panels : (k + 1) * width // panels, :3]
        assert np.mean(np.any(panel < 0.95, axis=-1)) > 0.001


def test_names_are_no_formulas(tmp_path: Path):
    scans = [_sphere(50)[:, :2] for _ in range(3)]
    T = np.tile(np.eye(3), (3, 1, 1))
    names = ["$a", r"$\frac{$", "_b$x^$"]
    figure = draw_reconstruction(scans, T, names, component=[0, 0, 1])
    save_figure(tmp_path / "figure.png", figure)
    assert _painted(tmp_path / "figure.png") > 0


@pytest.mark.parametrize("d", [2, 3])
def test_every_component_has_a_row(tmp_path: Path, d: int):
    scans = [_sphere(800)[:, :d] for _ in range(4)]
    T = np.tile(np.eye(d + 1), (4, 1, 1))
    path = tmp_path / "figure.png"
    figure = draw_reconstruction(scans, T, list("abcd"), component=[0, 0, 1, 1])
    save_figure(path, figure)
    image = matplotlib.image.imread(path)
    row = image[image.shape[0] // 2 : -90, image.shape[1] // 3 :, :3]
    assert np.mean(np.any(row < 0.95, axis=-1)) > 0.001


def test_flat_and_tiny_clouds_do_not_break_the_figure(tmp_path: Path):
    plane = np.zeros((50, 3))
    plane[:, :2] = RNG.normal(size=(50, 2))
    few = np.eye(4)[:, :3]
    T = np.tile(np.eye(4), (2, 1, 1))
    for name, scans in (("a", [plane, plane[:10]]), ("b", [few, few])):
        figure = draw_reconstruction(scans, T, ["a", "b"])
        save_figure(tmp_path / f"{name}.png", figure)
    assert _painted(tmp_path / "a.png") > 0.001
    assert _painted(tmp_path / "b.png") > 0.001


def test_graph_figure_shows_edges(tmp_path: Path):
    angle = np.linspace(0, 2 * np.pi, 20)
    for d in (2, 3):
        T = np.tile(np.eye(d + 1), (20, 1, 1))
        T[:, 0, d], T[:, 1, d] = np.cos(angle), np.sin(angle)
        T[:, d - 1, d] += 0.1 * angle
        edges = np.stack([np.arange(19), np.arange(1, 20)], axis=1)
        path = tmp_path / f"{d}.png"
        save_figure(path, draw_graph(edges, T, T, np.ones(20, bool)))
        assert _painted(path) > 0.002


def test_renderer_hides_what_lies_behind_and_fills_surfaces():
    front, back = _sphere(6000), _sphere(6000) * 0.9 - [0, 0, 3]
    points = np.concatenate([front, back])
    group = np.repeat([0, 1], 6000)
    image, extent = render_points(points, group, np.eye(3)[:2], size=200)
    assert image.shape[2] == 4
    assert max(image.shape[:2]) <= 204
    assert extent[0] < -0.95 < 0.95 < extent[1]
    rows, columns = np.indices(image.shape[:2])
    radius = np.hypot(rows - image.shape[0] / 2, columns - image.shape[1] / 2)
    disk = image[radius < 0.45 * min(image.shape[:2])]
    assert (disk[:, 3] > 0.99).mean() > 0.97
    covered = disk[disk[:, 3] > 0.99]
    assert (covered[:, 0] > covered[:, 1]).mean() > 0.93
    assert image[0, 0, 3] == 0


def test_renderer_lights_from_the_upper_left():
    group = np.zeros(20000, int)
    image, _ = render_points(_sphere(20000), group, np.ones((1, 3)), size=200)
    size = image.shape[0]
    near, far = size // 3, 2 * size // 3
    assert image[near, near, 0] > image[far, far, 0] + 0.1


def test_colours_of_some_scans_differ_for_the_colour_blind():
    # Machado, Oliveira, Fernandes 2009: what a deuteranope sees, in linear RGB.
    sees = np.array(
        [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]
    )
    linear = scan_colors(8) ** 2.2
    for seen in (linear, linear @ sees.T):
        color = np.clip(seen, 0, 1) ** (1 / 2.2)
        apart = np.linalg.norm(color[:, None] - color, axis=2) + np.eye(8)
        assert apart.min() > 0.2
    assert len(np.unique(scan_colors(40), axis=0)) == 40
    np.testing.assert_array_equal(scan_colors(40)[:3], scan_colors(3))
