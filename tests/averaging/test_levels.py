"""Levels: what points up in some frames is known, and no more of them."""

import functools
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg import Status
from jaxreg.averaging import (
    MotionAveraging,
    SpanningTree,
    average,
    edge_report,
    pose_covariances,
)
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import random_graph


NUM, SIGMA = 12, 2e-3
WRONG = [1, 4, 7]


def ups(X: np.ndarray, rng: np.random.Generator, sigma: float) -> np.ndarray:
    """What points up in each frame, with noise."""
    tilt = np.pad(sigma * rng.normal(size=(len(X), 2)), ((0, 0), (0, 1)))
    seen = np.array([0.0, 0, 1]) + np.cross(tilt, [0.0, 0, 1])
    return np.einsum("vij,vi->vj", X[:, :3, :3], seen)


class Case:
    """A graph, of whose frames levels and the places of two are known."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.X, edges, T_i_j, _ = random_graph(NUM, 36, 0.0, 3)
        up = 3 * ups(self.X, rng, SIGMA)
        up[WRONG] += rng.normal(size=(3, 3))
        self.levels = [(i, up[i], SIGMA) for i in range(NUM)]
        self.graph = PoseGraph.from_edges(edges, T_i_j.astype(np.float32))

    def points(self, *frames: int, at: Any = 0.0) -> list[Any]:
        lies = self.X[list(frames), :3, 3] + 0.01 * np.array(at)
        each = zip(frames, lies, strict=True)
        return [(i, np.zeros(3), q, 1e4 * np.eye(3)) for i, q in each]


@pytest.fixture(scope="module")
def case() -> Case:
    return Case()


def test_levels_and_two_places_hold_a_frame_and_wrong_levels_are_told(case: Case):
    told = {"control": case.points(2, 9), "levels": case.levels}
    sol = average(case.graph, SpanningTree(), **told)
    assert sol.status == Status.CONVERGED
    weight = np.asarray(sol.prior_weight)
    assert np.flatnonzero(weight < 0.5).tolist() == [2 + n for n in WRONG]
    assert np.all(weight[[2 + n for n in WRONG]] < 1e-6)
    away = np.linalg.norm((np.asarray(sol.T_world_i) - case.X)[:, :3, 3], axis=1)
    assert away.max() < 0.06
    tilt = np.linalg.norm((np.asarray(sol.T_world_i) - case.X)[:, 2, :3], axis=1)
    assert np.median(tilt) < 2 * SIGMA

    report = edge_report(case.graph, sol, **told)
    rows = report.edges[-NUM:]
    assert rows.tolist() == [[-1, i] for i in range(NUM)]
    # Two components each; six of every pose are free.
    wanted = 6 * 36 + 3 * 2 + 2 * (NUM - len(WRONG)) - 6 * NUM
    assert report.degrees_of_freedom == wanted
    covariance = np.asarray(pose_covariances(case.graph, sol, **told))
    assert np.all(np.linalg.eigvalsh(covariance)[:, 0] > 0)
    some = np.asarray(pose_covariances(case.graph, sol, poses=[3], **told))[0]
    np.testing.assert_allclose(some, covariance[3], atol=1e-3 * covariance[3].max())
    deviation = np.sqrt(covariance[0].diagonal())
    across = case.X[0, 2, :3]
    by_up = across @ covariance[0, 3:, 3:] @ across
    assert by_up > covariance[0, 3:, 3:].trace() / 2  # heading is known least
    assert deviation.max() < 0.1


def test_levels_leave_a_turn_about_the_vertical_free(case: Case):
    one, other = case.points(2, 9)
    # In line but for a ten thousandth, which says nothing of the turn.
    above = (2, np.array(case.X[2, 2, :3]), one[2] + [1e-4, 0, 1], 1e4 * np.eye(3))
    told = {"control": [one, above], "levels": case.levels}
    sol = average(case.graph, SpanningTree(), **told)
    assert sol.status == Status.DEGENERATE


def test_levels_of_which_half_contradict_the_rest_are_not_believed(case: Case):
    flat = np.array(case.X[:, 2, :3])
    flat[NUM // 2 :] = case.X[NUM // 2 :, 0, :3]  # what lies along x
    levels = [(i, flat[i], SIGMA) for i in range(NUM)]
    told = {"control": case.points(2, 9), "levels": levels}
    sol = average(case.graph, SpanningTree(), **told)
    assert sol.status == Status.NO_AGREEMENT


def test_levels_are_adjusted_to_at_once_with_the_motions_and_followed():
    with jax.enable_x64(True):
        rng = np.random.default_rng(1)
        X, edges, T_i_j, _ = random_graph(5, 8, 0.0, 1, noise=2.0)
        weigh = np.broadcast_to(900 * np.eye(6), (8, 6, 6))
        graph = PoseGraph.from_edges(edges, T_i_j, information=weigh)
        deviation = 0.05
        up = ups(X, rng, deviation)
        frames = [1, 2, 3]
        across = np.cross(up[2], [0.3, -0.5, 0.8]) * 1e-3

        @jax.jit
        @functools.partial(jax.value_and_grad, has_aux=True)
        def place(s: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            """Of a frame, as one direction turns; and the poses and trust."""
            seen = [up[i] + (s * across if i == 2 else 0) for i in frames]
            levels = [(i, u, deviation) for i, u in zip(frames, seen, strict=True)]
            how = {"fixed": [(0, X[0])], "levels": levels}
            sol = average(graph, MotionAveraging(), **how)
            assert sol.prior_weight is not None
            return sol.T_world_i[2, 2, 0], (sol.T_world_i, sol.prior_weight)

        (_, (T, trust)), slope = place(0.0)

        @jax.jit
        def linearised(T: jax.Array, trust: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Errors of poses beside the answer, written anew, in deviations."""

            def errors(x: jax.Array) -> tuple[jax.Array, jax.Array]:
                moved = T.at[1:].set(T[1:] @ lie.exp(x.reshape(4, 6)))
                seen = jnp.einsum(
                    "nij,nj->ni", moved[np.array(frames), :3, :3], up[1:4]
                )
                angle = jnp.arctan2(jnp.linalg.norm(seen[:, :2], axis=1), seen[:, 2])
                level = jnp.sqrt(trust) * angle / deviation
                edge = 30 * graph.tangent_errors(moved)
                out = jnp.concatenate([edge.ravel(), level])
                return out, out

            return jax.jacfwd(errors, has_aux=True)(jnp.zeros(24))

        J, r = (np.asarray(x) for x in linearised(T, trust))
        # The step of Gauss and Newton that is left.
        np.testing.assert_allclose(np.linalg.lstsq(J, r)[0], 0, atol=1e-4)

        # By a direction the answer changes as much as differences say, trust held.
        change = float(place(1.0)[0][0] - place(-1.0)[0][0]) / 2
        assert abs(change) > 1e-5
        assert float(slope) == pytest.approx(change, rel=0.1)


