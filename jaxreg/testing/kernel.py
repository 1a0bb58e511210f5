"""The promises of a robust kernel."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.robust import AbstractKernel
from jaxreg.testing.promises import (
    promise,
    promise_dtypes,
    promise_equal,
    promise_traced_numbers,
)


_WIDTH = 0.7
_UNIT = 1024.0


def check_kernel(kernel: AbstractKernel) -> None:
    """Evaluates a kernel at norms from zero to far beyond its width.

    Promised are: rho(0) = 0, and rho never falls; the weight is the derivative of rho
    by r over r, twice that by r^2, and trust, the weight over that at zero, falls from
    one and stays in [0, 1]; nothing is NaN at zero widths and huge residuals; dtypes of
    the residuals; the same trust in another unit of length; `width_of` is a length, of
    valid residuals alone, and zero where there are none.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    promise_traced_numbers(kernel)
    name = type(kernel).__name__
    with jax.enable_x64(True):
        _promise_loss(name, kernel)
        _promise_safety(name, kernel)
        _promise_width(name, kernel)
        for dtype in (np.float32, np.float64):
            sq = jax.ShapeDtypeStruct((5,), dtype)
            width, mask = jax.ShapeDtypeStruct((), dtype), np.ones(5, bool)
            out = eqx.filter_eval_shape(_evaluate, kernel, sq, width, mask)
            promise_dtypes(out, dtype, name)
            shapes = [x.shape for x in out]
            promise(
                shapes == [(5,), (5,), ()],
                f"{name}: of five residuals rho, weight and width_of have the shapes "
                f"{shapes}.",
            )


@eqx.filter_jit
def _evaluate(
    kernel: AbstractKernel, sq: jax.Array, width: jax.Array, mask: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """rho, weight, and the width that the residuals suggest."""
    both = kernel.rho(sq, width), kernel.weight(sq, width)
    return *both, kernel.width_of(sq, mask)


def _at(kernel: AbstractKernel, sq: np.ndarray, width: float) -> list[np.ndarray]:
    everyone = jnp.ones(sq.shape, bool)
    out = _evaluate(kernel, jnp.asarray(sq), jnp.asarray(width), everyone)
    return [np.asarray(x) for x in out]


def _promise_loss(name: str, kernel: AbstractKernel) -> None:
    # None at the width itself, where a loss may bend.
    norms = np.linspace(0, 5, 65)
    sq, step = norms**2, 1e-7
    rho, weight, _ = _at(kernel, sq, _WIDTH)
    higher, lower = (_at(kernel, sq + s * step, _WIDTH)[0] for s in (1, -1))
    promise(rho[0] == 0, f"{name}: rho(0) is {rho[0]:.3g}, not 0.")
    promise(np.diff(rho) >= -1e-12, f"{name}: rho falls somewhere.")
    promise_equal(
        (higher - lower)[1:] / step,
        weight[1:],
        f"{name}: the weight is not the derivative of rho by r over r",
        rtol=1e-6,
        atol=1e-7,
    )
    trust = weight / weight[0]
    promise(weight[0] > 0, f"{name}: a residual of zero has no weight.")
    within = np.all((trust >= 0) & (trust <= 1))
    promise(within, f"{name}: the weight over that at zero is not in [0, 1].")
    promise(np.diff(trust) <= 1e-12, f"{name}: the weight rises somewhere.")
    _, scaled, _ = _at(kernel, _UNIT**2 * sq, _UNIT * _WIDTH)
    promise_equal(
        scaled / scaled[0], trust, f"{name}: another unit of length changes trust"
    )
    mapped = jax.vmap(lambda s: kernel.weight(s, jnp.asarray(_WIDTH)))(jnp.asarray(sq))
    promise_equal(mapped, weight, f"{name}: vmap changes the weight", rtol=1e-12)


def _promise_safety(name: str, kernel: AbstractKernel) -> None:
    sq = np.array([0.0, 1e-38, 1.0, 1e30])
    for width in (0.0, 1e-12, 1e12):
        rho, weight, _ = _at(kernel, sq, width)
        what = f"for residuals from 0 to 1e15 at the width {width:.0e}"
        promise(np.isfinite(weight), f"{name}: a weight is not finite {what}.")
        promise(~np.isnan(rho), f"{name}: rho is NaN {what}.")
        pull = jax.vmap(jax.grad(lambda r, w=width: kernel.rho(r * r, jnp.asarray(w))))
        promise(pull(jnp.zeros(1)) == 0, f"{name}: a residual of zero pulls {what}.")


def _promise_width(name: str, kernel: AbstractKernel) -> None:
    rng = np.random.default_rng(0)
    sq, mask = rng.standard_normal(99) ** 2, rng.random(99) < 0.8

    def width(sq: np.ndarray, mask: np.ndarray) -> float:
        both = jnp.asarray(sq), jnp.asarray(mask)
        return float(_evaluate(kernel, both[0], jnp.asarray(_WIDTH), both[1])[2])

    found = width(sq, mask)
    promise(np.isfinite(found) and found >= 0, f"{name}: width_of gives {found}.")
    promise_equal(
        width(_UNIT**2 * sq, mask) / _UNIT,
        found,
        f"{name}: width_of is not a length: in another unit it is another",
    )
    other = np.where(mask, sq, 7.0)
    promise(width(other, mask) == found, f"{name}: masked residuals change width_of.")
    promise(
        width(sq, np.zeros(99, bool)) == 0,
        f"{name}: width_of is not zero where no residual is valid.",
    )
