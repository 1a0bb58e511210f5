"""The live view: what it shows, and that nothing that befalls it stops a run."""

import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from helpers import blob, motion, move

from jaxreg.app.live import LiveView
from jaxreg.app.pair_log import Pairs
from jaxreg.io import MissingExtraError


POSES = np.stack([motion(i, 3, angle=0.5 * i, shift=1.0) for i in range(4)])
CLOUD = blob(300, 3).astype(np.float64)
SCANS = [move(np.linalg.inv(T), CLOUD) for T in POSES]
MIDDLES = np.array([x.mean(axis=0) for x in SCANS])
CENTRED = POSES.copy()
CENTRED[:, :3, 3] += np.einsum("vij,vj->vi", POSES[:, :3, :3], MIDDLES)


def _pair(i: int, j: int, told: float) -> Pairs:
    T = np.linalg.inv(CENTRED[i]) @ CENTRED[j]
    one = np.ones((1, 1))
    return Pairs(np.array([[i, j]]), T[None, None], 0.7 * one, told * one, one)


@pytest.fixture
def view() -> Iterator[LiveView]:
    pytest.importorskip("viser")
    scans = [x - m for x, m in zip(SCANS, MIDDLES, strict=True)]
    shown = LiveView(["a", "b", "c", "d"], scans, MIDDLES, 1.0)
    yield shown
    shown.close()


def _seen(view: LiveView, i: int) -> np.ndarray:
    """The points of a scan as they lie on the page."""
    cloud = view._clouds[i]
    w, *xyz = cloud.wxyz
    xyz = np.array(xyz)
    once = np.cross(xyz, cloud.points) + w * cloud.points
    return cloud.points + 2 * np.cross(xyz, once) + cloud.position


def _apart(view: LiveView, i: int, j: int) -> float:
    """How far scan j is from where it lies on scan i, in the unit of the page."""
    return float(np.abs(_seen(view, i) - _seen(view, j)).max())


def test_scans_lie_apart_until_a_believed_pair_joins_them(view: LiveView):
    assert min(_apart(view, 0, j) for j in (1, 2, 3)) > 1
    view.pairs(_pair(0, 1, 5.0))
    view.pairs(_pair(1, 2, 0.5))
    assert _apart(view, 0, 1) < 1e-5
    assert _apart(view, 1, 2) > 1
    view.pairs(_pair(0, 2, 2.0))
    view.progress("registering pairs", 3, 6)
    assert _apart(view, 1, 2) < 1e-5
    assert _apart(view, 2, 3) > 1
    assert "2 of 3 pairs believed" in view._stage.content
    assert "| – | b, c | 0.70 | 0.5 |" in view._newest.content
    edges = np.array([(0, 1), (1, 2), (2, 3)])
    view.poses(POSES, np.zeros(4, int), edges, np.array([1.0, 0.0, 1.0]))
    assert max(_apart(view, 0, j) for j in (1, 2, 3)) < 1e-5
    assert "4 of 4 scans in one frame, 2 of 3 pairs trusted" in view._stage.content
    assert not view.ended


def _broken(*_: object, **__: object) -> None:
    raise RuntimeError("no picture")


def test_whatever_ails_it_the_run_goes_on(
    view: LiveView, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(view._server.scene, "add_line_segments", _broken)
    view.pairs(_pair(0, 1, 5.0))
    assert view.ended
    assert "The live view ended: no picture" in caplog.text
    view.pairs(_pair(1, 2, 5.0))
    view.progress("averaging", 1, 1)


def test_flat_scans_lie_in_a_plane():
    pytest.importorskip("viser")
    T = np.eye(3)
    T[:2, 2] = 1, 2
    flat = blob(50, 2)
    view = LiveView(["a", "b"], [flat, flat], np.zeros((2, 2)), 1.0)
    view.poses(
        np.stack([np.eye(3), T]), np.zeros(2, int), np.array([[0, 1]]), np.ones(1)
    )
    step = (np.array(view._clouds[1].position) - view._clouds[0].position) * view._unit
    np.testing.assert_allclose(step, [1, 2, 0], atol=1e-6)
    view.close()


def test_without_viser_the_extra_to_install_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtraError, match=r"jaxreg\[view\]"):
        LiveView(["a"], [CLOUD], np.zeros((1, 3)), 1.0)


def _wait(until: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not until():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_browser_that_comes_and_goes(view: LiveView):
    from tests.app.plot.browser import browser

    with browser() as page:
        opened = page._browser.new_page()
        opened.goto(view.url)
        opened.get_by_text("starting").wait_for(timeout=60_000)
        view.pairs(_pair(0, 1, 5.0))
        opened.get_by_text("a, b").wait_for(timeout=60_000)
        _wait(lambda: len(view._server.get_clients()) == 1)
        opened.close()
        _wait(lambda: not view._server.get_clients())
    view.pairs(_pair(1, 2, 5.0))
    assert _apart(view, 0, 2) < 1e-5
    assert not view.ended
