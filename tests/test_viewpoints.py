"""`register` told where scanners stood: points in what one saw to be free are wrong."""

import jax
import numpy as np
import pytest

import jaxreg as jr


# A room, seen from a place in it, and the same fitted to itself by a quarter turn: two
# of its walls then stand in the middle of what was seen.
LONG, WIDE, NUM = 3.0, 2.0, 400
AT = np.array([5.0, -4.0])
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
TURN[:2, 2] = AT - TURN[:2, :2] @ AT


def room(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, NUM)
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return AT + ray / np.max(np.abs(ray) / [LONG, WIDE], axis=1)[:, None]


@pytest.fixture(scope="module")
def pairs() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two pairs of scans and a guess of each: the right one, and the quarter turn."""
    source, target = (np.stack([room(s)] * 2).astype(np.float32) for s in range(2))
    return source, target, np.stack([np.eye(3), TURN]).astype(np.float32)


@pytest.fixture(scope="module")
def seen(pairs) -> jr.RegistrationSolution:
    source, target, init = pairs
    return jr.register(source, target, jr.ICP(), init, viewpoints=(AT, AT))


def test_a_pose_with_points_in_free_space_is_less_likely(pairs, seen):
    source, target, init = pairs
    told = jr.register(source, target, jr.ICP(), init).log_evidence
    assert float(seen.log_evidence[0]) > float(told[0]) + 3
    assert float(seen.log_evidence[1]) < float(told[1]) - 3
    assert float(seen.log_evidence[1]) < 1 < float(seen.log_evidence[0])


def test_lists_and_single_pairs_are_told_the_same(pairs, seen):
    source, target, init = pairs
    lists, eyes = (list(source), list(target)), ([AT, AT], np.stack([AT, AT]))
    of_list = jr.register(lists[0], lists[1], jr.ICP(), init, viewpoints=eyes)
    one = jax.jit(lambda *x: jr.register(x[0], x[1], jr.ICP(), x[2], viewpoints=x[3:]))
    for k in range(2):
        for found in (of_list[k], one(source[k], target[k], init[k], AT, AT)):
            told = found.log_evidence, seen.log_evidence[k]
            np.testing.assert_allclose(*told, rtol=1e-3, atol=1e-2)


def test_one_viewpoint_of_two_speaks_for_itself(pairs, seen):
    source, target, init = pairs
    for eyes in ((None, AT), (AT, None)):
        sol = jr.register(source, target, jr.ICP(), init, viewpoints=eyes)
        assert float(sol.log_evidence[1]) < float(sol.log_evidence[0]) - 5
    not_any = jr.register(source, target, jr.ICP(), init, viewpoints=(None, None))
    without = jr.register(source, target, jr.ICP(), init)
    np.testing.assert_array_equal(not_any.log_evidence, without.log_evidence)


def test_viewpoints_of_map_coordinates_are_moved_with_their_clouds(pairs, seen):
    source, target, init = (x.astype(np.float64) for x in pairs)
    far = np.array([4e6, -5e6])
    shifted = init.copy()
    shifted[:, :2, 2] += far - init[:, :2, :2] @ far
    eyes = AT + far, AT + far
    sol = jr.register(source + far, target + far, jr.ICP(), shifted, viewpoints=eyes)
    np.testing.assert_allclose(sol.log_evidence, seen.log_evidence, atol=0.3)
    eyes = None, np.zeros(3)
    with pytest.raises(ValueError, match=r"viewpoints\[1\]: wanted shape \(2,\)"):
        jr.register(source + far, target + far, jr.ICP(), shifted, viewpoints=eyes)


@pytest.mark.parametrize(
    ("viewpoints", "words"),
    [
        ((AT, AT, AT), "viewpoints: wanted two, of the source and of the target"),
        ([AT], "viewpoints: wanted two"),
        ((AT, np.zeros(3)), r"viewpoints\[1\]: wanted shape \(2,\), or \(2, 2\)"),
        ((np.full(2, np.nan), None), r"viewpoints\[0\]\[0\]: wanted finite.*None"),
        ((None, room(1)[7]), r"viewpoints\[1\]\[0\]: is a point of the scan, row 7"),
    ],
)
def test_viewpoints_that_do_not_fit_are_named(pairs, viewpoints, words):
    with pytest.raises(ValueError, match=words):
        jr.register(pairs[0], pairs[1], jr.ICP(), pairs[2], viewpoints=viewpoints)


def test_clouds_that_may_grow_have_no_viewpoints(pairs):
    method = jr.ICP(with_scale=True)
    with pytest.raises(ValueError, match="viewpoints: not with"):
        jr.register(pairs[0], pairs[1], method, pairs[2], viewpoints=(AT, None))
