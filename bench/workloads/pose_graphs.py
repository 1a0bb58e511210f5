"""Public graphs with published optima, from the motions alone, in float64."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.pose_graphs import g2o_solver
from bench.records import Metric
from bench.workloads.local_pairs import written_out
from jaxreg.averaging import (
    AbstractAverager,
    ChordalError,
    Correntropy,
    MotionAveraging,
    PoseGraphLM,
    average,
)
from jaxreg.averaging.methods.riemannian_staircase import RiemannianStaircase
from jaxreg.graph import PoseGraph
from jaxreg.io.graphs.g2o import read_g2o
from jaxreg.metrics import chordal_objective


#: Optima of SE-Sync's objective.
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
    "jaxreg PoseGraphLM": PoseGraphLM(),
    "jaxreg PoseGraphLM, chordal": PoseGraphLM(ChordalError()),
    "jaxreg RiemannianStaircase": RiemannianStaircase(),
    "jaxreg MotionAveraging": MotionAveraging(),
    "jaxreg default": Correntropy(),
}


def cases(options: Options) -> Iterator[Case]:
    """A case per graph that is there."""
    for name, optimum in OPTIMA.items():
        path = options.data / "pose_graphs" / f"{name}.g2o"
        if not path.exists():
            continue
        graph = read_g2o(path)
        own = [
            Method(k, "jaxreg", written_out(m), partial(_own, m, graph))
            for k, m in METHODS.items()
        ]
        start = "chordal relaxation" if graph.dim == 3 else "the poses of the file"
        peer = Method(
            "GTSAM LM",
            "gtsam",
            f"defaults, from {start}",
            prepare=partial(g2o_solver, path, graph.dim),
        )
        yield Case(
            name=name,
            data=f"{path.name}, {graph.num_poses} poses, {len(graph.edges)} edges",
            methods=[*own, peer],
            trials=[()],
            judge=partial(judge, graph, optimum),
            repeats=5,
            reference="GTSAM LM",
        )


def _own(method: AbstractAverager, graph: PoseGraph) -> np.ndarray:
    return np.asarray(average(graph, method).T_world_i)


def judge(graph: PoseGraph, optimum: float, answers: list[Any]) -> Judged:
    """Both objectives: SE-Sync's over its optimum, and the sum of r' Omega r."""
    T_world_i = jnp.asarray(answers[0])
    ratio = float(chordal_objective(graph, T_world_i)) / optimum
    r = graph.tangent_errors(T_world_i)
    log = float(jnp.einsum("ea,eab,eb->", r, graph.information, r))
    return Judged(
        [
            Metric("ratio", ratio, "", "down", max(0.1 * (ratio - 1), 1e-3)),
            Metric("log objective", log, "", "down", max(0.05 * log, 1e-6)),
        ]
    )
