"""Whether answers have the same bits from process to process, alone and beside load.

`python -m tests.bits` runs every function in three processes, each of which compiles
anew: on all cores; the same beside a thread that takes part of their time, which must
give the same bits; and on one core, where XLA splits products, factorisations and long
sums otherwise: these answers may differ by rounding.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


ROOT = Path(__file__).parents[1]


def _pair() -> tuple[np.ndarray, np.ndarray]:
    from jaxreg.testing import problems

    target = problems.surface(3000, 3, 0)
    T = problems.motion(3, 0.2, 0.05)
    source = problems.move(T, problems.surface(3000, 3, 1))
    return source.astype(np.float32), target.astype(np.float32)


def _icp() -> Any:
    import jaxreg as jr

    return jr.register(*_pair(), jr.ICP())


def _filter() -> Any:
    import jax

    import jaxreg as jr

    method = jr.ParticleFilter(num_prior=256, num_particles=64)
    return jr.register(*_pair(), method, key=jax.random.key(3))


def _average() -> Any:
    import jaxreg as jr
    from jaxreg.testing import problems

    rng = np.random.default_rng(0)
    num = 200
    T = np.stack([problems.motion(3, 0.01 * k, 1.0, k) for k in range(num)])
    i = rng.integers(0, num - 1, 1500)
    j = i + 1 + rng.integers(0, 20, 1500) % (num - 1 - i)
    noise = np.stack([problems.motion(3, 0.02, 0.02, k) for k in range(1500)])
    T_i_j = (np.linalg.inv(T[i]) @ T[j] @ noise).astype(np.float32)
    return jr.average(jr.PoseGraph.from_edges(np.stack([i, j], 1), T_i_j, num))


def _reconstruct() -> Any:
    import jax

    import jaxreg as jr

    source, target = _pair()
    scans = [target[:2000], source[:2000], target[1000:]]
    method = jr.ParticleFilter(num_prior=256, num_particles=64)
    return jr.reconstruct(scans, method=method, key=jax.random.key(3))


FUNCTIONS: dict[str, Callable[[], Any]] = {
    "ICP": _icp,
    "average": _average,
    "ParticleFilter": _filter,
    "reconstruct": _reconstruct,
}


#: What rounding of float32 makes of poses at most, seen: 5e-7.
ROUNDING = 1e-5


def answers(names: list[str], cores: int, load: bool) -> dict[str, dict[str, Any]]:
    """The arrays of each answer, from a process on so many cores, 0 for all."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": ""}
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "tests.bits"]
        words.append(json.dumps([names, cores, load, folder]))
        done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True)
        if done.returncode:
            raise RuntimeError(done.stderr.decode())
        found = {name: np.load(Path(folder) / f"{name}.npz") for name in names}
        return {name: dict(arrays) for name, arrays in found.items()}


def _child(names: list[str], cores: int, load: bool, folder: str) -> None:
    if cores and hasattr(os, "sched_setaffinity"):
        some = sorted(os.sched_getaffinity(0))[:cores]
        os.sched_setaffinity(0, some)
    if load:
        threading.Thread(target=_busy, daemon=True).start()
    import jax

    for name in names:
        leaves = jax.tree_util.tree_leaves_with_path(FUNCTIONS[name]())
        arrays = {jax.tree_util.keystr(path): np.asarray(x) for path, x in leaves}
        np.savez(Path(folder) / name, **arrays)  # pyright: ignore[reportArgumentType]


def _busy() -> None:
    x = np.ones((300, 300))
    while True:
        x = np.tanh(x @ x)


def apart(a: dict[str, Any], b: dict[str, Any]) -> float | None:
    """The largest difference of the poses of two answers; None where all bits agree."""
    other = [name for name in a if a[name].tobytes() != b[name].tobytes()]
    if not other:
        return None
    poses = next(name for name in a if name.startswith(".T_"))
    return float(np.max(np.abs(a[poses] - b[poses])))


def main() -> int:
    """Compares; 1 where bits differ that must not, or answers by more than rounding."""
    if len(sys.argv) > 1:
        _child(*json.loads(sys.argv[1]))
        return 0
    names = list(FUNCTIONS)
    alone = answers(names, 0, False)
    failed = False
    for words, cores, allowed in [("beside load", 0, 0.0), ("one core", 1, ROUNDING)]:
        others = answers(names, cores, cores == 0)
        for name in names:
            gap = apart(alone[name], others[name])
            said = (
                "the same bits" if gap is None else f"other bits, poses {gap:.1e} apart"
            )
            print(f"{name}, {words}: {said}")  # noqa: T201
            failed |= gap is not None and not (0 < allowed and gap <= allowed)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
