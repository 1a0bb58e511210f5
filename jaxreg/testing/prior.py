"""The promises of a prior."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.particle import AbstractPrior
from jaxreg.registrar import Frames
from jaxreg.testing.problems import motion
from jaxreg.testing.promises import (
    promise,
    promise_dtypes,
    promise_equal,
    promise_rigid,
    promise_traced_numbers,
)


def check_prior(prior: AbstractPrior, *, d: int = 3, num: int = 64) -> None:
    """Draws poses with an initial guess and without one.

    Promised are: `num` rigid poses in the dtype that is asked for; the same by the same
    key, compiled or not; that a prior in the frames of a search is a prior of such
    poses too, and the same where those frames are those of the input; that its
    `log_density` of a pose is one number, zero at most, and the same in any frames.

    Args:
        prior: the prior.
        d: dimension of the points, 2 or 3.
        num: of poses, as many as it holds where it holds some.

    Raises:
        AssertionError: naming the promise that is broken.
    """
    promise_traced_numbers(prior)
    name, key = type(prior).__name__, jax.random.key(0)
    with jax.enable_x64(True):
        guess = jnp.asarray(motion(d, 0.7, 0.5))
        zero, one = jnp.zeros(d), jnp.ones(())
        apart = Frames(jnp.arange(1.0, d + 1), jnp.full(d, -2.0), 3 * one)
        for which, init in (("with a guess", guess), ("without a guess", None)):
            found = prior.draw(key, num, d, init, np.dtype(float))
            _promise_poses(name, which, found, num, d)
            draw = jax.jit(lambda k, p=prior, T=init: p.draw(k, num, d, T, float))
            promise_equal(draw(key), found, f"{name}: compiling changes its poses")
            inside = [prior.in_frames(f) for f in (Frames(zero, zero, one), apart)]
            promise(
                all(isinstance(one, AbstractPrior) for one in inside),
                f"{name}: in_frames gives no prior.",
            )
            same, other = (p.draw(key, num, d, init, np.dtype(float)) for p in inside)
            promise_equal(same, found, f"{name}: frames of the input change its poses")
            _promise_poses(name, f"{which}, in other frames", other, num, d)
            single = None if init is None else init.astype(np.float32)
            out = jax.eval_shape(
                lambda k, T=single: prior.draw(k, num, d, T, np.dtype(np.float32)), key
            )
            promise_dtypes(out, np.float32, name)
            for T in found[:4]:
                _promise_density(name, prior, apart, T)


def _promise_density(
    name: str, prior: AbstractPrior, apart: Frames, T: jax.Array
) -> None:
    zero, one = jnp.zeros(apart.d), jnp.ones(())
    told = prior.in_frames(Frames(zero, zero, one)).log_density(T)
    promise(told.shape == (), f"{name}: log_density: found shape {told.shape}.")
    promise_dtypes(told, float, name)
    promise(-np.inf < float(told) <= 0, f"{name}: log_density speaks for a pose.")
    other = prior.in_frames(apart).log_density(apart.enter(T))
    promise_equal(other, told, f"{name}: frames change its log_density")


def _promise_poses(name: str, which: str, T: jax.Array, num: int, d: int) -> None:
    shape = (num, d + 1, d + 1)
    promise(T.shape == shape, f"{name}: wanted poses {shape}, found {T.shape}.")
    promise_dtypes(T, float, name)
    promise_rigid(name, which, np.asarray(T), atol=1e-6)  # it may hold single ones
