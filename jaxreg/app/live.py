"""A run to watch: scans, pairs and trust in a page of viser's, as they come.

The run tells the view, and hears nothing from it: the page may be opened late, closed,
or opened by several. Whatever ails it ends the view, not the run.
"""

import contextlib
import functools
import io
import logging
from collections.abc import Callable, Sequence
from typing import Concatenate, ParamSpec

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from jaxreg.app.colors import scan_colors
from jaxreg.app.pair_log import Pairs
from jaxreg.io.extras import require
from jaxreg.io.quaternions import xyzw_from_rotations


_P = ParamSpec("_P")
_MAX_POINTS = 300_000
# Of a pair that is believed, and of one that is not; between them by trust.
_TRUSTED, _OFF = np.array([33, 96, 172]), np.array([190, 190, 190])
_ROWS = 8  # of the newest pairs that are told in words


def _unless_ended(
    tell: Callable[Concatenate["LiveView", _P], None],
) -> Callable[Concatenate["LiveView", _P], None]:
    """Ends the view where something goes wrong, so that the run goes on."""

    @functools.wraps(tell)
    def call(self: "LiveView", *args: _P.args, **kwargs: _P.kwargs) -> None:
        if self.ended:
            return
        try:
            tell(self, *args, **kwargs)
        except Exception as err:  # whatever it is
            self.ended = True
            logging.getLogger("jaxreg").warning("The live view ended: %s", err)

    return call


