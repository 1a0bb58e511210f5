"""Relative motions that `jaxreg.reconstruct` estimates between real scans."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import jaxreg
from jaxreg.datasets import sculpture_scans
from jaxreg.io.poses.stanford import read_conf
from jaxreg.multiview import reconstruct


#: Folder, scans and poses of the sets, by name.
SETS = {
    "bunny": ("stanford_bunny", "bunny_scans.npz", "bun.conf"),
    "dragon": (
        "stanford_dragon",
        "dragonStandRight_scans.npz",
        "dragonStandRight.conf",
    ),
}
#: Lengths are reported in millimetres, as in the MCC paper; the files are in metres.
MM = 1000.0


class Motions(NamedTuple):
    """Every pair of scans once, i < j; lengths in millimetres."""

    name: str
    edges: np.ndarray  # (e, 2)
    T_i_j: np.ndarray  # (e, 4, 4) as registered
    overlap: np.ndarray  # (e,) the score of the registration, 0 to 1
    trusted: np.ndarray  # (e,) overlap that `reconstruct` averages
    T_true: np.ndarray  # (v, 4, 4) world from scan


def load_scans(name: str, data: Path) -> tuple[str, list[np.ndarray], np.ndarray]:
    """Title, scans and true poses, in metres; the sculpture where a set is absent."""
    folder, scans, truth = SETS[name]
    if not (data / folder / scans).exists():
        num = 10 if name == "bunny" else 15
        parts, T_world_i = sculpture_scans(num, seed=0)
        return f"sculpture of {num} views (no {data / folder})", parts, T_world_i
    poses = read_conf(data / folder / truth)
    with np.load(data / folder / scans) as file:
        parts = [file[key] for key in poses]
    return f"Stanford {name}", parts, np.stack(list(poses.values()))


def estimate(name: str, data: Path, seed: int) -> Motions:
    """Registers all pairs of a set."""
    title, scans, T_true = load_scans(name, data)
    found = jax.block_until_ready(reconstruct(scans, key=jax.random.key(seed)))
    overlap, rows = np.asarray(found.overlap), np.arange(found.overlap.size)
    log_evidence = np.asarray(found.motions.log_evidence)[rows, np.asarray(found.mode)]
    return Motions(
        name=f"{title}, seed {seed}",
        edges=np.asarray(found.graph.edges),
        T_i_j=_in_mm(np.asarray(found.graph.T_i_j)),
        overlap=overlap,
        trusted=log_evidence >= jaxreg.ParticleFilter().min_log_evidence,
        T_true=_in_mm(T_true),
    )


def _in_mm(T: np.ndarray) -> np.ndarray:
    T = T.astype(np.float64)
    T[:, :3, 3] *= MM
    return T
