"""Priors, fixed poses and control points: the answer is in their frame."""

import functools
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxreg import Status
from jaxreg.averaging import (
    Correntropy,
    MotionAveraging,
    SpanningTree,
    average,
    edge_report,
    pose_covariances,
)
from jaxreg.averaging.world import arguments, rigid_fit
from jaxreg.averaging.world.adjustment import Adjustment
from jaxreg.averaging.world.parts import brought
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from jaxreg.graph.anchored import KnownPoses
from tests.averaging.graphs import motions, random_graph, rotations


# Where a surveyor's coordinates lie: float32 rounds them to half a metre.
MAP = np.array([350_000.0, 5_600_000.0, 120.0])


def image(T: np.ndarray, x: np.ndarray) -> np.ndarray:
    return T[:-1, :-1] @ x + T[:-1, -1]


def offset(T: np.ndarray, by: np.ndarray) -> np.ndarray:
    out = np.array(T)
    out[..., :-1, -1] += by
    return out


class Oracle:
    """Least squares over the free poses, by SciPy in float64."""

    def __init__(self, d: int, known: float = 7e3) -> None:
        rng = np.random.default_rng(0)
        self.num, self.fixed_frames = 7, [0, 4]
        self.X, self.edges, self.T_i_j, _ = random_graph(7, 14, 0.0, 1, d=d, noise=2.0)
        k = lie.tangent_dim(d)
        half = rng.normal(size=(14, k, k))
        self.information = 900 * (np.eye(k) + half @ half.swapaxes(1, 2) / k)
        near = motions(rotations(rng, 2, d, 0.02), 0.02 * rng.normal(size=(2, d)))
        self.priors = [
            (int(i), self.X[i] @ E, np.diag(np.linspace(500.0, 900.0, k)))
            for i, E in zip([2, 5], near, strict=True)
        ]
        self.fixed = [(i, self.X[i]) for i in self.fixed_frames]
        seen = rng.normal(size=(4, d))
        noise = 0.01 * rng.normal(size=(4, d))
        self.control = [
            (i, u, image(self.X[i], u) + e, known * np.diag(np.linspace(0.8, 1.2, d)))
            for i, u, e in zip([1, 3, 3, 6], seen, noise, strict=True)
        ]
        self.graph = PoseGraph.from_edges(
            self.edges, self.T_i_j, information=self.information
        )

    @property
    def told(self) -> dict[str, Any]:
        return {"priors": self.priors, "fixed": self.fixed, "control": self.control}

    def rows(self, T: np.ndarray, trust: np.ndarray) -> np.ndarray:
        inverse, i, j = np.linalg.inv, *self.edges.T
        gaps = inverse(self.T_i_j) @ inverse(T[i]) @ T[j]
        known = [inverse(M) @ T[k] for k, M, _ in self.priors]
        errors = np.asarray(LOG(np.concatenate([gaps, known])))
        whole = [*self.information, *(W for *_, W in self.priors)]
        root = np.sqrt(np.append(np.ones(len(gaps)), trust[: len(known)]))
        each = zip(root, whole, errors, strict=True)
        out = [w * half(W).T @ e for w, W, e in each]
        for w, (k, u, q, W) in zip(trust[len(known) :], self.control, strict=True):
            out.append(np.sqrt(w) * half(W).T @ (image(T[k], u) - q))
        return np.concatenate(out)

    def minimum(self, T: np.ndarray, trust: np.ndarray) -> Any:
        free = [i for i in range(self.num) if i not in self.fixed_frames]
        k = self.information.shape[-1]

        def moved(x: np.ndarray) -> np.ndarray:
            out = T.copy()
            out[free] = T[free] @ np.asarray(EXP(x.reshape(-1, k)))
            return out

        start = np.zeros(k * len(free))
        found = least_squares(
            lambda x: self.rows(moved(x), trust), start, method="lm", xtol=1e-13
        )
        return found, free


