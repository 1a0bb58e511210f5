"""The promises of a residual."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.local import turn_and_shift
from jaxreg.matching import AbstractResidual, Match, moved
from jaxreg.testing.matches import matched, noisy_match, random_normals
from jaxreg.testing.problems import NUM_POINTS, motion, surface
from jaxreg.testing.promises import (
    promise,
    promise_dtypes,
    promise_equal,
    promise_traced_numbers,
)


_STEP = 1e-4


def check_residual(residual: AbstractResidual) -> None:
    """Evaluates a residual where it vanishes and where it does not, in 2D and 3D.

    Promised are: energy, b and every descent are zero at the identity on equal clouds,
    and there H is the matrix of the energy's second differences, symmetric and positive
    semidefinite; elsewhere b is minus its first differences with matches held, and the
    sum of the descents; the energy is not negative, does not change when both clouds
    turn, and a point of weight zero counts for nothing; dtypes of the points; the same
    compiled and side by side with others.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    promise_traced_numbers(residual)
    for d in (2, 3):
        name = f"{type(residual).__name__} in {d}D"
        with jax.enable_x64(True):
            _promise_zero(name, residual, d)
            _promise_descent(name, residual, d)
            for dtype in (np.float32, np.float64):
                found = jax.eval_shape(lambda t=dtype, d=d: noisy_match(d, t)[0])
                weight = jax.ShapeDtypeStruct((NUM_POINTS,), dtype)
                out = eqx.filter_eval_shape(_evaluate, residual, found, weight)
                promise_dtypes(out, dtype, name)
                k = 3 * d - 3
                wanted = [(), (k, k), (k,), (k, NUM_POINTS)]
                shapes = [x.shape for x in out]
                promise(
                    shapes == wanted,
                    f"{name}: energy, H, b and descents have the shapes {shapes}; "
                    f"wanted {wanted}.",
                )


@eqx.filter_jit
def _evaluate(
    residual: AbstractResidual, found: Match, weight: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Energy, H, b, descents."""
    H, b = residual.normal_equations(found, weight)
    return residual.energy(found, weight), H, b, residual.descents(found)


@eqx.filter_jit
def _energies(
    residual: AbstractResidual,
    found: Match,
    weight: jax.Array,
    T: jax.Array,
    tangents: jax.Array,
) -> jax.Array:
    """At poses around T, with matches held."""

    def one(tangent: jax.Array) -> jax.Array:
        there = turn_and_shift(T, tangent)
        return residual.energy(moved(found, T, there), weight)

    return jax.vmap(one)(tangents)


def _weight(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.1, 1, NUM_POINTS)


def _promise_zero(name: str, residual: AbstractResidual, d: int) -> None:
    source, normals, k = surface(NUM_POINTS, d), random_normals(d)[:1], 3 * d - 3
    still = np.eye(d + 1)
    found = matched(source, source, np.concatenate([normals, normals]), still)
    weight = jnp.asarray(_weight())
    energy, H, b, descents = map(np.asarray, _evaluate(residual, found, weight))
    what = "at the identity on equal clouds"
    promise(abs(energy) < 1e-20, f"{name}: the energy is {energy:.3g} {what}.")
    promise(np.abs(b) < 1e-12, f"{name}: b is not zero {what}.")
    promise(np.abs(descents) < 1e-12, f"{name}: a point pulls {what}.")
    promise(np.allclose(H, H.T, rtol=1e-9), f"{name}: H is not symmetric.")
    least = np.linalg.eigvalsh(H)[0]
    promise(least >= -1e-9 * np.max(np.abs(H)), f"{name}: H has a negative eigenvalue.")
    steps = _STEP * np.eye(k)
    plus = steps[:, None] + steps[None]
    minus = steps[:, None] - steps[None]
    offsets = np.stack([plus, minus, -minus, -plus]).reshape(-1, k)
    E = _energies(residual, found, weight, jnp.asarray(still), jnp.asarray(offsets))
    E = np.asarray(E).reshape(4, k, k)
    second = (E[0] - E[1] - E[2] + E[3]) / (4 * _STEP**2)
    promise_equal(
        H,
        second,
        f"{name}: H is not the second differences of the energy {what}",
        rtol=1e-5,
        atol=1e-5 * float(np.max(np.abs(H))),
    )


def _promise_descent(name: str, residual: AbstractResidual, d: int) -> None:
    (found, T), weight = noisy_match(d), jnp.asarray(_weight())
    energy, H, b, descents = _evaluate(residual, found, weight)
    promise(float(energy) >= 0, f"{name}: a negative energy.")
    promise_equal(descents @ weight, b, f"{name}: descents do not add up to b")
    steps = _STEP * np.eye(len(b))
    offsets = jnp.asarray(np.concatenate([steps, -steps]))
    E = np.asarray(_energies(residual, found, weight, jnp.asarray(T), offsets))
    slope = (E[: len(b)] - E[len(b) :]) / (2 * _STEP)
    promise_equal(
        b,
        -slope,
        f"{name}: b is not minus the differences of the energy",
        rtol=1e-6,
        atol=1e-6 * float(np.max(np.abs(slope))),
    )
    eager = residual.energy(found, weight)
    promise_equal(eager, energy, f"{name}: compiling changes the energy", rtol=1e-9)
    turned, _ = noisy_match(d, turn=motion(d, 0.9, 0.0, 5))
    promise_equal(
        _evaluate(residual, turned, weight)[0],
        energy,
        f"{name}: the energy changes when both clouds turn",
        rtol=1e-9,
    )
    without = weight.at[0].set(0)
    far = eqx.tree_at(
        lambda m: (m.source, m.residual),
        found,
        (found.source.at[:, 0].set(7.0), found.residual.at[:, 0].set(-9.0)),
    )
    promise_equal(
        _evaluate(residual, far, without)[:3],
        _evaluate(residual, found, without)[:3],
        f"{name}: a point of weight zero counts",
    )