UP = np.array([0.0, 0, 1])


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"levels": [(0, UP, 0.1)]}, "control: wanted at least 2 points beside levels"),
        ({"levels": [(0, UP)]}, "levels[0]: wanted (frame, what points up in it, dev"),
        ({"levels": [(9, UP, 0.1)]}, "levels[0]: wanted a frame below 7, found 9"),
        ({"levels": [(0, 0 * UP, 0.1)]}, "levels[0]: wanted a direction, found zeros"),
        ({"levels": [(0, UP, 0.0)]}, "levels[0]: wanted a deviation above zero"),
        ({"levels": [(0, UP[:2], 0.1)]}, "levels[0]: wanted shape (3,), found (2,)"),
        (
            {"priors": [(0, np.eye(4), np.diag([0.0, 0, 0, 1, 1, 0]))]},
            "of a tilt alone `levels`",
        ),
    ],
)
def test_wrong_rows_are_named(told: dict[str, Any], message: str):
    _, edges, T_i_j, _ = random_graph(7, 14, 0.0, 1)
    graph = PoseGraph.from_edges(edges, T_i_j)
    with pytest.raises((ValueError, TypeError), match=re.escape(message)):
        average(graph, MotionAveraging(), **told)


def test_in_two_dimensions_nothing_tilts():
    _, edges, T_i_j, _ = random_graph(7, 14, 0.0, 1, d=2)
    graph = PoseGraph.from_edges(edges, T_i_j)
    with pytest.raises(ValueError, match="levels: wanted a graph in 3D"):
        average(graph, levels=[(0, UP, 0.1)])
