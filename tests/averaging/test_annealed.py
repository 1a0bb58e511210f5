"""Which descent follows which, and which end is kept."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg import Status
from jaxreg.averaging import average
from jaxreg.averaging.likelihood import Explained
from jaxreg.averaging.methods import annealed
from jaxreg.averaging.steps.iterate import Iterated
from jaxreg.averaging.trace import AveragingTrace, no_rows
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import crooked_path, motions, random_graph, rotations


WIDTHS, SETTLING = annealed._SETTLING, annealed._SETTLING
GOING_ON, DONE = annealed._GOING_ON, annealed._DONE


def _end(mark: float) -> Iterated:
    steps = jnp.asarray(1, jnp.int32)
    return Iterated(
        T_world_i=jnp.full((2, 4, 4), mark),
        trust=jnp.full(1, mark),
        width=jnp.full(2, mark),
        converged=jnp.asarray(True),
        num_steps=steps,
        trace=AveragingTrace.of(no_rows(4, jnp.zeros(0).dtype), steps),
    )


def _told(log_ratio: float, deviation: float) -> Explained:
    return Explained(jnp.asarray(log_ratio), jnp.asarray(deviation), jnp.zeros(1))


def _before(stage: int) -> annealed._Descended:
    low, start = jnp.asarray(-1.0), _end(1.0)
    known = annealed._Start(low, start.trust, start.T_world_i, low, start.width)
    least = jnp.asarray(10.0)
    return annealed._Descended(jnp.asarray(stage), least, known, start, low)


@pytest.mark.parametrize(
    ("stage", "log_ratio", "next_stage", "kept"),
    [
        (0, 9.0, 1, 2.0),  # the first width loses: half of it
        (0, 11.0, SETTLING, 2.0),
        (WIDTHS - 1, 9.0, SETTLING, 2.0),  # there is no narrower one
        (SETTLING, 11.0, DONE, 2.0),
        (SETTLING, 9.0, GOING_ON, 1.0),  # settling blurs: from the end before
        (GOING_ON, 9.0, DONE, 2.0),
    ],
)
def test_a_descent_that_loses_likelihood_is_followed_by_another(
    stage, log_ratio, next_stage, kept
):
    before = _before(stage)
    told = _told(log_ratio, 0.1)
    after = before.followed_by(_end(2.0), told, told)
    assert int(after.stage) == next_stage
    np.testing.assert_array_equal(after.end.trust, [kept])
    np.testing.assert_array_equal(after.end.width, [kept, kept])
    opening = stage < SETTLING
    assert int(after.end.num_steps) == (1 if opening or kept == 1 else 2)


@pytest.mark.parametrize(("plain", "kept"), [(6.0, 2.0), (4.0, 1.0)])
def test_kernels_narrow_from_the_likelier_of_the_start_and_plain_steps(plain, kept):
    # Edges do not count here: nothing is expected to be lost by chance.
    nothing = _told(5.0, 0.1)._replace(log_odds=jnp.full(1, -jnp.inf))
    alone, scale = _told(1.0, 0.25), jnp.asarray(2.0)
    first = _before(annealed._JUDGING).judged(_end(1.0), nothing, alone, scale)
    assert int(first.stage) == annealed._PLAIN
    then = nothing._replace(log_ratio=jnp.asarray(plain))
    after = first.judged(_end(2.0), then, _told(9.0, 0.5), scale)
    assert int(after.stage) == 0
    np.testing.assert_array_equal(after.start.T_world_i, np.full((2, 4, 4), kept))
    assert float(after.least) == max(plain, 5.0)
    # Three deviations and half an octave, of the poses that are kept.
    width = 3 * 2**0.5 * (0.25 if kept == 1 else 0.5)
    np.testing.assert_allclose(after.start.width, [2 * width, width], rtol=1e-6)
    # Of the start itself, whichever is kept.
    assert float(after.start.evidence) == 1
    np.testing.assert_array_equal(after.start.right, [0.5])


def test_few_right_closures_of_a_short_path_are_trusted():
    # Five of six steps hold all but exactly: they tell little about the noise.
    graph, _ = crooked_path(0, 60, 10, 0, told=False)
    assert np.asarray(average(graph).edge_weight > 0.5).all()


def test_translations_of_a_short_path_are_not_taken_for_exact():
    # 29 edges hold 23 poses: turns can be a little off so that no translation is.
    widths = []
    for seed in range(3):
        found = average(crooked_path(seed, 24, 6, 2, told=False)[0])
        assert found.status == Status.CONVERGED
        widths.append(found.kernel_width)
    three_deviations = [3 * 0.01, 3 * 0.009]
    ratio = np.median(widths, axis=0) / three_deviations
    assert ((ratio > 0.5) & (ratio < 2)).all()


def test_precise_translations_of_many_edges_stay_precise():
    # One edge more cannot say that they are as bad as turns.
    X, edges, _, _ = random_graph(20, 150, 0.0, 3)
    rng = np.random.default_rng(0)
    T = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]]
    T = T @ motions(rotations(rng, 150, 3, 0.05), 0.02 * rng.normal(size=(150, 3)))
    graph = PoseGraph.from_edges(edges, T.astype(np.float32), 20)
    width = average(graph).kernel_width
    np.testing.assert_allclose(width, [3 * 0.02, 3 * 0.05], rtol=0.1)