LOG, EXP, half = jax.jit(lie.log), jax.jit(lie.exp), np.linalg.cholesky


@pytest.mark.parametrize("d", [2, 3])
def test_all_that_is_known_is_adjusted_at_once(d: int):
    with jax.enable_x64(True):
        case = Oracle(d)
        sol = average(case.graph, MotionAveraging(), **case.told)
        T, trust = np.asarray(sol.T_world_i), np.asarray(sol.prior_weight)
        assert sol.status == Status.CONVERGED
        assert np.all(sol.placed)
        np.testing.assert_allclose(T[[0, 4]], case.X[[0, 4]], atol=1e-14)
        assert np.all(trust > 0.5)
        found, free = case.minimum(T, trust)
        np.testing.assert_allclose(found.x, 0, atol=1e-5)

        report = edge_report(case.graph, sol, **case.told)
        k = 6 if d == 3 else 3
        between = np.isin(case.edges, case.fixed_frames).all(axis=1).sum()
        rows = k * (14 - between) + k * 2 + d * 4
        assert report.degrees_of_freedom == rows - k * 5
        ranks = np.repeat([k, d], [16, 4])
        assert (report.redundancy * ranks)[report.trusted].sum() == pytest.approx(
            report.degrees_of_freedom
        )
        assert report.trusted.sum() == 20 - between
        errors = case.rows(T, np.ones(6)).reshape(-1)
        square = np.sum(errors**2) - np.sum(
            errors[: 14 * k].reshape(14, k)[~report.trusted[:14]] ** 2
        )
        assert report.chi_square == pytest.approx(square, rel=1e-6)
        assert report.edges[14:].tolist() == [[-1, i] for i in (2, 5, 1, 3, 3, 6)]

        wanted = np.linalg.inv(found.jac.T @ found.jac)
        covariances = np.asarray(pose_covariances(case.graph, sol, **case.told))
        np.testing.assert_array_equal(covariances[[0, 4]], 0)
        some = pose_covariances(case.graph, sol, poses=[6, 0, 3], **case.told)
        np.testing.assert_allclose(some, covariances[[6, 0, 3]], rtol=1e-6, atol=1e-12)
        for n, i in enumerate(free):
            own = wanted[k * n : k * (n + 1), k * n : k * (n + 1)]
            np.testing.assert_allclose(
                covariances[i], own, atol=0.02 * np.abs(own).max()
            )
        with pytest.raises(ValueError, match="6 priors, control points"):
            edge_report(case.graph, sol)


def survey(num: int = 20) -> tuple[np.ndarray, PoseGraph]:
    """Poses on a map, and a graph in float32 of which a fifth is wrong."""
    X, edges, T_i_j, _ = random_graph(num, 100, 0.2, 3)
    X[:, :3, 3] *= 40
    T_i_j[:, :3, 3] *= 40
    graph = PoseGraph.from_edges(edges, T_i_j.astype(np.float32))
    return offset(X, MAP), graph


def off(sol: Any, X: np.ndarray) -> float:
    assert isinstance(sol.T_world_i, np.ndarray)
    assert sol.T_world_i.dtype == np.float64
    return float(np.linalg.norm((sol.T_world_i - X)[:, :3, 3], axis=1).max())


def rough_priors(X: np.ndarray, wrong: list[int]) -> list[tuple[int, np.ndarray]]:
    """Eight, some of them off by ten."""
    rng = np.random.default_rng(0)
    priors = [(int(i), X[i]) for i in rng.choice(len(X), 8, replace=False)]
    for n in wrong:
        shift = rng.normal(size=3)
        shift *= 10 / np.linalg.norm(shift)
        priors[n] = (priors[n][0], offset(priors[n][1], shift))
    return priors


