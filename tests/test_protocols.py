"""Every public method and part keeps its contract, inside `jit`, `vmap` and `grad`."""

import inspect
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import switched_on
from protocols import (
    AVERAGERS,
    DYNAMICS,
    ENERGIES,
    FUNCTIONS,
    INDEXES,
    KERNELS,
    KEY,
    PRIORS,
    REGISTRARS,
    RESAMPLERS,
    RESIDUALS,
    STEPS,
    graph,
    measured,
    pair,
    scans,
)

import jaxreg as jr
from jaxreg.particle import conclude, last_digits
from jaxreg.testing import (
    check_averager,
    check_dynamics,
    check_energy,
    check_index,
    check_kernel,
    check_prior,
    check_registrar,
    check_resampler,
    check_residual,
    check_step,
)
from jaxreg.testing.problems import EDGES, NUM_POSES, relative_motions
from jaxreg.testing.promises import (
    promise_dtypes,
    promise_round_trips,
    promise_same,
    promise_traced_numbers,
)


@pytest.fixture(autouse=True, scope="module")
def _strict() -> Iterator[None]:
    """What is not a number raises, and ranks that are raised without a word."""
    with switched_on("jax_debug_nans"), jax.numpy_rank_promotion("raise"):
        yield


def _transfers_nothing_unasked(
    name: str, call: Callable[..., Any], *arrays: Any
) -> None:
    """The call, first traced and then compiled; with arrays that are on the device.

    But for optimistix, whose loops put constants there.
    """
    if name.endswith("by optimistix"):
        return
    given = jax.device_put(arrays)
    with jax.transfer_guard("disallow"):
        for _ in range(2):
            jax.block_until_ready(call(*given))


def _concrete(base: type) -> set[type]:
    """The public classes of the package that are made, below an abstract one."""
    found = set()
    for child in base.__subclasses__():
        found |= _concrete(child)
        public = child.__module__.startswith("jaxreg.") and child.__name__[0] != "_"
        if public and not inspect.isabstract(child):
            found.add(child)
    return found


def _types(parts) -> set[type]:
    return {type(part) for part in parts}


def test_every_public_method_is_in_the_table():
    registrars = _types(row.make(2) for row in REGISTRARS.values())
    averagers = _types(row.make(2) for row in AVERAGERS.values())
    assert _concrete(jr.AbstractRegistrar) == registrars
    assert _concrete(jr.AbstractAverager) == averagers
    assert _concrete(jr.AbstractIndex) == set(INDEXES)
    assert _concrete(jr.AbstractResidual) == _types(RESIDUALS)
    assert _concrete(jr.AbstractKernel) == _types(KERNELS)
    assert _concrete(jr.AbstractResampler) == _types(RESAMPLERS)
    assert _concrete(jr.AbstractStep) == _types(step for step, _ in STEPS)
    assert _concrete(jr.AbstractDynamics) == _types(DYNAMICS)
    assert _concrete(jr.AbstractEnergy) == _types(ENERGIES)
    assert _concrete(jr.AbstractPrior) == _types(prior for prior, _ in PRIORS)
    public = {name: getattr(jr, name) for name in jr.__all__}
    functions = {
        name for name, x in public.items() if callable(x) and not inspect.isclass(x)
    }
    assert functions == FUNCTIONS


@pytest.mark.parametrize("name", REGISTRARS)
def test_methods_of_register(name, monkeypatch):
    row = REGISTRARS[name]
    # Gradients are those of pulls that balance, which takes more last steps than most
    # digits of an answer are worth.
    monkeypatch.setattr(conclude, "_POLISH", 60)
    monkeypatch.setattr(last_digits, "_STEPS", 120)
    # Searches compile long: once, in the plane.
    d = 2 if row.promises.get("draws") else 3
    method = row.make(d)
    with jax.enable_x64(True):
        clouds = pair(d, float)
        given = *clouds, np.eye(d + 1), *(np.ones(len(x), bool) for x in clouds)
        _transfers_nothing_unasked(
            name,
            lambda source, target, init, *masks: jr.register(
                *(source, target, method, init, KEY),
                source_mask=masks[0],
                target_mask=masks[1],
            ),
            *given,
        )
    check_registrar(method, d=d, **row.promises)


@pytest.mark.parametrize("name", AVERAGERS)
def test_methods_of_average(name):
    row = AVERAGERS[name]
    method = row.make(3)
    with jax.enable_x64(True):
        _transfers_nothing_unasked(
            name,
            lambda T, weight, mask: jr.average(
                jr.PoseGraph.from_edges(EDGES, T, NUM_POSES, weight, mask=mask),
                *(method, None, KEY),
            ),
            *(relative_motions(3, 0.035), np.ones(len(EDGES)), EDGES[:, 0] >= 0),
        )
    check_averager(method, **row.promises)


