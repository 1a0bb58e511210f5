"""Cost against the number of poses, with and without wrong closures."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.pose_graphs import Found, large_lm, robust
from bench.records import Metric, error
from bench.workloads.averaging_data import large_chain, large_graph
from bench.workloads.false_closures import odometry
from bench.workloads.local_pairs import written_out
from jaxreg.averaging import AbstractAverager, Correntropy, PoseGraphLM, average
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_errors, translation_errors


#: Poses, by the share of the edges that are wrong.
SIZES = {
    0.0: (1_000, 3_000, 10_000),
    0.1: (1_000, 3_000, 10_000, 100_000, 1_000_000),
}
CHAINS = (100_000, 1_000_000)
#: Poses from which on a graph is float32, as of a million it takes twice the memory
#: else, and is solved once.
_SINGLE = 1_000_000
#: Wrong closures fill the factors of GTSAM's elimination: a call of LM takes 3 s at
#: 1,000 poses, 68 s and 1 GB at 3,000; one of GNC 40 s at 1,000.
LARGEST_LM, LARGEST_GNC = {0.0: 10_000, 0.1: 3_000}, {0.0: 0, 0.1: 1_000}


def cases(options: Options) -> Iterator[Case]:
    """A case per share of wrong closures and size."""
    sizes = {0.0: (1_000,)} if options.quick else SIZES
    for outliers, nums in sizes.items():
        for num in nums:
            yield _case(num, outliers, quick=options.quick)
    for num in () if options.quick else CHAINS:
        yield _chain_case(num)


def _chain_case(num: int) -> Case:
    X, edges, T, wrong = large_chain(num, seed=0)
    graph = _graph(num, edges, T, degrees=0.1, shift=0.002)
    method = Correntropy()
    own = partial(_own, method, graph)
    text = written_out(method)
    return Case(
        name=f"a chain of {num} poses, 1% closures, a tenth of them wrong",
        data=f"generated graph, {len(edges)} edges",
        methods=[Method("jaxreg default", "jaxreg", text, own, on_accelerator=True)],
        trials=[()],
        judge=partial(judge, X, wrong),
        repeats=3,
        long=True,
        once=num >= _SINGLE,
        x=num,
        x_label="poses of a chain, 1% closures, a tenth of them wrong",
    )


def _graph(
    num: int, edges: np.ndarray, T: np.ndarray, *, degrees: float, shift: float
) -> PoseGraph:
    """With the information of noise of these deviations."""
    T = T.astype(np.float32) if num >= _SINGLE else T
    each = np.repeat([shift**-2, np.deg2rad(degrees) ** -2], 3)
    information = np.broadcast_to(np.diag(each).astype(T.dtype), (len(edges), 6, 6))
    return PoseGraph.from_edges(edges, T, num, None, information)


def _case(num: int, outliers: float, *, quick: bool) -> Case:
    X, edges, T, wrong = large_graph(num, outliers, seed=0)
    d = np.deg2rad(1.0)
    graph = _graph(num, edges, T, degrees=1.0, shift=0.02)
    own: dict[str, AbstractAverager] = {}
    if not quick:
        own["jaxreg default"] = Correntropy()
    if not outliers:
        own["jaxreg PoseGraphLM"] = PoseGraphLM()
    methods = [
        Method(
            k, "jaxreg", written_out(m), partial(_own, m, graph), on_accelerator=True
        )
        for k, m in own.items()
    ]
    peer = num <= LARGEST_LM[outliers]
    if peer:
        text = "chordal relaxation, then LM, the true deviations"
        solver = partial(large_lm, edges, T, num, d, 0.02)
        methods.append(Method("GTSAM LM", "gtsam", text, prepare=solver))
    if num <= LARGEST_GNC[outliers]:
        text = "from the path, the true deviations; the path is right"
        information = np.asarray(graph.information)
        solve = partial(_gnc, edges, T, num, information, odometry(graph))
        methods.append(Method("GTSAM GNC", "gtsam", text, solve))
    # Of those that take a minute.
    long = outliers > 0 and num != 10_000
    return Case(
        name=f"{num} poses, {outliers:.0%} of the edges wrong",
        data=f"generated graph, {len(edges)} edges",
        methods=methods,
        trials=[()],
        judge=partial(judge, X, wrong),
        repeats=3 if long else 5,
        reference="GTSAM LM" if peer else "",
        long=long,
        once=num >= _SINGLE,
        x=num,
        x_label=f"poses, {outliers:.0%} of the edges wrong",
    )


def _own(method: AbstractAverager, graph: PoseGraph) -> Found:
    found = average(graph, method)
    # Without a kernel all edges are trusted.
    tells = isinstance(method, Correntropy)
    weight = np.asarray(found.edge_weight) if tells else None
    return Found(np.asarray(found.T_world_i), weight)


def _gnc(
    edges: np.ndarray,
    T: np.ndarray,
    num: int,
    information: np.ndarray,
    T_start: np.ndarray,
) -> Found:
    return robust(
        edges,
        T,
        num,
        kernel="GNC TLS",
        information=information,
        T_start=T_start,
        right=range(num - 1),  # the path comes first
    )


def judge(X: np.ndarray, wrong: np.ndarray, answers: list[Any]) -> Judged:
    """Mean errors in the best common frame; lengths in the distance of poses."""
    T_world_i, weight = answers[0]
    T, true = jnp.asarray(T_world_i), jnp.asarray(X)
    degrees = float(np.rad2deg(rotation_errors(T, true, "best")).mean())
    shift = float(translation_errors(T, true, "best").mean())
    metrics = [
        error("e_rot", degrees, "deg", 0.01),
        error("e_trans", shift, "steps", 0.01),
    ]
    if weight is not None:
        trusted, few = weight > 0.5, 1e-3 * len(wrong)
        kept, lost = int(np.sum(trusted & wrong)), int(np.sum(~trusted & ~wrong))
        metrics += [
            Metric("wrong trusted", kept, "", "down", few),
            Metric("right lost", lost, "", "down", few),
        ]
    return Judged(metrics)