def test_wrong_priors_are_told():
    (X, graph), wrong = survey(), [1, 4, 6]
    sol = average(graph, Correntropy(), priors=rough_priors(X, wrong))
    assert sol.status == Status.CONVERGED
    assert np.flatnonzero(np.asarray(sol.prior_weight) < 0.5).tolist() == wrong
    assert off(sol, X) < 0.5


def test_a_fixed_pose_stays_and_decides():
    # With the world a frame more: by the programs of twenty frames.
    (X, graph), wrong = survey(19), [1, 3, 4, 6]
    priors = rough_priors(X, wrong)
    held = priors[1][0]
    sol = average(graph, Correntropy(), priors=priors, fixed=[(held, X[held])])
    # Half of the priors contradict the rest, and the fixed pose tells which.
    assert sol.status == Status.CONVERGED
    assert np.flatnonzero(np.asarray(sol.prior_weight) < 0.5).tolist() == wrong
    np.testing.assert_allclose(sol.T_world_i[held], X[held], atol=1e-5)
    assert off(sol, X) < 0.5
    assert np.asarray(sol.prior_weight)[1] == 0


@pytest.mark.parametrize("told", [False, True])
def test_almost_half_of_the_control_points_may_be_wrong(told: bool):
    X, graph = survey()
    rng = np.random.default_rng(1)
    frames, wrong = rng.choice(20, 9, replace=False), [0, 3, 5, 8]
    seen = 3 * rng.normal(size=(9, 3))
    lies = np.stack([image(X[i], u) for i, u in zip(frames, seen, strict=True)])
    lies += 0.01 * rng.normal(size=(9, 3))
    lies[wrong] += 8 * rng.normal(size=(4, 3))
    known = [(1e4 * np.eye(3),) if told else ()] * 9
    control = [
        (int(i), u, q, *W) for i, u, q, W in zip(frames, seen, lies, known, strict=True)
    ]
    sol = average(graph, Correntropy(), control=control)
    assert sol.status == Status.CONVERGED
    assert np.flatnonzero(np.asarray(sol.prior_weight) < 0.5).tolist() == wrong
    assert off(sol, X) < 0.5


def test_parts_of_a_graph_meet_in_the_world():
    X, edges, T_i_j, _ = random_graph(8, 24, 0.0, 2, d=2)
    apart = (edges < 4).all(axis=1) | (edges >= 4).all(axis=1)
    graph = PoseGraph.from_edges(edges, T_i_j.astype(np.float32), mask=apart)
    sol = average(graph, MotionAveraging(), priors=[(2, X[2]), (6, X[6])])
    assert np.all(sol.placed)
    np.testing.assert_allclose(sol.T_world_i, X, atol=0.05)
    sol = average(graph, MotionAveraging(), priors=[(6, X[6]), (5, X[5])])
    assert sol.status == Status.DISCONNECTED
    assert np.flatnonzero(np.asarray(sol.placed)).tolist() == [4, 5, 6, 7]
    assert np.asarray(sol.component).tolist() == [0, 0, 0, 0, 4, 4, 4, 4]


def test_poses_follow_what_is_known():
    with jax.enable_x64(True):
        # So little is known that trust, which is held, is near one.
        case = Oracle(2, known=50.0)
        u, q = (jnp.asarray(case.control[0][n]) for n in (1, 2))

        @jax.jit
        @jax.value_and_grad
        def y_of_pose(x: jax.Array) -> jax.Array:
            frame, T, W = case.priors[0]
            T = jnp.asarray(T).at[:2, 2].add(x[:2])
            sol = average(
                case.graph,
                MotionAveraging(),
                priors=[(frame, T, W), case.priors[1]],
                fixed=case.fixed,
                control=[(1, u, q + x[2:], case.control[0][3]), *case.control[1:]],
            )
            return sol.T_world_i[1, 1, 2]

        step = 1e-4
        _, slope = y_of_pose(np.zeros(4))
        for n, axis in enumerate(step * np.eye(4)):
            change = float(y_of_pose(axis)[0] - y_of_pose(-axis)[0])
            assert float(slope[n]) == pytest.approx(change / (2 * step), abs=2e-3)
        assert float(slope[3]) > 0.01


