"""Real scans into one frame without an initial guess: accuracy and time.

Run: python -m bench.scans [--data DIR] [--seeds 2] [--only bunny|dragon]

Each run is a process of its own, `jaxreg multiview` with an empty compilation cache, so
that its time is what a person waits the first time, from files to written result. DIR
holds the folders stanford_bunny and stanford_dragon (else JAXREG_DATA, else
../shared/data). Errors are those of the MCC paper, e_R and e_t, with scan 0 as the
common frame; the paper starts from a good guess.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path


SETS = {
    "bunny": ("stanford_bunny", "bunny_scans.npz", "bun.conf", 0.0086, 0.6749),
    "dragon": (
        "stanford_dragon",
        "dragonStandRight_scans.npz",
        "dragonStandRight.conf",
        0.0163,
        1.3837,
    ),
}


def run(folder: Path, scans: str, truth: str, seed: int) -> dict:
    """One cold run of the command; its result.json with the wall time added."""
    with tempfile.TemporaryDirectory() as scratch:
        environment = {**os.environ, "XDG_CACHE_HOME": scratch}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        out = Path(scratch, "out")
        command = [sys.executable, "-m", "jaxreg", "multiview", str(folder / scans)]
        command += ["--truth", str(folder / truth), "--seed", str(seed)]
        command += ["--out", str(out), "--quiet"]
        start = time.perf_counter()
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
        wall = time.perf_counter() - start
        return {**json.loads((out / "result.json").read_text()), "wall": wall}


def main() -> None:
    """Prints a row per set and seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = os.environ.get("JAXREG_DATA", "../shared/data")
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", choices=SETS)
    options = parser.parse_args()
    print("set     seed  placed   e_R rad (paper)      e_t mm (paper)    cold wall s")
    for name, (folder, scans, truth, paper_R, paper_t) in SETS.items():
        if options.only not in (None, name):
            continue
        if not (options.data / folder).is_dir():
            print(f"{name:7s} no data: {options.data / folder}")
            continue
        for seed in range(options.seeds):
            result = run(options.data / folder, scans, truth, seed)
            errors = result["errors"]
            placed = sum(scan["placed"] for scan in result["scans"])
            print(
                f"{name:7s} {seed:4d}  {placed:2d}/{len(result['scans']):2d}   "
                f"{errors['mean_e_R']:.5f} ({paper_R:.4f})   "
                f"{1000 * errors['mean_e_t']:.3f} ({paper_t:.4f})   "
                f"{result['wall']:.0f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
