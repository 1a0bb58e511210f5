"""Scans and solvers for the tests of commands, so that each takes milliseconds."""

import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg
from jaxreg import AveragedPairs, Status
from jaxreg.registrar import Modes


CLOUD = np.random.default_rng(0).normal(size=(40, 3))
FILES = [
    "figure.png",
    "graph.g2o",
    "merged.ply",
    "poses.tum",
    "report.html",
    "result.json",
]
GRAPH = """\
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0
VERTEX_SE2 2 1 1 0
EDGE_SE2 0 1 1 0 1.5 1 0 0 1 0 1
EDGE_SE2 1 2 1 0 1.5 1 0 0 1 0 1
EDGE_SE2 0 2 1.1 1 3.0 1 0 0 1 0 1
"""


def shift(t: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = t
    return T


def turned(angle: float, offset: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], [offset, 1, 2]
    return T


POSES = np.stack([np.eye(4), turned(0.4, 3.0), turned(-1.2, -5.0)])


def seen_from(T_world_scan: np.ndarray) -> np.ndarray:
    T = np.linalg.inv(T_world_scan)
    return CLOUD @ T[:3, :3].T + T[:3, 3]


def middle_of(T_world_scan: np.ndarray) -> np.ndarray:
    return np.median(seen_from(T_world_scan), axis=0)


def save_scans(folder: Path) -> list[str]:
    for k, T in enumerate(POSES):
        np.save(folder / f"s{k}.npy", seen_from(T))
    return [f"s{k}.npy" for k in range(3)]


def write_truth(folder: Path, scans: list[str], poses: np.ndarray) -> None:
    lines = []
    for name, T in zip(scans, poses, strict=True):
        half = 0.5 * np.arctan2(T[1, 0], T[0, 0])
        t = " ".join(map(str, T[:3, 3]))
        lines.append(f"bmesh {name} {t} 0 0 {-np.sin(half)} {np.cos(half)}")
    (folder / "truth.conf").write_text("\n".join(lines).replace(".npy", ".ply"))


def left(folder: Path) -> set[str]:
    return set(os.listdir(folder))


def fake_reconstruct(
    monkeypatch: pytest.MonkeyPatch,
    T_true: np.ndarray,
    placed: list[bool],
    component: list[int] | None = None,
) -> list[Any]:
    """A solver that knows the poses of the centred scans; returns what it was given."""
    given: list[Any] = []

    def reconstruct(
        scans: list[np.ndarray], *, key: Any, progress: Any, **options: Any
    ) -> Any:
        given.append((scans, key, options))
        progress("pairs", 1, 3)
        progress("pairs", 3, 3)
        v = len(scans)
        told = [*options.get("control", []), *options.get("levels", [])]
        in_world = bool(told or options.get("fixed"))
        middle = np.zeros(3) if in_world else np.median(CLOUD, axis=0)
        T = np.stack([shift(-middle) @ T_true[i] for i in range(v)])
        T = np.stack([T[i] @ shift(middle_of(T_true[i])) for i in range(v)])
        edges = np.array([(i, j) for i in range(v) for j in range(i + 1, v)])
        i, j = edges.T
        graph = jaxreg.PoseGraph.from_edges(edges, np.linalg.inv(T)[i] @ T[j])
        both = np.array(placed)[edges].all(axis=1)
        lost, overlap = Status.LOW_OVERLAP, jnp.asarray(np.where(both, 0.8, 0.1))
        zeros = jnp.zeros(len(edges))
        dropped = [np.sum(~np.isfinite(s).all(1)) for s in scans]
        modes = (x[:, None] for x in (graph.T_i_j, overlap, 9 * overlap, zeros))
        return jaxreg.ReconstructionSolution(
            T_world_i=jnp.asarray(T),
            status=jnp.asarray(0 if all(placed) else Status.DISCONNECTED, int),
            scan_status=jnp.asarray([0 if p else lost for p in placed]),
            placed=jnp.asarray(placed),
            component=jnp.asarray(component or np.where(placed, 0, -1)),
            graph=graph,
            overlap=overlap,
            edge_weight=jnp.asarray(both.astype(float)),
            inlier_rmse=zeros,
            mode=jnp.zeros(len(edges), int),
            motions=jaxreg.RelativeMotions(graph.edges, *modes),
            averaged=AveragedPairs(graph.edges, overlap),
            num_dropped=jnp.asarray(dropped),
            prior_weight=jnp.ones(len(told)) if in_world else None,
        )

    def covariances(scans: list[np.ndarray], *_: Any, **__: Any) -> np.ndarray:
        return np.stack([1e-6 * np.eye(6)] * len(scans))

    monkeypatch.setattr(jaxreg, "reconstruct", reconstruct)
    monkeypatch.setattr(jaxreg, "scan_covariances", covariances)
    return given


def registered(T: np.ndarray, status: int, overlap: float) -> Any:
    """A solution with the pose that the search ended in, and an unused mode."""
    number, modes = jnp.zeros((), int), jnp.asarray([1.0, 0.0])
    covariance = 1e-6 * jnp.eye(6)
    return jaxreg.RegistrationSolution(
        T_target_source=jnp.asarray(T),
        status=jnp.asarray(status, int),
        fitness=jnp.asarray(0.95),
        inlier_rmse=jnp.asarray(0.02),
        num_inliers=number,
        overlap=jnp.asarray(overlap),
        log_evidence=jnp.asarray(9 * overlap),
        num_steps=number,
        H=jnp.eye(6),
        b=jnp.zeros(6),
        error=jnp.zeros(()),
        covariance=covariance,
        modes=Modes(
            T_target_source=jnp.stack([T, T]),
            weight=modes,
            fitness=0.95 * modes,
            overlap=overlap * modes,
            inlier_rmse=0.02 * modes,
            log_evidence=9 * overlap * modes,
            covariance=jnp.stack([covariance] * 2),
        ),
    )


def register_s1_onto_s0(
    source: np.ndarray,
    target: np.ndarray,
    method: Any,
    *,
    key: Any,
    init: Any = None,
    viewpoints: Any = None,
) -> Any:
    assert np.isfinite(source).all()
    T = shift(-np.median(CLOUD, axis=0)) @ POSES[1] @ shift(middle_of(POSES[1]))
    return registered(T, 0, 0.93)
