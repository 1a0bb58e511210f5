"""Robot-mapping graphs from the motions alone: objective and time.

Run: python -m bench.pose_graphs [DATA]

Reads the graphs with published optima from DATA (else JAXREG_DATA, else ../shared/data,
folder pose_graphs), averages them in float64, and prints SE-Sync's objective beside the
optimum, the sum of r' Omega r of the log errors over that of PoseGraphLM(), which is
what the default ends with, the time of a call after the first, and that of the first
(with compilation) apart.
"""

import os
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp


jax.config.update("jax_enable_x64", True)

from jaxreg import Status  # noqa: E402
from jaxreg.averaging import (  # noqa: E402
    AbstractAverager,
    Correntropy,
    MotionAveraging,
    PoseGraphLM,
    SpanningTree,
    average,
)
from jaxreg.io.g2o import read_g2o  # noqa: E402
from jaxreg.metrics import chordal_objective  # noqa: E402


OPTIMA = {
    "smallGrid3D": 1025.398,
    "sphere2500": 1687.0058,
    "parking-garage": 1.262524,
    "CSAIL": 31.7037,
    "intel": 52.3482,
    "MIT": 61.1541,
    "manhattan": 6431.39,
}
METHODS: dict[str, AbstractAverager] = {
    "PoseGraphLM": PoseGraphLM(),
    "LM, chordal": PoseGraphLM(objective="chordal"),
    "tree by path": SpanningTree(by="path"),
    "MotionAveraging": MotionAveraging(),
    "default": Correntropy(),
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


def log_objective(graph, T_world_i) -> float:  # noqa: ANN001
    """The sum of r' Omega r over the edges."""
    r = graph.tangent_errors(T_world_i)
    return float(jnp.einsum("ea,eab,eb->", r, graph.information, r))


def main() -> None:
    """Prints the table."""
    print(
        f"{'graph':15}{'method':18}{'objective':>14}{'optimum':>12}{'log ratio':>11}"
        f"{'status':>12}{'steps':>7}{'time s':>9}{'first s':>9}"
    )
    for name, optimum in OPTIMA.items():
        graph = read_g2o(data_dir() / f"{name}.g2o")
        best = None
        for label, method in METHODS.items():
            solution, first, later = timed(graph, method)
            value = float(chordal_objective(graph, solution.T_world_i))
            log = log_objective(graph, solution.T_world_i)
            best = log if best is None else best
            print(
                f"{name:15}{label:18}{value:14.8g}{optimum:12.8g}{log / best:11.5g}"
                f"{Status(int(solution.status)).name:>12}{int(solution.num_steps):7d}{later:9.3f}{first:9.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
