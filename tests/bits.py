"""Whether answers have the same bits on one core and on two, alone and beside load.

`python -m tests.bits` runs every function twice, in a process of its own each time: on
all cores, and on one, compiled there anew, beside a thread that takes half of its time.
"""

import hashlib
import json
import os
import subprocess
import sys
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


def digests(names: list[str], cores: int, load: bool, cache: str = "") -> dict:
    """Of all arrays of the answers, from a process on so many cores, 0 for all."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
    if cores == 1:
        environment["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    words = [sys.executable, "-m", "tests.bits", json.dumps([names, cores, load])]
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True)
    if done.returncode:
        raise RuntimeError(done.stderr.decode())
    return json.loads(done.stdout)


def _child(names: list[str], cores: int, load: bool) -> None:
    if cores and hasattr(os, "sched_setaffinity"):
        some = sorted(os.sched_getaffinity(0))[:cores]
        os.sched_setaffinity(0, some)
    if load:
        threading.Thread(target=_busy, daemon=True).start()
    import jax

    found = {}
    for name in names:
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(FUNCTIONS[name]()):
            digest.update(np.asarray(leaf).tobytes())
        found[name] = digest.hexdigest()[:16]
    sys.stdout.write(json.dumps(found))


def _busy() -> None:
    x = np.ones((300, 300))
    while True:
        x = np.tanh(x @ x)


def main() -> int:
    """Compares; 1 where bits differ."""
    if len(sys.argv) > 1:
        _child(*json.loads(sys.argv[1]))
        return 0
    names = list(FUNCTIONS)
    two, one = digests(names, 0, False), digests(names, 1, True)
    for name in names:
        same = "the same" if one[name] == two[name] else "other"
        print(f"{name}: {same} bits ({two[name]}, {one[name]})")  # noqa: T201
    return int(one != two)


if __name__ == "__main__":
    sys.exit(main())
