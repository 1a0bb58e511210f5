"""Points for the page: thinned, with light on them and their distance to other scans.

The browser gets 15 bits a coordinate in the frame of each scan and applies the poses
itself, so that "before", "after" and every mode share one copy of the points.
"""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxreg.app.merge import merge_scans


if TYPE_CHECKING:
    from scipy.spatial import KDTree


MAX_POINTS = 64_000
_MAX_REFERENCE = 1_500_000
_NEIGHBOURS = 12


@dataclass(frozen=True)
class PagePoints:
    """Thinned scans.

    Attributes:
        local: `(n_i, d)` float64 in the frame of each scan.
        world: `(n_i, d)` float64 in the common frame.
        light: `(n_i,)` uint8, how bright a point is drawn.
        distance: `(n_i,)` uint8, to the nearest point of the other scans of the same
            component, 254 being `far`, 255 anything farther.
        far: upper end of the scale of distances, in the unit of the scans.
    """

    local: list[np.ndarray]
    world: list[np.ndarray]
    light: list[np.ndarray]
    distance: list[np.ndarray]
    far: float


def page_points(
    scans: Sequence[np.ndarray],
    T_world_i: np.ndarray,
    component: np.ndarray,
    camera: np.ndarray | None = None,
) -> PagePoints:
    """Thins scans to `MAX_POINTS` in all and measures them against the full ones.

    Args:
        scans: `(n_i, d)` arrays; rows with NaN or inf are left out.
        T_world_i: `(v, d+1, d+1)` poses.
        component: `(v,)` those that share one number share a frame, -1 has none.
        camera: `(3, 3)` rows right, up and towards the viewer; None for 2D.
    """
    from scipy.spatial import KDTree  # at use: a start takes a tenth longer by it

    step = 1 + sum(map(len, scans)) // _MAX_REFERENCE
    full = [s[np.isfinite(s).all(axis=1)][::step].astype(np.float64) for s in scans]
    budget = _budget(np.array([len(x) for x in full]), MAX_POINTS)
    local = [_thin(x, budget) for x in full]
    world = [_move(T, x) for T, x in zip(T_world_i, local, strict=True)]
    trees = [KDTree(x) for x in full]
    light = [np.full(len(x), 200, np.uint8) for x in local]
    for i, x in enumerate(local):
        if camera is not None and len(x):
            model = [world[j] for j in np.flatnonzero(component == component[i])]
            centre = np.median(np.concatenate(model), axis=0)
            normal = _normals(trees[i], x) @ T_world_i[i][:3, :3].T
            light[i] = _light(_outward(normal, world[i] - centre) @ camera.T)
    distance, far = _distances(trees, world, T_world_i, component)
    return PagePoints(local, world, light, distance, far)


def encode_points(points: PagePoints) -> dict[str, Any]:
    """The points as base64 text, with the offset and scale of each scan.

    What differs little from row to row takes little room in the packed page: rows are
    steps from one point to the next, and light and distance are as coarse as the page
    draws them.
    """
    offsets, scales, parts = [], [], []
    for x in points.local:
        some = x if len(x) else np.zeros((1, x.shape[1]))
        low, high = some.min(axis=0), some.max(axis=0)
        middle = (low + high) / 2
        scale = max(float(np.max(high - low)) / 32766, 1e-300)
        rows = np.round((x - middle) / scale).astype("<i2")
        parts.append(np.diff(rows, axis=0, prepend=np.zeros_like(rows[:1])))
        offsets.append(middle.tolist())
        scales.append(scale)
    return {
        "count": [len(x) for x in points.local],
        "offset": offsets,
        "scale": scales,
        "xyz": _base64(parts),
        "light": _base64([x & 0xF8 for x in points.light]),
        "distance": _base64([_coarse(x) for x in points.distance]),
        "far": points.far,
    }


def _coarse(distance: np.ndarray) -> np.ndarray:
    """In fourteen steps, as it is drawn; farther stays farther."""
    step = np.round(distance * (14 / 254)) * (254 / 14)
    return np.where(distance == 255, 255, np.round(step)).astype(np.uint8)


def _base64(parts: list[np.ndarray]) -> str:
    return base64.b64encode(b"".join(x.tobytes() for x in parts)).decode("ascii")


def _move(T: np.ndarray, x: np.ndarray) -> np.ndarray:
    return x @ T[:-1, :-1].T + T[:-1, -1]


def _budget(counts: np.ndarray, total: int) -> int:
    """The most points a scan may keep so that all together keep at most `total`."""
    order = np.sort(counts)
    for k, n in enumerate(order):
        share = total // (len(order) - k)
        if n > share:
            return max(share, 1)
        total -= int(n)
    return int(order[-1])


