"""Arrays of other libraries as NumPy arrays, and words on those that cannot be."""

from typing import Any

import jax
import numpy as np


def held_points(x: Any) -> Any:
    """The points of a cloud or mesh of Open3D or trimesh; all else as it is."""
    if type(x).__module__.partition(".")[0] not in ("open3d", "trimesh"):
        return x
    for part in ("point", "vertex"):  # Open3D's tensor kind
        if hasattr(x, part):
            return getattr(x, part).positions.cpu().numpy()
    for part in ("points", "vertices"):
        if hasattr(x, part):
            return np.asarray(getattr(x, part))
    return x


def as_host_array(x: object, name: str) -> np.ndarray:
    """What `numpy.asarray` or DLPack takes, or a cloud, as a NumPy array of numbers."""
    x = held_points(x)
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


def as_host_numbers(x: object, name: str) -> np.ndarray:
    """Real numbers in float64 on the host, of what is written to files."""
    found = as_host_array(x, name)
    if found.dtype.kind not in "iuf":
        raise TypeError(f"{name}: wanted real numbers, found dtype {found.dtype}.")
    return found.astype(np.float64)
