"""What is done to poses before and after they are judged: many steps on all points."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxreg._core import control
from jaxreg._core.arrays import cast_floats
from jaxreg._core.shares import shared
from jaxreg._core.typing import Motion, Scalar
from jaxreg.geometry import lie
from jaxreg.local import Curvature, GaussNewton, LocalOptimiser, Rest, at_rest
from jaxreg.matching import PlaneToPlane, PointToPlane, Problem, match
from jaxreg.robust import AbstractKernel


Out = TypeVar("Out")


def refined(
    problem: Problem,
    kernel: AbstractKernel,
    T: Float[Array, "q D D"],
    used: Bool[Array, " q"],
    widths: Float[Array, " s"],
) -> tuple[Float[Array, "q D D"], Bool[Array, " q"]]:
    """After a step of each width on all points.

    And which of the poses in use are sound; the others become the identity.
    """
    optimiser = LocalOptimiser(PointToPlane(), kernel, GaussNewton())
    optimiser = cast_floats(optimiser, T.dtype)
    if len(widths):
        T = _of_used(lambda T: optimiser.repeat(problem, T, widths), T, used)
    T = lie.straightened(T)
    sound = used & jnp.all(jnp.isfinite(T), axis=(1, 2))
    eye = lie.identity(T.shape[-1] - 1, T.dtype, (1,))
    return jnp.where(sound[:, None, None], T, eye), sound


def polished(
    problem: Problem,
    kernel: AbstractKernel,
    T: Float[Array, "q D D"],
    sound: Bool[Array, " q"],
    hopeful: Bool[Array, " q"],
    width: Scalar,
    num_steps: int,
) -> tuple[Float[Array, "q D D"], Curvature]:
    """The last steps, in the metric of both surfaces, and the curvature there.

    Three times as accurate as planes of the target alone; but modes are compared
    before, as wrong ones gain more by it than right ones. What is no mode stays, and so
    do those without hope, which have a curvature only.
    """
    optimiser = polishing(kernel, T.dtype)

    def polish(T: Motion) -> Motion:
        return lie.straightened(
            optimiser.repeat(problem, T, jnp.full(num_steps, width))
        )

    def curvature_at(T: Motion) -> Curvature:
        return Curvature.of(optimiser, problem, T, match(problem, T), width)

    polished = _of_used(polish, T, sound & hopeful)
    T = jnp.where((sound & hopeful)[:, None, None], polished, T)
    return T, _of_used(curvature_at, T, sound)


def polishing(kernel: AbstractKernel, dtype: Any) -> LocalOptimiser:
    """What `polished` steps by."""
    optimiser = LocalOptimiser(PlaneToPlane(0.01), kernel, GaussNewton())
    return cast_floats(optimiser, dtype)


def followed(
    optimiser: LocalOptimiser,
    problem: Problem,
    width: Scalar,
    T: Float[Array, "q D D"],
    used: Bool[Array, " q"],
) -> Float[Array, "q D D"]:
    """The same poses, those in use with the derivatives of the balance near by."""

    def one(mode: tuple[Motion, Bool[Array, ""]]) -> Motion:
        return control.cond(
            mode[1],
            lambda T: at_rest(
                Rest(optimiser=optimiser, problem=problem, width=width, T=T)
            )[0],
            lambda T: T,
            mode[0],
        )

    return lax.map(one, (T, used))


def _of_used(
    function: Callable[[Motion], Out], T: Float[Array, "q D D"], used: Bool[Array, " q"]
) -> Out:
    """Of each pose in use, one after another; zero of the others."""

    def one(mode: tuple[Motion, Bool[Array, ""]]) -> Out:
        T, used = mode
        shapes = jax.eval_shape(function, T)
        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        return control.cond(used, function, lambda _: zero, T)

    return shared(lambda modes: lax.map(one, modes), (T, used))
