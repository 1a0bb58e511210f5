"""`register` of lists and batches: few programs, and the answers of single pairs."""

import dataclasses
from itertools import pairwise

import jax
import numpy as np
import pytest
from helpers import compiled, motion
from pairs import BESL_MCKAY, FILTER, Centroids, M, N, pair

import jaxreg as jr
from jaxreg import Status
from jaxreg.registration import many


@pytest.fixture(name="compiled")
def _compiled():
    """Names of functions, as they are compiled."""
    with compiled() as names:
        yield names


def _ragged(num: int):
    rng = np.random.default_rng(0)
    rows = np.arange(num)
    sources = [rng.standard_normal((450 + k, 3)).astype(np.float32) for k in rows]
    targets = [rng.standard_normal((860 - k, 3)).astype(np.float32) for k in rows]
    return sources, targets


def _poses(solutions: list[jr.RegistrationSolution]) -> np.ndarray:
    return np.stack([x.T_target_source for x in solutions])


def test_a_hundred_sizes_compile_once(compiled):
    sources, targets = _ragged(100)
    source_mask = [None] * 99 + [np.arange(549) < 100]
    sol = jr.register(sources, targets, Centroids(), source_mask=source_mask)
    programs = [name for name in compiled if "register" in name]
    assert len(programs) == 1
    assert len(compiled) < 20  # what the host does compiles for no size of its own
    alike = [np.stack([x[:100] for x in xs]) for xs in (sources, targets)]
    batch = jr.register(alike[0], alike[1], Centroids()).T_target_source[:, :3, 3]
    np.testing.assert_allclose(batch, alike[1].mean(1) - alike[0].mean(1), atol=1e-5)
    sources[-1] = sources[-1][:100]
    shift = [t.mean(0) - s.mean(0) for s, t in zip(sources, targets, strict=True)]
    assert [type(x) for x in sol] == 100 * [jr.RegistrationSolution]
    np.testing.assert_allclose(_poses(sol)[:, :3, 3], shift, atol=1e-5)
    assert [int(x.num_inliers) for x in sol] == [len(s) for s in sources]
    assert "CONVERGED" in repr(sol[0])


def test_single_pairs_of_similar_sizes_share_a_program(compiled):
    sources, targets = _ragged(100)
    for k in (0, 20, 60):  # up to 512 and 896 rows
        sol = jr.register(sources[k], targets[k], Centroids())
        shift = targets[k].mean(0) - sources[k].mean(0)
        np.testing.assert_allclose(sol.T_target_source[:3, 3], shift, atol=1e-5)
        assert int(sol.num_inliers) == len(sources[k])
    assert len([name for name in compiled if "register" in name]) == 1
    assert len(compiled) < 20


def test_lists_of_very_different_sizes_are_grouped(monkeypatch, compiled):
    sources, targets = _ragged(9)
    sources[4] = sources[4][:5]
    targets[6] = targets[6][:0]
    monkeypatch.setattr(many, "_MOST_PADDING", 300)
    sol = jr.register(sources, targets, Centroids())
    assert len([name for name in compiled if "register" in name]) == 3
    few = np.arange(9) == 6
    np.testing.assert_array_equal(
        [x.status for x in sol], np.where(few, Status.TOO_FEW_POINTS, Status.CONVERGED)
    )
    shift = [t.sum(0) / max(len(t), 1) for t in targets]
    shift = np.array(shift) - [s.mean(0) for s in sources]
    shift[6] = 0
    np.testing.assert_allclose(_poses(sol)[:, :3, 3], shift, atol=1e-5)
    inside = jax.jit(lambda s, t: jr.register(s, t, Centroids()))(sources, targets)
    np.testing.assert_allclose(_poses(inside), _poses(sol), atol=1e-6)


def test_progress_over_many_pairs_rises_to_their_number():
    calls = []

    def run(sources, targets):
        method, hear = Centroids(), lambda *call: calls.append(call)
        return jr.register(sources, targets, method, progress=hear)

    sources, targets = _ragged(20)
    run(sources, targets)
    stages, done, totals = zip(*calls, strict=True)
    assert set(stages) == {"registering pairs"}
    assert set(totals) == {20}
    assert (done[0], done[-1]) == (0, 20)
    assert len(done) > 3
    assert all(a < b for a, b in pairwise(done))
    calls.clear()
    jax.jit(run)(sources, targets)
    assert not calls


@pytest.mark.parametrize("name", ["filter", "icp"])
def test_padding_changes_an_answer_by_rounding_only(name, compiled):
    pairs = [pair(3, seed, angle=0.3) for seed in (3, 4)]
    sources, targets, T = (list(x) for x in zip(*pairs, strict=True))
    sources.append(sources[0][:40])  # too few for a search, but some
    targets.append(targets[0][:0])
    T.append(np.eye(4))
    init = [motion(9, 3, angle=0.1, shift=0.05) @ x for x in T]
    if name == "filter":
        method, init, key = FILTER, None, jax.random.key(7)
        other = dataclasses.replace(method, min_log_evidence=2.0)
        keys = list(jax.random.split(key, 3))
    else:
        method, key, keys = jr.ICP(), None, [None] * 3
        other = jr.ICP(tolerance=1e-3, width_end=1.5)
    sol = jr.register(sources, targets, method, init, key)
    for k in range(2):
        guess = None if init is None else init[k]
        alone = jr.register(sources[k], targets[k], method, guess, keys[k])
        for field in ("T_target_source", "fitness", "overlap", "inlier_rmse"):
            np.testing.assert_allclose(
                getattr(sol[k], field), getattr(alone, field), atol=1e-3, err_msg=field
            )
        assert int(sol[k].status) == int(alone.status)
    assert int(sol[2].status) == Status.TOO_FEW_POINTS
    compiled.clear()
    jr.register(sources, targets, other, init, key)
    assert not [name for name in compiled if "register" in name]


def test_threads_keep_the_precision_of_the_caller():
    with jax.enable_x64(True):
        source, target, _ = pair(3, 3, angle=0.2)
        pairs = [np.stack([x.astype(float)] * 3) for x in (source, target)]
        T, again = (
            jr.register(pairs[0], pairs[1], Centroids(), batch_size=k).T_target_source
            for k in (1, 2)
        )
        assert T.dtype == np.float64
        np.testing.assert_allclose(again, T, atol=1e-12)
        shift = pairs[1].mean(1) - pairs[0].mean(1)
        np.testing.assert_allclose(T[:, :3, 3], shift, atol=1e-12)


def test_pairs_side_by_side_have_the_answers_and_the_memory_of_their_number():
    method = BESL_MCKAY
    pairs = [pair(2, seed, angle=0.2) for seed in range(5)]
    arrays = [np.stack(x).astype(np.float32) for x in zip(*pairs, strict=True)]

    def run(batch_size: int, repeats: int = 1):
        """Poses, and bytes beyond inputs, of which a copy is made, and outputs."""
        many = [np.tile(x, (repeats, 1, 1)) for x in arrays]

        def poses(source, target, T):
            found = jr.register(source, target, method, T, batch_size=batch_size)
            return found.T_target_source

        program = jax.jit(poses).lower(*many).compile()
        memory = program.memory_analysis()
        assert memory is not None
        copied = sum(x.nbytes for x in many)
        return program(*many), memory.temp_size_in_bytes - copied

    one, two, more = run(1), run(2), run(2, 4)
    np.testing.assert_allclose(two[0], one[0], atol=1e-5)
    assert one[1] < two[1] < 2 * (1e7 + 900 * (N + M))
    assert more[1] < 1.2 * two[1]