def _thin(x: np.ndarray, num: int) -> np.ndarray:
    """About one point per cube, for scans that are denser near the scanner."""
    if not len(x):
        return x
    x = x[:: 1 + len(x) // (8 * num)]
    some = merge_scans([x], np.eye(x.shape[1] + 1)[None], np.ones(1, bool), num)[0]
    return _in_strips(some)


def _in_strips(x: np.ndarray) -> np.ndarray:
    """Rows in an order in which the next is seldom far: it packs in less room."""
    low, extent = x[:, 0].min(), np.ptp(x[:, :2], axis=0)
    width = max(2 * float(np.sqrt(np.prod(extent) / len(x))), 1e-300)
    return x[np.lexsort((x[:, 1], (x[:, 0] - low) // width))]


def _normals(tree: "KDTree", x: np.ndarray) -> np.ndarray:
    _, index = tree.query(x, k=min(_NEIGHBOURS, tree.n), workers=-1)
    near = tree.data[index.reshape(len(x), -1)]
    near = near - near.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    return vectors[:, :, 0]


def _outward(normal: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Flips normals to the side that a viewer sees.

    A range scan sees its surface from one side, so that all its normals lean towards
    one direction. Where many are square to that direction the scan is a whole object,
    and outward is away from its middle.
    """
    vectors = np.linalg.eigh(normal.T @ normal)[1]
    view = vectors[:, 2]
    for _ in range(8):
        view = (normal * np.where(normal @ view < 0, -1, 1)[:, None]).mean(axis=0)
        view = view / max(float(np.linalg.norm(view)), 1e-12)
    lean = normal @ view
    if np.mean(np.abs(lean) < 0.2) > 0.12:
        lean = np.sum(normal * (arm - arm.mean(axis=0)), axis=1)
    elif np.sum(np.sign(lean)[:, None] * normal * arm) < 0:
        lean = -lean
    return normal * np.where(lean < 0, -1, 1)[:, None]


def _light(normal: np.ndarray) -> np.ndarray:
    """Soft light from the upper left of the viewer, and a weaker one from behind."""
    key = np.array([-0.45, 0.55, 0.70]) / np.linalg.norm([-0.45, 0.55, 0.70])
    back = np.array([0.6, 0.2, -0.75]) / np.linalg.norm([0.6, 0.2, -0.75])
    front = np.clip(0.5 + 0.5 * normal @ key, 0, 1) ** 1.7
    behind = np.clip(0.5 + 0.5 * normal @ back, 0, 1) ** 2.5
    return np.round(255 * np.clip(front + 0.5 * behind, 0, 1)).astype(np.uint8)


def _distances(
    trees: list["KDTree"],
    world: list[np.ndarray],
    T_world_i: np.ndarray,
    component: np.ndarray,
) -> tuple[list[np.ndarray], float]:
    model = [w for w, k in zip(world, component, strict=True) if k == 0]
    bound = 0.05 * float(np.max(np.ptp(np.concatenate(model), axis=0)))
    found = [np.full(len(x), np.inf) for x in world]
    ids = np.flatnonzero(component >= 0)
    boxes = {
        j: (_corners(trees[j], T_world_i[j]), np.linalg.inv(T_world_i[j])) for j in ids
    }
    for i in ids:
        for j in ids:
            (low, high), T_j_world = boxes[j]
            near = ((world[i] > low - bound) & (world[i] < high + bound)).all(axis=1)
            if i == j or component[i] != component[j] or not near.any():
                continue
            moved = _move(T_j_world, world[i][near])
            d, _ = trees[j].query(moved, distance_upper_bound=bound, workers=-1)
            found[i][near] = np.minimum(found[i][near], d)
    every = np.concatenate(found)
    close = every[np.isfinite(every)]
    # Twice the gap between points: less is sampling, more is a misfit or no overlap.
    gaps = [np.median(t.query(t.data[:1000], k=2)[0][:, 1]) for t in trees if t.n > 1]
    far = 2 * float(np.median(gaps)) if gaps else 0.0
    far = max(far, float(np.quantile(close, 0.6)) if len(close) else 0.0, 1e-300)
    codes = [np.where(d > far, 255, np.minimum(254 * d / far, 254)) for d in found]
    return [c.astype(np.uint8) for c in codes], far


def _corners(tree: "KDTree", T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    moved = _move(T, np.asarray(tree.data))
    return moved.min(axis=0), moved.max(axis=0)
