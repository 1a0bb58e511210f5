import gc
import os
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import pytest
from helpers import switched_on


# Set before JAX starts: compiled programs are shared between runs and workers.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".jax_cache")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
os.environ.setdefault("MPLBACKEND", "agg")
# Compiling is what most tests cost; `fully_compiled` is for those that compute.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# The older of two generators of kernels takes half of the time; later there is but one.
_FLAGS = ["--xla_cpu_use_fusion_emitters=false"] * version("jaxlib").startswith("0.10.")
# For what spreads over devices; all else stays on the first.
_FLAGS += ["--xla_force_host_platform_device_count=8"]
os.environ.setdefault("XLA_FLAGS", " ".join(_FLAGS))


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what `slow.txt` names."""
    lines = (Path(__file__).parent / "slow.txt").read_text().splitlines()
    slow = {f"tests/{line}" for line in lines if not line.startswith("#")}
    for item in items:
        if slow & {item.nodeid, item.nodeid.partition("[")[0]}:
            item.add_marker("slow")


def pytest_collection_finish() -> None:
    """Tracing makes much garbage: looking through all that lives costs a fifth."""
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


@pytest.fixture(scope="module", autouse=True)
def _bounded_number_of_live_programs() -> Iterator[None]:
    """A process that holds hundreds of compiled programs can die on CPU."""
    yield
    import jax

    jax.clear_caches()
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _programs_are_traced_anew() -> Iterator[None]:
    """What a test replaces in the package is no part of the key of a kept program."""
    yield
    from jaxreg._core.programs import keep_programs

    keep_programs(None)


@pytest.fixture(scope="module")
def fully_compiled() -> Iterator[None]:
    """For modules of large problems, whose time is that of computing."""
    with switched_on("jax_disable_most_optimizations", to=False):
        yield
