"""Pairs side by side, as on an accelerator, are what they are one after another."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxreg as jr
from jaxreg._core.platforms import traced_for
from jaxreg.batching.side_by_side import map_side_by_side
from jaxreg.multiview.find_slipping import slipping
from jaxreg.multiview.likely_overlap import likely_overlap
from jaxreg.multiview.place import Placement, place
from jaxreg.multiview.prepare import prepare_scans
from jaxreg.multiview.refine import measured
from jaxreg.multiview.relative_motions import relative_motions
from jaxreg.testing.problems import motion, surface


PAIRS = jnp.asarray([[0, 1], [0, 2], [1, 2], [2, 3], [0, 0]], jnp.int32)
LEAST = jnp.float32(1.0)


def _scans() -> jax.Array:
    """Views of one surface, a little turned, and another surface."""
    whole = surface(300, 3, 0)
    T = [motion(3, 0.05 * k, 0.02, k) for k in range(3)]
    views = [(whole[k::3][:96] - x[:3, 3]) @ x[:3, :3] for k, x in enumerate(T)]
    return jnp.asarray(np.stack([*views, surface(96, 3, 7)]), jnp.float32)


def _found(platform: str, placement: Placement | None = None) -> tuple:
    points = _scans()
    with traced_for(platform):
        scans = prepare_scans(jr.ICP(), points, jnp.ones(points.shape[:2], bool))
        motions = relative_motions(jr.ICP(), scans, PAIRS, jax.random.key(0))
        placed = placement or place(motions, len(points), None, LEAST)
        # Traced: threads, which work on blocks else, know of no other platform.
        told = jax.jit(
            lambda scans: (
                likely_overlap(scans, placed, PAIRS),
                measured(scans, placed, LEAST, PAIRS, exact=True)[0],
                slipping(scans, placed, LEAST, PAIRS),
            )
        )(scans)
    return placed, (scans.clouds, motions, told)


def test_many_pairs_at_once_tell_what_they_tell_one_by_one():
    placed, one_by_one = _found("cpu")
    assert len(set(np.asarray(placed.part)[:3].tolist())) == 1
    assert float(one_by_one[1].overlap[0, 0]) > 0.5
    _, at_once = _found("gpu", placed)
    for mine, other in zip(
        jax.tree.leaves(one_by_one), jax.tree.leaves(at_once), strict=True
    ):
        np.testing.assert_allclose(mine, other, rtol=1e-3, atol=2e-4)


def test_a_cpu_takes_one_after_another():
    def programs(platform: str) -> int:
        """Of one item, of a batch, of the batch that is left."""
        traced = []

        def one(x: jax.Array) -> jax.Array:
            traced.append(x)
            return x.sum()

        with traced_for(platform):
            found = map_side_by_side(one, jnp.ones((6, 3)), 1 << 18)
        np.testing.assert_array_equal(found, [3] * 6)
        return len(traced)

    assert programs("cpu") == 1
    assert programs("gpu") == 2
