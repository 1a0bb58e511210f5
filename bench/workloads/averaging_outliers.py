"""Break-down over the share of outliers: random graphs from the motions alone."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.pose_graphs import SIGMAS, robust
from bench.records import error, share
from bench.workloads.averaging_data import on_group
from bench.workloads.local_pairs import written_out
from jaxreg.averaging import (
    MCC,
    AbstractAverager,
    Correntropy,
    MotionAveraging,
    SpanningTree,
    average,
)
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_errors, translation_errors
from tests.averaging.graphs import random_graph


SIZES, SHARES, SEEDS = ((12, 46), (16, 100), (32, 465)), (0.0, 0.3, 0.5, 0.6), 20
METHODS: dict[str, AbstractAverager] = {
    "MA": MotionAveraging(),
    "MCC paper": MCC(initialiser=SpanningTree()),
    "default": Correntropy(),
}


def cases(options: Options) -> Iterator[Case]:
    """A case per size and share of outliers."""
    sizes = ((32, 465),) if options.quick else SIZES
    for num, edges in sizes:
        for outliers in (0.5,) if options.quick else SHARES:
            if num == 12 and outliers > 0.55:
                continue  # hardly any such graph is connected by its inliers
            count = 6 if options.quick else SEEDS
            drawn = [random_graph(num, edges, outliers, seed) for seed in range(count)]
            yield Case(
                name=f"{num} poses, {edges} edges, {outliers:.0%} wrong",
                data="generated graphs",
                methods=methods(options.quick),
                trials=[_trial(*graph[:3]) for graph in drawn],
                judge=partial(judge, drawn),
                repeats=4 if options.quick else 1,
                reference="GTSAM GNC",
                x=100 * outliers,
                x_label=f"% of outliers, {num} poses and {edges} edges",
            )


def _trial(X: np.ndarray, edges: np.ndarray, T: np.ndarray) -> tuple:
    """The graph, and its edges, motions and number of poses for the peers."""
    T = T.astype(np.float32)
    return PoseGraph.from_edges(edges, T, len(X)), edges, T, len(X)


def methods(quick: bool) -> list[Method]:
    """Averagers of jaxreg, the default alone when quick, then GTSAM."""
    own = [
        Method(f"jaxreg {k}", "jaxreg", written_out(m), partial(_own, m))
        for k, m in METHODS.items()
        if k == "default" or not quick
    ]
    text = f"from a breadth-first tree, deviations {SIGMAS[0]:g} degrees, {SIGMAS[1]:g}"
    kernels = {
        "GTSAM GNC": "GNC",
        "GTSAM Huber, Geman-McClure": "Huber",
    }
    return own + [
        Method(k, "gtsam", text, partial(_gtsam, kernel))
        for k, kernel in kernels.items()
    ]


def _own(method: AbstractAverager, graph: PoseGraph, *_: Any) -> np.ndarray:
    return np.asarray(average(graph, method).T_world_i)


def _gtsam(
    kernel: str, graph: PoseGraph, edges: np.ndarray, T: np.ndarray, num: int
) -> np.ndarray:
    # It takes rotations of float64 accuracy.
    T = on_group(T.astype(np.float64))
    return robust(edges, T, num, kernel=kernel).T_world_i


def judge(drawn: list, answers: list[Any]) -> Judged:
    """Success, wrong frames, and the errors of what succeeded."""
    rows = []
    for (X, edges, T, _), found in zip(drawn, answers, strict=True):
        graph = PoseGraph.from_edges(edges, T.astype(np.float32), len(X))
        true = jnp.asarray(X, jnp.float32)
        rows.append(errors_of(graph, jnp.asarray(found, jnp.float32), true))
    e_R, e_t, frames, margin = np.array(rows, dtype=np.float64).T
    ok = (e_R < np.deg2rad(5)) & (e_t < 0.05)
    one = 100 * max(1.0, 0.05 * len(ok)) / len(ok) + 1e-6
    metrics = [
        share("success", ok, one),
        share("as the truth", ok | (margin >= 0), one),
        error("wrong frames", 100 * float(1 - frames.mean()), "%", 5.0),
    ]
    if ok.any():
        degrees = float(np.rad2deg(np.median(e_R[ok])))
        metrics += [
            error("e_rot", degrees, "deg", 0.005),
            error("e_trans", 100 * float(np.median(e_t[ok])), "% of size", 0.005),
        ]
    return Judged(metrics, {"e_rot": np.rad2deg(e_R).tolist()})


@eqx.filter_jit
def errors_of(graph: PoseGraph, T, T_true) -> tuple:
    """Mean errors, share of right frames, and agreement against the truth's."""
    rotation = rotation_errors(T, T_true, "best")
    translation = translation_errors(T, T_true, "best")
    relative = T_true @ jnp.linalg.inv(T)
    angles = jax.vmap(lambda G: rotation_errors(G @ T, T_true, "none"))(relative)
    shifts = jax.vmap(lambda G: translation_errors(G @ T, T_true, "none"))(relative)
    right = (angles < jnp.deg2rad(5.0)) & (shifts < 0.05)
    scale = graph.length_scale
    margin = agreement(graph, T, scale) - agreement(graph, T_true, scale)
    frames = jnp.max(jnp.mean(right, axis=1))
    return jnp.mean(rotation), jnp.mean(translation), frames, margin


def agreement(graph: PoseGraph, T, scale) -> jax.Array:
    """Edges that agree, summed over errors from half a radian down by octaves."""
    rotation, translation = graph.differences(T)
    sq = rotation / 2 + translation / scale**2
    width = (0.5 / 2 ** jnp.arange(8))[:, None]
    return jnp.sum(jnp.exp(-sq / (2 * width**2)))
