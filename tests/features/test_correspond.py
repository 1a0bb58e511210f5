"""Mutual matches against a comparison of all features with both signs."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.cloud import Described
from jaxreg.features import mutual


def random_features(n: int, seed: int) -> Described:
    """Points whose features share parts, some masked."""
    rng = np.random.default_rng(seed)
    points, normals = jnp.asarray(rng.normal(size=(2, n, 3)), jnp.float32)
    even, odd = jnp.asarray(rng.normal(size=(2, n, 6)), jnp.float32)
    mask = jnp.asarray(rng.uniform(size=n) > 0.2)
    return Described(points, normals, even, odd, mask)


def distances(a: Described, b: Described) -> np.ndarray:
    """Squared, of whole features, the lesser of both signs."""

    def whole(x: Described, sign: int) -> np.ndarray:
        return np.concatenate([x.even, sign * x.odd], axis=1).astype(float)

    apart = [whole(a, 1)[:, None] - whole(b, sign) for sign in (1, -1)]
    sq = np.min([np.sum(x**2, axis=-1) for x in apart], axis=0)
    return np.where(np.asarray(a.mask)[:, None] & np.asarray(b.mask), sq, np.inf)


def expected_pairs(a: Described, b: Described) -> dict[int, tuple[int, float]]:
    """Rows of mutual matches, and how near they are compared to the second."""
    sq = distances(a, b)
    out = {}
    for i in np.flatnonzero(a.mask):
        j = int(np.argmin(sq[i]))
        if np.argmin(sq[:, j]) == i:
            least, second = np.sort(sq[i])[:2]
            out[int(i)] = j, least / second
    return out


def rows_of(points: jax.Array, among: jax.Array) -> list[int]:
    return [int(np.flatnonzero(np.all(among == x, axis=1))[0]) for x in points]


def test_pairs_are_each_others_nearest_with_either_sign():
    a, b = random_features(60, 0), random_features(80, 1)
    expected = expected_pairs(a, b)
    found = mutual(a, b, 60)
    use = np.asarray(found.mask)
    rows = rows_of(found.source[use], a.points), rows_of(found.target[use], b.points)
    assert dict(zip(*rows, strict=True)) == {i: j for i, (j, _) in expected.items()}
    np.testing.assert_array_equal(
        found.source_normals[use], a.normals[jnp.asarray(rows[0])]
    )
    np.testing.assert_array_equal(
        found.target_normals[use], b.normals[jnp.asarray(rows[1])]
    )


def test_of_too_many_the_most_distinct_are_kept():
    a, b = random_features(60, 2), random_features(80, 3)
    expected = expected_pairs(a, b)
    best = sorted(expected, key=lambda i: expected[i][1])[:5]
    found = mutual(a, b, 5)
    assert np.all(found.mask)
    assert rows_of(found.source, a.points) == best


def test_without_features_there_is_no_pair():
    a, b = random_features(30, 4), random_features(30, 5)
    none = Described(b.points, b.normals, b.even, b.odd, jnp.zeros(30, bool))
    assert not np.any(mutual(a, none, 10).mask)
    assert not np.any(mutual(none, a, 10).mask)
