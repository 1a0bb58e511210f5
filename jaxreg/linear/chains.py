"""An approximate inverse of graph Laplacians that are chains for the most part.

Sequences with few closures are: most frames stand between the one before and the one
behind, and a multigrid cycle, which must find out how long chains bend, needs hundreds
of rounds for them. A chain is a row of springs: compliances add up, and what forces on
its inner frames do are sums along it. So the frames at the ends of chains, with one
edge for each chain, are a small graph with the same solution. Conjugate gradients solve
that, and the inner frames follow exactly.

Sizes are static: there is room for so many ends and closures as a sequence of as many
edges has. Other graphs of few edges, and damped ones, whose frames are all tied to the
ground, get the multigrid cycle of the whole.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg.linear.carried import carried, carried_back, stiffness_carried_back
from jaxreg.linear.krylov import conjugate_gradients
from jaxreg.linear.multigrid import Multigrid, block_inverses, multigrid
from jaxreg.linear.operator import GraphLaplacian
from jaxreg.linear.small import after, product


# Room for two ends of each closure and some gaps; worth it up to a quarter of so many
# frames at least: of fewer a cycle of the whole solves in less than a second, and
# compiles in two thirds of the time.
_ENDS, _GAPS, _WORTH, _LONG = 2, 64, 4, 8192
# What is left of the small system: the rounds outside are few then, one to eight on a
# chain of 10,000 frames.
_LEFT, _ROUNDS = 1e-3, 100


class _Order(NamedTuple):
    """Which frames are ends of chains, and which are inner ones."""

    inner: Bool[Array, " v"]
    begin: Int[Array, " v"]  # the last end before each frame, by number
    row: Int[Array, " v"]  # of an end in the small graph; m for other frames
    behind: Int[Array, " v"]  # row of the first end from each frame on
    frame: Int[Array, " m"]  # of each row, v - 1 where there is none
    arrives: Bool[Array, " m"]  # a chain does at this row, from the row of `begin`
    is_end: Bool[Array, " m"]
    fits: Bool[Array, ""]

    def along(self, x: Float[Array, "v ..."]) -> Float[Array, "v ..."]:
        """Sums over each chain, from the frame behind its begin to every frame."""
        starts = jnp.roll(~self.inner, 1).at[0].set(True)

        def both(first: tuple, second: tuple) -> tuple:
            begins = second[0][:, None, None]
            return first[0] | second[0], jnp.where(begins, 0, first[1]) + second[1]

        return jax.lax.associative_scan(both, (starts, x))[1]

    def before(self, x: Float[Array, "v ..."]) -> Float[Array, "v ..."]:
        """Of the inner frame before each frame; 0 behind an end."""
        return jnp.where(self.inner[:, None, None], x, 0).take(
            jnp.arange(-1, len(x) - 1), axis=0, mode="wrap"
        )


class Chains(NamedTuple):
    """The approximate inverse of a matrix whose chains fit."""

    order: _Order
    compliance: Float[Array, "v k k"]  # of the step to each frame, at the begin
    stiffness: Float[Array, "m k k"]  # of the chain to each row, at the begin
    lever: Float[Array, "v d"] | None  # from the point of the begin to that of a frame
    ends: GraphLaplacian
    cycle: Multigrid  # of `ends`

    def __call__(self, r: Float[Array, "v k c"]) -> Float[Array, "v k c"]:
        """Approximately solves for right-hand sides r."""
        order, at = self.order, self.order.frame
        inner, arrives = order.inner[:, None, None], order.arrives[:, None, None]
        force = r if self.lever is None else carried_back(r, self.lever)
        # Each step bears the pull of its chain, less the forces before it.
        pushed = order.before(order.along(jnp.where(inner, force, 0)))
        given = order.along(product(self.compliance, pushed))
        held = product(self.stiffness, given[at])
        to_end = jnp.where(arrives, pushed[at] - held, 0)
        if self.lever is not None:
            to_end = carried_back(to_end, -self.lever[at])
        low = order.row[order.begin[at]]
        rhs = jnp.where(order.is_end[:, None, None], r[at], 0) + to_end
        rhs = rhs.at[low].add(jnp.where(arrives, held, 0), mode="drop")
        x = conjugate_gradients(
            self.ends.mv, self.cycle, rhs, tolerance=_LEFT, max_steps=_ROUNDS
        )[0]
        seen = x if self.lever is None else carried(x, -self.lever[at])
        pull = held + product(self.stiffness, seen - x[low])
        strain = product(self.compliance, pull[order.behind] - pushed)
        y = x[order.row[order.begin]] + order.along(jnp.where(inner, strain, 0))
        y = y if self.lever is None else carried(y, self.lever)
        own = jnp.where((order.row < len(at))[:, None, None], x[order.row], 0)
        return jnp.where(inner, y, own)


class Chained(NamedTuple):
    """By chains where they fit, else by a cycle of the whole."""

    chains: Chains
    cycle: Multigrid

    def __call__(self, r: Float[Array, "v k c"]) -> Float[Array, "v k c"]:
        """Approximately solves for right-hand sides r, each by itself."""
        fits = self.chains.order.fits
        return control.cond(fits, lambda: self.chains(r), lambda: self.cycle(r))


def near_inverse(matrix: GraphLaplacian) -> Multigrid | Chained:
    """Of a matrix of positive semidefinite weights: by chains where they are long."""
    num = len(matrix.own)
    room = _ENDS * max(len(matrix.edges) - num + 1, 0) + _GAPS
    if num < max(_LONG, _WORTH * room):
        return multigrid(matrix)
    by_chains = chains(matrix, room)
    blank = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(multigrid, matrix)
    )
    # Side by side under `vmap`, and both have a call of LAPACK.
    weight = after(matrix.weight, by_chains.cycle.bottom)
    whole = dataclasses.replace(matrix, weight=weight)
    fits = by_chains.order.fits
    cycle = control.cond(fits, lambda: blank, lambda: multigrid(whole))
    return Chained(by_chains, cycle)


def chains(matrix: GraphLaplacian, room: int) -> Chains:
    """The chains of a matrix, with room for so many ends, and so many other edges."""
    i, j = matrix.edges[:, 0], matrix.edges[:, 1]
    high = jnp.maximum(i, j)
    present = (jnp.trace(matrix.weight, axis1=-2, axis2=-1) > 0) & (i != j)
    step = present & (jnp.abs(i - j) == 1)
    order = _order(matrix, present, step, room)
    origin, lever, stiff = matrix.origin, None, matrix.weight
    if origin is not None:
        lever = origin - origin[order.begin]
        stiff = stiffness_carried_back(stiff, origin[j] - origin[order.begin[high]])
    to = jnp.where(step, high, len(matrix.own))
    total = jnp.zeros_like(matrix.own).at[to].add(stiff, mode="drop")
    compliance = block_inverses(total)
    stiffness = block_inverses(order.along(compliance)[order.frame])
    stiffness = jnp.where(order.arrives[:, None, None], stiffness, 0)
    ends = _ends(matrix, order, present & ~step, stiffness)
    return Chains(order, compliance, stiffness, lever, ends, multigrid(ends))


def _order(matrix: GraphLaplacian, present: Array, step: Array, room: int) -> _Order:
    num = len(matrix.own)
    i, j = matrix.edges[:, 0], matrix.edges[:, 1]
    here, none = jnp.arange(num, dtype=jnp.int32), jnp.zeros((num,), jnp.int32)
    steps = none.at[jnp.maximum(i, j)].add(step)  # to each frame
    degree = none.at[i].add(present).at[j].add(present)
    tied = jnp.trace(matrix.own, axis1=-2, axis2=-1) > 0
    inner = (steps == 1) & (jnp.roll(steps, -1) == 1) & (degree == 2) & ~tied
    inner = inner.at[0].set(False).at[-1].set(False)
    is_end = ~inner & ((degree > 0) | tied)
    place = jnp.cumsum(is_end, dtype=jnp.int32) - 1
    row = jnp.where(is_end, jnp.minimum(place, room), room)
    last = jax.lax.cummax(jnp.where(is_end, here, 0))
    begin = jnp.roll(last, 1).at[0].set(0)
    frame = jnp.full((room,), num - 1, jnp.int32).at[row].set(here, mode="drop")
    there = jnp.arange(room) <= place[-1]
    fits = (place[-1] < room) & (jnp.sum(present & ~step) <= room)
    behind = jax.lax.cummin(row, reverse=True)
    arrives = there & (steps[frame] > 0)
    return _Order(inner, begin, row, behind, frame, arrives, there, fits)


def _ends(
    matrix: GraphLaplacian,
    order: _Order,
    other: Bool[Array, " e"],
    stiffness: Float[Array, "m k k"],
) -> GraphLaplacian:
    """The ends of chains: an edge for each chain, and the other edges."""
    count, room = len(matrix.edges), len(order.frame)
    slot = jnp.where(other, jnp.cumsum(other, dtype=jnp.int32) - 1, room)
    edge = jnp.full((room,), count, jnp.int32)
    edge = edge.at[slot].set(jnp.arange(count, dtype=jnp.int32), mode="drop")
    there, edge = edge < count, jnp.minimum(edge, count - 1)
    rows = jnp.minimum(order.row, room - 1)
    closures = jnp.where(there[:, None], rows[matrix.edges[edge]], 0)
    # Chains are stiff at the points of their begins: those come second.
    ends = jnp.stack([jnp.arange(room), rows[order.begin[order.frame]]], axis=1)
    ends = jnp.where(order.arrives[:, None], ends, 0).astype(jnp.int32)
    return GraphLaplacian(
        jnp.concatenate([closures, ends]),
        jnp.concatenate(
            [jnp.where(there[:, None, None], matrix.weight[edge], 0), stiffness]
        ),
        jnp.where(order.is_end[:, None, None], matrix.own[order.frame], 0),
        None if matrix.origin is None else matrix.origin[order.frame],
    )
