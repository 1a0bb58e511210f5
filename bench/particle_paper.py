"""The experiments of the PF paper's section 5: letter, cube, truck, horse.

Run: python -m bench.particle_paper [--only letter|cube|truck|horse] [--seeds 100]
     [--trials 1000] [--data DIR] [--out DIR] [--json FILE]

The paper shows one run of each of the first three; here it is a hundred, each with its
own displacement, points and random numbers. The horse is Table 1, with `--trials` at
each level of noise, on the scan in DIR/horse where that is there and on a generated
shape. CPU time is that of all threads, compilation apart. `--out` receives a
picture of each experiment's first trial.
"""

import argparse
import os
from pathlib import Path

import numpy as np

from bench import particle_horse
from bench.particle_data import Trials
from bench.particle_methods import EXPERIMENTS, Experiment, correlation
from bench.particle_plot import Panel, trial_figure
from bench.particle_run import Method, Outcome, look_ups, run
from bench.timing import cpu_model, keep, num_cores, versions


_HEAD = (
    f"{'method':28s}{'success':>9s}{'as shape':>10s}{'deg':>8s}{'shift':>9s}"
    f"{'CPU ms':>9s}{'look-ups':>10s}"
)


def row_of(name: str, method: Method, trials: Trials, found: Outcome) -> dict:
    """What is told of a method, in percent, medians, milliseconds and counts."""
    return {
        "experiment": name,
        "method": method.name,
        "trials": len(found.success),
        "success": 100 * float(found.success.mean()),
        "aligned": 100 * float(found.aligned.mean()),
        "median_degrees": float(np.median(found.degrees)),
        "median_shift": float(np.median(found.shift)),
        "cpu_ms": found.cpu_ms,
        "look_ups": look_ups(method.registrar, trials),
    }


def print_row(row: dict) -> None:
    """One line of a table."""
    print(
        f"{row['method']:28s}{row['success']:8.0f}%{row['aligned']:9.0f}%"
        f"{row['median_degrees']:8.2f}{row['median_shift']:9.3f}"
        f"{row['cpu_ms']:9.1f}{row['look_ups'] / 1e6:9.2f}M",
        flush=True,
    )


def compare(
    name: str, experiment: Experiment, num: int, out: Path | None
) -> list[dict]:
    """Prints the table of an experiment and draws its picture."""
    trials = experiment.trials(num)
    prior = experiment.prior
    print(
        f"\n{name}: {num} trials, {trials.source.shape[1]} points on "
        f"{len(trials.target)}; success within {trials.degrees:g} degrees and "
        f"{trials.shift:g} units.\nPrior: Gaussian around the given pose, "
        f"{prior.translation_spread:g} radii and {prior.rotation_spread:g} rad.\n"
        + _HEAD
    )
    rows, drawn = [], {}
    for method in experiment.methods:
        drawn[method.name] = run(method, trials)
        rows.append(row_of(name, method, trials, drawn[method.name]))
        print_row(rows[-1])
    rivals = {}
    for bandwidth in experiment.bandwidths:
        method = correlation(bandwidth)
        rivals[method.name] = run(method, trials)
        rows.append(row_of(name, method, trials, rivals[method.name]))
        print_row(rows[-1])
    any_of_them = float(np.any([r.success for r in rivals.values()], axis=0).mean())
    print(f"{'  any of these bandwidths':28s}{100 * any_of_them:8.0f}%")
    if out is not None:
        best = max(rivals, key=lambda r: rivals[r].success.mean())
        shown = {k: drawn[k] for k in experiment.drawn} | {best: rivals[best]}
        panels = [Panel("as given", np.eye(trials.target.shape[1] + 1))]
        panels += [Panel(_title(k, r), r.T_target_source[0]) for k, r in shown.items()]
        trial_figure(out / f"{name}.png", trials.source[0], trials.target, panels)
    return rows


def _title(name: str, found: Outcome) -> str:
    verdict = "found" if found.success[0] else "missed"
    return f"{name}: {verdict} ({100 * found.success.mean():.0f} % of all)"


def main() -> None:
    """Prints the tables and keeps what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=[*EXPERIMENTS, "horse"])
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--trials", type=int, default=1000)
    data = os.environ.get("JAXREG_DATA", "../shared/data")
    parser.add_argument("--data", type=Path, default=Path(data))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
    common = {"cpu": cpu_model(), "cores": num_cores(), **versions("jax", "numpy")}
    for name, experiment in EXPERIMENTS.items():
        if options.only in (None, name):
            rows = compare(name, experiment, options.seeds, options.out)
            keep(rows, common, options.json)
    if options.only in (None, "horse"):
        folder = options.data / "horse"
        rows = particle_horse.compare(options.trials, folder, options.out)
        keep(rows, common, options.json)


if __name__ == "__main__":
    main()
