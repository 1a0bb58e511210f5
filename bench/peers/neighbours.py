"""Trees of other libraries: built once, asked for the closest point of each query."""

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np


#: Of queries `(n, 3)` float32: distances `(n,)`.
Query = Callable[[np.ndarray], np.ndarray]


def scipy_tree(target: np.ndarray) -> Query:
    """CKDTree with its defaults."""
    lib: Any = importlib.import_module("scipy.spatial")
    tree = lib.KDTree(target)
    return lambda x: tree.query(x)[0]


def pykdtree_tree(target: np.ndarray) -> Query:
    """Pykdtree with its defaults, float32 as given."""
    lib: Any = importlib.import_module("pykdtree.kdtree")
    tree = lib.KDTree(target)
    return lambda x: tree.query(x)[0]


def small_gicp_tree(target: np.ndarray) -> Query:
    """small_gicp takes float64 and returns squares."""
    lib: Any = importlib.import_module("small_gicp")
    tree = lib.KdTree(target.astype(np.float64))

    def query(x: np.ndarray) -> np.ndarray:
        found = tree.batch_nearest_neighbor_search(x.astype(np.float64), 1)
        return np.sqrt(np.asarray(found[1])).ravel()

    return query


def open3d_tree(target: np.ndarray) -> Query:
    """Open3D's tensor search with nanoflann."""
    lib: Any = importlib.import_module("open3d")
    search = lib.core.nns.NearestNeighborSearch(lib.core.Tensor(target))
    search.knn_index()

    def query(x: np.ndarray) -> np.ndarray:
        found = search.knn_search(lib.core.Tensor(x), 1)
        return np.sqrt(found[1].numpy()).ravel()

    return query


def jaxkd_tree(target: np.ndarray) -> Query:
    """Jaxkd with its defaults."""
    lib: Any = importlib.import_module("jaxkd")
    jax: Any = importlib.import_module("jax")
    tree = jax.block_until_ready(lib.build_tree(jax.numpy.asarray(target)))
    return lambda x: np.asarray(
        lib.query_neighbors(tree, jax.numpy.asarray(x), k=1)[1]
    ).ravel()


#: Function and parameters, by name and library.
TREES: dict[tuple[str, str], Callable[[np.ndarray], Query]] = {
    ("pykdtree", "pykdtree"): pykdtree_tree,
    ("SciPy KDTree", "scipy"): scipy_tree,
    ("small_gicp KdTree", "small_gicp"): small_gicp_tree,
    ("Open3D NearestNeighborSearch", "open3d"): open3d_tree,
    ("jaxkd", "jaxkd"): jaxkd_tree,
}
