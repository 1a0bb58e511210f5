"""Views of a real room: what cameras that stand in it would see of its fragments.

The points are measured ones of the six kitchen fragments, those that are in front from
a camera, of four fragments at a time; so a surface is as thick as they are apart, some
centimetres. Cameras stand about the middle, look anywhere, and roll as they like, and
every view is given in a frame of its own. Many show little but a wall or the floor.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.io import read_log


# Half the view of a camera as a tangent, its pixels along a side, and how far behind
# the nearest point of a pixel others count, in metres.
_HALF, _PIXELS, _BEHIND = 0.75, 60, 0.1
# Where cameras stand, about the middle; how near a point may be to one, and how near
# what it looks at, in metres.
_ABOUT, _NEAREST, _SEES = 0.6, 0.3, 0.8
# Points of four fragments that are looked at, of a view at least and at most.
_LOOKED_AT, _FEWEST, _MOST = 200_000, 6_000, 20_000


def kitchen(folder: Path) -> tuple[list[np.ndarray], np.ndarray]:
    """The fragments, `(n, 3)` each in metres, and their motions to the first."""
    with np.load(folder / "fragments.npz") as file:
        scans = [file[name] for name in file.files]
    truth = read_log(folder / "gt.log")
    T_world_i = np.tile(np.eye(4), (len(scans), 1, 1))
    edges, T_i_j = np.asarray(truth.edges), np.asarray(truth.T_i_j)
    for (i, j), T in zip(edges, T_i_j, strict=True):
        if i == 0:
            T_world_i[j] = T
    return scans, T_world_i


def room_views(
    folder: Path, num: int, seed: int = 0
) -> tuple[list[np.ndarray], np.ndarray]:
    """Views, `(n, 3)` float32 each, and their poses in the room.

    Args:
        folder: of the kitchen's fragments.
        num: of views.
        seed: of the cameras; the same gives the same views.
    """
    scans, T_world_i = kitchen(folder)
    parts = [x @ T[:3, :3].T + T[:3, 3] for x, T in zip(scans, T_world_i, strict=True)]
    every = np.concatenate(parts)
    middle, rng = np.median(every, axis=0), np.random.default_rng(seed)
    views, poses = [], []
    while len(views) < num:
        some = rng.choice(len(parts), 4, replace=False)
        points = np.concatenate([parts[k] for k in some])
        points = points[rng.choice(len(points), _LOOKED_AT, replace=False)]
        at = middle + rng.uniform(-_ABOUT, _ABOUT, 3)
        to = every[rng.integers(len(every))]
        if np.linalg.norm(to - at) < _SEES:
            continue
        T_room_camera = _camera(at, to, rng)
        seen = _seen((points - at) @ T_room_camera[:3, :3])
        if len(seen) < _FEWEST:
            continue
        seen = seen[rng.permutation(len(seen))[:_MOST]]
        T_view_camera = np.eye(4)
        T_view_camera[:3, :3] = Rotation.random(rng=rng).as_matrix()
        T_view_camera[:3, 3] = rng.normal(size=3)
        view = seen @ T_view_camera[:3, :3].T + T_view_camera[:3, 3]
        views.append(view.astype(np.float32))
        poses.append(T_room_camera @ np.linalg.inv(T_view_camera))
    return views, np.stack(poses)


def _camera(at: np.ndarray, to: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Pose of a camera whose third axis points at a point."""
    ahead = (to - at) / np.linalg.norm(to - at)
    right = np.cross(ahead, rng.normal(size=3))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = at
    return T


def _seen(points: np.ndarray) -> np.ndarray:
    """Of points in the camera's frame those in view and in front of the others."""
    points = points[points[:, 2] > _NEAREST]
    at = points[:, :2] / points[:, 2:]
    within = np.abs(at).max(axis=1) < _HALF
    points, at = points[within], at[within]
    pixel = ((at + _HALF) / (2 * _HALF) * _PIXELS).astype(int)
    pixel = pixel[:, 0] * _PIXELS + pixel[:, 1]
    nearest = np.full(_PIXELS**2, np.inf)
    np.minimum.at(nearest, pixel, points[:, 2])
    return points[points[:, 2] < nearest[pixel] + _BEHIND]
