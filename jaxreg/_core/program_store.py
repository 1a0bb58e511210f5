"""A folder of traced programs, each found by what is asked."""

import functools
import platform
import warnings
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.checks import is_concrete
from jaxreg._core.program_call import Call
from jaxreg._core.program_files import Hole, digest, pickled, read, write
from jaxreg._core.programs_ahead import ProgramsAhead


class Program(NamedTuple):
    """A traced program, and what its answer looks like."""

    run: Any  # what `jax.jit` makes
    skeleton: Any  # the answer with holes for arrays
    exported: Any
    kept: bool  # whether it was on disk

    @classmethod
    def of(cls, exported: Any, skeleton: Any, kept: bool) -> "Program":
        """From what a file has."""
        return cls(jax.jit(exported.call), skeleton, exported, kept)

    def __call__(self, args: Any, kwargs: Any) -> Any:
        given = jax.tree.leaves(eqx.filter((args, kwargs), eqx.is_array))
        leaves = self.run(*given)
        if self.platform == "cpu" and not any(map(is_committed, given)):
            leaves = _uncommitted(leaves)
        return self._filled(leaves)

    @property
    def platform(self) -> str:
        """Of the only one that it is for."""
        (platform,) = self.exported.platforms
        return platform

    def lowered(self) -> Any:
        """What a thread can compile; `run` then finds it compiled."""
        return self.run.lower(*map(_shape, self.exported.in_avals))

    @property
    def gives(self) -> Any:
        """The answer with shapes for arrays."""
        return self._filled([_shape(x) for x in self.exported.out_avals])

    def _filled(self, leaves: list[Any]) -> Any:
        holes, rest = eqx.partition(self.skeleton, lambda x: isinstance(x, Hole))
        return eqx.combine(jax.tree.unflatten(jax.tree.structure(holes), leaves), rest)


class ProgramStore:
    """A folder of programs, and those that this process has met."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._met: dict[Any, Program | None] = {}
        self._ahead = ProgramsAhead(folder, self._compiled)
        self._wide = False
        self._told = False

    def program(self, call: Call) -> Program | None:
        """The program of a call; None if it cannot be kept."""
        if call.key not in self._met:
            self._met[call.key] = self._made(call)
        return self._met[call.key]

    def _made(self, call: Call) -> Program | None:
        """From the folder, else traced and put there."""
        who = call.function.__module__, call.function.__qualname__
        try:
            name = digest(pickled((*who, call.asked)), *call.settings, *_code())
        except Exception:  # noqa: BLE001  whatever the pickling of an object raises
            return None
        self._wide = jnp.result_type(float) == jnp.float64
        found = self._ahead.ask(name) or self._read(name)
        if found is not None:
            return found
        made = _exported(call)
        if made is None:
            return None
        self._write(self.folder / f"{name}.program", *made)
        return Program.of(*made, kept=False)

    def _read(self, name: str) -> Program | None:
        found = read(self.folder / f"{name}.program")
        return None if found is None else Program.of(*found, kept=True)

    def _compiled(self, name: str) -> Program | None:
        """From the folder, ready to run; in a thread, which has settings of its own."""
        program = self._read(name)
        if program is not None and program.platform == jax.default_backend():
            with jax.enable_x64(self._wide):
                program.lowered().compile()
        return program

    def _write(self, path: Path, exported: Any, skeleton: Any) -> None:
        """A folder that takes nothing is told of once."""
        try:
            write(path, exported, skeleton)
        except OSError as err:
            if not self._told:
                told = f"{self.folder}: programs cannot be kept: {err}"
                warnings.warn(told, stacklevel=2)
            self._told = True


def _shape(aval: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=aval.weak_type)


def is_committed(x: Any) -> bool:
    return isinstance(x, jax.Array) and x.committed


def _uncommitted(leaves: list[jax.Array]) -> list[jax.Array]:
    """On no device for good, as the answers of programs that are traced.

    JAX commits what exported programs give; what is then given both ways is compiled
    twice. By NumPy nothing is copied on a CPU; 20 arrays take 0.4 ms.
    """
    if not all(map(is_concrete, leaves)):  # traced in a program of the user
        return leaves
    kinds = [_kind_of_key(x) for x in leaves]
    bare = [
        x if kind is None else jax.random.key_data(x)
        for x, kind in zip(leaves, kinds, strict=True)
    ]
    there = jax.device_put(list(map(np.asarray, bare)))
    return [
        x if kind is None else jax.random.wrap_key_data(x, impl=kind)
        for x, kind in zip(there, kinds, strict=True)
    ]


def _kind_of_key(x: jax.Array) -> Any:
    """Of random numbers that a key draws; None of other arrays."""
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return jax.random.key_impl(x) if is_key else None


@functools.cache
def _code() -> tuple[str, ...]:
    """Versions, and the code of this package itself, which may be a checkout."""
    root = Path(__file__).parents[1]
    files = sorted(root.rglob("*.py"))
    code = digest(*(part for p in files for part in (str(p), p.read_bytes())))
    libraries = ("jax", "jaxlib", "equinox", "lineax", "optimistix", "numpy")
    versions = (metadata.version(name) for name in libraries)
    return code, platform.python_version(), *versions


def _exported(call: Call) -> tuple[Any, Any] | None:
    """The traced program and the skeleton of its answer; None if it cannot be kept."""
    from jax import export

    arrays, static = eqx.partition((call.args, call.kwargs), eqx.is_array)
    leaves, places = jax.tree.flatten(arrays)
    skeletons = []

    def flat(*leaves: Any) -> list[Any]:
        args, kwargs = eqx.combine(jax.tree.unflatten(places, leaves), static)
        answer = call.function(call.platform, args, kwargs)
        arrays, rest = eqx.partition(answer, eqx.is_array)
        skeletons.append(eqx.combine(jax.tree.map(lambda _: Hole(), arrays), rest))
        return jax.tree.leaves(arrays)

    flat.__name__ = call.function.__name__
    try:
        return export.export(jax.jit(flat))(*leaves), skeletons[-1]
    except Exception:  # noqa: BLE001  `filter_jit` then raises what a user did wrong
        return None
