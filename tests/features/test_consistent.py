"""A pose is found among many wrong correspondences."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import motion

from jaxreg.features import Agreed, Correspondences, consistent_poses


TOLERANCE = 0.02
_poses = jax.jit(consistent_poses)
RIGHT, WRONG = 24, 96


def correspondences(
    seed: int, right: int = RIGHT
) -> tuple[Correspondences, np.ndarray]:
    """`right` that noise has touched, the others anywhere; and the true motion."""
    rng = np.random.default_rng(seed)
    n, T = RIGHT + WRONG, motion(seed, 3)
    source, target = rng.uniform(-1, 1, (2, n, 3))
    normals, others = rng.normal(size=(2, n, 3))
    target[:right] = source[:right] @ T[:3, :3].T
    target += T[:3, 3]
    target[:right] += rng.normal(0, TOLERANCE / 6, (right, 3))
    others[:right] = normals[:right] @ T[:3, :3].T
    others *= rng.choice([-1, 1], (n, 1))  # normals of either sign
    normals, others = (
        x / np.linalg.norm(x, axis=1, keepdims=True) for x in (normals, others)
    )
    order = rng.permutation(n)
    arrays = (x[order] for x in (source, normals, target, others))
    source, normals, target, others = (
        jnp.asarray(x.astype(np.float32)) for x in arrays
    )
    valid = jnp.asarray(np.ones(n, bool))
    pairs = Correspondences(source, normals, target, others, valid)
    return pairs, T


def best(agreed: Agreed) -> tuple[np.ndarray, int]:
    row = int(np.argmax(agreed.num_agreeing))
    return np.asarray(agreed.T_target_source[row]), int(agreed.num_agreeing[row])


def test_a_fifth_that_is_right_gives_the_pose():
    for seed in range(5):
        pairs, T = correspondences(seed)
        found, number = best(_poses(pairs, np.float32(TOLERANCE)))
        np.testing.assert_allclose(found, T, atol=TOLERANCE / 2)
        assert RIGHT - 1 <= number <= RIGHT + 2


def test_few_agree_where_none_is_right():
    for seed in range(5):
        pairs, _ = correspondences(seed, right=0)
        agreed = _poses(pairs, np.float32(TOLERANCE))
        assert np.max(agreed.num_agreeing) <= 4
        assert np.all(np.isfinite(agreed.T_target_source))


def test_masked_correspondences_do_not_count():
    pairs, _ = correspondences(0)
    none = jnp.zeros_like(pairs.mask)
    masked = Correspondences(
        pairs.source, pairs.source_normals, pairs.target, pairs.target_normals, none
    )
    agreed = _poses(masked, np.float32(TOLERANCE))
    assert not np.any(agreed.num_agreeing)
    assert np.all(np.isfinite(agreed.T_target_source))


def test_many_sets_at_once():
    each = [correspondences(seed) for seed in range(3)]
    stacked = jax.tree.map(
        lambda *x: jnp.asarray(np.stack(x)), *(pairs for pairs, _ in each)
    )
    many = jax.jit(jax.vmap(consistent_poses, (0, None)))
    agreed = jax.device_get(many(stacked, np.float32(TOLERANCE)))
    for lane, (_, T) in enumerate(each):
        found, _ = best(jax.tree.map(lambda x, i=lane: x[i], agreed))
        np.testing.assert_allclose(found, T, atol=TOLERANCE / 2)
