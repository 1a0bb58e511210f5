"""Relative motions that `jaxreg.reconstruct` estimates between real scans."""

import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import jaxreg
from jaxreg.datasets import sculpture_scans
from jaxreg.io.stanford import read_conf
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
    T_refined: np.ndarray  # (v, 4, 4) what `reconstruct` returns in the end
    T_true: np.ndarray  # (v, 4, 4) world from scan
    centre: np.ndarray  # (v, 3) mean of each scan
    seconds: float  # of `reconstruct`, compilation included


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


def estimate(name: str, data: Path, seed: int, cache: Path | None) -> Motions:
    """Registers all pairs of a set, or reads what an earlier call left in `cache`."""
    title, scans, T_true = load_scans(name, data)
    kind = "scans" if title.startswith("Stanford") else "sculpture"
    centre = MM * np.stack([np.mean(x, axis=0, dtype=np.float64) for x in scans])
    path = None if cache is None else cache / f"motions_{name}_{kind}_{seed}.npz"
    if path is not None and path.exists():
        with np.load(path) as file:
            parts = {k: file[k] for k in file.files if k != "seconds"}
            seconds = float(file["seconds"])
        return Motions(f"{title}, seed {seed}", **parts, centre=centre, seconds=seconds)
    begin = time.perf_counter()
    found = reconstruct(scans, key=jax.random.key(seed))
    found = jax.block_until_ready(found)
    seconds = time.perf_counter() - begin
    low = jaxreg.ParticleFilter().min_overlap
    parts = {
        "edges": np.asarray(found.graph.edges),
        "T_i_j": _in_mm(np.asarray(found.graph.T_i_j)),
        "overlap": np.asarray(found.overlap),
        "trusted": np.asarray(found.overlap) >= low,
        "T_refined": _in_mm(np.asarray(found.T_world_i)),
        "T_true": _in_mm(T_true),
    }
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **parts, seconds=seconds)
    return Motions(f"{title}, seed {seed}", **parts, centre=centre, seconds=seconds)


def _in_mm(T: np.ndarray) -> np.ndarray:
    T = T.astype(np.float64)
    T[:, :3, 3] *= MM
    return T
