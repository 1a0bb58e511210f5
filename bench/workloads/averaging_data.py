"""Relative motions to average: generated, and real ones with real outliers."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import scipy.io
from scipy.spatial.transform import Rotation

from jaxreg.averaging import ShortestPaths, average
from jaxreg.graph import PoseGraph
from jaxreg.io import read_log


#: Poses and edges of small graphs, poses of a ring of large ones.
N, H, RING = 32, 465, 100
#: Steps of a street of large chains, and frames in a row that see a place again.
STREET, SEEN = 10, 5


def motions(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Homogeneous matrices."""
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, t
    return T


def small_rotations(rng: np.random.Generator, num: int, degrees: float) -> np.ndarray:
    """Normal rotation vectors of this standard deviation."""
    return Rotation.from_rotvec(
        np.deg2rad(degrees) * rng.normal(size=(num, 3))
    ).as_matrix()


def small_graph(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """True poses, edges and motions of one graph of a batch."""
    X = motions(Rotation.random(N, rng).as_matrix(), rng.uniform(-0.5, 0.5, (N, 3)))
    pairs = np.stack(np.triu_indices(N, 1), axis=1)
    edges = pairs[np.sort(rng.choice(len(pairs), H, replace=False))]
    error = motions(small_rotations(rng, H, 0.5), 0.005 * rng.normal(size=(H, 3)))
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ error
    wrong = rng.choice(H, round(0.3 * H), replace=False)
    R = Rotation.random(len(wrong), rng).as_matrix()
    T[wrong] = motions(R, rng.uniform(-1, 1, (len(wrong), 3)))
    return X, edges, T


def batch_of(edges: np.ndarray, T_i_j: np.ndarray) -> PoseGraph:
    """Small graphs along a leading axis, on JAX's default device."""
    num = len(edges)
    return PoseGraph(
        edges=jnp.asarray(edges, jnp.int32),
        T_i_j=jnp.asarray(T_i_j, jnp.float32),
        weight=jnp.ones((num, H), jnp.float32),
        mask=jnp.ones((num, H), bool),
        information=None,
        num_poses=N,
    )


def large_graph(
    num: int, outliers: float, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """True poses, edges, motions, and which are wrong."""
    rng = np.random.default_rng(seed)
    step = np.arange(num)
    around = 2 * np.pi * step / RING
    down = np.pi * (0.1 + 0.8 * step / num)
    radius = RING / (2 * np.pi)
    t = radius * np.stack(
        [
            np.sin(down) * np.cos(around),
            np.sin(down) * np.sin(around),
            (num / RING / (0.8 * np.pi)) * np.cos(down) / radius,
        ],
        axis=1,
    )
    X = motions(Rotation.from_euler("zy", np.stack([around, down], 1)).as_matrix(), t)
    near = [1, RING, RING + 1, RING - 1]
    pairs = [np.stack([step[:-k], step[k:]], axis=1) for k in near]
    thinned = [p[rng.random(len(p)) < 0.95] for p in pairs[1:]]
    edges = np.concatenate([pairs[0], *thinned])
    closures = np.flatnonzero(edges[:, 1] - edges[:, 0] > 1)
    wrong = np.zeros(len(edges), bool)
    wrong[rng.choice(closures, round(outliers * len(edges)), replace=False)] = True
    error = motions(
        small_rotations(rng, len(edges), 1.0), 0.02 * rng.normal(size=(len(edges), 3))
    )
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ error
    # As from two places that look like those of a true closure.
    first = rng.integers(0, num, int(wrong.sum()))
    second = (first + rng.integers(1, num, len(first))) % num
    edges[wrong] = np.stack([first, second], axis=1)
    return X, edges, T, wrong


def large_chain(
    num: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of a drive through streets, with 1 % closures: the same as `large_graph`.

    Streets of `STREET` steps between crossings, each passed about ten times. Where one
    is passed again, `SEEN` frames in a row may close a loop; a tenth of the closures is
    wrong.
    """
    rng = np.random.default_rng(seed)
    X, streets, forward = _drive(num, rng)
    # An earlier pass of the same street, if there is one.
    order = np.argsort(streets, kind="stable")
    again = np.flatnonzero(streets[order][1:] == streets[order][:-1])
    again = rng.choice(again, min(len(again), num // 100 // SEEN), replace=False)
    before, now = order[again], order[again + 1]
    within = np.arange(2, 2 + SEEN)
    turned = forward[before] != forward[now]
    there = np.where(turned[:, None], STREET - within, within)
    first = (STREET * before[:, None] + there).ravel()
    second = (STREET * now[:, None] + within).ravel()
    step = np.arange(num)
    edges = np.concatenate(
        [np.stack([step[:-1], step[1:]], 1), np.stack([first, second], 1)]
    )
    # Odometry: a tenth of the noise of the grid.
    error = motions(
        small_rotations(rng, len(edges), 0.1), 0.002 * rng.normal(size=(len(edges), 3))
    )
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ error
    wrong = np.zeros(len(edges), bool)
    wrong[num - 1 + rng.choice(len(first), len(first) // 10, replace=False)] = True
    edges[wrong, 0] = rng.integers(0, num // 2, int(wrong.sum()))
    edges[wrong, 1] = rng.integers(num // 2, num, int(wrong.sum()))
    return X, edges, T, wrong


def _drive(
    num: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses, and the street and its direction of each `STREET` of them."""
    blocks = -(-num // STREET)
    side = max(2, round((blocks / 20) ** 0.5))
    heading, at = np.zeros(blocks, int), np.zeros((blocks, 2), int)
    ways = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    turns = rng.integers(-1, 2, blocks)  # right, straight on or left
    place, way = np.zeros(2, int), 0
    for k in range(blocks):
        way = (way + turns[k]) % 4
        while not np.all((0 <= place + ways[way]) & (place + ways[way] <= side)):
            way = (way + 1) % 4
        heading[k], at[k] = way, place
        place = place + ways[way]
    forward = heading < 2
    low = np.where(forward[:, None], at, at + ways[heading])
    streets = (low[:, 0] * (side + 1) + low[:, 1]) * 2 + heading % 2
    block, step = np.divmod(np.arange(num), STREET)
    t = STREET * at[block] + step[:, None] * ways[heading[block]]
    R = Rotation.from_euler("z", np.pi / 2 * heading[block][:, None]).as_matrix()
    return motions(R, np.pad(t, ((0, 0), (0, 1))).astype(float)), streets, forward


def on_group(T: np.ndarray) -> np.ndarray:
    """Rotations made orthonormal, last rows exact."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    sign = np.linalg.det(U @ Vt)
    U[..., -1] *= sign[..., None]
    out = np.zeros_like(T)
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = U @ Vt, T[..., :3, 3], 1
    return out


def learning2sync(path: Path) -> tuple[PoseGraph, np.ndarray, np.ndarray]:
    """A scene as graph, true poses and frames that have one."""
    scene = scipy.io.loadmat(path)
    T_view_world = on_group(np.asarray(scene["Tstar"], dtype=np.float64))
    num = len(T_view_world)
    blocks = scene["T"].reshape(num, 4, num, 4).transpose(0, 2, 1, 3)
    i, j = np.triu_indices(num, 1)
    # The file maps view i into view j.
    T_i_j = np.linalg.inv(on_group(blocks[i, j]))
    graph = PoseGraph.from_edges(np.stack([i, j], 1), T_i_j.astype(np.float32), num)
    return graph, np.linalg.inv(T_view_world), np.ones(num, bool)


def log(path: Path) -> PoseGraph:
    """A Redwood log with its rotations on the group: OpenCV's are off by up to 0.1."""
    rows = np.array(path.read_text().split(), dtype=np.float64).reshape(-1, 19)
    T_i_j = on_group(rows[:, 3:].reshape(-1, 4, 4)).astype(np.float32)
    return PoseGraph.from_edges(rows[:, :2].astype(int), T_i_j, int(rows[0, 2]))


def chained(logs: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    """True poses along the true pairs, and the frames of the largest component."""
    parts = [read_log(path) for path in logs if path.exists()]
    edges = np.concatenate([part.edges for part in parts])
    T_i_j = np.concatenate([part.T_i_j for part in parts])
    graph = PoseGraph.from_edges(edges, T_i_j, parts[0].num_poses)
    found = average(graph, ShortestPaths())
    component = np.asarray(found.component)
    known = component == np.bincount(component).argmax()
    return np.asarray(found.T_world_i, float), known
