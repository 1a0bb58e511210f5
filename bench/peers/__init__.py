"""Other libraries, called as their users call them."""

import importlib


#: Module to import, by the name of the package.
PEERS = {
    "open3d": "open3d",
    "small_gicp": "small_gicp",
    "gtsam": "gtsam",
    "kiss-icp": "kiss_icp",
    "kiss-matcher": "kiss_matcher",
    "probreg": "probreg",
    "pycpd": "pycpd",
    "scipy": "scipy",
    "pykdtree": "pykdtree.kdtree",
    "jaxkd": "jaxkd",
    "pypose": "pypose",
    "theseus-ai": "theseus",
}


def missing(library: str) -> str | None:
    """Why a library cannot be used, or None."""
    try:
        importlib.import_module(PEERS.get(library, library))
    except ModuleNotFoundError as err:
        own = PEERS.get(library, library).split(".")[0]
        return "not installed" if err.name == own else str(err)
    except Exception as err:  # broken builds raise anything
        return f"{type(err).__name__}: {err}"
    return None