EYE, ZERO = np.eye(4), np.zeros(3)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"priors": [(0, EYE), (9, EYE)]}, "priors[1]: wanted a frame below 7"),
        ({"priors": [(0, 2 * EYE)]}, "priors[0]: wanted rigid motions"),
        ({"priors": [(0, ZERO)]}, "priors[0]: wanted shape (4, 4)"),
        (
            {"priors": [(0, EYE, np.diag([1.0, 1, 1, 0, 0, 0]))]},
            "priors[0]: information: wanted a positive definite matrix",
        ),
        ({"priors": [(0,)]}, "priors[0]: wanted (frame, T_world_i)"),
        ({"fixed": [(1, EYE), (1, EYE)]}, "fixed[1]: frame 1 is fixed by fixed[0]"),
        ({"fixed": [(1.0, EYE)]}, "fixed[0]: wanted a frame's number"),
        ({"control": [(0, ZERO, ZERO)]}, "control: wanted at least 3 points"),
        ({"control": [(0, ZERO, np.nan * ZERO)]}, "control[0]: wanted finite numbers"),
        ({"control": [(0, ZERO)]}, "control[0]: wanted (frame, point in it"),
        (
            {"control": [(0, ZERO, ZERO, np.eye(3)), *[(0, ZERO, ZERO)] * 2]},
            "control[1]: wanted an information, as control[0] has one",
        ),
    ],
)
def test_wrong_rows_are_named(told: dict[str, Any], message: str):
    _, edges, T_i_j, _ = random_graph(7, 14, 0.0, 1)
    info = np.broadcast_to(np.eye(6), (14, 6, 6))
    graph = PoseGraph.from_edges(edges, T_i_j, information=info)
    with pytest.raises((ValueError, TypeError), match=re.escape(message)):
        average(graph, MotionAveraging(), **told)
    with pytest.raises(ValueError, match="of one graph"):
        average([graph], **told)


def test_rough_priors_are_weighed_by_what_is_known_of_them():
    """Fixes of half the length of a step, one of them ten deviations off."""
    rng = np.random.default_rng(0)
    num, sigma = 20, 0.5
    X = motions(rotations(rng, num, 2, 1.0), np.cumsum(rng.normal(size=(num, 2)), 0))
    edges = np.array(
        [(i, j) for i in range(num) for j in range(i + 1, i + 4) if j < num]
    )
    i, j = edges.T
    near = motions(
        rotations(rng, len(i), 2, 0.003), 0.006 * rng.normal(size=(len(i), 2))
    )
    graph = PoseGraph.from_edges(
        edges,
        (np.linalg.inv(X[i]) @ X[j] @ near).astype(np.float32),
        information=np.diag([6e-3**-2] * 2 + [3e-3**-2])[None].repeat(len(i), 0),
    )
    rough = motions(rotations(rng, num, 2, 0.1), sigma * rng.normal(size=(num, 2)))
    rough[3, :2, 2] += 10 * sigma
    information = np.diag([sigma**-2] * 2 + [0.1**-2])
    priors = [(k, X[k] @ rough[k], information) for k in range(num)]
    sol = average(graph, MotionAveraging(), priors=priors)
    assert sol.status == Status.CONVERGED
    assert np.flatnonzero(np.asarray(sol.prior_weight) < 0.5).tolist() == [3]
    # Of twenty fixes the mean has less than a quarter of the deviation of one.
    assert np.linalg.norm((sol.T_world_i - X)[:, :2, 2], axis=1).max() < 2 * sigma / 3


