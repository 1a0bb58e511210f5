"""Readings of the MCC paper: what its Algorithm 1 leaves open, one at a time.

`docs/pages/readings.md` has the sentence that each rests on. They are tried on the
motions that `reconstruct` finds, and on motions drawn with the errors of Table II.
"""

from collections.abc import Iterator
from functools import partial
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from bench.case import Case, Judged, Method, Options
from bench.motion_scans import SETS, estimate
from bench.records import error
from bench.workloads.averaging_paper import (
    edge_sets,
    graphs,
    judge,
    motions_in_words,
)
from bench.workloads.local_pairs import written_out
from bench.workloads.table_two import TABLE_II, drawn_graphs
from jaxreg._core.arrays import traced
from jaxreg.averaging import (
    MCC,
    AbstractAverager,
    AveragingSolution,
    LowRankSparse,
    MotionAveraging,
    PoseGraphLM,
    SpanningTree,
    WeightedMotionAveraging,
    WeightRows,
    average,
    starting_poses,
)
from jaxreg.averaging.measures import frobenius, weighted_mean
from jaxreg.averaging.steps.iterate import averaging_step, iterate, solution_of
from jaxreg.averaging.steps.kernel_width import gaussian_trust
from jaxreg.averaging.steps.rows import RootRows
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from jaxreg.metrics import rotation_error, translation_error


#: Graphs drawn for each line of Table II.
GRAPHS = 20


class Reading(AbstractAverager):
    """Algorithm 1 with what `MCC` has settled left open.

    Attributes:
        mean: sigma is alpha times the mean of the errors (0), the root of the mean of
            their squares (1), or that mean itself (2).
        unit: the length that counts as a radian; zero for that of the graph.
        on_the_right: whether poses are updated as Eq. 21 prints it.
    """

    MEANS: ClassVar[tuple[str, ...]] = ("mean", "root mean square", "mean square")

    mean: Array | float = traced(0.0)
    unit: Array | float = traced(0.0)
    on_the_right: bool = eqx.field(static=True, default=False)

    @eqx.filter_jit
    def solve(
        self, graph: PoseGraph, init: Array | None, key: Array | None
    ) -> AveragingSolution:
        """Averages a prepared graph; no gradients."""
        own = graph.length_scale
        scale = jnp.where(jnp.asarray(self.unit) > 0, self.unit, own).astype(own.dtype)
        end = iterate(
            graph,
            starting_poses(LowRankSparse(), graph, init, key),
            jnp.full((2,), jnp.inf, own.dtype),
            eqx.Partial(_width, self.mean, scale),
            gaussian_trust,
            _step_on_the_right if self.on_the_right else averaging_step(RootRows()),
            max_steps=100,
            tolerance=1e-8,
        )
        return solution_of(graph, end)


def _width(
    mean: Array | float, scale: Array, g: PoseGraph, T: Array, _: Array
) -> Array:
    e = frobenius(g, T, scale)
    square = weighted_mean(e**2, g.weight)
    kinds = jnp.stack([weighted_mean(e, g.weight), jnp.sqrt(square), square])
    sigma = jnp.maximum(kinds[jnp.asarray(mean, int)], 64 * jnp.finfo(e.dtype).eps)
    return jnp.stack([sigma * scale, sigma / 2**0.5])


def _step_on_the_right(g: PoseGraph, T: Array, trust: Array, width: Array) -> Array:
    """T_world_i <- T_world_i exp(dm_i), where Eq. 14 needs exp(dm_i) T_world_i."""
    left = averaging_step(RootRows())(g, T, trust, width)
    return T @ (left @ lie.inverse(T))


class Row(NamedTuple):
    """A method, and whether its edges weigh their overlap."""

    method: AbstractAverager
    weighted: bool = False


#: From the poses of LRS, but where a row names another start.
ROWS = {
    "LRS": Row(LowRankSparse()),
    "G2O": Row(PoseGraphLM()),
    "MA": Row(MotionAveraging()),
    "wMA": Row(WeightedMotionAveraging(), weighted=True),
    "MCC": Row(MCC()),
    "MCC, rows by w": Row(MCC(rows=WeightRows())),
    "MCC, alpha = 1/2": Row(MCC(alpha=0.5)),
    "MCC, rows by w, alpha = 1/2": Row(MCC(alpha=0.5, rows=WeightRows())),
    "MCC, alpha = 2": Row(MCC(alpha=2.0)),
    "MCC, sigma from the root mean square": Row(Reading(mean=1.0)),
    "MCC, sigma from the mean square": Row(Reading(mean=2.0)),
    "MCC, a millimetre counts as a radian": Row(Reading(unit=1.0)),
    "MCC, update on the right": Row(Reading(on_the_right=True)),
    "MCC, stopped after 10 steps": Row(MCC(max_steps=10)),
    "MCC, 300 steps": Row(MCC(max_steps=300, tolerance=0.0)),
    "MCC, from a spanning tree": Row(MCC(initialiser=SpanningTree())),
}


def cases(options: Options) -> Iterator[Case]:
    """Drawn graphs for each object of Table II, then real motions."""
    drawn = {k: v for k, v in ROWS.items() if not v.weighted}
    for name in TABLE_II:
        found = drawn_graphs(name, GRAPHS)
        yield Case(
            name=f"Table II, {name}",
            data=f"{GRAPHS} graphs with errors drawn; {found.words}",
            methods=[_method(label, row) for label, row in drawn.items()],
            trials=[(g, g, _lrs(g)) for g in found.graphs],
            judge=partial(judge_drawn, found.T_world_i),
        )
    for name, (folder, scans, _) in SETS.items():
        if not (options.data / folder / scans).exists():
            continue
        motions = estimate(name, options.data, 0)
        for label in ("share", "all"):
            use = edge_sets(name, motions)[label]
            plain, weighted = graphs(motions, use)
            yield Case(
                name=f"{name}, {label} edges",
                data=motions_in_words(name, motions, use),
                methods=[_method(*both) for both in ROWS.items()],
                trials=[(plain, weighted, _lrs(plain))],
                judge=partial(judge, [motions], [use]),
                repeats=5,
            )


def _method(label: str, row: Row) -> Method:
    return Method(label, "jaxreg", written_out(row.method), partial(_solve, row))


def _lrs(graph: PoseGraph) -> Array:
    return average(graph, LowRankSparse()).T_world_i


def _solve(
    row: Row, plain: PoseGraph, weighted: PoseGraph, T_lrs: jax.Array
) -> np.ndarray:
    own_start = isinstance(getattr(row.method, "initialiser", None), SpanningTree)
    graph = weighted if row.weighted else plain
    found = average(graph, row.method, None if own_start else T_lrs)
    return np.asarray(found.T_world_i)


def judge_drawn(T_true: np.ndarray, answers: list[np.ndarray]) -> Judged:
    """Means of e_R and e_t over the graphs, with frame 0 in common."""
    true = jnp.asarray(T_true)
    both = [
        (
            rotation_error(T[: len(T_true)], true),
            translation_error(T[: len(T_true)], true),
        )
        for T in map(jnp.asarray, answers)
    ]
    e_R, e_t = np.mean(np.asarray(both, float), axis=0).tolist()
    return Judged([error("e_R", e_R, "rad", 2e-4), error("e_t", e_t, "mm", 0.02)])
