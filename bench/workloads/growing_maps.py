"""The cost of a few more poses on a graph that was averaged before."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.pose_graphs import Found
from bench.workloads.averaging_data import large_graph
from bench.workloads.large_graphs import judge
from bench.workloads.local_pairs import written_out
from jaxreg.averaging import AveragingSolution, Correntropy, average
from jaxreg.graph import PoseGraph


#: Poses before, and those that are added.
OLD, MORE = 1_000, 10


def cases(options: Options) -> Iterator[Case]:
    """Without wrong edges, and with."""
    for outliers in (0.0,) if options.quick else (0.0, 0.1):
        yield _case(outliers)


def _case(outliers: float) -> Case:
    num = OLD + MORE
    X, edges, T, wrong = large_graph(num, outliers, seed=0)
    late = np.any(edges >= OLD, axis=1)
    order = np.argsort(late, kind="stable")
    edges, T, wrong, late = edges[order], T[order], wrong[order], late[order]
    among = np.all(edges >= OLD, axis=1) & ~wrong
    whole = _graph(edges, T, num)
    alone = _graph(edges[among] - OLD, T[among], MORE)
    previous = average(_graph(edges[~late], T[~late], OLD))
    text = written_out(Correntropy())
    own = {
        "added": partial(_own, whole, previous),
        "alone": partial(_alone, alone),
        "anew": partial(_own, whole, None),
    }
    return Case(
        name=f"{MORE} poses on {OLD}, {outliers:.0%} of the edges wrong",
        data=f"generated graph, {len(edges)} edges",
        methods=[Method(k, "jaxreg", text, solve) for k, solve in own.items()],
        trials=[()],
        judge=partial(_judge, X, wrong),
        repeats=20,
        reference="alone",
    )


def _graph(edges: np.ndarray, T: np.ndarray, num: int) -> PoseGraph:
    information = np.diag(np.repeat([1 / 0.02**2, 1 / np.deg2rad(1.0) ** 2], 3))
    information = np.broadcast_to(information, (len(edges), 6, 6)).astype(np.float32)
    return PoseGraph.from_edges(edges, T.astype(np.float32), num, None, information)


def _own(graph: PoseGraph, previous: AveragingSolution | None) -> Found:
    found = average(graph, previous=previous)
    return Found(np.asarray(found.T_world_i), np.asarray(found.edge_weight))


def _alone(graph: PoseGraph) -> None:
    np.asarray(average(graph).T_world_i)


def _judge(X: np.ndarray, wrong: np.ndarray, answers: list[Found | None]) -> Judged:
    return judge(X, wrong, answers) if answers[0] is not None else Judged([])
