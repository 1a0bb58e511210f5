"""Time a pair of `register`, beside that of another checkout.

`git worktree add ../before COMMIT`, then
`python -m bench.studies.pair_times ../before --data DIR`.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np


# Run in either checkout, so it uses only what both have. CPU time from NumPy points,
# compiled before: clouds are padded to one of few sizes.
_CHILD = """
import json, sys, time
import jax, numpy as np
import jaxreg as jr
for path in sys.argv[2:]:
    with np.load(path) as file:
        clouds = [np.asarray(file[name], np.float32) for name in ("source", "target")]
    size = next(n for n in (8192, 32768, 98304) if n >= max(map(len, clouds)))
    masks = [np.arange(size) < len(c) for c in clouds]
    clouds = [np.pad(c, ((0, size - len(c)), (0, 0))) for c in clouds]
    times = []
    for seed in range(1 + int(sys.argv[1])):
        start = time.process_time()
        found = jr.register(*clouds, key=jax.random.key(seed), source_mask=masks[0],
                            target_mask=masks[1])
        jax.block_until_ready(found.T_target_source)
        times.append(time.process_time() - start)
    print(json.dumps([path, times[1:]]), flush=True)
"""


def main() -> None:
    """Prints a row per pair and the median of their ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("before", type=Path, help="the other checkout")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--keys", type=int, default=5)
    args = parser.parse_args()
    pairs = sorted((args.data / "sensor_pairs").glob("*.npz"))
    pairs = [str(p.resolve()) for p in pairs if "source" in np.load(p)]
    here = Path(__file__).resolve().parents[2]
    ratios = []
    print("| pair | before, s | now, s | ratio |\n|---|---|---|---|")
    for path in pairs:
        # In turn, so that both meet the same neighbours on the machine.
        before, now = (_seconds(root, path, args.keys) for root in (args.before, here))
        ratios.append(now / before)
        name = Path(path).stem
        print(f"| {name} | {before:.2f} | {now:.2f} | {now / before:.2f} |", flush=True)
    print(f"\nmedian {np.median(ratios):.2f}, worst {max(ratios):.2f}")


def _seconds(root: Path, path: str, keys: int) -> float:
    """The median over keys."""
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, str(keys), path],
        cwd=root,  # whose `jaxreg` comes first
        capture_output=True,
        text=True,
        check=True,
    )
    return float(np.median(json.loads(done.stdout)[1]))


if __name__ == "__main__":
    main()
