"""Every public method stands inside `jit`, `vmap` and `grad`, as the table says."""

import dataclasses
import inspect
import pickle
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import switched_on
from protocols import (
    AVERAGERS,
    FUNCTIONS,
    INDEXES,
    KEY,
    REGISTRARS,
    graph,
    measured,
    measured_changes,
    pair,
    pair_changes,
    scans,
    turned_frames,
)

import jaxreg as jr
from jaxreg.averaging import AbstractAverager
from jaxreg.neighbours import AbstractIndex
from jaxreg.registrar import AbstractRegistrar


STEP = 2e-6


@pytest.fixture(autouse=True, scope="module")
def _strict() -> Iterator[None]:
    """In double precision; what is not a number raises.

    Compiled in a hurry: these programs run once.
    """
    with switched_on(
        "jax_enable_x64",
        "jax_debug_nans",
        "jax_disable_most_optimizations",
    ):
        yield


def _concrete(base: type) -> set[type]:
    """The classes of the package that are made, below an abstract one."""
    found = set()
    for child in base.__subclasses__():
        found |= _concrete(child)
        if child.__module__.startswith("jaxreg.") and not inspect.isabstract(child):
            found.add(child)
    return found


def _types(rows: dict) -> set[type]:
    return {type(row.make(2)) for row in rows.values()}


def test_every_public_method_is_in_the_table():
    assert _concrete(AbstractRegistrar) == _types(REGISTRARS)
    assert _concrete(AbstractAverager) == _types(AVERAGERS)
    assert _concrete(AbstractIndex) == set(INDEXES)
    public = {name: x for name, x in vars(jr).items() if not name.startswith("_")}
    functions = {
        name for name, x in public.items() if callable(x) and not inspect.isclass(x)
    }
    assert functions == FUNCTIONS
    contracts = AbstractRegistrar, AbstractAverager, AbstractIndex
    methods = {
        x
        for x in public.values()
        if inspect.isclass(x) and issubclass(x, contracts) and not inspect.isabstract(x)
    }
    assert methods <= _types(REGISTRARS) | _types(AVERAGERS) | set(INDEXES)


def test_numbers_but_counts_are_traced_so_that_changing_them_compiles_nothing():
    parts: list[eqx.Module] = [
        row.make(2) for row in (*REGISTRARS.values(), *AVERAGERS.values())
    ]
    while parts:
        part = parts.pop()
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            if isinstance(value, eqx.Module):
                parts.append(value)
            assert not isinstance(value, float), (part, field.name)


def _dtypes(tree) -> set[np.dtype]:
    return {x.dtype for x in jax.tree.leaves(tree) if x.dtype.kind in "fiu"}


SINGLE = {np.dtype(np.float32), np.dtype(np.int32)}
DOUBLE = {np.dtype(np.float64), np.dtype(np.int32)}


def _lanes(args, changes, other):
    """The problem, each change of it to both sides, and another problem."""
    lanes = [args]
    for change in changes:
        for side in (STEP, -STEP):
            lanes.append(tuple(a + side * c for a, c in zip(args, change, strict=True)))
    return tuple(jnp.stack(x) for x in zip(*lanes, other, strict=True))


def _to_first_step(solution):
    """With a trace of one row: how many there are is a matter of rounding."""
    if isinstance(solution, jr.ReconstructionSolution):
        return solution
    trace = jax.tree.map(lambda x: x[:1] if x.ndim else x, solution.trace)
    return dataclasses.replace(solution, trace=trace)


def _check_lane(many, lane, alone):
    """A lane of a batch against the same problem alone."""
    assert _dtypes(alone) == _dtypes(many) == DOUBLE
    assert int(alone.status) == int(many.status[lane])
    batched = jax.tree.map(lambda x: x[lane], many)
    both = (jax.tree.leaves(_to_first_step(x)) for x in (alone, batched))
    for single, one in zip(*both, strict=True):
        if single.dtype.kind == "f":
            np.testing.assert_allclose(one, single, rtol=1e-6, atol=1e-8)


