"""Pose graphs in g2o text files: SE2 and SE3, any ids, also compressed by gzip.

An edge line `i j` holds `T_i_j`, quaternions are xyzw, and its upper triangle is the
information of the right tangent error (translation first). As GTSAM and SE-Sync do,
the rotational part is taken to be that of the rotation vector.
"""

import gzip
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.checks import as_host_array, as_host_numbers, check_rigid
from jaxreg._core.typing import ArrayLike
from jaxreg.geometry import lie
from jaxreg.graph.edge_checks import EdgeError, check_information, check_weights
from jaxreg.graph.pose_graph import PoseGraph, check_graph
from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import InputError
from jaxreg.io.graphs.g2o_file import EDGE, VERTEX, parse
from jaxreg.io.graphs.g2o_known import KnownOfGraph, known_lines, known_of
from jaxreg.io.graphs.g2o_lines import columns, lines_of, motions
from jaxreg.io.graphs.information import nearest_semidefinite


def read_g2o(path: str | Path) -> PoseGraph:
    """Reads the edges of a g2o file.

    Args:
        path: a `.g2o` file, or `.g2o.gz`, of one dimension.

    Returns:
        The graph, with information matrices. Its frames are the ids of the file in
        increasing order, see `read_g2o_poses`; what the file knows of poses is read by
        `read_g2o_known`. Lines of unknown kinds are skipped, and for indefinite
        information matrices the nearest positive semidefinite ones are taken; a
        warning counts either.

    Raises:
        InputError: for a file that cannot be read or a line that makes no sense, which
            the message names.
    """
    file = parse(Path(path))
    if not len(file.edges.line):
        raise InputError(f"{path}: holds no EDGE_SE2 or EDGE_SE3:QUAT line.")
    d = file.dim
    k = lie.tangent_dim(d)
    num = d + 1 if d == 2 else 7
    T_i_j = motions(file.edges, d, path)
    upper = file.edges.values[:, num:]
    information = np.zeros((len(upper), k, k))
    rows, columns = np.triu_indices(k)
    information[:, rows, columns] = upper
    information[:, columns, rows] = upper
    information = nearest_semidefinite(information, path)
    edges = np.searchsorted(file.ids, file.edges.ids)
    try:
        return PoseGraph.from_edges(
            edges, T_i_j, num_poses=len(file.ids), information=information
        )
    except EdgeError as err:
        line = file.edges.line[err.edge]
        raise InputError(f"{path}, line {line}: {err}") from err


def read_g2o_poses(
    path: str | Path,
) -> tuple[np.ndarray, Float[Array, "v D D"] | None]:
    """Reads the ids and the poses (initial guesses) of a g2o file.

    Returns:
        `(v,)` ids of the frames in increasing order, those named by edges alone
        included, and `(v, d+1, d+1)` poses, or None unless each frame has a VERTEX
        line.

    Raises:
        InputError: as `read_g2o`.
    """
    file = parse(Path(path))
    T = motions(file.vertices, file.dim, path)
    where = file.places()
    if where is None:
        return file.ids, None
    poses = np.empty_like(T)
    poses[where] = T
    return file.ids, jnp.asarray(poses, dtype=jnp.result_type(float))


def read_g2o_known(path: str | Path) -> KnownOfGraph:
    """Reads what a g2o file knows of poses.

    Returns:
        Lists that `average` takes as they are, `average(graph, **known._asdict())`:
        priors (EDGE_PRIOR_SE2, EDGE_SE3_PRIOR), fixed poses (FIX, of vertices that have
        a pose), control points (EDGE_PRIOR_SE2_XY, EDGE_SE3_XYZPRIOR, and priors that
        say nothing of turns). Frames as in `read_g2o`.

    Raises:
        InputError: as `read_g2o`; for ids and parameters that the file does not have.
    """
    file = parse(Path(path))
    return known_of(file.lines, file.ids, file.vertices, file.dim)


def write_g2o(
    path: str | Path,
    graph: PoseGraph,
    T_world_i: ArrayLike | None = None,
    ids: ArrayLike | None = None,
    known: KnownOfGraph | None = None,
) -> None:
    """Writes poses and edges; the file appears whole or not at all.

    Masked edges are left out. The information written is that of the graph (the
    identity if it has none) times the prior weight.

    Args:
        path: the file to write; a name ending in `.gz` is compressed.
        graph: the relative motions.
        T_world_i: `(v, d+1, d+1)` poses, or None for no VERTEX lines.
        ids: `(v,)` names of the frames, None for 0, 1, 2, ...
        known: what `read_g2o_known` reads again; fixed poses are those of `T_world_i`,
            and an information that is left out is the identity.

    Raises:
        ValueError: if `T_world_i` or `ids` do not belong to the graph, or it holds what
            `read_g2o` refuses: negative weights, indefinite information.
        InputError: if the folder cannot be written.
    """
    check_graph(graph, "graph")
    try:
        check_weights(graph.weight, graph.edges, graph.mask)
        check_information(graph.information, graph.edges, graph.mask)
    except EdgeError as err:
        raise ValueError(f"graph: {err}") from None
    d, num = graph.dim, graph.num_poses
    names = as_host_array(np.arange(num) if ids is None else ids, "ids")
    if names.shape != (num,):
        raise ValueError(f"ids: wanted shape {(num,)}, found {names.shape}.")
    if names.dtype.kind not in "iu" or len(np.unique(names)) != num:
        raise ValueError("ids: wanted integers, each another.")
    digits = 9 if graph.T_i_j.dtype == jnp.float32 else 17
    lines = []
    if T_world_i is not None:
        poses = as_host_numbers(T_world_i, "T_world_i")
        if poses.shape != (num, d + 1, d + 1):
            raise ValueError(
                f"T_world_i: wanted shape {(num, d + 1, d + 1)}, found {poses.shape}."
            )
        check_rigid(poses, "T_world_i")
        lines += lines_of(list(VERTEX)[d - 2], names[:, None], columns(poses), digits)
    keep = np.asarray(graph.mask)
    k = lie.tangent_dim(d)
    weight = np.asarray(graph.weight, dtype=np.float64)[keep, None, None]
    info = (
        np.eye(k) if graph.information is None else np.asarray(graph.information)[keep]
    )
    upper = (weight * info)[:, *np.triu_indices(k)]
    T_i_j = np.asarray(graph.T_i_j, dtype=np.float64)[keep]
    check_rigid(T_i_j, "graph: T_i_j")
    motions = columns(T_i_j)
    values = np.concatenate([motions, upper], axis=1)
    lines += lines_of(
        list(EDGE)[d - 2], names[np.asarray(graph.edges)[keep]], values, digits
    )
    if known is not None:
        lines += known_lines(known, names, d, digits)
    text = "\n".join(lines) + "\n"
    with atomic_write(path, "wb") as file:
        data = text.encode()
        file.write(gzip.compress(data) if Path(path).suffix == ".gz" else data)
