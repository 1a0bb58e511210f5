"""What a program is asked for, and by what it is found again."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxreg._core.checks import is_concrete
from jaxreg._core.program_files import Hole


class Call(NamedTuple):
    """A call from outside of transformations, with arrays of one device.

    Attributes:
        function: of a platform, arguments and named ones.
        platform: of the device.
        args, kwargs: the arguments.
        settings: those of JAX on which the program depends.
        key: equal for those that share a program, in this process.
    """

    function: Callable[..., Any]
    platform: str
    args: Any
    kwargs: Any
    settings: tuple[str, ...]
    key: Any

    @classmethod
    def of(
        cls, function: Callable[..., Any], platform: str, args: Any, kwargs: Any
    ) -> "Call | None":
        """None where its program cannot be found again."""
        arrays, static = eqx.partition((args, kwargs), eqx.is_array)
        leaves, places = jax.tree.flatten(arrays)
        settings = _settings(platform)
        usual = all(_is_usual(x, platform) for x in leaves)
        if settings is None or not usual:
            return None
        rest, others = jax.tree.flatten(static)
        holes = tuple(map(_hole, leaves))
        # With their types, as 1 is True.
        typed = tuple((type(x), x) for x in rest)
        key = (function, places, others, typed, holes, settings)
        try:
            hash(key)
        except TypeError:  # something static has no hash
            return None
        return cls(function, platform, args, kwargs, settings, key)

    @property
    def asked(self) -> Any:
        """The arguments with holes for arrays."""
        given = self.args, self.kwargs
        return jax.tree.map(lambda x: _hole(x) if eqx.is_array(x) else x, given)


def _hole(x: Any) -> Hole:
    return Hole(tuple(x.shape), str(x.dtype), bool(getattr(x, "weak_type", False)))


def _is_usual(x: Any, platform: str) -> bool:
    """Whether an array is known, and on one device of the platform."""
    if not is_concrete(x):
        return False
    devices = x.devices() if isinstance(x, jax.Array) else ()
    return len(devices) < 2 and {d.platform for d in devices} <= {platform}


def _settings(platform: str) -> tuple[str, ...] | None:
    """Of JAX, on which a program depends; None where programs are not to be kept."""
    config: Any = jax.config  # its names are made as it runs
    if config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs:
        return None
    return (
        str(jnp.result_type(float)),
        str(config.jax_default_matmul_precision),
        str(config.jax_default_prng_impl),
        str(config.jax_threefry_partitionable),
        platform,
    )