def _check(solve, row, problems, changes):
    """One compiled program against single calls and against central differences."""

    def answer(*args):
        out, solution = solve(*args)
        weight = jnp.cos(jnp.arange(out.size, dtype=out.dtype)).reshape(out.shape)
        return jnp.sum(weight * out), solution

    lanes = _lanes(problems[0], changes, problems[1])
    every = jax.vmap(jax.value_and_grad(answer, (0, 1), has_aux=True))
    run = jax.jit(every)
    (value, many), slopes = run(*lanes)
    for lane, args in ((0, problems[0]), (-1, problems[1])):
        alone = solve(*args)[1]
        _check_lane(many, lane, alone)
    numeric = (value[1:-1:2] - value[2:-1:2]) / (2 * STEP)
    slope = [
        sum(float(jnp.sum(g[0] * c)) for g, c in zip(slopes, change, strict=True))
        for change in changes
    ]
    if row.slopes == "zero":
        assert not any(slope)
    else:
        largest = float(jnp.max(jnp.abs(numeric)))
        assert largest > 1e-2
        np.testing.assert_allclose(slope, numeric, rtol=1e-5, atol=1e-5 * largest)
    return alone


def _check_round_trips(method, solution):
    assert eqx.tree_equal(pickle.loads(pickle.dumps(method)), method)
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(solution))
    leaves, structure = jax.tree.flatten(solution)
    assert eqx.tree_equal(jax.tree.unflatten(structure, leaves), solution)
    back = pickle.loads(pickle.dumps(jax.device_get(solution)))
    assert eqx.tree_equal(jax.tree.map(jnp.asarray, back), solution)
    assert repr(solution)


@pytest.mark.parametrize("name", REGISTRARS)
def test_registration_in_any_transformation(name):
    row = REGISTRARS[name]
    d = 2 if row.slopes == "zero" else 3
    method, init = row.make(d), np.eye(d + 1)

    def solve(source, target):
        solution = jr.register(source, target, method, init, KEY)
        return solution.T_target_source, solution

    problems = pair(d, float), pair(d, float, 1)
    solution = _check(solve, row, problems, pair_changes(d, float))
    _check_round_trips(method, solution)


def _check_trace(solve, problem):
    """In single precision: nothing leaks, and the solution's dtypes."""
    with jax.check_tracer_leaks():
        solution = jax.eval_shape(lambda *args: solve(*args)[1], *problem)
    assert _dtypes(solution) == SINGLE


@pytest.mark.parametrize("name", REGISTRARS)
def test_registration_in_the_plane_keeps_single_precision(name):
    method = REGISTRARS[name].make(2)

    def solve(source, target):
        solution = jr.register(source, target, method, np.eye(3), KEY)
        return solution.T_target_source, solution

    _check_trace(solve, pair(2, np.float32))


@pytest.mark.parametrize("name", AVERAGERS)
def test_averaging_in_any_transformation(name):
    row, d = AVERAGERS[name], 3
    method = row.make(d)

    def solve(T_i_j, weight):
        solution = jr.average(graph(T_i_j, weight), method)
        return solution.T_world_i, solution

    problems = measured(d, float), measured(d, float, 1)
    kinds = {"at held widths": turned_frames}
    changes = kinds.get(row.slopes, measured_changes)(d, float)
    solution = _check(solve, row, problems, changes)
    _check_round_trips(method, solution)


@pytest.mark.parametrize("name", AVERAGERS)
def test_averaging_in_the_plane_keeps_single_precision(name):
    method = AVERAGERS[name].make(2)

    def solve(T_i_j, weight):
        solution = jr.average(graph(T_i_j, weight), method)
        return solution.T_world_i, solution

    _check_trace(solve, measured(2, np.float32))


