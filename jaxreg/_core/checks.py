"""Checks of arguments while tracing: they raise and name what was found and wanted."""

import dataclasses
from collections.abc import Callable
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from jaxreg._core.host_arrays import as_host_array as as_host_array
from jaxreg._core.host_arrays import as_host_numbers as as_host_numbers
from jaxreg._core.host_arrays import held_points as held_points
from jaxreg._core.typing import Key


#: A rotation this far from orthonormal is projected, one further is refused.
ROTATION_TOLERANCE = 1e-2
#: In the metadata of a field: it holds a number that is traced.
TRACED = "traced"


def is_concrete(x: Any) -> bool:
    """True where the values can be read, False while tracing."""
    return not isinstance(x, Tracer)


def as_float_array(x: object, name: str) -> Array:
    """Converts what `numpy.asarray` or DLPack takes to a float32 or float64 array.

    Integers become the default float type; half precision, complex numbers and
    anything that is not a number are refused.

    Args:
        x: an array of any library, nested lists, a JAX array (also a tracer), or a
            cloud or mesh of Open3D or trimesh, which stands for its points.
        name: how error messages call the argument.
    """
    if not isinstance(x, jax.Array):
        x = as_host_array(x, name)
        if x.dtype.kind in "fc" and x.dtype not in (np.float32, np.float64):
            raise TypeError(f"{name}: wanted float32 or float64, found {x.dtype}.")
        if x.dtype == np.float64 and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
            x = x.astype(np.float32)
    # Of NumPy arrays `jnp.asarray` compiles a program for each size.
    out = x if isinstance(x, jax.Array) else jax.device_put(x)
    if jnp.issubdtype(out.dtype, jnp.integer):
        return out.astype(jnp.result_type(float))
    if out.dtype not in (jnp.float32, jnp.float64):
        raise TypeError(f"{name}: wanted float32 or float64, found {out.dtype}.")
    return out


def check_points(points: Array, name: str) -> int:
    """Requires `(..., n, d)` with d = 2 or 3 and n >= 1; returns d."""
    if points.ndim < 2 or points.shape[-1] not in (2, 3):
        turned = points.ndim > 1 and points.shape[-2] in (2, 3)
        hint = f" Points are rows: try {name}.T." if turned else ""
        raise ValueError(
            f"{name}: wanted shape (n, 2) or (n, 3) with leading batch axes at most, "
            f"found {points.shape}.{hint}"
        )
    if points.shape[-2] == 0:
        raise ValueError(f"{name}: holds no points, found shape {points.shape}.")
    return points.shape[-1]


def check_mask(mask: object, shape: tuple[int, ...], name: str) -> Array:
    """Returns a boolean mask of `shape`; None stands for everything valid."""
    if mask is None:
        return jax.device_put(np.ones(shape, dtype=bool))
    out = mask if isinstance(mask, jax.Array) else as_host_array(mask, name)
    if out.dtype != bool:
        raise TypeError(f"{name}: wanted a boolean mask, found dtype {out.dtype}.")
    if out.shape != shape:
        raise ValueError(f"{name}: wanted shape {shape}, found {out.shape}.")
    return out if isinstance(out, jax.Array) else jax.device_put(out)


def check_pair(
    source: object, target: object, source_mask: object, target_mask: object
) -> tuple[Array, Array, Array, Array]:
    """Point sets of one dtype, dimension and leading axes, and masks of their rows."""
    source, target = as_float_array(source, "source"), as_float_array(target, "target")
    d = check_points(source, "source")
    if check_points(target, "target") != d:
        raise ValueError(
            f"target: wanted points of dimension {d} like source, found shape "
            f"{target.shape}."
        )
    if target.dtype != source.dtype:
        raise TypeError(
            f"target: wanted dtype {source.dtype} like source, found {target.dtype}."
        )
    if target.shape[:-2] != source.shape[:-2]:
        raise ValueError(
            f"target: wanted leading axes {source.shape[:-2]} like source, found "
            f"{target.shape[:-2]}."
        )
    source_mask = check_mask(source_mask, source.shape[:-1], "source_mask")
    target_mask = check_mask(target_mask, target.shape[:-1], "target_mask")
    return source, target, source_mask, target_mask


