"""Robustness of `average` from the motions alone on random graphs with outliers.

Run: python -m bench.averaging_outliers [--seeds 40] [--double]

Graphs of N poses and H edges; inlier noise 0.5 degrees and 0.5 % of the size; outlier
motions uniformly random; only graphs whose inlier edges connect all poses. Success:
mean errors within 5 degrees and 5 % in the best common frame. "as the truth": success,
or an answer that as many edges agree with as with the true poses (a frame of one right
and several wrong edges cannot be told apart by anybody). "frames": the share of frames
that are right. The oracle is the same method started at the truth on the inliers alone;
its median error is compared over the successes of both. Time is that of one graph in a
call of its own after the first call, least of all seeds.
"""

import argparse
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.averaging import (
    AbstractAverager,
    Correntropy,
    MotionAveraging,
    SpanningTree,
    average,
)
from jaxreg.averaging.base import length_scale
from jaxreg.averaging.evidence import agreement
from jaxreg.graph import PoseGraph
from jaxreg.metrics import (
    rotation_errors,
    translation_errors,
)
from tests.averaging.graphs import random_graph


SIZES = ((12, 46), (16, 100), (32, 465))
SHARES = (0.0, 0.3, 0.5, 0.6)
METHODS: dict[str, AbstractAverager] = {
    "MA": MotionAveraging(),
    "MCC paper": Correntropy(width="paper", initialiser=SpanningTree()),
    "default": Correntropy(),
}


@eqx.filter_jit
def judge(graph: PoseGraph, T, T_true) -> tuple:
    """Mean errors, share of right frames, and agreement against the truth's."""
    rotation = rotation_errors(T, T_true, "best")
    translation = translation_errors(T, T_true, "best")
    relative = T_true @ jnp.linalg.inv(T)
    angles = jax.vmap(lambda G: rotation_errors(G @ T, T_true, "none"))(relative)
    shifts = jax.vmap(lambda G: translation_errors(G @ T, T_true, "none"))(relative)
    right = (angles < jnp.deg2rad(5.0)) & (shifts < 0.05)
    scale = length_scale(graph)
    margin = agreement(graph, T, scale) - agreement(graph, T_true, scale)
    share = jnp.max(jnp.mean(right, axis=1))
    return jnp.mean(rotation), jnp.mean(translation), share, margin


def run(method: AbstractAverager, cases: list, dtype: type) -> dict[str, float]:
    """Scores one method on all seeds."""
    rows, times = [], []
    for X, edges, T, bad in cases:
        graph = PoseGraph.from_edges(edges, T.astype(dtype), len(X))
        T_true = jnp.asarray(X.astype(dtype))
        kept = PoseGraph.from_edges(edges, T.astype(dtype), len(X), mask=~bad)
        oracle = average(kept, Correntropy(), init=T_true)
        base = judge(graph, oracle.T_world_i, T_true)
        solution = jax.block_until_ready(average(graph, method))
        begin = time.perf_counter()
        solution = jax.block_until_ready(average(graph, method))
        times.append(time.perf_counter() - begin)
        rows.append([*judge(graph, solution.T_world_i, T_true), base[0], base[1]])
    e_R, e_t, share, margin, o_R, o_t = np.array(rows, dtype=np.float64).T
    ok = (e_R < np.deg2rad(5)) & (e_t < 0.05)
    ratio = [np.nan, np.nan]
    if ok.any():
        ratio = [
            np.median(e_R[ok]) / np.median(o_R[ok]),
            np.median(e_t[ok]) / np.median(o_t[ok]),
        ]
    return {
        "success": 100 * ok.mean(),
        "as the truth": 100 * (ok | (margin > 0)).mean(),
        "frames": 100 * share.mean(),
        "e_R ratio": ratio[0],
        "e_t ratio": ratio[1],
        "ms": 1e3 * min(times),
    }


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--double", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", options.double)
    dtype = np.float64 if options.double else np.float32
    print(
        f"{'graph':8}{'outliers':>9} {'method':10}"
        + "".join(
            f"{x:>13}"
            for x in (
                "success",
                "as the truth",
                "frames",
                "e_R ratio",
                "e_t ratio",
                "ms",
            )
        )
    )
    for num, edges in SIZES:
        for share in SHARES:
            if num == 12 and share > 0.55:
                continue  # hardly any such graph is connected by its inliers
            cases = [random_graph(num, edges, share, s) for s in range(options.seeds)]
            for name, method in METHODS.items():
                scores = run(method, cases, dtype)
                print(
                    f"{num}:{edges:<5}{share:9.0%} {name:10}"
                    + "".join(f"{v:13.4g}" for v in scores.values()),
                    flush=True,
                )


if __name__ == "__main__":
    main()
