"""Whether batches of small problems hang: `python -m tests.stress`, on two cores.

Every public method of `register` and `average` under `vmap`, over and over. Two batched
calls of LAPACK in one program, which stood still on two cores, were met in most runs.
A child that takes no time of the cores for a minute is said to hang; where that cannot
be read, one that stays without a word for ten.
"""

import argparse
import os
import selectors
import subprocess
import sys
import time
from pathlib import Path


ROOT = Path(__file__).parents[1]
STILL, SILENCE = 60, 600  # seconds without time of the cores, without a word


def _child(name: str, runs: int, batch: int) -> None:
    """Runs a method over a batch of problems; a line for each run."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    sys.path.insert(0, str(ROOT / "tests"))
    import jax
    import jax.numpy as jnp
    import numpy as np
    from protocols import AVERAGERS, KEY, REGISTRARS, graph, measured, pair

    import jaxreg as jr
    from jaxreg.particle import AbstractSearch

    def repeated(x: jax.Array) -> jax.Array:
        noise = jax.random.normal(KEY, (batch, *x.shape), x.dtype)
        return x + 1e-4 * noise

    if name in REGISTRARS:
        method = REGISTRARS[name].make(3)
        if isinstance(method, AbstractSearch):  # of a hundred poses each
            batch //= 8
        inputs = tuple(map(repeated, pair(3, np.float32)))

        def one(source: jax.Array, target: jax.Array) -> jax.Array:
            return jr.register(source, target, method, key=KEY).T_target_source

    else:
        method = AVERAGERS[name].make(3)
        T, weight = measured(3, np.float32)
        inputs = jnp.stack([T] * batch), jnp.abs(repeated(weight))

        def one(source: jax.Array, target: jax.Array) -> jax.Array:
            return jr.average(graph(source, target), method, key=KEY).T_world_i

    together = jax.jit(jax.vmap(one))
    for number in range(runs):
        answer = np.asarray(together(*inputs))
        print(number, np.isfinite(answer).all(), flush=True)  # noqa: T201


def watched(name: str, runs: int, batch: int) -> str:
    """How the runs of a method ended, in words."""
    words = [sys.executable, "-m", "tests.stress", "--child", name]
    words += ["--runs", str(runs), "--batch", str(batch)]
    begin, done = time.monotonic(), 0
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, bufsize=0) as child:
        assert child.stdout is not None
        heard = selectors.DefaultSelector()
        heard.register(child.stdout, selectors.EVENT_READ)
        used = _core_seconds(child.pid)
        while True:
            if not heard.select(SILENCE if used is None else STILL):
                before, used = used, _core_seconds(child.pid)
                if before is None or used is None or used - before < 1:
                    child.kill()
                    return f"HANGS after {done} runs"
                continue
            line = child.stdout.readline()
            if not line:
                break
            done += line.endswith(b"True\n")
    if child.returncode or done < runs:
        return f"FAILED after {done} runs, code {child.returncode}"
    return f"{done} runs in {time.monotonic() - begin:.0f} s"


def _core_seconds(pid: int) -> float | None:
    """Time of the cores that a process has used, where that can be read."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def main() -> int:
    """Runs all methods; 1 if one hangs or fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.stress", description=__doc__)
    parser.add_argument("--runs", type=int, default=200, help="of each method")
    parser.add_argument("--batch", type=int, default=4000)
    parser.add_argument("--only", nargs="*", help="names of methods")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        _child(options.child, options.runs, options.batch)
        return 0
    sys.path.insert(0, str(ROOT / "tests"))
    from protocols import AVERAGERS, REGISTRARS

    ends = {}
    for name in options.only or [*AVERAGERS, *REGISTRARS]:
        ends[name] = watched(name, options.runs, options.batch)
        print(f"{name}: {ends[name]}", flush=True)  # noqa: T201
    return int(any(not end.endswith(" s") for end in ends.values()))


if __name__ == "__main__":
    sys.exit(main())