def check_motion(T: Array, d: int, name: str) -> None:
    """Requires homogeneous matrices `(..., d+1, d+1)`."""
    if T.ndim < 2 or T.shape[-2:] != (d + 1, d + 1):
        raise ValueError(
            f"{name}: wanted homogeneous matrices of shape (..., {d + 1}, {d + 1}), "
            f"found {T.shape}."
        )


def check_rigid(T: Array | np.ndarray, name: str, scaled: bool = False) -> None:
    """Requires rotations without reflection, and without scale if not `scaled`.

    Traced ones are not looked at, nor those that are not finite: they end in a status.
    """
    if not is_concrete(T):
        return
    R = np.asarray(T, np.float64)[..., :-1, :-1]
    R = R.reshape(-1, *R.shape[-2:])
    R = R[np.all(np.isfinite(R), axis=(1, 2))]
    with np.errstate(over="ignore", invalid="ignore"):
        gram = np.einsum("bij,bik->bjk", R, R)
    if scaled:
        size = np.trace(gram, axis1=1, axis2=2) / R.shape[-1]
        gram = gram / np.maximum(size, np.finfo(size.dtype).tiny)[:, None, None]
    worst = np.max(np.abs(gram - np.eye(R.shape[-1])), initial=0)
    # Negated: of huge numbers it is NaN.
    if not worst <= ROTATION_TOLERANCE or np.any(np.linalg.det(R) < 0):
        raise ValueError(
            f"{name}: wanted rigid motions, found a rotation that is not orthonormal "
            f"within {ROTATION_TOLERANCE:g} or is a reflection."
        )


def check_key(key: Key | None, name: str = "key") -> Key:
    """Requires one PRNG key of `jax.random.key` (or the older `PRNGKey`)."""
    if key is None:
        raise ValueError(
            f"{name}: this method draws random numbers; pass key=jax.random.key(seed)."
        )
    if not isinstance(key, jax.Array):
        raise TypeError(
            f"{name}: wanted jax.random.key(seed), found {type(key).__name__}."
        )
    if jnp.issubdtype(key.dtype, jax.dtypes.prng_key):
        if key.ndim:
            raise ValueError(f"{name}: wanted one key, found shape {key.shape}.")
        return key
    if key.dtype == jnp.uint32 and key.shape == (2,):
        return jax.random.wrap_key_data(key)
    raise TypeError(
        f"{name}: wanted jax.random.key(seed), found an array of dtype {key.dtype} "
        f"and shape {key.shape}."
    )


def check_instance(found: object, name: str, contract: Any) -> None:
    """Requires a part or a method that follows a contract.

    Args:
        found: what the user gave.
        name: how error messages call it.
        contract: an abstract class, whose `described` says what is wanted, such as "a
            kernel such as Huber()"; or its union with None.
    """
    if isinstance(found, contract):
        return
    optional = get_args(contract)
    kind = optional[0] if optional else contract
    wanted = kind.described + (", or None" if optional else "")
    raise TypeError(f"{name}: wanted {wanted}, found {told(found, kind)}.")


def check_method(found: object, contract: Any) -> None:
    """Requires a method that follows a contract, of one number in each field.

    More, for `vmap` over methods, are for it to hand out.
    """
    check_instance(found, "method", contract)
    _check_scalars(found)


def _check_scalars(part: Any) -> None:
    for field in dataclasses.fields(part):
        found: Any = getattr(part, field.name)
        if field.metadata.get(TRACED):
            if found is not None and found.ndim:
                raise ValueError(
                    f"{type(part).__name__}: {field.name}: wanted one number, found "
                    f"shape {found.shape}. Use jax.vmap over the call."
                )
        elif dataclasses.is_dataclass(found) and not isinstance(found, type):
            _check_scalars(found)