class LiveView:
    """A page that shows a run of `reconstruct`.

    Scans lie side by side until pairs join them: parts are put together along the most
    likely pairs, before any averaging, and by the final poses in the end.

    Args:
        names: of the scans.
        scans: `(n_i, d)` about their own middles; rows with NaN or inf are left out.
        middles: `(v, d)`, which were subtracted from them.
        least: log evidence from which a pair is believed.

    Attributes:
        ended: whether it is shown no more.
        url: of the page, on this machine alone.

    Raises:
        MissingExtraError: if viser is not installed.
    """

    def __init__(
        self,
        names: Sequence[str],
        scans: Sequence[np.ndarray],
        middles: np.ndarray,
        least: float,
    ) -> None:
        viser = require("viser", "The live view", "view")
        clouds = [_flat_in_space(x[np.isfinite(x).all(axis=1)]) for x in scans]
        reach = [float(np.quantile(np.linalg.norm(x, axis=1), 0.98)) for x in clouds]
        self._names, self._least = list(names), least
        self._middles = _flat_in_space(middles)
        self._unit, self._radius = max(*reach, 1e-300), np.array(reach)
        self._pairs: dict[tuple[int, int], tuple[np.ndarray, float, float]] = {}
        with contextlib.redirect_stdout(io.StringIO()):  # it greets
            self._server = viser.ViserServer(host="localhost", verbose=False)
        self.url = f"http://localhost:{self._server.get_port()}"
        self.ended = False
        self._stage = self._server.gui.add_markdown("starting")
        self._newest = self._server.gui.add_markdown("")
        step = 1 + sum(map(len, clouds)) // _MAX_POINTS
        self._clouds = [
            self._server.scene.add_point_cloud(
                f"/scans/{i}",
                (x[::step] / self._unit).astype(np.float32),
                np.round(255 * color).astype(np.uint8),
                point_size=0.008,
                precision="float32",
            )
            for i, (x, color) in enumerate(
                zip(clouds, scan_colors(len(clouds)), strict=True)
            )
        ]
        self._draw_parts()

    @_unless_ended
    def progress(self, stage: str, done: int, total: int) -> None:
        """What the run is at."""
        believed = sum(told >= self._least for _, told, _ in self._pairs.values())
        self._stage.content = (
            f"**{stage}** {done} of {total}\n\n"
            f"{believed} of {len(self._pairs)} pairs believed"
        )

    @_unless_ended
    def pairs(self, found: Pairs) -> None:
        """Pairs that were registered, between the scans about their middles."""
        for e, (i, j) in enumerate(found.edges.tolist()):
            told, overlap = found.log_evidence[e, 0], found.overlap[e, 0]
            T_i_j = _in_space(found.T_i_j[e, 0])
            self._pairs[i, j] = T_i_j, float(told), float(overlap)
        newest = list(self._pairs.items())[: -_ROWS - 1 : -1]
        rows = [
            f"| {'✓' if told >= self._least else '–'} | {self._names[i]}, "
            f"{self._names[j]} | {overlap:.2f} | {told:.1f} |"
            for (i, j), (_, told, overlap) in newest
        ]
        head = "| | pair | overlap | log evidence |", "|---|---|---|---|"
        self._newest.content = "\n".join([*head, *rows])
        self._draw_parts()

    @_unless_ended
    def poses(
        self,
        T_world_i: np.ndarray,
        component: np.ndarray,
        edges: np.ndarray,
        trust: np.ndarray,
    ) -> None:
        """The answer: `(v, d+1, d+1)` poses of the scans as they were read."""
        part = np.where(component < 0, -1 - np.arange(len(component)), component)
        T = np.stack([_in_space(x) for x in T_world_i])
        T[:, :3, 3] += np.einsum("vij,vj->vi", T[:, :3, :3], self._middles)
        self._stage.content = (
            f"**done**: {int(np.sum(component == 0))} of {len(component)} scans in one "
            f"frame, {int(np.sum(trust > 0.5))} of {len(edges)} pairs trusted"
        )
        self._draw(T, np.unique(part, return_inverse=True)[1], edges, trust)

    def close(self) -> None:
        """Ends the page; who looks at it keeps what was there last."""
        self.ended = True
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _draw_parts(self) -> None:
        """Poses along the likeliest pairs that are believed."""
        num = len(self._clouds)
        edges = np.array(list(self._pairs), int).reshape(-1, 2)
        told = np.array([told for _, told, _ in self._pairs.values()])
        sure = told >= self._least
        i, j = edges[sure].T
        cost = 1 / (1 + np.maximum(told[sure], 0))
        tree = minimum_spanning_tree(coo_array((cost, (i, j)), (num, num)))
        T, part = np.tile(np.eye(4), (num, 1, 1)), np.full(num, -1)
        for root in range(num):
            if part[root] >= 0:
                continue
            order, before = breadth_first_order(tree, root, directed=False)
            part[order] = root
            for k in order[1:]:
                p = int(before[k])
                known = (p, k) in self._pairs
                T_i_j = self._pairs[(p, k) if known else (k, p)][0]
                T[k] = T[p] @ (T_i_j if known else np.linalg.inv(T_i_j))
        part = np.unique(part, return_inverse=True)[1]
        self._draw(T, part, edges, sure.astype(float))

    def _draw(
        self, T: np.ndarray, part: np.ndarray, edges: np.ndarray, trust: np.ndarray
    ) -> None:
        """Each part about its middle, the parts side by side, and lines for pairs."""
        place = T[:, :3, 3] / self._unit
        middle = [place[part == k].mean(axis=0) for k in range(part.max() + 1)]
        place = place - np.array(middle)[part]
        far = np.linalg.norm(place, axis=1) + self._radius / self._unit
        radius = np.array([far[part == k].max() for k in range(len(middle))])
        place = place + _side_by_side(radius)[part]
        wxyz = xyzw_from_rotations(T[:, :3, :3])[:, [3, 0, 1, 2]]
        for cloud, q, t in zip(self._clouds, wxyz, place, strict=True):
            cloud.wxyz, cloud.position = q, t
        share = np.reshape(trust, (-1, 1, 1))
        color = np.tile(_OFF + share * (_TRUSTED - _OFF), (1, 2, 1))
        self._server.scene.add_line_segments(
            "/pairs",
            place[edges].astype(np.float32),
            np.round(color).astype(np.uint8),
            thickness=2.0,
            thickness_units="screen",
        )


def _side_by_side(radius: np.ndarray) -> np.ndarray:
    """Middles `(k, 3)` of discs on shelves, the largest about the origin."""
    order = np.argsort(-radius, kind="stable")
    width = 3 * float(np.sqrt(np.sum(radius**2)))
    out, x, y, height = np.zeros((len(radius), 3)), 0.0, 0.0, 0.0
    for k in order:
        size = 2.2 * radius[k]
        if x > 0 and x + size > width:
            x, y, height = 0.0, y - height, 0.0
        out[k, :2] = x + size / 2, y - size / 2
        x, height = x + size, max(height, size)
    return out - out[order[0]]


def _flat_in_space(x: np.ndarray) -> np.ndarray:
    return np.pad(x.astype(np.float64), [(0, 0), (0, 3 - x.shape[1])])


def _in_space(T: np.ndarray) -> np.ndarray:
    """A motion of the plane as one of space; those of space as they are."""
    out = np.eye(4)
    d = T.shape[-1] - 1
    out[:d, :d], out[:d, 3] = T[:d, :d], T[:d, d]
    return out
