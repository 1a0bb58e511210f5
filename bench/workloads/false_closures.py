"""False loop closures in public pose graphs, as from places that look alike.

A share of the file's own closures is added: two random poses, with the motion and the
information of a true closure taken at random.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options
from bench.peers.pose_graphs import Found, robust
from bench.records import Metric, error
from bench.timing import within
from bench.workloads.local_pairs import written_out
from jaxreg.app.plot.figure import principal_axes, tilt
from jaxreg.averaging import (
    MCC,
    AbstractAverager,
    ChordalError,
    Correntropy,
    MotionAveraging,
    PoseGraphLM,
    average,
)
from jaxreg.graph import PoseGraph
from jaxreg.graph.trees import along_frames
from jaxreg.io.graphs.g2o import read_g2o
from jaxreg.metrics import (
    align_poses,
    chordal_objective,
    rotation_errors,
    translation_errors,
)
from tests.averaging.graphs import crooked_path


GRAPHS, SHARES, SEEDS = ("parking-garage", "intel"), (0.1, 0.3, 0.5), 3
#: A path that hardly resists: thirty closures, in no order.
PATH = "path of 300"
#: The share that the picture shows, and of how many poses and false closures.
DRAWN, POSES, CLOSURES = 0.3, 300, 60
#: Averagers, and whether they start at the odometry.
OWN: dict[str, tuple[AbstractAverager, bool]] = {
    "jaxreg MotionAveraging": (MotionAveraging(), False),
    "jaxreg PoseGraphLM": (PoseGraphLM(), False),
    "jaxreg MCC paper, from odometry": (MCC(), True),
    "jaxreg default, from odometry": (Correntropy(), True),
    "jaxreg default": (Correntropy(), False),
}
#: GTSAM's kernels, and what else it is told. Huber first, where Geman-McClure comes
#: alone, draws all poses together: 11 m off on intel.
PEERS = {
    "GTSAM Geman-McClure, from odometry": ("Geman-McClure", "no word on the odometry"),
    "GTSAM GNC, from odometry": ("GNC TLS", "the odometry is right"),
}
#: Calls that take minutes are given so many seconds, in a process of their own.
SLOW, PATIENCE = {("parking-garage", "GTSAM GNC, from odometry")}, 60.0


class Trial(NamedTuple):
    """A graph with false closures at the end."""

    graph: PoseGraph
    false: np.ndarray  # (e,)
    T_odometry: np.ndarray  # (v, d+1, d+1)


def cases(options: Options) -> Iterator[Case]:
    """A case per graph that is there and share of false closures."""
    for name, text, clean in _graphs(options):
        T_clean = average(clean, PoseGraphLM(ChordalError())).T_world_i
        for share in SHARES:
            trials = [with_false_closures(clean, share, seed) for seed in range(SEEDS)]
            num = int(trials[0].false.sum())
            yield Case(
                name=f"{name}, {share:.0%} false closures",
                data=f"{text}, {clean.num_poses} poses, "
                f"{int(closures(clean.edges).sum())} true closures and {num} false",
                methods=methods(name, clean),
                trials=[(trial,) for trial in trials],
                judge=partial(judge, clean, T_clean, trials, draw=share == DRAWN),
                reference="GTSAM Geman-McClure, from odometry",
                long=True,
            )


def _graphs(options: Options) -> Iterator[tuple[str, str, PoseGraph]]:
    """Name, what it is, and a graph: files that are there, and a path."""
    for name in GRAPHS:
        path = options.data / "pose_graphs" / f"{name}.g2o"
        if path.exists():
            yield name, path.name, read_g2o(path)
    yield PATH, "generated path", crooked_path(0, 300, 30, 0, told=True)[0]


def closures(edges: Any) -> np.ndarray:
    """Which edges are not between successive poses."""
    i, j = np.asarray(edges).T
    return np.abs(i - j) != 1


def with_false_closures(clean: PoseGraph, share: float, seed: int) -> Trial:
    """Adds that share of the true closures."""
    rng = np.random.default_rng([round(100 * share), seed])
    edges = np.asarray(clean.edges)
    true = np.flatnonzero(closures(edges))
    count = round(share * len(true))
    # At least a twentieth of the path apart.
    i, j = np.triu_indices(clean.num_poses, clean.num_poses // 20)
    pairs = np.stack([i, j], axis=1)[rng.choice(len(i), count, replace=False)]
    rows = np.concatenate([np.arange(len(edges)), rng.choice(true, count)])
    information = clean.information
    assert information is not None  # g2o files have it
    graph = PoseGraph.from_edges(
        np.concatenate([edges, pairs]),
        clean.T_i_j[rows],
        clean.num_poses,
        information=information[rows],
    )
    return Trial(graph, np.arange(len(rows)) >= len(edges), odometry(clean))


_chain = jax.jit(along_frames)


def odometry(graph: PoseGraph) -> np.ndarray:
    """Poses along the edges between successive frames."""
    return np.asarray(_chain(graph), float)


def methods(graph: str, clean: PoseGraph) -> list[Method]:
    """The odometry, averagers of jaxreg, GTSAM, and the clean optimum."""
    own = [
        Method(name, "jaxreg", written_out(method), partial(_own, method, started))
        for name, (method, started) in OWN.items()
    ]
    peers = [
        Method(
            name,
            "gtsam",
            f"information of the file; {text}",
            partial(within, PATIENCE, _gtsam, k)
            if (graph, name) in SLOW
            else partial(_gtsam, k),
        )
        for name, (k, text) in PEERS.items()
    ]
    optimum = PoseGraphLM(ChordalError())
    return [
        Method("odometry", "jaxreg", "successive edges chained", _odometry),
        *own,
        *peers,
        Method(
            "jaxreg PoseGraphLM, without the false ones",
            "jaxreg",
            written_out(optimum),
            lambda _: Found(np.asarray(average(clean, optimum).T_world_i), None),
        ),
    ]


def _odometry(trial: Trial) -> Found:
    return Found(odometry(trial.graph), None)


def _own(method: AbstractAverager, from_odometry: bool, trial: Trial) -> Found:
    init = jnp.asarray(trial.T_odometry) if from_odometry else None
    found = average(trial.graph, method, init)
    # The others trust all edges alike.
    tells = isinstance(method, MCC | Correntropy)
    weight = np.asarray(found.edge_weight) if tells else None
    return Found(np.asarray(found.T_world_i), weight)


def _gtsam(kernel: str, trial: Trial) -> Found:
    graph = trial.graph
    edges = np.asarray(graph.edges)
    return robust(
        edges,
        np.asarray(graph.T_i_j),
        graph.num_poses,
        kernel=kernel,
        information=np.asarray(graph.information),
        T_start=trial.T_odometry,
        right=np.flatnonzero(~closures(edges)).tolist(),
    )


def judge(
    clean: PoseGraph,
    T_clean: jax.Array,
    trials: list[Trial],
    answers: list[Found],
    *,
    draw: bool,
) -> Judged:
    """Distance from the clean optimum; the worst seed's counts of closures."""
    best, rows, counts = chordal_objective(clean, T_clean), [], []
    for trial, (T, weight) in zip(trials, answers, strict=True):
        T = jnp.asarray(T)
        shift = translation_errors(T, T_clean, "best")
        turn = rotation_errors(T, T_clean, "best")
        ratio = chordal_objective(clean, T) / best
        rows.append([*(float(jnp.mean(x)) for x in (shift, turn)), float(ratio),
                     float(jnp.max(shift))])  # fmt: skip
        if weight is not None:
            true = ~trial.false & closures(trial.graph.edges)
            trusted = weight > 0.5
            counts.append([np.sum(trusted & trial.false), np.sum(~trusted & true)])
    e_t, e_R, ratio, _ = np.median(rows, axis=0).tolist()
    metrics = [
        error("e_t", e_t, "m", 0.005),
        Metric("e_t_max", max(row[-1] for row in rows), "m", "down"),
        error("e_R", e_R, "rad", 5e-4),
        Metric("ratio", ratio, "", "down", max(0.1 * (ratio - 1), 1e-2)),
    ]
    if counts:
        false, true = np.max(counts, axis=0).tolist()
        metrics += [
            Metric("false trusted", false, "", "down", 2.0),
            Metric("true lost", true, "", "down", 0.01 * len(clean.edges)),
        ]
    picture = seen(T_clean, trials[0], answers[0]) if draw else {}
    return Judged(metrics, {"e_t": [row[0] for row in rows], **picture})


def seen(T_clean: jax.Array, trial: Trial, found: Found) -> dict[str, list[float]]:
    """For the picture: some of the positions, seen from where the clean ones spread."""
    clean = _positions(np.asarray(T_clean))
    turn, centre = np.eye(3), clean.mean(axis=0)
    if clean[:, 2].any():
        turn, centre = principal_axes(clean)
        # Most trajectories are flat: look down on them at an angle.
        turn = tilt(35.0, 0.0) @ turn[[1, 2, 0]]
    T = align_poses(jnp.asarray(found.T_world_i), T_clean, "best")
    step = -(-len(clean) // POSES)
    x, y, _ = turn @ (_positions(np.asarray(T)) - centre)[::step].T
    false = np.asarray(trial.graph.edges)[trial.false]
    some = false[:: max(1, len(false) // CLOSURES)] // step
    return {"x": x.tolist(), "y": y.tolist(), "false": some.ravel().tolist()}


def _positions(T: np.ndarray) -> np.ndarray:
    t = T[:, :-1, -1]
    return np.pad(t, [(0, 0), (0, 3 - t.shape[1])])
