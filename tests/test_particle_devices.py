"""Particles of one pair over devices: a share each, and the answer of one device."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chex import assert_trees_all_close, assert_trees_all_equal
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import jaxreg as jr
from jaxreg._core.shares import shared, sharing
from jaxreg.batching.devices import chosen_devices
from jaxreg.testing import problems


KEY = jax.random.key(0)
EVERYWHERE, ROWS = PartitionSpec(), PartitionSpec("pair")
# Blocks of eight: four particles on each of two devices, two on each of four; of nine
# modes five and three.
FILTER = jr.ParticleFilter(
    num_prior=48,
    num_particles=16,
    num_times=2,
    prior_steps=2,
    inner_steps=1,
    refine_steps=4,
    num_points=40,
    num_modes=9,
    max_points=64,
    batch_size=8,
)
ROUNDING = 2e-5
COLLECTIVE = re.compile(
    r" = \w+\[([\d,]*)\]\S* "
    r"(all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter)\("
    r".*?replica_groups=(\{\{.*?\}\}|\S+),"
)


def _mesh(shape, names, kind=AxisType.Auto):
    devices = jax.devices()[: np.prod(shape)]
    kinds = (kind,) * len(shape)
    return jax.make_mesh(shape, names, axis_types=kinds, devices=devices)


def _particles(num):
    return _mesh((num,), ("particle",))


@pytest.fixture(scope="module")
def clouds():
    """Two pairs in the plane."""
    both = zip(*(problems.pair(2, seed) for seed in range(2)), strict=True)
    return tuple(jnp.asarray(np.stack(x), jnp.float32) for x in both)


def _pull(source, target, key, mesh=None):
    """An angle that the points turn the answer by, and the answer."""
    found = jr.register(source, target, FILTER, key=key, mesh=mesh)
    return found.T_target_source[1, 0], found


@pytest.fixture(scope="module")
def alone(clouds):
    """What each is on one device, by its key in the batch, and the gradients."""
    pull = jax.jit(jax.value_and_grad(_pull, (0, 1), has_aux=True))
    keys = jax.random.split(KEY)
    found = [pull(*x, key=k) for *x, k in zip(*clouds, keys, strict=True)]
    return jax.tree.map(lambda *x: jnp.stack(x), *found)


def _assert_same(found, known):
    """Poses to rounding, and what is decided to the bit."""
    assert_trees_all_close(found.T_target_source, known.T_target_source, atol=ROUNDING)
    modes = found.modes.T_target_source, known.modes.T_target_source
    assert_trees_all_close(*modes, atol=ROUNDING)
    assert_trees_all_equal(found.status, known.status)
    assert_trees_all_equal(found.num_steps, known.num_steps)
    assert_trees_all_equal(found.trace.num_measured, known.trace.num_measured)
    level = found.trace.least_energy, known.trace.least_energy
    assert_trees_all_close(*level, atol=ROUNDING)


def test_a_pair_has_the_same_bits_on_two_devices_and_four(clouds, alone):
    (source, _), (target, _) = clouds
    key = jax.random.split(KEY)[0]
    # Of both axes one pair uses but that of particles.
    beside = _mesh((2, 2), ("pair", "particle"), AxisType.Explicit)
    two, four = (
        jr.register(source, target, FILTER, key=key, mesh=mesh)
        for mesh in (beside, _particles(4))
    )
    assert_trees_all_equal(two, four)
    _assert_same(four, jax.tree.map(lambda x: x[0], alone[0][1]))
    T = four.T_target_source
    everywhere = NamedSharding(_particles(4), EVERYWHERE)
    assert T.sharding.is_equivalent_to(everywhere, T.ndim)


def test_gradients_pass_through_shared_particles(clouds, alone):
    (source, _), (target, _) = clouds
    with jax.set_mesh(_particles(8)):
        pull = jax.jit(jax.value_and_grad(_pull, (0, 1), has_aux=True))
        program = pull.lower(source, target, jax.random.split(KEY)[0]).compile()
        (_, found), slopes = program(source, target, jax.random.split(KEY)[0])
    # Spread over the mesh around.
    assert COLLECTIVE.search(program.as_text() or "")
    known = jax.tree.map(lambda x: x[0], alone)
    _assert_same(found, known[0][1])
    assert_trees_all_close(slopes, known[1], atol=1e-4)


def test_pairs_over_one_axis_and_their_particles_over_another(clouds, alone):
    mesh = _mesh((2, 4), ("pair", "particle"))
    both = jax.device_put(clouds, NamedSharding(mesh, ROWS))
    program = jax.jit(lambda x, y: jr.register(x, y, FILTER, key=KEY, mesh=mesh))
    program = program.lower(*both).compile()
    found = program(*both)
    _assert_same(found, alone[0][1])
    T = found.T_target_source
    assert T.sharding.is_equivalent_to(NamedSharding(mesh, ROWS), T.ndim)
    told = COLLECTIVE.findall(program.as_text() or "")
    # Among those of one pair alone.
    assert {kind for _, kind, _ in told} == {"all-gather"}
    assert {groups for *_, groups in told} == {"{{0,1,2,3},{4,5,6,7}}"}
    # Of each device two poses of a block, slopes at three modes, and what holds them.
    assert {"2,4,3,3", "3,4,3", "3,4,2"} <= {shape for shape, *_ in told}


def test_starts_are_shared(clouds):
    method = jr.MultiStart(8, 2, num_points=40, max_points=64, batch_size=8)
    mesh = _particles(4)
    program = jax.jit(lambda x, y: jr.register(x, y, method, key=KEY, mesh=mesh))
    (source, _), (target, _) = clouds
    text = program.lower(source, target).as_text()
    assert re.search(r"stablehlo.all_gather.* -> tensor<2x4x3x3xf32>", text)


@pytest.mark.parametrize("num", [2, 4])
def test_rows_are_shared_and_put_together(num):
    rows = jnp.arange(5.0), jnp.arange(10).reshape(5, 2)
    seen = []

    def twice(rows):
        seen.append(len(rows[0]))
        # A share is not shared once more.
        return shared(lambda x: 2 * x, rows[0]), 2 * rows[1]

    def every(rows):
        with sharing("particle"):
            return shared(twice, rows)

    mesh = _particles(num)
    spread = jax.shard_map(
        every, mesh=mesh, in_specs=EVERYWHERE, out_specs=EVERYWHERE, check_vma=False
    )
    found = jax.jit(spread)(rows)
    assert seen == [-(-5 // num)]
    assert_trees_all_equal(found, twice(rows))
    for x in found:
        for part in x.addressable_shards:
            assert_trees_all_equal(part.data, x)


def _axes(mesh, *arrays, particles=True):
    """Those of rows, and that of particles; None where nothing is spread."""
    found = chosen_devices(mesh, *arrays, particles=particles)
    return None if found is None else (found.axes, found.particles)


def test_which_axes_are_found(clouds):
    mesh = _mesh((2, 4), ("pair", "particle"))
    source, _ = clouds
    held = jax.device_put(source, NamedSharding(mesh, ROWS))
    across = NamedSharding(_particles(2), PartitionSpec("particle"))
    assert _axes(mesh) == _axes(None, held) == (("pair",), "particle")
    assert _axes(mesh, particles=False) == (("pair",), None)
    assert _axes(None, held, particles=False) == (("pair",), None)
    assert _axes(None, jax.device_put(source, across)) == (("particle",), None)
    assert _axes(_particles(2)) == ((), "particle")
    with jax.set_mesh(_particles(2)):
        assert _axes(None) == ((), "particle")
        assert _axes(None, particles=False) is None

    def inside(x):
        assert _axes(None) is None
        return x

    jax.jit(jax.shard_map(inside, mesh=mesh, in_specs=ROWS, out_specs=ROWS))(held)


def test_a_mesh_of_other_axes_is_refused(clouds):
    (source, _), (target, _) = clouds
    other = _mesh((2,), ("data",))
    with pytest.raises(ValueError, match=r"an axis 'pair' or 'particle', found axes"):
        jr.register(source, target, FILTER, key=KEY, mesh=other)
    with pytest.raises(ValueError, match=r"'pair', .*; only a search has particles\."):
        jr.register(source, target, jr.ICP(), mesh=_particles(2))
