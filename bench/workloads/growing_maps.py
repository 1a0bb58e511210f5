"""The cost of a few more poses, or scans, on a map that was made before."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.pose_graphs import Found
from bench.records import Metric, error
from bench.workloads.averaging_data import large_graph
from bench.workloads.large_graphs import judge
from bench.workloads.local_pairs import written_out
from bench.workloads.many_scans import SHARES, Replayed, street
from jaxreg import ReconstructionSolution, ScanSet, reconstruct
from jaxreg.averaging import AveragingSolution, Correntropy, average
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_errors, translation_errors


#: Poses before, and those that are added.
OLD, MORE = 1_000, 10


def cases(options: Options) -> Iterator[Case]:
    """Poses without wrong edges, and with; scans that join others, which stay."""
    del options
    for outliers in (0.0, 0.1):
        yield _case(outliers)
    yield _of_scans()


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


def _of_scans() -> Case:
    """Prepared scans of a street; the search is replayed."""
    scans, T_world_i, place = street(OLD + MORE)
    text = "reconstruct of a ScanSet, pairs replayed"
    own = {
        "held": partial(_held, scans, T_world_i, place),
        "alone": partial(_few, scans[OLD:], T_world_i[OLD:], place[OLD:]),
    }
    return Case(
        name=f"{MORE} scans on {OLD}, which stay",
        data=f"generated street, scans of {scans.shape[1]} points",
        methods=[Method(k, "jaxreg", text, prepare=make) for k, make in own.items()],
        trials=[()],
        judge=partial(_judge_scans, T_world_i),
        repeats=5,
        reference="alone",
    )


def _held(
    scans: np.ndarray, T_world_i: np.ndarray, place: np.ndarray
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """The last scans join a map of the others."""
    old = Replayed.of(scans[:OLD], T_world_i[:OLD], place[:OLD], SHARES["street"])
    every = Replayed.of(scans, T_world_i, place, SHARES["street"])
    before = ScanSet.of(scans[:OLD])
    previous = _reconstructed(before, old)
    told = {"previous": previous, "hold_previous": True}
    return partial(_answer, before.joined(scans[OLD:]), every, told)


def _few(
    scans: np.ndarray, T_world_i: np.ndarray, place: np.ndarray
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """A map of few scans."""
    replayed = Replayed.of(scans, T_world_i, place, SHARES["street"])
    return partial(_answer, ScanSet.of(scans), replayed, {})


def _answer(
    scans: ScanSet, replayed: Replayed, told: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    found = _reconstructed(scans, replayed, **told)
    return np.asarray(found.T_world_i), np.asarray(found.placed)


def _reconstructed(
    scans: ScanSet, replayed: Replayed, **told: Any
) -> ReconstructionSolution:
    return reconstruct(scans, key=jax.random.key(0), executor=replayed, **told)


def _judge_scans(
    T_world_i: np.ndarray, answers: list[tuple[np.ndarray, np.ndarray]]
) -> Judged:
    """Of the last scans, in the best frame of all."""
    (T, placed), late = answers[0], slice(-MORE, None)
    told = jnp.asarray(T), jnp.asarray(T_world_i[-len(T) :], jnp.float32)
    degrees = np.rad2deg(rotation_errors(*told, "best"))[late]
    shift = np.asarray(translation_errors(*told, "best"))[late]
    return Judged(
        [
            error("e_rot", float(degrees.mean()), "deg", 0.01),
            error("e_trans", float(shift.mean()), "", 0.01),
            Metric("placed", float(placed[late].mean()), "", "up"),
        ]
    )
