"""Batches stay on their devices, each alone with its rows, on one device and many."""

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chex import assert_trees_all_close, assert_trees_all_equal
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from protocols import graph, measured

import jaxreg as jr
from jaxreg.batching.devices import chosen_devices
from jaxreg.testing import problems


NUM = 8
ROWS = PartitionSpec("pair")
ICP = jr.ICP(jr.PointToPoint(), max_steps=10)
TREE = jr.SpanningTree()
COLLECTIVES = re.compile(
    r"all-gather|all-reduce|all-to-all|collective-permute|reduce-scatter"
)


def _mesh(num: int, kind: AxisType = AxisType.Auto) -> jax.sharding.Mesh:
    return jax.make_mesh(
        (num,), ("pair",), axis_types=(kind,), devices=jax.devices()[:num]
    )


def _put(tree, mesh):
    return jax.device_put(tree, NamedSharding(mesh, ROWS))


@pytest.fixture(scope="module")
def clouds() -> tuple[jax.Array, jax.Array]:
    """Eight pairs in the plane."""
    both = zip(*(problems.pair(2, seed) for seed in range(NUM)), strict=True)
    source, target = (jnp.asarray(np.stack(x)[:, :64], jnp.float32) for x in both)
    return source, target


@pytest.fixture(scope="module")
def graphs() -> list[jr.PoseGraph]:
    """Eight graphs of one size."""
    return [graph(*measured(3, np.float32, seed)) for seed in range(NUM)]


@pytest.fixture(scope="module")
def batch(graphs) -> jr.PoseGraph:
    """The same, with a leading axis."""
    return jax.tree.map(lambda *x: jnp.stack(x), *graphs)


@pytest.fixture(scope="module")
def alone(graphs) -> jr.AveragingSolution:
    """What each is on its own."""
    found = [jr.average(g, TREE) for g in graphs]
    return jax.tree.map(lambda *x: jnp.stack(x), *found)


def test_pairs_have_the_same_bits_on_two_devices_and_four(clouds):
    source, target = clouds
    one, two, four = (
        jr.register(source, target, ICP, mesh=_mesh(k)) for k in (1, 2, 4)
    )
    assert_trees_all_equal(two, four)
    # On one the program is another: sums are rounded elsewhere.
    assert_trees_all_close(one.T_target_source, four.T_target_source, atol=1e-6)
    assert_trees_all_equal(one.status, four.status)
    T = four.T_target_source
    assert T.sharding.is_equivalent_to(NamedSharding(_mesh(4), ROWS), T.ndim)


def test_register_runs_inside_shard_map_with_its_checks(clouds):
    mesh = _mesh(2)
    inside = jax.jit(
        jax.shard_map(
            lambda x, y: jr.register(x, y, ICP),
            mesh=mesh,
            in_specs=ROWS,
            out_specs=ROWS,
        )
    )
    found = inside(*_put(clouds, mesh))
    source, target = clouds
    known = jr.register(source, target, ICP, mesh=mesh)
    assert_trees_all_close(found.T_target_source, known.T_target_source, atol=1e-6)
    assert_trees_all_equal(found.status, known.status)
    text = inside.lower(*_put(clouds, mesh)).compile().as_text()
    assert text
    assert not COLLECTIVES.search(text)


@pytest.mark.parametrize("kind", [AxisType.Auto, AxisType.Explicit])
def test_a_batch_stays_where_it_is(batch, alone, kind):
    mesh = _mesh(NUM, kind)
    found = jr.average(_put(batch, mesh), TREE)
    T = found.T_world_i
    assert T.sharding.is_equivalent_to(NamedSharding(mesh, ROWS), T.ndim)
    assert_trees_all_close(T, alone.T_world_i, atol=1e-6)
    assert_trees_all_equal(found.status, alone.status)


@pytest.mark.parametrize("by", ["mesh", "the mesh around", "type"])
def test_a_compiled_batch_has_no_collective(batch, alone, by):
    mesh = _mesh(NUM, AxisType.Explicit if by == "type" else AxisType.Auto)
    named = mesh if by == "mesh" else None
    function = jax.jit(lambda g: jr.average(g, TREE, mesh=named))
    held = _put(batch, mesh)
    if by == "the mesh around":
        with jax.set_mesh(mesh):
            program = function.lower(held).compile()
    else:
        program = function.lower(held).compile()
    text = program.as_text()
    assert text
    assert not COLLECTIVES.search(text)
    found = program(held).T_world_i
    assert len(found.addressable_shards) == NUM
    assert {x.data.shape[0] for x in found.addressable_shards} == {1}
    assert_trees_all_close(found, alone.T_world_i, atol=1e-6)


