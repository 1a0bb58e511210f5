"""Good calls of every public function and constructor, and what honest answers are."""

import dataclasses
import inspect
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

import jaxreg as jr
from jaxreg import averaging, io, metrics, particle, robust
from jaxreg.particle import dynamics
from jaxreg.testing import problems


KEY = jax.random.key(0)
# Padded to the same size as a few points more or less.
SOURCE, TARGET = (x[:46].astype(np.float32) for x in problems.pair(3))
MOTIONS = problems.relative_motions(3, 0.035)[:-1].astype(np.float32)
EDGES = problems.EDGES[:-1]
POSES = problems.poses(3).astype(np.float32)
GRAPH = jr.PoseGraph.from_edges(EDGES, MOTIONS)


@dataclass(frozen=True)
class Call:
    """A call that ends well.

    Attributes:
        name: what is called.
        function: it, of keywords.
        arguments: good ones.
        wrong: what is wrong with an answer, None if nothing.
        dear: whether an answer has to be compiled.
    """

    name: str
    function: Callable[..., Any]
    arguments: dict[str, Any]
    wrong: Callable[[Any], str | None]
    dear: bool = False


def untrue(answer: Any) -> str | None:
    """What no answer may be: converged poses that are none."""
    for sol in answer if isinstance(answer, list) else [answer]:
        status = np.atleast_1d(np.asarray(sol.status))
        if not np.isin(status, list(jr.Status)).all():
            return f"status {status}"
        T = sol.T_target_source if hasattr(sol, "T_target_source") else sol.T_world_i
        T = np.asarray(T, np.float64).reshape(*status.shape, -1, *T.shape[-2:])
        good = T[status == jr.Status.CONVERGED]
        if not np.isfinite(good).all():
            return "CONVERGED, and poses that are not finite"
        gram = np.swapaxes(good, -1, -2)[..., :-1, :-1] @ good[..., :-1, :-1]
        if good.size and np.abs(gram - np.eye(gram.shape[-1])).max() > 1e-3:
            return "CONVERGED, and poses that are no motions"
        if not np.isfinite(T).all() and status.tolist() == [jr.Status.CONVERGED]:
            return "poses that are not finite"
    return None


def _not_finite(answer: Any) -> str | None:
    arrays = [x for x in jax.tree.leaves(answer) if eqx.is_inexact_array_like(x)]
    fine = all(np.isfinite(np.asarray(x)).all() for x in arrays)
    return None if fine else "numbers that are not finite"


def _anything(answer: Any) -> str | None:
    del answer
    return None


def _written(write: Callable[..., Any], read: Callable[[Path], Any], suffix: str):
    """A writer without its path: what it writes is read again."""

    def call(**arguments: Any) -> Any:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"a{suffix}"
            write(path, **arguments)
            try:
                return read(path)
            except io.InputError as err:
                return err

    return call


def _unreadable(answer: Any) -> str | None:
    """Of what was written: failed solutions are, too, and graphs without edges."""
    known = "not finite", "finite numbers", "holds no"
    message = str(answer) if isinstance(answer, io.InputError) else ""
    if message and not any(words in message for words in known):
        return f"wrote what it does not read: {answer}"
    return None


_SEARCH: dict[str, Any] = {
    "num_prior": 8,
    "num_particles": 4,
    "num_times": 1,
    "num_proposals": 0,
    "num_points": 16,
    "num_modes": 2,
    "max_points": 48,
    "batch_size": 16,
}
# What has no default.
_NEEDED: dict[type, dict[str, Any]] = {
    particle.GivenParticles: {"T_target_source": POSES},
    particle.PartialPose: {"up": (0.0, 0.0, 1.0), "position": (0.5, 0.1, 0.2)},
    jr.ScanPositions: {"position": np.zeros((3, 3), np.float32)},
    jr.RecursiveCheckpointAdjoint: {"checkpoints": 3},
    jr.KernelCorrelation: {"bandwidth": 0.25},
}
# Set by the methods themselves.
_INTERNAL = {"frames"}
_MODULES = (jr, robust, particle, dynamics, averaging)


def _classes() -> list[type]:
    """Methods and their parts."""
    found = {
        kind
        for module in _MODULES
        for kind in vars(module).values()
        if inspect.isclass(kind)
        and dataclasses.is_dataclass(kind)
        and not inspect.isabstract(kind)
        and (hasattr(kind, "described") or kind in _NEEDED)
    }
    return sorted(found, key=lambda kind: kind.__name__)


def _constructors() -> Iterator[Call]:
    for kind in _classes():
        arguments = {}
        for field in dataclasses.fields(kind):
            value = field.default
            if field.default_factory is not dataclasses.MISSING:
                value = field.default_factory()
            arguments[field.name] = value
        arguments |= _NEEDED.get(kind, {})
        arguments = {k: v for k, v in arguments.items() if k not in _INTERNAL}
        if arguments:
            yield Call(kind.__name__, kind, arguments, _unsound)
    good = {"d": 3, "num_particles": 8, "dynamics": None, "prior": None}
    good |= {"num_times": 2, "num_points": 16}
    yield Call("sandhu2010", jr.sandhu2010, good, _unsound)
    good = {"kind": jr.VoxelTable, "candidates": 4}
    yield Call("IndexOptions", jr.neighbours.IndexOptions, good, _anything)