def test_reconstruction_in_any_transformation():
    method = REGISTRARS["ParticleFilter"].make(2)

    def solve(points):
        solution = jr.reconstruct(points, key=KEY, method=method)
        return solution.T_world_i, solution

    problems = jnp.stack([scans(2, float), scans(2, float, 1)])
    many = jax.jit(jax.vmap(lambda points: solve(points)[1]))(problems)
    first, other = (solve(points)[1] for points in problems)  # stage by stage
    _check_lane(many, 0, first)
    _check_lane(many, 1, other)
    slope = jax.vmap(jax.grad(lambda points: jnp.sum(solve(points)[0])))
    assert not jax.jit(slope)(problems).any()
    _check_round_trips(method, first)


def test_reconstruction_in_space_keeps_single_precision():
    method = REGISTRARS["ParticleFilter"].make(3)

    def solve(points):
        return None, jr.reconstruct(points, key=KEY, method=method)

    _check_trace(solve, (scans(3, np.float32),))


def test_covariances_in_any_transformation():
    solution = jr.average(graph(*measured(3, float)), jr.MotionAveraging())

    def answer(*args):
        out = jr.pose_covariances(graph(*args), solution)
        return jnp.sum(out), out

    both = measured(3, float), measured(3, float, 1)
    problems = [jnp.stack(x) for x in zip(*both, strict=True)]
    run = jax.jit(jax.vmap(jax.value_and_grad(answer, (0, 1), has_aux=True)))
    (_, many), slopes = run(*problems)
    assert not any(slope.any() for slope in slopes)
    for lane in (0, 1):
        alone = answer(*(x[lane] for x in problems))[1]
        assert alone.dtype == np.float64
        np.testing.assert_allclose(many[lane], alone, rtol=1e-9)
    flat = measured(2, np.float32)
    low = jr.average(graph(*flat), jr.SpanningTree())
    with jax.check_tracer_leaks():
        out = jax.eval_shape(
            lambda *args: jr.pose_covariances(graph(*args), low), *flat
        )
    assert out.dtype == np.float32


@pytest.mark.parametrize("index", [*INDEXES, None])
def test_closest_points_in_any_transformation(index):
    """Of every index, and by `correspondences`."""

    def solve(target, queries):
        if index is None:
            still = np.eye(target.shape[1] + 1)
            found = jr.correspondences(queries, target, still)
        else:
            found = index.build(target, **INDEXES[index]).query(queries)
        return found.sq_distance, found

    def answer(*args):
        out, found = solve(*args)
        return jnp.sum(jnp.cos(jnp.arange(out.size)) * out), found

    targets, queries = (
        jnp.stack(x) for x in zip(pair(3, float), pair(3, float, 1), strict=True)
    )
    run = jax.jit(jax.vmap(jax.value_and_grad(answer, (0, 1), has_aux=True)))
    (_, many), (by_target, by_query) = run(targets, queries)
    for lane in (0, 1):
        alone = solve(targets[lane], queries[lane])[1]
        assert _dtypes(alone) == _dtypes(many) == DOUBLE
        np.testing.assert_array_equal(many.index[lane], alone.index)
        delta = queries[lane] - targets[lane][alone.index]
        delta = 2 * np.cos(np.arange(len(delta)))[:, None] * delta
        np.testing.assert_allclose(by_query[lane], delta, rtol=1e-12, atol=1e-12)
        expected = np.zeros_like(targets[lane])
        np.add.at(expected, np.asarray(alone.index), -delta)
        np.testing.assert_allclose(by_target[lane], expected, rtol=1e-12, atol=1e-12)
    built = None if index is None else index.build(targets[0], **INDEXES[index])
    _check_round_trips(built, alone)
    plane = [x[..., :2].astype(np.float32) for x in (targets[0], queries[0])]
    with jax.check_tracer_leaks():
        out = jax.eval_shape(lambda *x: solve(*x)[1], *plane)
    assert _dtypes(out) == SINGLE
