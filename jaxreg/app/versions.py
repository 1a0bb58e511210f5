"""Versions of what runs."""

import platform
from importlib import metadata


def version(package: str) -> str:
    """The version of an installed package; a bare source tree has none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on, and the device."""
    found = {name: version(name) for name in ("jaxreg", "jax", "jaxlib", "numpy")}
    import jax  # who asks for one version need not wait for it

    device = jax.devices()[0]
    return {
        **found,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "device": f"{device.platform} {device.device_kind}",
    }
