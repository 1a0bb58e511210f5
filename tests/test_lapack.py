"""No program has two batched LAPACK calls that do not wait for each other.

Each would split its batch over the pool of threads that both run on, and block one of
them: on two cores a program of two such calls can stand still for ever.
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from protocols import AVERAGERS, KEY, REGISTRARS, graph, measured, pair, scans

import jaxreg as jr


LAPACK = {
    *("lu", "qr", "geqrf", "geqp3", "householder_product", "cholesky", "svd", "eig"),
    *("eigh", "schur", "triangular_solve", "hessenberg", "tridiagonal", "ormqr"),
}
# Their programs are part of the caller's.
CALLS = {"jit", "pjit", "closed_call", "core_call", "checkpoint", "remat2"}
CALLS |= {"custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"}


def inner(value: Any) -> Iterator[Jaxpr]:
    """The programs among the parameters of an operation."""
    if isinstance(value, ClosedJaxpr):
        yield value.jaxpr
    elif isinstance(value, Jaxpr):
        yield value
    elif isinstance(value, tuple | list):
        for item in value:
            yield from inner(item)


def _is_batched(eqn: Any) -> bool:
    return eqn.primitive.name in LAPACK and eqn.invars[0].aval.ndim > 2


def apart(jaxpr: Jaxpr) -> list[str]:
    """Batched LAPACK calls that an earlier one of the same program does not lead to."""
    calls: list[str] = []
    wrong: list[str] = []

    def walk(program: Jaxpr, behind: list[frozenset[int]]) -> list[frozenset[int]]:
        known: dict[Any, frozenset[int]] = dict(
            zip(program.invars, behind, strict=True)
        )

        def of(var: Any) -> frozenset[int]:
            none = frozenset()
            return none if isinstance(var, Literal) else known.get(var, none)

        for eqn in program.eqns:
            before = frozenset().union(*map(of, eqn.invars))
            name = eqn.primitive.name
            parts = list(inner(list(eqn.params.values())))
            if name in CALLS and len(parts) == 1:
                found = walk(parts[0], [of(var) for var in eqn.invars])
                known.update(zip(eqn.outvars, found, strict=True))
                continue
            # Loops and branches are one operation each, looked into by themselves.
            below = [call for part in parts for call in _all_calls(part)]
            for part in parts:
                wrong.extend(apart(part))
            batched = _is_batched(eqn)
            if batched or below:
                if len(before) < len(calls):
                    wrong.append(f"{name} {below} beside {calls}")
                before = before | {len(calls)}
                calls.append(name)
            known.update(dict.fromkeys(eqn.outvars, before))
        return [of(var) for var in program.outvars]

    walk(jaxpr, [frozenset()] * len(jaxpr.invars))
    return wrong


def _all_calls(jaxpr: Jaxpr) -> list[str]:
    found = []
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if _is_batched(eqn):
            found.append(name)
        for part in inner(list(eqn.params.values())):
            found += _all_calls(part)
    return found


def independent(function: Any, *args: Any) -> list[str]:
    return apart(jax.make_jaxpr(function)(*args).jaxpr)


def test_two_inverses_side_by_side_are_found():
    A = jnp.ones((5, 3, 3))
    inv = jnp.linalg.inv
    assert independent(lambda a, b: inv(a).sum() + inv(b).sum(), A, A)
    assert not independent(lambda a: inv(inv(a)), A)
    assert not independent(lambda a, b: inv(a[0]).sum() + inv(b[0]).sum(), A, A)
    assert independent(lambda a: jax.lax.map(lambda x: inv(x) + inv(2 * x), a[None]), A)


def _two(x: jax.Array) -> jax.Array:
    return jnp.stack([x, x])


@pytest.mark.parametrize("name", REGISTRARS)
def test_registration_of_a_batch(name: str):
    source, target = map(_two, pair(3, np.float32))
    method = REGISTRARS[name].make(3)

    def registered(source: jax.Array, target: jax.Array) -> Any:
        one = lambda s, t: jr.register(s, t, method=method, key=KEY)  # noqa: E731
        return jax.vmap(one)(source, target)

    assert independent(registered, source, target) == []


@pytest.mark.parametrize("name", AVERAGERS)
def test_averaging_of_a_batch(name: str):
    T, weight = map(_two, measured(3, np.float32))
    method = AVERAGERS[name].make(3)

    def poses(T: jax.Array, weight: jax.Array) -> jax.Array:
        return jr.average(graph(T, weight), method, key=KEY).T_world_i

    assert independent(jax.vmap(poses), T, weight) == []
    if AVERAGERS[name].promises["gradients"] == "refused":
        return
    slope = jax.vmap(jax.grad(lambda T, weight: poses(T, weight).sum()))
    assert independent(slope, T, weight) == []


def test_information_and_covariances_of_a_batch():
    T, weight = map(_two, measured(3, np.float32))
    information = jnp.broadcast_to(jnp.eye(6), (*weight.shape, 6, 6))

    def spread(T: jax.Array, weight: jax.Array, information: jax.Array) -> Any:
        plain = graph(T, weight)
        full = jr.PoseGraph.from_edges(
            plain.edges, T, plain.num_poses, weight, information
        )
        sol = jr.average(full, jr.PoseGraphLM())
        return jr.pose_covariances(full, sol), jr.metrics.chordal_objective(
            full, sol.T_world_i
        )

    assert independent(jax.vmap(spread), T, weight, information) == []


def test_slopes_of_registration():
    source, target = pair(3, np.float32)

    def moved(source: jax.Array) -> jax.Array:
        return jr.register(source, target, method=jr.ICP()).T_target_source.sum()

    assert independent(jax.vmap(jax.grad(moved)), _two(source)) == []


def test_reconstruction():
    x = scans(3, np.float32)
    method = REGISTRARS["ParticleFilter"].make(3)
    assert independent(lambda x: jr.reconstruct(x, method=method, key=KEY), x) == []
