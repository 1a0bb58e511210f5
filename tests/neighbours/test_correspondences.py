"""`correspondences`: pairs at a pose, against SciPy."""

import numpy as np
import pytest
from helpers import blob, motion, move
from scipy.spatial import KDTree

import jaxreg as jr


@pytest.fixture(scope="module")
def pair():
    T = motion(1, 3, angle=0.4).astype(np.float32)
    target = blob(300, 3, seed=1)
    source = move(np.linalg.inv(T), blob(200, 3, seed=2))
    return source, target, T


def test_pairs_are_the_closest_at_the_pose(pair):
    source, target, T = pair
    mask = np.arange(200) % 3 > 0
    found = jr.correspondences(source, target, T, max_distance=0.1, source_mask=mask)
    distance, row = KDTree(target).query(move(T, source))
    np.testing.assert_array_equal(found.index, row)
    np.testing.assert_allclose(np.sqrt(found.sq_distance), distance, atol=1e-5)
    near = np.abs(distance - 0.1) > 1e-5
    valid = np.asarray(found.valid)
    np.testing.assert_array_equal(valid[near], ((distance < 0.1) & mask)[near])
    assert 0 < valid.sum() < mask.sum()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda s, t, T: (s[:, :2], t, T), r"target: .* dimension 2"),
        (lambda s, t, T: (s[None], t[None], T), r"source: wanted one point set"),
        (lambda s, t, T: (s, t, T[:3, :3]), r"T_target_source: .* found \(3, 3\)"),
        (lambda s, t, T: (s, t, T[None]), r"T_target_source: wanted one motion"),
    ],
)
def test_what_does_not_fit_is_named(pair, change, text):
    with pytest.raises(ValueError, match=text):
        jr.correspondences(*change(*pair))