def _unsound(made: Any) -> str | None:
    """What no method or part may hold, by the types of its defaults."""
    for field in dataclasses.fields(made):
        found, default = getattr(made, field.name), field.default
        if default is dataclasses.MISSING or default is None:
            continue
        fits = True
        if isinstance(default, bool):
            fits = isinstance(found, bool)
        elif isinstance(default, int) and not field.metadata.get("traced"):
            fits = isinstance(found, int | np.integer) and abs(found) < 2**31
            fits = fits and not isinstance(found, bool)
        elif field.metadata.get("traced"):  # more than one are for vmap
            fits = found is None or (
                isinstance(found, np.ndarray | jax.Array)
                and found.dtype.kind in "iuf"
                and not np.isnan(found).any()
            )
        if not fits:
            return f"{type(made).__name__}({field.name}={found!r})"
    return None


def _icp(**numbers: Any) -> jr.ICP:
    return jr.ICP(jr.PointToPoint(), max_steps=20, **numbers)


def _locally(source: Any, target: Any, init: Any, **others: Any) -> Any:
    names = ("max_correspondence_distance", "width_end", "tolerance")
    method = _icp(**{name: others.pop(name) for name in names})
    return jr.register(source, target, method, init, **others)


def _registrations() -> Iterator[Call]:
    eye = np.eye(4, dtype=np.float32)
    good = {"source": SOURCE, "target": TARGET, "init": eye}
    masks = {"source_mask": np.ones(46, bool), "target_mask": np.ones(46, bool)}
    numbers = {"max_correspondence_distance": 9.0, "width_end": 1.0, "tolerance": 1e-4}
    local = {**good, **masks, "key": KEY, "batch_size": 1}
    yield Call("register", _locally, {**local, **numbers}, untrue)
    far = {"source": SOURCE + np.float64(5e5), "target": TARGET - np.float64(3e6)}
    far["init"] = np.eye(4)
    far["init"][:3, 3] = -3.5e6
    yield Call("register far away", _locally, {**local, **far, **numbers}, untrue)
    aside = np.full(3, 9.0, np.float32)
    by = {"method": _icp(), "init": None, "progress": None, "viewpoints": [aside, None]}
    yield Call("register by", jr.register, {**local, **by}, untrue, dear=True)
    search = jr.ParticleFilter(**_SEARCH)
    free = {"source": SOURCE, "target": TARGET, "method": search, "key": KEY}
    name = "register without a guess"
    yield Call(name, jr.register, free, untrue, dear=True)
    many = {"method": _icp(), "batch_size": 1}
    pairs = {"source": [SOURCE, SOURCE[:44]], "target": [TARGET, TARGET]}
    lists = {**pairs, "init": np.stack([eye, eye]), **many}
    lists["viewpoints"] = [[aside, aside], np.stack([aside, -aside])]
    yield Call("register of lists", jr.register, lists, untrue, dear=True)
    batch = {"source": np.stack([SOURCE] * 2), "target": np.stack([TARGET] * 2)}
    name = "register of a batch"
    yield Call(name, jr.register, {**batch, **many}, untrue, dear=True)
    good = {"source": SOURCE, "target": TARGET, "T_target_source": eye, **masks}
    good["max_distance"] = 1.0
    yield Call("correspondences", jr.correspondences, good, _anything)


def _graphs() -> Iterator[Call]:
    weight = np.ones(len(EDGES), np.float32)
    yield Call(
        "PoseGraph.from_edges",
        jr.PoseGraph.from_edges,
        {
            "edges": EDGES,
            "T_i_j": MOTIONS,
            "num_poses": problems.NUM_POSES,
            "weight": weight,
            "information": np.tile(np.eye(6, dtype=np.float32), (len(EDGES), 1, 1)),
            "mask": np.ones(len(EDGES), bool),
        },
        _not_finite,
    )
    one = {"graph": GRAPH, "method": jr.Correntropy(), "init": POSES, "key": KEY}
    yield Call("average", jr.average, {**one, "batch_size": 1}, untrue, dear=True)
    several = {**one, "graph": [GRAPH, GRAPH], "init": [POSES, POSES]}
    yield Call("average of a list", jr.average, several, untrue, dear=True)

    def measured(T_i_j: Any, weight: Any, init: Any, tolerance: Any) -> Any:
        graph = jr.PoseGraph.from_edges(EDGES, T_i_j, problems.NUM_POSES, weight)
        return jr.average(graph, jr.MotionAveraging(tolerance=tolerance), init)

    good = {"T_i_j": MOTIONS, "weight": weight, "init": POSES, "tolerance": 1e-6}
    yield Call("from_edges and average", measured, good, untrue)
    for kind in (jr.Correntropy, jr.PoseGraphLM, jr.LowRankSparse):

        def by(T_i_j: Any, weight: Any, tolerance: Any, kind: Any = kind) -> Any:
            graph = jr.PoseGraph.from_edges(EDGES, T_i_j, problems.NUM_POSES, weight)
            return jr.average(graph, kind(tolerance=tolerance))

        good = {"T_i_j": MOTIONS, "weight": weight, "tolerance": 1e-6}
        yield Call(f"average by {kind.__name__}", by, good, untrue, dear=True)
    good = {"graph": GRAPH, "solution": jr.average(GRAPH, jr.SpanningTree())}
    yield Call("pose_covariances", jr.pose_covariances, good, _anything)
    some = {**good, "poses": [1, 0]}
    yield Call("pose_covariances of some", jr.pose_covariances, some, _anything)