@pytest.mark.parametrize("kind", [AxisType.Auto, AxisType.Explicit])
def test_more_devices_than_graphs(graphs, batch, alone, kind):
    mesh = _mesh(NUM, kind)
    few = jax.tree.map(lambda x: x[:3], batch)
    found = jr.average(few, TREE, mesh=mesh)
    assert_trees_all_close(found.T_world_i, alone.T_world_i[:3], atol=1e-6)
    listed = jr.average(graphs[:3], TREE, mesh=mesh)
    assert len(listed) == 3
    for k, sol in enumerate(listed):
        assert_trees_all_close(sol.T_world_i, alone.T_world_i[k], atol=1e-6)


def test_what_is_the_same_everywhere_stays_so(graphs, batch, alone):
    """A method's poses for all devices, beside a batch that is spread."""
    mesh = jax.make_mesh((2, 4), ("pair", "other"))

    def both(one, many):
        own = jax.vmap(lambda g: jr.average(g, TREE).T_world_i)(many)
        return jr.average(one, TREE).T_world_i, own

    specs = PartitionSpec(), ROWS
    inside = jax.jit(jax.shard_map(both, mesh=mesh, in_specs=specs, out_specs=specs))
    everywhere = jax.device_put(graphs[0], NamedSharding(mesh, PartitionSpec()))
    one, many = inside(everywhere, _put(batch, mesh))
    assert_trees_all_close(one, alone.T_world_i[0], atol=1e-6)
    assert_trees_all_close(many, alone.T_world_i, atol=1e-6)


def test_a_mesh_is_named_as_it_should_be(batch, clouds):
    source, target = clouds
    other = jax.make_mesh((2,), ("data",))
    with pytest.raises(ValueError, match=r"mesh: wanted one with an axis 'pair'"):
        jr.average(batch, TREE, mesh=other)
    with pytest.raises(ValueError, match=r"mesh: .*found axes \('data',\)"):
        jr.register(source, target, ICP, mesh=other)
    with pytest.raises(TypeError, match=r"mesh: wanted a jax.sharding.Mesh, found int"):
        chosen_devices(2)


def _hosts(command: list[str], num: int) -> list[subprocess.Popen]:
    """So many of the hosts that share the work; the command ends in an address."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    # Two devices each, and compiled as all else is here.
    count = "--xla_force_host_platform_device_count="
    flags = re.sub(count + r"\d+", count + "2", os.environ["XLA_FLAGS"])
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    return [
        subprocess.Popen(
            [sys.executable, *command, address, "2", str(k)],
            cwd=Path(__file__).parents[1],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for k in range(num)
    ]


def test_two_hosts_share_the_pairs():
    """`notebooks/hosts.py`, as its text says."""
    hosts = _hosts(["notebooks/hosts.py"], 2)
    try:
        told = [host.communicate(timeout=300)[0].splitlines() for host in hosts]
    finally:
        for host in hosts:
            host.kill()
    angles = np.linspace(0.02, 0.1, 8)
    for k, lines in enumerate(told):
        rows = [x for x in lines if x.startswith(f"host {k}, pair ")]
        pairs = [int(x.split()[3].rstrip(":")) for x in rows]
        assert pairs == list(range(4 * k, 4 * k + 4))
        found = [float(x.split()[4]) for x in rows]
        np.testing.assert_allclose(found, angles[pairs], atol=2e-3)


def test_a_host_waits_for_others_no_longer_than_it_says():
    short = (
        "import sys; sys.path.append('notebooks'); import hosts; hosts.SECONDS = 1; "
    )
    (host,) = _hosts(["-c", short + "hosts.main(sys.argv[1], 2, 0)"], 1)
    try:
        told, _ = host.communicate(timeout=60)
    finally:
        host.kill()
    assert host.returncode
    assert "host 0 waits 1 s at most for 2 hosts at localhost:" in told
    assert "DEADLINE_EXCEEDED" in told
