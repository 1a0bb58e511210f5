"""Arrays of other libraries as NumPy arrays, and words on those that cannot be."""

import jax
import numpy as np


def as_host_array(x: object, name: str) -> np.ndarray:
    """Converts what `numpy.asarray` or DLPack takes to a NumPy array of numbers."""
    _refuse_geometry(x, name)
    try:
        if hasattr(x, "__dlpack__") and not isinstance(x, np.ndarray | jax.Array):
            x = np.from_dlpack(x)  # pyright: ignore[reportArgumentType]
        x = np.asarray(x)
    except (BufferError, RuntimeError) as err:  # on a device, or with a gradient
        raise ValueError(
            f"{name}: its {type(x).__name__} gives no array that NumPy reads ({err}); "
            f"of a PyTorch tensor {name}.detach().cpu() does."
        ) from err
    except (ValueError, TypeError, OverflowError) as err:
        raise ValueError(f"{name}: not a rectangular array of numbers.") from err
    if x.dtype.kind not in "biufc":
        hint = " Files are read by jaxreg.io." if x.dtype.kind in "SUV" else ""
        raise TypeError(f"{name}: wanted numbers, found dtype {x.dtype}.{hint}")
    return x


def _refuse_geometry(x: object, name: str) -> None:
    """Names the converter of clouds and meshes of Open3D and trimesh."""
    package = type(x).__module__.partition(".")[0]
    if package in ("open3d", "trimesh") and any(
        hasattr(x, part) for part in ("points", "vertices", "point", "vertex")
    ):
        raise TypeError(
            f"{name}: wanted an array, found {package}'s {type(x).__name__}; "
            f"jaxreg.io.points_of({name}) is its points."
        )


def as_host_numbers(x: object, name: str) -> np.ndarray:
    """Real numbers in float64 on the host, of what is written to files."""
    found = as_host_array(x, name)
    if found.dtype.kind not in "iuf":
        raise TypeError(f"{name}: wanted real numbers, found dtype {found.dtype}.")
    return found.astype(np.float64)
