"""Targets, queries and oracles that the tests of this folder share."""

import functools

import jax
import numpy as np
from hypothesis import settings
from hypothesis import strategies as st


M, N = 300, 200
KINDS = ("random", "clustered", "duplicated", "collinear", "offset", "far queries")
kinds = st.sampled_from(KINDS)
seeds = st.integers(0, 10**6)
# Squared distances stay in float32's range; nothing else about the scale may matter.
scales = st.sampled_from([1e-12, 1e-3, 1, 1e3, 1e12])
few = settings(max_examples=30, deadline=None, derandomize=True)


def clouds(kind: str, seed: int, d: int, scale: float = 1, dtype: type = np.float32):
    """Targets `(M, d)`, a mask, queries `(N, d)` around them."""
    rng = np.random.default_rng(seed)
    x = rng.random((M, d))
    if kind == "clustered":
        x = x**4
    elif kind == "duplicated":
        x = x[rng.integers(0, M // 3, M)]
    elif kind == "collinear":
        x = x[:, :1] * np.ones(d)
    q = x[rng.permutation(M)[:N]] + 0.1 * rng.standard_normal((N, d))
    if kind == "offset":
        x, q = x + 1e6, q + 1e6
    elif kind == "far queries":
        q = q + 1e4 * rng.standard_normal((N, d))
    mask = rng.random(M) < 0.7
    mask[rng.integers(M)] = True
    return (scale * x).astype(dtype), mask, (scale * q).astype(dtype)


def distances(target, mask, queries) -> np.ndarray:
    """`(n, m)` in float64; inf for masked targets."""
    delta = queries[:, None].astype(float) - target[None].astype(float)
    return np.where(mask, np.linalg.norm(delta, axis=-1), np.inf)


@functools.cache
def compiled(index, k: int = 1, **options):
    """Builds and queries, `k` and the options static."""

    def find(target, mask, queries, radius=None):
        return index.build(target, mask, **options).query(queries, k, radius)

    return jax.jit(find)
