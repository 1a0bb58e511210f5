"""Global registration of pairs, with no initial guess, beside its peers.

Run: taskset -c 0 python -m bench.global_pairs [--only so3|half|scans|look_ups|many]
     [--trials 200] [--methods NAME ...] [--data DIR] [--json FILE] [--out DIR]

so3, half: the PF paper's horse under rotations uniform over SO(3), whole or one side of
a random plane, with noise. scans: all pairs of the Bunny's and of the Dragon's scans,
by their overlap. look_ups: success against the number of closest points looked up, for
the filter with its dynamics, without and with constant velocity, and for plain descents
from many starts; with the picture `look_ups.png` under `--out`. many: thousands of
trials in one call, memory and throughput.

CPU time is that of all threads, after a first call that compiles. Without the horse in
DIR (else JAXREG_DATA, else ../shared/data) a generated one is used and named; without
the scans their part is left out.
"""

import argparse
import os
from collections.abc import Callable
from pathlib import Path


# Read by the libraries when they load; the number of cores is the process's affinity.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import jax  # noqa: E402

import jaxreg as jr  # noqa: E402
from bench import (  # noqa: E402
    global_horse,
    global_look_ups,
    global_many,
    global_scans,
    timing,
)
from bench.particle_data import horse_model  # noqa: E402


PACKAGES = ("jax", "numpy", "scipy", "small_gicp", "open3d")


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = ("so3", "half", "scans", "look_ups", "many")
    parser.add_argument("--only", choices=parts)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--many", type=int, default=4000, help="trials of `many`")
    parser.add_argument("--methods", nargs="+", help="those whose name contains one")
    default = Path(os.environ.get("JAXREG_DATA", "../shared/data"))
    parser.add_argument("--data", type=Path, default=default)
    parser.add_argument("--json", type=Path, help="adds a line per row to this file")
    parser.add_argument("--out", type=Path, default=Path("notebooks"))
    return parser.parse_args()


def main() -> None:
    """Prints the tables."""
    options = parse()
    folder = options.data / "horse"
    scanned = (folder / "horse.ply.gz").is_file()
    machine = {
        "horse": "scanned" if scanned else "generated",
        "cores": timing.num_cores(),
        "cpu": timing.cpu_model(),
        "device": jax.devices()[0].device_kind,
        "versions": {"jaxreg": jr.__version__, **timing.versions(*PACKAGES)},
    }
    print(f"{machine['horse']} horse; {machine['cores']} core(s) of {machine['cpu']}")
    print(machine["versions"])
    model = horse_model(folder if scanned else None)
    num, names = options.trials, options.methods
    parts: dict[str, Callable[[], list[dict]]] = {
        "so3": lambda: global_horse.compare("so3", num, model, names),
        "half": lambda: global_horse.compare("half", num, model, names),
        "scans": lambda: global_scans.compare(options.data, names),
        "look_ups": lambda: global_look_ups.compare(
            num, model, options.data, options.out
        ),
        "many": lambda: global_many.compare(options.many, model),
    }
    for name, part in parts.items():
        if options.only in (None, name):
            timing.keep(part(), machine, options.json)


if __name__ == "__main__":
    main()