def test_of_two_priors_that_contradict_each_other_none_is_believed():
    X, edges, T_i_j, _ = random_graph(8, 24, 0.0, 2, d=2)
    graph = PoseGraph.from_edges(edges, T_i_j.astype(np.float32))
    away = offset(X[5], np.array([10.0, 0]))
    sol = average(graph, MotionAveraging(), priors=[(2, X[2]), (5, away)])
    assert sol.status == Status.NO_AGREEMENT
    assert np.sum(np.asarray(sol.prior_weight) > 0.5) == 1


def test_drift_is_spread_up_to_what_is_known_at_the_far_end():
    """A chain that turns by half a deviation at each step, always to one side."""
    num, turn = 40, 0.002
    X = np.tile(np.eye(3), (num, 1, 1))
    X[:, 0, 2] = np.arange(num)
    bias = np.eye(3)
    bias[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    edges = np.stack([np.arange(num - 1), np.arange(1, num)], 1)
    steps = np.linalg.inv(X[edges[:, 0]]) @ X[edges[:, 1]] @ bias
    info = np.diag([0.02**-2] * 2 + [(2 * turn) ** -2])[None].repeat(num - 1, 0)
    graph = PoseGraph.from_edges(edges, steps.astype(np.float32), information=info)
    alone = functools.reduce(np.matmul, steps)
    assert np.abs(alone[:2, 2] - X[-1, :2, 2]).max() > 1.4
    sure = np.diag([0.01**-2] * 2 + [0.001**-2])
    priors = [(k, X[k], sure) for k in (0, 1, 2, 3, num - 1)]
    # The last is off by more than a hundred deviations from where the others have it.
    sol = average(graph, SpanningTree(), priors=priors)
    assert sol.status == Status.CONVERGED
    assert np.all(np.asarray(sol.prior_weight) > 0.5)
    assert np.linalg.norm((sol.T_world_i - X)[:, :2, 2], axis=1).max() < 0.2


def test_of_many_priors_some_place_a_body():
    rng = np.random.default_rng(0)
    X = motions(rotations(rng, 20, 3, 1.0), rng.normal(size=(20, 3)))
    frame = np.arange(600) % 20
    known = X[frame].copy()
    known[:200, :3, 3] += 5 + rng.normal(size=(200, 3))  # the first third is wrong
    away = motions(rotations(rng, 1, 3, 1.0), rng.normal(size=(1, 3)))[0]
    poses = KnownPoses(
        frame=jnp.asarray(frame, jnp.int32),
        mask=jnp.asarray(np.arange(600) < 599),
        T_world_prior=jnp.asarray(known, jnp.float32),
        information=None,
        fixed=jnp.asarray(np.zeros(20, bool)),
        T_world_fixed=jnp.asarray(np.tile(np.eye(4, dtype=np.float32), (20, 1, 1))),
    )
    part = jnp.asarray(np.zeros(20, np.int32))
    start = jnp.asarray(away @ X, jnp.float32)
    unit = jnp.asarray(np.float32(1))
    found = eqx.filter_jit(brought)(start, part, poses, None, None, unit)
    assert np.all(found.held)
    np.testing.assert_allclose(found.T_world_i, X, atol=1e-4)


def test_one_more_of_each_kind_takes_the_programs_that_are_there(monkeypatch):
    case, traced = Oracle(3), []
    watched = Adjustment.solve

    def solve(self: Adjustment, T: jax.Array) -> Any:
        traced.append(len(self.usable))
        return watched(self, T)

    monkeypatch.setattr(Adjustment, "solve", solve)
    graph = jax.tree.map(lambda x: jnp.asarray(x, x.dtype), case.graph)
    few = average(graph, MotionAveraging(), **case.told)
    assert few.prior_weight is not None
    assert (len(few.prior_weight), traced) == (6, [8])
    told = {
        "priors": [*case.priors, (6, case.X[6], case.priors[0][2])],
        "fixed": [*case.fixed, (3, case.X[3])],
        "control": case.control[:3],
    }
    more = average(graph, MotionAveraging(), **told)
    assert more.prior_weight is not None
    assert len(more.prior_weight) == 6
    # By the program that was there: nothing was traced.
    assert traced == [8]
    assert more.status == Status.CONVERGED


@pytest.mark.parametrize("levels", [False, True])
def test_padding_of_what_is_known_changes_no_answer(levels, monkeypatch):
    with jax.enable_x64(True):
        case = Oracle(3)
        # A wrong one of each kind comes first, and deviations are told too small: the
        # middle one of the rows that there are tells how much.
        priors = [(i, T, 30 * W) for i, T, W in case.priors]
        control = [(i, u, q, 30 * W) for i, u, q, W in case.control]
        i, u, q, W = control[1]
        told: dict[str, Any] = {
            "priors": [(3, case.X[0], priors[0][2]), *priors],
            "fixed": case.fixed,
            "control": [(i, u, q + 3, W), *control],
        }
        if levels:
            told["levels"] = [(i, T[2, :3], 1e-2) for i, T in enumerate(case.X[:5])]
        padded = average(case.graph, MotionAveraging(), **told)
        monkeypatch.setattr(arguments, "_rounded", lambda num: num)
        exact = average(case.graph, MotionAveraging(), **told)
    assert padded.status == exact.status == Status.CONVERGED
    np.testing.assert_allclose(padded.T_world_i, exact.T_world_i, atol=1e-9)
    assert padded.prior_weight is not None
    assert exact.prior_weight is not None
    np.testing.assert_allclose(padded.prior_weight, exact.prior_weight, atol=1e-9)
    assert np.all(np.asarray(padded.prior_weight)[[0, 3]] < 0.1)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 40])
