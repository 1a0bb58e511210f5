"""First calls of the functions of the public face: tracing, compiling and one run.

Caches are emptied before each call. The fixed program beside it tells how fast this
machine and this XLA compile.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxreg as jr
from bench.case import Case, Judged, Method, Options
from bench.workloads.local_data import draw, load
from jaxreg._core.program_room import drop_programs
from jaxreg.averaging import Correntropy, average
from jaxreg.datasets import sculpture_scans
from jaxreg.graph import PoseGraph
from tests.averaging.graphs import random_graph


def cases(options: Options) -> Iterator[Case]:
    """A case of all functions: the fixed program is compiled in turn with them."""
    pair = draw(load(None), 1_000, 0)
    clouds = jnp.asarray(pair.source), jnp.asarray(pair.target)
    X, edges, T, _wrong = random_graph(32, 465, 0.3, 0)
    graph = PoseGraph.from_edges(edges, T.astype(np.float32), len(X))
    guess = jnp.eye(4)
    scans, key = sculpture_scans(4, seed=0)[0], jax.random.key(0)
    own: dict[str, Callable[[], Any]] = {
        "jaxreg ICP": lambda: jr.register(*clouds, jr.ICP(), guess),
        "jaxreg ParticleFilter": lambda: jr.register(*clouds, key=key),
        "jaxreg Correntropy": partial(average, graph, Correntropy()),
        "jaxreg reconstruct": partial(jr.reconstruct, scans, key=key),
    }
    methods = [Method("fixed program", "jax", "eigh, svd and a loop", _compile_fixed)]
    for name, call in own.items():
        methods.append(Method(name, "jaxreg", "first call", partial(_first, call)))
    yield Case(
        name="first calls",
        data="generated",
        methods=methods,
        trials=[()],
        judge=lambda answers: Judged([]),
        repeats=5,
        reference="fixed program",
    )


def _first(call: Callable[[], Any]) -> None:
    drop_programs()
    jax.block_until_ready(call())


def _compile_fixed() -> None:
    jax.clear_caches()

    def body(_: int, A: jax.Array) -> jax.Array:
        w, V = jnp.linalg.eigh(A @ A.T)
        U, s, Vt = jnp.linalg.svd(A)
        return (V * jnp.sqrt(jnp.abs(w))) @ V.T + (U * s) @ Vt

    run = jax.jit(jax.vmap(lambda A: jax.lax.fori_loop(0, 10, body, A)))
    jax.block_until_ready(run(jnp.ones((16, 8, 8)) + jnp.eye(8)))
