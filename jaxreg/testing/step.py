"""The promises of a step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.local import AbstractStep
from jaxreg.matching import AbstractResidual, Match, PointToPoint, moved
from jaxreg.testing.matches import matched, noisy_match, random_normals
from jaxreg.testing.methods import UNIT, promise_unit
from jaxreg.testing.problems import NUM_POINTS, motion, surface
from jaxreg.testing.promises import (
    promise,
    promise_dtypes,
    promise_equal,
    promise_rigid,
    promise_traced_numbers,
)


#: Match, pose, weights.
_Held = tuple[Match, np.ndarray, np.ndarray]


def check_step(
    step: AbstractStep,
    residual: AbstractResidual = PointToPoint(),  # noqa: B008, frozen
) -> None:
    """Takes one step from a pose 0.1 rad off, points being matched, in 2D and 3D.

    Promised are: poses that are rigid, in the dtype of the pose; the pose itself where
    all weights are zero, and where all residuals are; less energy of the same matches;
    a point of weight zero counts for nothing, and one point alone breaks nothing; the
    step turns with the clouds, and follows another unit of length; the same compiled
    and side by side with others.

    Args:
        step: the step.
        residual: one that it can make smaller.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    promise_traced_numbers(step)
    for d in (2, 3):
        name = f"{type(step).__name__} in {d}D"
        with jax.enable_x64(True):
            held = _problems(d)
            stacked = jax.tree.map(lambda *x: jnp.stack(x), *held.values())
            poses = np.asarray(_together(step, residual, *stacked))
            found = dict(zip(held, poses, strict=True))
            _promise_answers(name, held, found, d)
            _promise_descent(name, residual, held["plain"], found["plain"])
            plain, T, weight = jax.tree.map(jnp.asarray, held["plain"])
            promise_equal(
                step(T, plain, weight, residual),
                found["plain"],
                f"{name}: alone and side by side it does not give the same",
            )
            for dtype in (np.float32, np.float64):
                match, T = jax.eval_shape(lambda t=dtype, d=d: noisy_match(d, t))
                kinds = [
                    jax.ShapeDtypeStruct(s, dtype) for s in (T.shape, (NUM_POINTS,))
                ]
                out = eqx.filter_eval_shape(step, kinds[0], match, kinds[1], residual)
                promise_dtypes(out, dtype, name)
                promise(
                    out.shape == (d + 1, d + 1),
                    f"{name}: wanted a pose {(d + 1, d + 1)}, found {out.shape}.",
                )


@eqx.filter_jit
def _together(
    step: AbstractStep,
    residual: AbstractResidual,
    match: Match,
    T: jax.Array,
    weight: jax.Array,
) -> jax.Array:
    return jax.vmap(lambda m, T, w: step(T, m, w, residual))(match, T, weight)


def _problems(d: int) -> dict[str, _Held]:
    weight = np.random.default_rng(0).uniform(0.1, 1, NUM_POINTS)
    (plain, T), (turned, T_turned) = noisy_match(d), noisy_match(d, turn=_turn(d))
    points, normals = surface(NUM_POINTS, d), random_normals(d)[:1]
    still = np.eye(d + 1)
    equal = matched(points, points, np.concatenate([normals, normals]), still)
    first = np.arange(NUM_POINTS) == 0
    T_unit = T.copy()
    T_unit[:d, d] *= UNIT

    def with_lengths(source: jax.Array, residual: jax.Array) -> Match:
        return eqx.tree_at(lambda m: (m.source, m.residual), plain, (source, residual))

    junk = with_lengths(
        plain.source.at[:, 0].set(7.0), plain.residual.at[:, 0].set(-9.0)
    )
    return {
        "plain": (plain, T, weight),
        "without weight": (plain, T, 0 * weight),
        "equal": (equal, still, weight),
        "without one": (plain, T, np.where(first, 0, weight)),
        "junk": (junk, T, np.where(first, 0, weight)),
        "alone": (plain, T, np.where(first, weight, 0)),
        "turned": (turned, T_turned, weight),
        "unit": (
            with_lengths(UNIT * plain.source, UNIT * plain.residual),
            T_unit,
            weight,
        ),
    }


def _turn(d: int) -> np.ndarray:
    return motion(d, 0.9, 0.0, 5)


def _promise_answers(
    name: str, held: dict[str, _Held], found: dict[str, np.ndarray], d: int
) -> None:
    for which, T in found.items():
        promise_rigid(name, which, T)
    for which, what in (
        ("without weight", "weights of zero move the pose"),
        ("equal", "residuals of zero move the pose"),
    ):
        promise_equal(found[which], held[which][1], f"{name}: {what}")
    what = "a point of weight zero counts"
    promise_equal(found["junk"], found["without one"], f"{name}: {what}")
    G = _turn(d)
    promise_equal(
        found["turned"],
        G @ found["plain"] @ np.linalg.inv(G),
        f"{name}: it does not turn with the clouds",
    )
    promise_unit(name, found["unit"], found["plain"])


def _promise_descent(
    name: str, residual: AbstractResidual, held: _Held, T_after: np.ndarray
) -> None:
    match, T, weight = jax.tree.map(jnp.asarray, held)
    before = float(residual.energy(match, weight))
    after = float(residual.energy(moved(match, T, jnp.asarray(T_after)), weight))
    promise(
        after < before, f"{name}: the energy does not fall, from {before} to {after}."
    )
