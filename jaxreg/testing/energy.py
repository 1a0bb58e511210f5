"""The promises of an energy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.matching import Match
from jaxreg.particle import AbstractEnergy
from jaxreg.testing.matches import matched, noisy_match, random_normals
from jaxreg.testing.problems import NUM_POINTS, motion, surface
from jaxreg.testing.promises import (
    promise,
    promise_dtypes,
    promise_equal,
    promise_traced_numbers,
)


_WIDTH = 0.2
# Poses that are not the true one.
_ANGLES = (0.05, 0.3, 1.0, 3.0)


def check_energy(energy: AbstractEnergy) -> None:
    """Evaluates an energy at the true pose of a cloud and away from it, in 2D and 3D.

    Promised are: a finite number in the dtype of the match; least at the true pose; a
    mean over the valid points, of which masked ones are none, and finite where there
    are none; no change when both clouds turn; a `resolution` that is not negative; the
    same compiled and side by side with others.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    promise_traced_numbers(energy)
    name, resolution = type(energy).__name__, energy.resolution
    promise(
        isinstance(resolution, (int, float)) and resolution >= 0,
        f"{name}: resolution is {resolution!r}; wanted a number that is not negative.",
    )
    for d in (2, 3):
        with jax.enable_x64(True):
            _promise_values(f"{name} in {d}D", energy, d)


def _promise_values(name: str, energy: AbstractEnergy, d: int) -> None:
    matches, width = _matches(d), jnp.asarray(_WIDTH)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *matches.values())
    values = np.asarray(_together(energy, stacked, width))
    promise(
        values.shape == (len(matches),),
        f"{name}: wanted one number, found the shape {values.shape[1:]}.",
    )
    promise(np.isfinite(values), f"{name}: it is not finite.")
    found = dict(zip(matches, values, strict=True))
    for angle in _ANGLES:
        promise(
            found["true"] < found[f"{angle} rad"],
            f"{name}: it is not less at the true pose than {angle} rad from it.",
        )
    for which, what in (
        ("junk", "masked points count"),
        ("doubled", "it is no mean: points that are there twice change it"),
        ("turned", "it changes when both clouds turn"),
    ):
        promise_equal(found[which], found["plain"], f"{name}: {what}")
    promise_equal(
        energy(matches["plain"], width),
        found["plain"],
        f"{name}: alone and side by side it does not give the same",
    )
    for dtype in (np.float32, np.float64):
        match = jax.eval_shape(lambda t=dtype: noisy_match(d, t)[0])
        out = eqx.filter_eval_shape(energy, match, jax.ShapeDtypeStruct((), dtype))
        promise_dtypes(out, dtype, name)


@eqx.filter_jit
def _together(energy: AbstractEnergy, match: Match, width: jax.Array) -> jax.Array:
    return jax.vmap(lambda m: energy(m, width))(match)


def _matches(d: int) -> dict[str, Match]:
    """By name, all with as many points again behind them, masked if not said else."""
    points, normals = surface(NUM_POINTS, d), random_normals(d)[:1]
    normals = np.concatenate([normals, normals])

    def away(angle: float) -> Match:
        T = motion(d, angle, angle / 10, 1)
        return _joined(matched(points, points, normals, T), valid=False)

    plain, turned = noisy_match(d)[0], noisy_match(d, turn=motion(d, 0.9, 0.0, 5))[0]
    without = _joined(plain, valid=False)
    junk = eqx.tree_at(
        lambda m: (m.source, m.residual),
        without,
        (
            without.source.at[:, NUM_POINTS:].set(7.0),
            without.residual.at[:, NUM_POINTS:].set(-9.0),
        ),
    )
    nobody = eqx.tree_at(
        lambda m: (m.mask, m.agreement),
        without,
        (jnp.zeros_like(without.mask), jnp.zeros_like(without.agreement)),
    )
    return {
        "plain": without,
        "doubled": _joined(plain, valid=True),
        "junk": junk,
        "nobody": nobody,
        "turned": _joined(turned, valid=False),
        "true": away(0.0),
        **{f"{angle} rad": away(angle) for angle in _ANGLES},
    }


def _joined(match: Match, *, valid: bool) -> Match:
    """The match twice, the second time valid or masked."""
    twice = jax.tree.map(lambda x: jnp.concatenate([x, x], axis=-1), match)
    keep = jnp.concatenate(
        [jnp.ones_like(match.mask), jnp.full_like(match.mask, valid)]
    )
    return eqx.tree_at(
        lambda m: (m.R, m.turn, m.mask, m.agreement),
        twice,
        (match.R, match.turn, twice.mask & keep, jnp.where(keep, twice.agreement, 0)),
    )