def told(found: object, contract: type) -> str:
    """What was found where an instance of `contract` was wanted, for a message."""
    if isinstance(found, type):
        add = "; add ()" if issubclass(found, contract) else ""
        return f"the class {found.__name__}{add}"
    return shown(found)


def shown(found: object) -> str:
    """What was found, in a line."""
    short = isinstance(found, (str, int, float, complex, type(None)))
    text = repr(found) if short else ""
    return text if 0 < len(text) < 80 else f"an object of {type(found).__name__}"


def check_parts(method: object, **contracts: Any) -> None:
    """Requires that the fields so named follow their contracts."""
    for name, contract in contracts.items():
        full = f"{type(method).__name__}: {name}"
        check_instance(getattr(method, name), full, contract)


def check_counts(method: object, **least: int) -> None:
    """Requires integers, given with their least values."""
    for name, low in least.items():
        check_count(getattr(method, name), f"{type(method).__name__}: {name}", low)


def check_count(found: object, name: str, least: int = 1) -> None:
    """Requires an integer of at least so much."""
    wanted = f"{name}: wanted an integer of at least {least}"
    if isinstance(found, bool) or not isinstance(found, (int, np.integer)):
        raise TypeError(f"{wanted}, found {shown(found)}.")
    if found < least:
        raise ValueError(f"{wanted}, found {found}.")
    if found >= 2**31:
        raise ValueError(f"{name}: wanted an integer below 2^31, found {found:.3g}.")


def check_flag(found: object, name: str) -> None:
    """Requires True or False."""
    if not isinstance(found, bool | np.bool_):
        raise TypeError(f"{name}: wanted True or False, found {shown(found)}.")


def check_callable(found: object, name: str) -> None:
    """Requires what can be called, or None."""
    if found is not None and not callable(found):
        raise TypeError(f"{name}: wanted a function, or None, found {shown(found)}.")


def check_positive(method: object, *names: str) -> None:
    """Requires numbers above zero; those that are traced are not looked at."""
    _check_numbers(method, names, lambda x: x > 0, "a positive number")


def check_not_negative(method: object, *names: str) -> None:
    """Requires numbers of at least zero; those that are traced are not looked at."""
    _check_numbers(method, names, lambda x: x >= 0, "a number of at least 0")


def check_numbers(method: object, *names: str) -> None:
    """Requires numbers, infinite ones too; those that are traced are not looked at."""
    _check_numbers(method, names, lambda x: ~np.isnan(x), "a number")


def check_shares(method: object, *names: str) -> None:
    """Requires numbers above zero, one at most; traced ones are not looked at."""
    _check_numbers(
        method, names, lambda x: (x > 0) & (x <= 1), "a number above 0, at most 1"
    )


def _numbers(found: object) -> np.ndarray | None:
    """A number, or an array of them for `vmap`; None for anything else."""
    if not isinstance(found, int | float | np.generic | np.ndarray | jax.Array):
        return None
    try:
        values = np.asarray(found)
    except TypeError:  # keys
        return None
    return values if values.size and values.dtype.kind in "iuf" else None


def _check_numbers(
    method: object,
    names: tuple[str, ...],
    fits: Callable[[np.ndarray], np.ndarray],
    wanted: str,
) -> None:
    for name in names:
        found = getattr(method, name)
        if not is_concrete(found):
            continue
        told = f"{type(method).__name__}: {name}: wanted {wanted}, found"
        values = _numbers(found)
        if values is None:
            raise TypeError(f"{told} {shown(found)}.")
        # Negated: what is not a number does not fit.
        if not np.all(fits(values)):
            raise ValueError(f"{told} {values.tolist()}.")
