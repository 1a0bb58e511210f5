"""Robot-mapping graphs from the motions alone: objective and time.

Run: python -m bench.pose_graphs [DATA]

Reads parking-garage.g2o and sphere2500.g2o from DATA (else JAXREG_DATA, else
../shared/data, folder pose_graphs), averages them in float64, and prints SE-Sync's
objective of the start and of the result beside the certified optimum, the time of a
call after the first, and that of the first (with compilation) apart.
"""

import os
import sys
import time
from pathlib import Path

import jax


jax.config.update("jax_enable_x64", True)

from jaxreg.averaging import (  # noqa: E402
    AbstractAverager,
    MotionAveraging,
    SpanningTree,
    average,
)
from jaxreg.io.g2o import read_g2o  # noqa: E402
from jaxreg.metrics import chordal_objective  # noqa: E402


OPTIMA = {"parking-garage": 1.262524, "sphere2500": 1687.0058}
METHODS: dict[str, AbstractAverager] = {
    "tree by weight": SpanningTree(),
    "tree by path": SpanningTree(by="path"),
    "MotionAveraging": MotionAveraging(),
}


def data_dir() -> Path:
    """The folder of the graphs."""
    here = Path(__file__).parents[1] / ".." / "shared" / "data"
    root = sys.argv[1] if len(sys.argv) > 1 else os.environ.get("JAXREG_DATA", here)
    return Path(root) / "pose_graphs"


def timed(graph, method) -> tuple:  # noqa: ANN001
    """Solution, first call and best of three later calls in seconds."""
    times = []
    solution = None
    for _ in range(4):
        begin = time.perf_counter()
        solution = jax.block_until_ready(average(graph, method))
        times.append(time.perf_counter() - begin)
    return solution, times[0], min(times[1:])


def main() -> None:
    """Prints the table."""
    print(
        f"{'graph':15}{'method':18}{'objective':>14}{'optimum':>12}"
        f"{'steps':>7}{'time s':>9}{'first s':>9}"
    )
    for name, optimum in OPTIMA.items():
        graph = read_g2o(data_dir() / f"{name}.g2o")
        for label, method in METHODS.items():
            solution, first, later = timed(graph, method)
            value = float(chordal_objective(graph, solution.T_world_i))
            print(
                f"{name:15}{label:18}{value:14.6g}{optimum:12.6g}"
                f"{int(solution.num_steps):7d}{later:9.3f}{first:9.2f}"
            )


if __name__ == "__main__":
    main()