@pytest.mark.parametrize("index", INDEXES, ids=lambda x: x.__name__)
def test_indexes(index):
    row = INDEXES[index]
    with jax.debug_nans(False):  # queries that are not finite are asked on purpose
        check_index(row.make(3), **row.promises)


@pytest.mark.parametrize("residual", RESIDUALS, ids=lambda r: type(r).__name__)
def test_residuals(residual):
    check_residual(residual)


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
def test_kernels(kernel):
    check_kernel(kernel)


@pytest.mark.parametrize("resampler", RESAMPLERS, ids=lambda r: type(r).__name__)
def test_resamplers(resampler):
    with jax.debug_nans(False):  # rows that are not in use hold them
        check_resampler(resampler)


@pytest.mark.parametrize(("step", "residual"), STEPS, ids=repr)
def test_steps(step, residual):
    check_step(step, residual)


@pytest.mark.parametrize("dynamics", DYNAMICS, ids=repr)
def test_dynamics(dynamics):
    with jax.debug_nans(False):  # rows that are not in use hold them
        check_dynamics(dynamics)


@pytest.mark.parametrize("energy", ENERGIES, ids=repr)
def test_energies(energy):
    check_energy(energy)


@pytest.mark.parametrize(("prior", "num"), PRIORS, ids=repr)
def test_priors(prior, num):
    check_prior(prior, num=num)


def test_reconstruction_in_any_transformation():
    method = REGISTRARS["ICP"].make(2)
    promise_traced_numbers(method)

    def solve(points):
        solution = jr.reconstruct(points, key=KEY, method=method)
        return jnp.sum(solution.T_world_i), solution

    with jax.enable_x64(True):
        problems = jnp.stack([scans(2, float), scans(2, float, 1)])
        run = jax.jit(jax.vmap(jax.value_and_grad(solve, has_aux=True)))
        (_, many), slopes = run(problems)
        assert np.isfinite(slopes).all()
        assert slopes.any(axis=(1, 2, 3)).all()
        for lane in (0, 1):
            alone = solve(problems[lane])[1]  # stage by stage
            promise_dtypes(alone, float, "reconstruct")
            found = jax.tree.map(lambda x, lane=lane: x[lane], many)
            promise_same("reconstruct", jr.ReconstructionSolution, found, alone)
        promise_round_trips(method, alone)


def test_reconstruction_in_space_keeps_single_precision():
    method = REGISTRARS["ParticleFilter"].make(3)
    with jax.enable_x64(True):
        out = jax.eval_shape(
            lambda points: jr.reconstruct(points, key=KEY, method=method),
            scans(3, np.float32),
        )
    promise_dtypes(out, np.float32, "reconstruct")


def test_covariances_in_any_transformation():
    with jax.enable_x64(True):
        both = measured(3, float), measured(3, float, 1)
        solution = jr.average(graph(*both[0]), jr.MotionAveraging())

        def answer(*args):
            out = jr.pose_covariances(graph(*args), solution)
            return jnp.sum(out), out

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
        out = jax.eval_shape(
            lambda *args: jr.pose_covariances(graph(*args), low), *flat
        )
        assert out.dtype == np.float32


def test_correspondences_in_any_transformation():
    def answer(target, queries):
        found = jr.correspondences(queries, target, np.eye(4))
        return jnp.sum(found.sq_distance), found

    with jax.enable_x64(True):
        both = pair(3, float), pair(3, float, 1)
        problems = [jnp.stack(x) for x in zip(*both, strict=True)]
        run = jax.jit(jax.vmap(jax.value_and_grad(answer, (0, 1), has_aux=True)))
        (_, many), (by_target, by_query) = run(*problems)
        for lane in (0, 1):
            target, queries = (np.asarray(x[lane]) for x in problems)
            alone = answer(target, queries)[1]
            promise_dtypes(alone, float, "correspondences")
            np.testing.assert_array_equal(many.index[lane], alone.index)
            delta = 2 * (queries - target[np.asarray(alone.index)])
            np.testing.assert_allclose(by_query[lane], delta, rtol=1e-12, atol=1e-12)
            expected = np.zeros_like(target)
            np.add.at(expected, np.asarray(alone.index), -delta)
            np.testing.assert_allclose(by_target[lane], expected, atol=1e-12)
