"""The settings with which each peer registers a pair locally, and their names."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from bench.case import Method
from bench.peers.local_pairs import (
    coherent_drift,
    filter_reg,
    numpy_plane,
    open3d,
    open3d_tensor,
    small_gicp,
    small_vgicp,
)


class Peer(NamedTuple):
    """A peer, and the numbers of points for which its setting makes sense."""

    method: Method
    smallest: int = 0
    largest: int = 1_000_000


def _method(
    library: str,
    run: Callable,
    name: str,
    smallest: int = 0,
    largest: int = 1_000_000,
    **options: Any,
) -> Peer:
    """A peer with its options written out."""
    defaults = {
        key: parameter.default
        for key, parameter in inspect.signature(run).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }
    text = ", ".join(f"{key}={x}" for key, x in (options | defaults | options).items())
    method = Method(name, library, text, solve=partial(run, **options))
    return Peer(method, smallest, largest)


FULL = ((0, 0.1),)  # one stage on all points


def peers() -> list[Peer]:
    """All peers, each with the best settings found for this task.

    `stages` are (voxel size or 0 for all points, largest distance of a pair), shares
    of the extent. Settings that thin the clouds have rows of their own.
    """
    return [
        _method(
            "scipy",
            numpy_plane,
            "NumPy+SciPy plane",
            reach=0.1,
            k=10,
            steps=40,
            stop=3e-4,
        ),
        *_small_gicp_peers(),
        *_open3d_peers(),
        # All pairs of points: for small clouds alone.
        _method("probreg", filter_reg, "probreg FilterReg", 0, 2_000, sigma=0.05),
        _method("pycpd", coherent_drift, "pycpd CPD", 0, 500, steps=50),
    ]


def _small_gicp_peers() -> list[Peer]:
    own = partial(_method, "small_gicp", small_gicp)
    return [
        own("small_gicp ICP", kind="ICP", stages=FULL),
        own("small_gicp PLANE", kind="PLANE_ICP", stages=FULL),
        own(
            "small_gicp PLANE tight",
            kind="PLANE_ICP",
            stages=FULL,
            turn_deg=0.01,
            shift=1e-4,
        ),
        own("small_gicp GICP", kind="GICP", stages=FULL),
        own("small_gicp GICP k=6", kind="GICP", stages=FULL, k=6),
        own("small_gicp GICP 2-stage", kind="GICP", stages=((0.05, 0.1), (0, 0.02))),
        *(
            own(
                f"small_gicp GICP voxel {voxel}",
                smallest=smallest,
                kind="GICP",
                stages=((voxel, 0.1),),
            )
            for voxel, smallest in ((0.03, 0), (0.02, 2_000), (0.01, 2_000))
        ),
        own(
            "small_gicp GICP voxels .04 .01",
            smallest=2_000,
            kind="GICP",
            stages=((0.04, 0.1), (0.01, 0.03)),
        ),
        own("small_gicp GICP voxel 0.005", 50_000, kind="GICP", stages=((0.005, 0.1),)),
        own(
            "small_gicp PLANE voxel 0.01",
            smallest=10_000,
            kind="PLANE_ICP",
            stages=((0.01, 0.1),),
        ),
        _method(
            "small_gicp",
            small_vgicp,
            "small_gicp VGICP",
            cell=0.02,
            voxel=1e-5,
            reach=0.1,
        ),
        _method(
            "small_gicp",
            small_vgicp,
            "small_gicp VGICP voxel 0.01",
            smallest=2_000,
            cell=0.02,
            voxel=0.01,
            reach=0.1,
        ),
    ]


def _open3d_peers() -> list[Peer]:
    own = partial(_method, "open3d", open3d)
    return [
        own("Open3D point", kind="point", stages=FULL),
        own("Open3D plane", kind="plane", stages=FULL),
        own("Open3D plane 2-stage", kind="plane", stages=((0.03, 0.1), (0, 0.02))),
        own("Open3D plane voxel 0.01", 10_000, kind="plane", stages=((0.01, 0.1),)),
        own("Open3D GICP", kind="gicp", stages=FULL, k=10),
        own("Open3D GICP voxel 0.01", 10_000, kind="gicp", stages=((0.01, 0.1),), k=10),
        _method(
            "open3d",
            open3d_tensor,
            "Open3D tensor plane 2-stage",
            stages=((0.02, 0.1), (0, 0.02)),
            k=20,
        ),
    ]


def solve_many(
    task: tuple[str, list[tuple[np.ndarray, np.ndarray]], float],
) -> np.ndarray:
    """Poses of a list of pairs by the peer of that name, for a worker process."""
    name, pairs, extent = task
    solve = next(x.method.solve for x in peers() if x.method.name == name)
    assert solve is not None
    return np.stack([solve(s, t, extent) for s, t in pairs])