def test_of_many_points_choices_are_of_those_that_are_usable(count):
    rng = np.random.default_rng(count)
    usable = np.zeros(40, bool)
    usable[rng.permutation(40)[:count]] = True
    rows = np.asarray(rigid_fit._choices(jnp.asarray(usable), 3))
    assert rows.shape == (rigid_fit.CHOICES, 3)
    assert usable[rows].all() == (count >= 3)
    if count >= 3:
        assert all(len(set(row)) == 3 for row in rows.tolist())
        assert len(np.unique(rows)) == count
    else:
        assert not usable[rows].all(axis=1).any()


def few_points(deviation: float) -> tuple[np.ndarray, PoseGraph, Any]:
    """Seven poses, and three points that some of them see."""
    X, edges, T_i_j, _ = random_graph(7, 14, 0.0, 1)
    info = np.broadcast_to(1e4 * np.eye(6, dtype=np.float32), (len(edges), 6, 6))
    graph = PoseGraph.from_edges(edges, T_i_j.astype(np.float32), information=info)
    seen = np.eye(3)
    control = [
        (i, u, X[i][:3, :3] @ u + X[i][:3, 3], np.eye(3) / deviation**2)
        for i, u in zip((1, 3, 5), seen, strict=True)
    ]
    return X, graph, control


@pytest.mark.parametrize(("deviation", "agrees"), [(0.02, False), (2.0, True)])
def test_three_points_that_bend_all_by_many_deviations_do_not_agree(deviation, agrees):
    """One of three is off by 10: none of them shows which."""
    _, graph, control = few_points(deviation)
    sol = average(graph, SpanningTree(), control=control)
    assert sol.status == Status.CONVERGED
    control[1][2][0] += 10 * deviation if agrees else 10
    sol = average(graph, SpanningTree(), control=control)
    assert sol.status == (Status.CONVERGED if agrees else Status.NO_AGREEMENT)


def test_points_on_a_line_leave_a_turn_free():
    _, graph, control = few_points(0.02)
    line = [(i, 0 * u, np.array([i, 2.0 * i, 0]), W) for i, u, _, W in control]
    sol = average(graph, SpanningTree(), control=line)
    assert sol.status == Status.DEGENERATE
