import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxreg.graph.shortest_paths import shortest_paths


#: Few frames, and so many that a queue is used, of which as few have edges.
SIZES, V, E = [200, 5000], 200, 500
shortest = jax.jit(shortest_paths, static_argnums=3)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.sampled_from(["even", "hub", "chain"]),
    st.booleans(),
    st.sampled_from(SIZES),
)
def test_paths_are_as_short_as_those_of_scipy(seed, kind, equal, num):
    rng = np.random.default_rng(seed)
    i = rng.integers(0, V, E)
    edges = np.stack([i, (i + rng.integers(1, V, E)) % V], axis=1).astype(np.int32)
    if kind == "hub":  # of more edges than a step has places
        edges[: V - 1] = np.stack([np.full(V - 1, 7), np.delete(np.arange(V), 7)], 1)
    if kind == "chain":
        name = rng.permutation(V)
        edges[: V - 1] = np.stack([name[:-1], name[1:]], axis=1)
    length = np.ones(E) if equal else rng.integers(1, 900, E)
    length = np.where(rng.uniform(size=E) < 0.2, np.inf, length)
    length[0] = 1  # that of the greatest weight
    edges[0] = seed % V, (seed + 1) % V
    T = np.tile(np.eye(3, dtype=np.float32), (E, 1, 1))
    weight = np.float32(1 / length)
    root = seed % V
    found = shortest(edges, jnp.asarray(T), jnp.asarray(weight), num, root)
    dense = np.full((V, V), np.inf)
    for (a, b), x in zip(edges.tolist(), length.tolist(), strict=True):
        dense[a, b] = dense[b, a] = min(dense[a, b], x)
    sparse = sp.csr_matrix(np.where(np.isfinite(dense), dense, 0))
    expected = sp.csgraph.dijkstra(sparse, indices=root)
    np.testing.assert_array_equal(found.reached[:V], np.isfinite(expected))
    assert not found.reached[V:].any()
    # Along parents and their edges the lengths add up to the shortest.
    parent, via = np.asarray(found.parent)[:V], np.asarray(found.via)[:V]
    on = np.isfinite(expected) & (np.arange(V) != root)
    stepped = expected[parent[on]] + length[via[on]]
    np.testing.assert_allclose(stepped, expected[on], rtol=1e-5)


def test_poses_of_a_long_chain_are_exact():
    num = 30_000
    edges = jnp.stack([jnp.arange(num - 1), jnp.arange(1, num)], axis=1)
    T = np.tile(np.eye(3, dtype=np.float32), (num - 1, 1, 1))
    T[:, 0, 2] = 1
    args = (edges.astype(jnp.int32), jnp.asarray(T), jnp.ones(num - 1))
    found = shortest(*args, num)
    np.testing.assert_array_equal(found.T_root_i[:, 0, 2], np.arange(num))