def _reconstructions() -> Iterator[Call]:
    scans = [SOURCE, TARGET, SOURCE[:44]]
    method = _icp()
    good: dict[str, Any] = {
        "scans": scans,
        "key": KEY,
        "method": method,
        "averaging": jr.SpanningTree(),
        "viewpoints": [np.full(3, 9.0, np.float32), None, None],
        "positions": None,
        "order": "any",
        "previous": None,
        "hold_previous": False,
        "progress": None,
        "on_pairs": None,
    }
    yield Call("reconstruct", jr.reconstruct, good, untrue, dear=True)
    away = [scan + np.float64(1e6) for scan in scans]
    places = jr.ScanPositions(np.zeros((3, 3)), antenna=np.full((3, 3), 1e6 + 1))
    far = {**good, "scans": away, "method": jr.ParticleFilter(**_SEARCH)}
    far |= {"positions": places, "viewpoints": np.full((3, 3), 1e6 - 9)}
    far |= {"priors": [(1, np.eye(4))], "fixed": [(0, np.eye(4))]}
    far |= {"control": [(2, np.zeros(3), np.ones(3), np.eye(3))]}
    yield Call("reconstruct far away", jr.reconstruct, far, untrue, dear=True)
    padded = {**good, "scans": np.stack([SOURCE] * 3), "mask": np.ones((3, 46), bool)}
    del padded["viewpoints"]
    yield Call("reconstruct of an array", jr.reconstruct, padded, untrue, dear=True)


def _measures() -> Iterator[Call]:
    poses = {
        "T_world_i": POSES,
        "T_true_i": POSES,
        "align": "best",
        "mask": np.ones(problems.NUM_POSES, bool),
    }
    for function in (
        metrics.align_poses,
        metrics.rotation_errors,
        metrics.translation_errors,
        metrics.rotation_error,
        metrics.translation_error,
    ):
        yield Call(f"metrics.{function.__name__}", function, poses, _anything)
    good = {"T_world_i": POSES, "T_true_i": POSES, "delta": 2}
    yield Call("metrics.relative_errors", metrics.relative_errors, good, _anything)
    good = {"graph": GRAPH, "T_world_i": POSES}
    name = "metrics.chordal_objective"
    yield Call(name, metrics.chordal_objective, good, _anything)


def _files() -> Iterator[Call]:
    colors = np.linspace(0, 1, 3 * len(SOURCE)).reshape(-1, 3)
    cloud = {"points": SOURCE, "colors": colors}
    ids = np.arange(problems.NUM_POSES)
    graph = {"graph": GRAPH, "T_world_i": POSES, "ids": ids}
    timed = {"T_world_i": POSES, "timestamps": ids.astype(float)}
    for write, read, suffix, good in (
        (io.write_ply, io.read_points, ".ply", {**cloud, "binary": True}),
        (io.write_points, io.read_points, ".csv", cloud),
        (io.write_g2o, io.read_g2o, ".g2o", graph),
        (io.write_g2o, io.read_g2o_poses, ".g2o", graph),
        (io.write_tum, io.read_tum, ".tum", timed),
        (io.write_kitti, io.read_kitti, ".txt", {"T_world_i": POSES}),
        (io.write_log, io.read_log, ".log", {"graph": GRAPH}),
    ):
        again = _written(write, read, suffix)
        name = f"io.{write.__name__}, io.{read.__name__}"
        yield Call(name, again, good, _unreadable)
    yield Call("io.to_trimesh", io.to_trimesh, {"points": SOURCE}, _anything)
    good = {"geometry": io.to_trimesh(SOURCE)}
    yield Call("io.points_of", io.points_of, good, _anything)


def calls(dear: bool = True) -> list[Call]:
    """One of each; without those whose answers take long to compile if not `dear`."""
    found = [
        *(*_registrations(), *_graphs(), *_reconstructions(), *_measures()),
        *(*_files(), *_constructors()),
    ]
    return [call for call in found if dear or not call.dear]
