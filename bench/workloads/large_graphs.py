"""Cost against the number of poses, with and without wrong closures."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from bench.averaging_scale import large_graph
from bench.case import Case, Judged, Method, Options
from bench.peers.pose_graphs import large_lm
from bench.records import error
from bench.workloads.local_pairs import written_out
from jaxreg.averaging import AbstractAverager, Correntropy, PoseGraphLM, average
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_errors, translation_errors


SIZES = (1_000, 3_000, 10_000)


def cases(options: Options) -> Iterator[Case]:
    """A case per size and share of wrong closures."""
    for num in (1_000,) if options.quick else SIZES:
        for outliers in (0.0,) if options.quick else (0.0, 0.1):
            X, edges, T, _ = large_graph(num, outliers, seed=0)
            d = np.deg2rad(1.0)
            information = np.diag(np.repeat([1 / 0.02**2, 1 / d**2], 3))
            information = np.broadcast_to(information, (len(edges), 6, 6))
            graph = PoseGraph.from_edges(edges, T, num, None, information)
            own: dict[str, AbstractAverager] = {}
            if not options.quick:
                own["jaxreg default"] = Correntropy()
            if not outliers:
                own["jaxreg PoseGraphLM"] = PoseGraphLM()
            methods = [
                Method(
                    k, "jaxreg", written_out(m), partial(_own, m, graph),
                    on_accelerator=True,
                )
                for k, m in own.items()
            ]  # fmt: skip
            text = "chordal relaxation, then LM, the true deviations"
            peer = partial(large_lm, edges, T, num, d, 0.02)
            yield Case(
                name=f"{num} poses, {outliers:.0%} of the edges wrong",
                data=f"generated graph, {len(edges)} edges",
                methods=[*methods, Method("GTSAM LM", "gtsam", text, prepare=peer)],
                trials=[()],
                judge=partial(judge, X),
                repeats=5,
                reference="GTSAM LM",
                x=num,
                x_label=f"poses, {outliers:.0%} of the edges wrong",
            )


def _own(method: AbstractAverager, graph: PoseGraph) -> np.ndarray:
    return np.asarray(average(graph, method).T_world_i)


def judge(X: np.ndarray, answers: list[Any]) -> Judged:
    """Mean errors in the best common frame; lengths in the distance of poses."""
    T, true = jnp.asarray(answers[0]), jnp.asarray(X)
    degrees = float(np.rad2deg(rotation_errors(T, true, "best")).mean())
    shift = float(translation_errors(T, true, "best").mean())
    return Judged(
        [error("e_rot", degrees, "deg", 0.01), error("e_trans", shift, "steps", 0.01)]
    )
