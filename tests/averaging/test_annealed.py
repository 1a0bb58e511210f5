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
    before = annealed._Descended(
        jnp.asarray(stage, jnp.int32), jnp.asarray(10.0), _end(1.0)
    )
    told = Explained(jnp.asarray(log_ratio), jnp.asarray(0.1), jnp.zeros(1))
    after = before.followed_by(_end(2.0), told)
    assert int(after.stage) == next_stage
    np.testing.assert_array_equal(after.end.trust, [kept])
    np.testing.assert_array_equal(after.end.width, [kept, kept])
    opening = stage < SETTLING
    assert int(after.end.num_steps) == (1 if opening or kept == 1 else 2)


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
