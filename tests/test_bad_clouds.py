"""Clouds far from their origins, clouds in other units, guesses that are not rigid."""

import jax
import numpy as np
import pytest
from helpers import blob, motion, move, pose_error

import jaxreg as jr
from jaxreg import Status, particle


N = 1024  # a size that lists are padded to: they and arrays share a program
MIDDLES = np.array([500_000.0, 4_200_000.0, 120.0]), np.array([-3e6, 7e5, 900.0])


def _far(seed, middles=MIDDLES):
    """A pair on the map, and the pose between it."""
    T = motion(seed, 3, angle=0.2, shift=0.1)
    target = 5 * blob(N, 3, 1).astype(np.float64)
    source = 5 * blob(N, 3, 2).astype(np.float64)
    source = move(np.linalg.inv(T), source) + middles[0]
    T_far = T.copy()
    T_far[:3, 3] += middles[1] - T[:3, :3] @ middles[0]
    return source, target + middles[1], T_far


def _gap(T, T_true, source):
    """The greatest distance between images of the source, in its unit."""
    return np.max(np.linalg.norm(move(T, source) - move(T_true, source), axis=1))


def test_map_coordinates_keep_their_digits():
    source, target, T_true = _far(0)
    sol = jr.register(source, target, jr.ICP(), init=T_true)
    assert int(sol.status) == Status.CONVERGED
    assert sol.T_target_source.dtype == np.float64
    assert _gap(sol.T_target_source, T_true, source) < 0.05
    np.testing.assert_array_equal(sol.T_target_source, sol.modes.T_target_source[0])
    R = sol.T_target_source[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    near, middle = source - MIDDLES[0], target - MIDDLES[1]
    near[np.isnan(near)] = 0
    T = jr.register(near, middle, jr.ICP(), init=motion(0, 3, angle=0.2, shift=0.1))
    assert isinstance(T.T_target_source, jax.Array)
    assert pose_error(T.T_target_source, R_and_t(sol.T_target_source))[0] < 1e-4


def R_and_t(T):
    """The same pose between clouds about their middles."""
    out = T.copy()
    out[:3, 3] += T[:3, :3] @ MIDDLES[0] - MIDDLES[1]
    return out


def test_lists_and_batches_of_map_coordinates():
    pairs = [_far(0), _far(1, (MIDDLES[0], np.zeros(3)))]
    sources, targets, truth = (list(x) for x in zip(*pairs, strict=True))
    found = jr.register(sources, targets, jr.ICP(), init=np.array(truth))
    batch = jr.register(
        np.array(sources), np.array(targets), jr.ICP(), init=np.array(truth)
    )
    for k, sol in enumerate(found):
        assert _gap(sol.T_target_source, truth[k], sources[k]) < 0.05
        assert _gap(batch.T_target_source[k], truth[k], sources[k]) < 0.05


def test_rows_that_are_masked_do_not_tell_where_a_cloud_is():
    source, target, T_true = _far(0)
    mask = np.arange(N) < N - 120
    padded = np.where(mask[:, None], source, 0)
    sol = jr.register(padded, target, jr.ICP(), init=T_true, source_mask=mask)
    assert _gap(sol.T_target_source, T_true, source[mask]) < 0.05


def test_a_position_between_map_coordinates_is_refused():
    source, target, _ = _far(0)
    prior = particle.PartialPose(position=(0, 0, 0))
    with pytest.raises(ValueError, match="subtract their middles"):
        jr.register(
            source, target, jr.ParticleFilter(prior=prior), key=jax.random.key(0)
        )


@pytest.mark.parametrize("scale", [(1, 1000), (1000, 1)])
def test_metres_on_millimetres_are_told(scale):
    source, target, T = _far(0, (np.zeros(3), np.zeros(3)))
    sol = jr.register(scale[0] * source, scale[1] * target, jr.ICP(), init=T)
    assert int(sol.status) == Status.UNIT_DIFFERS


@pytest.mark.parametrize("scale", [(2, 2, 2), (1, 1, -1)])
def test_a_guess_that_is_not_rigid_is_refused(scale):
    source, target, T = _far(0, (np.zeros(3), np.zeros(3)))
    bent = T @ np.diag([*scale, 1])
    with pytest.raises(ValueError, match="init: wanted rigid motions"):
        jr.register(source, target, jr.ICP(), init=bent)
    if min(scale) > 0:  # where it is looked for, scale may be given

        def pose(source, target):
            method = jr.ICP(with_scale=True)
            return jr.register(source, target, method, init=bent).T_target_source

        jax.eval_shape(pose, source, target)
    with pytest.raises(ValueError, match="init: wanted rigid motions"):
        jr.register([source], [target], jr.ICP(), init=bent[None])


def test_a_guess_beyond_all_numbers_on_the_map_has_a_status():
    source, target, T_true = _far(0)
    lost = T_true.copy()
    lost[0, 3] = 1e38
    sol = jr.register(source, target, jr.ICP(), init=lost)
    assert int(sol.status) == Status.NON_FINITE


def _street(seed, num=10_000, ground=0.9):
    """A street corner: the ground, and walls and posts with the other points."""
    rng = np.random.default_rng(seed)
    flat = np.zeros((int(ground * num), 3))
    flat[:, :2] = rng.uniform(-20, 20, (len(flat), 2))
    walls = [  # where, how long and which way
        ((-8, -6), 9, 0.0),
        ((7, -9), 6, 1.3),
        ((9, 8), 11, 0.4),
        ((-6, 10), 4, 2.2),
        ((2, 3), 0.6, 0.7),
        ((-3, -1), 0.6, 0.2),
    ]
    lengths = np.array([length for _, length, _ in walls])
    which = rng.choice(len(walls), num - len(flat), p=lengths / lengths.sum())
    along = rng.uniform(0, lengths[which])
    way = np.array([angle for *_, angle in walls])[which]
    foot = np.array([place for place, *_ in walls])[which]
    up = rng.uniform(0, 3, len(which))
    tall = np.column_stack(
        [foot[:, 0] + along * np.cos(way), foot[:, 1] + along * np.sin(way), up]
    )
    points = np.concatenate([flat, tall])
    return points + 0.02 * rng.standard_normal(points.shape)


def test_the_ground_with_nine_tenths_of_the_points_does_not_decide():
    T_true, c, s = np.eye(4), np.cos(0.7), np.sin(0.7)
    T_true[:3] = [[c, -s, 0, 2.0], [s, c, 0, -1.5], [0, 0, 1, 0.1]]
    source = move(np.linalg.inv(T_true), _street(1))
    sol = jr.register(source, _street(2), key=jax.random.key(0))
    angle, shift = pose_error(sol.T_target_source, T_true)
    assert int(sol.status) == Status.CONVERGED
    assert angle < 0.01
    assert shift < 0.1


def test_hundred_thousand_points_on_three_hundred():
    T_true = motion(5, 3, angle=1.5, shift=0.5)
    source = move(np.linalg.inv(T_true), blob(100_000, 3, 1).astype(np.float64))
    target = blob(300, 3, 2)
    for method in (None, jr.ICP()):
        init = None if method is None else T_true @ motion(6, 3, angle=0.1, shift=0.02)
        sol = jr.register(source, target, method, init=init, key=jax.random.key(0))
        assert int(sol.status) == Status.CONVERGED
        angle, shift = pose_error(sol.T_target_source, T_true)
        assert angle < 0.02
        assert shift < 0.02
