"""Random graphs with known poses and outliers, in NumPy and SciPy."""

import numpy as np
import scipy.sparse as sp
from scipy.spatial.transform import Rotation

from jaxreg.graph import PoseGraph


def motions(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    d = t.shape[-1]
    T = np.tile(np.eye(d + 1), (len(t), 1, 1))
    T[:, :d, :d], T[:, :d, d] = R, t
    return T


def rotations(rng: np.random.Generator, num: int, d: int, sigma: float | None):
    """Uniform rotations, or small ones of standard deviation sigma (radians)."""
    if d == 2:
        a = (
            rng.uniform(-np.pi, np.pi, num)
            if sigma is None
            else sigma * rng.normal(size=num)
        )
        return np.moveaxis(
            np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]), -1, 0
        )
    if sigma is None:
        return Rotation.from_quat(rng.normal(size=(num, 4))).as_matrix()
    return Rotation.from_rotvec(sigma * rng.normal(size=(num, 3))).as_matrix()


def random_graph(
    num: int,
    num_edges: int,
    outliers: float,
    seed: int,
    *,
    d: int = 3,
    noise: float = 1.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """True poses, edges, motions and outlier flags.

    Noise is 0.5 degrees and 0.5 % of the size (1); outlier motions are uniformly
    random; the inlier edges connect all poses.
    """
    rng = np.random.default_rng(seed)
    X = motions(rotations(rng, num, d, None), rng.uniform(-0.5, 0.5, (num, d)))
    X = np.linalg.inv(X[0]) @ X
    pairs = np.stack(np.triu_indices(num, 1), axis=1)
    while True:
        edges = pairs[np.sort(rng.choice(len(pairs), num_edges, replace=False))]
        bad = np.zeros(num_edges, bool)
        bad[rng.choice(num_edges, round(outliers * num_edges), replace=False)] = True
        i, j = edges[~bad].T
        graph = sp.coo_matrix((np.ones(len(i)), (i, j)), (num, num))
        if sp.csgraph.connected_components(graph, directed=False)[0] == 1:
            break
    error = motions(
        rotations(rng, num_edges, d, noise * np.deg2rad(0.5)),
        noise * 0.005 * rng.normal(size=(num_edges, d)),
    )
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ error
    wild = motions(
        rotations(rng, num_edges, d, None), rng.uniform(-1, 1, (num_edges, d))
    )
    return X, edges, np.where(bad[:, None, None], wild, T), bad


def folding_graph(
    seed: int, num: int = 40
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Views around an object that looks alike from both sides, all pairs measured.

    Right between near views; half of the motions between views on opposite sides agree
    with each other on the poses that lay one side over the other; the rest is random.

    Returns:
        True poses, the folded ones, edges and motions.
    """
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(num) / num
    turn = Rotation.from_rotvec(angle[:, None] * [0, 0, 1]).as_matrix()
    X = motions(turn, np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
    half_turn = np.diag([-1.0, -1, 1, 1])
    folded = np.where(np.arange(num)[:, None, None] < num // 2, X, half_turn @ X)
    edges = np.stack(np.triu_indices(num, 1), axis=1)
    i, j = edges.T
    apart = np.minimum(j - i, num - (j - i))
    alike = (apart >= num // 2 - 9) & (rng.random(len(i)) < 0.5)
    wild = motions(
        rotations(rng, len(i), 3, None), rng.uniform(-1, 1, size=(len(i), 3))
    )
    flipped = np.linalg.inv(X[i]) @ half_turn @ X[j]
    T = np.where(alike[:, None, None], flipped, wild)
    T = np.where((apart <= 4)[:, None, None], np.linalg.inv(X[i]) @ X[j], T)
    error = motions(
        rotations(rng, len(i), 3, 0.01), 0.01 * rng.normal(size=(len(i), 3))
    )
    X, folded = np.linalg.inv(X[0]) @ X, np.linalg.inv(folded[0]) @ folded
    return X, folded, edges, T @ error


def noisy_grid(
    num: int, seed: int, noise: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses on a cubic grid of that many, edges to the next, and their motions.

    Noise, at 1, is 14 degrees and a tenth of the distance; no three edges form a cycle.
    """
    rng = np.random.default_rng(seed)
    axes = np.meshgrid(*[np.arange(num)] * 3, indexing="ij")
    place = np.stack(axes, axis=-1).reshape(-1, 3).astype(float)
    X = motions(rotations(rng, len(place), 3, None), place)
    apart = np.abs(place[:, None] - place).sum(axis=-1)
    edges = np.argwhere(np.triu(apart == 1))
    error = motions(
        rotations(rng, len(edges), 3, 0.25 * noise),
        0.1 * noise * rng.normal(size=(len(edges), 3)),
    )
    return X, edges, np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ error


def crooked_path(seed: int, num: int, closures: int, false: int, told: bool):
    """Graph of a path with closures in no order, some of them false; which."""
    rng = np.random.default_rng(seed)
    shift = np.eye(3)[:1].repeat(num, axis=0)
    X = [np.eye(4)]
    for T in motions(rotations(rng, num - 1, 3, 0.35), shift[1:]):
        X.append(X[-1] @ T)
    X = np.array(X)
    low = rng.integers(0, num - 10, closures)
    high = np.minimum(num - 1, low + rng.integers(5, num // 2, closures))
    chain = np.stack([np.arange(num - 1), np.arange(1, num)], axis=1)
    edges = np.concatenate([chain, np.stack([low, high], axis=1)])
    noise = motions(
        rotations(rng, len(edges), 3, 0.009), 0.01 * rng.normal(size=(len(edges), 3))
    )
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ noise
    wrong = np.zeros(len(edges), bool)
    wrong[num - 1 + rng.permutation(closures)[:false]] = True
    T[wrong] = T[wrong] @ motions(
        rotations(rng, false, 3, 1.5), 5 * rng.normal(size=(false, 3))
    )
    each = np.diag(np.repeat([0.01**-2, 0.009**-2], 3)).astype(np.float32)
    information = np.tile(each, (len(edges), 1, 1)) if told else None
    args = (edges, T.astype(np.float32), num, None, information)
    return PoseGraph.from_edges(*args), wrong
