"""New scans beside old ones whose poses are held.

The old frames are one body: motions between them count no more, and those of new scans
to any of them say where the new scan lies in the old world.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar
from jaxreg.averaging import AbstractAverager
from jaxreg.batching.padding import rounded_up
from jaxreg.geometry import lie
from jaxreg.matching import NO_EVIDENCE
from jaxreg.multiview.place import Placement, agreeing, joins, place
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.refine import measured, wide_unless_given
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.scan_blocks import rows_for
from jaxreg.multiview.solution import ReconstructionSolution


class Held(eqx.Module):
    """Poses that stay.

    Attributes:
        T_world_i: `(v, d+1, d+1)` in the input's frames and unit, the identity for the
            others.
        held: `(v,)` which scans stay.
        node: `(v,)` int32, 0 for these, and a number for each other scan; one more for
            the padding.
    """

    T_world_i: Float[Array, "v D D"]
    held: Bool[Array, " v"]
    node: Int[Array, " v"]

    @classmethod
    def of(cls, previous: ReconstructionSolution, scans: PreparedScans) -> "Held":
        """The placed scans of an earlier solution of the first of these scans."""
        more = scans.num_scans - previous.num_scans
        held = np.pad(np.asarray(previous.placed), (0, more))
        T = np.asarray(previous.T_world_i)
        T = np.concatenate(
            [T, np.tile(np.eye(T.shape[-1], dtype=T.dtype), (more, 1, 1))]
        )
        others = np.cumsum(~held & np.asarray(scans.present))
        node = np.where(np.asarray(scans.present), others, np.max(others) + 1)
        node = np.where(held, 0, node).astype(np.int32)
        return cls(jnp.asarray(T), jnp.asarray(held), jnp.asarray(node))

    def of_new(self, pairs: Int[Array, "p 2"]) -> Int[Array, "q 2"]:
        """Those of them that have to be measured: not those of scans that stay."""
        ids, held = np.asarray(pairs), np.asarray(self.held)
        ids = ids[(ids[:, 0] != ids[:, 1]) & ~held[ids].all(axis=1)]
        more = rounded_up(len(ids)) - len(ids)
        return jax.device_put(np.pad(ids, ((0, more), (0, 0))).astype(np.int32))

    def place(
        self,
        scans: PreparedScans,
        found: Placement,
        averaging: AbstractAverager | None,
        least: Scalar,
        pairs: Int[Array, "p 2"],
    ) -> Placement:
        """The others beside those that stay.

        Args:
            scans: prepared scans.
            found: where all of them lie, none held.
            averaging: as in `place`.
            least: log evidence of the pairs that count.
            pairs: those that may overlap (`near_pairs`), of scans that do not stay.
        """
        averaging, placed = wide_unless_given(averaging), _brought(self, scans, found)
        count = jnp.max(jnp.where(scans.present, self.node, 0)) + 1
        for exact in (False, True):
            motions = measured(scans, placed, least, pairs, exact=exact)
            motions = _contracted(self, placed, motions)
            nodes = place(motions, self._num_nodes, averaging, least, count)
            placed = _expanded(self, placed, nodes)
        return placed

    def in_round(
        self,
        scans: PreparedScans,
        found: RelativeMotions,
        size: int,
        averaging: AbstractAverager | None,
        least: Scalar,
    ) -> tuple[Placement, np.ndarray]:
        """Where all scans lie by what was found so far, and which pairs are trusted.

        Those of two that stay are trusted where they agree with their poses.

        Args:
            scans: prepared scans.
            found: motions of pairs, of NumPy arrays.
            size: for how many pairs to compile.
            averaging: as in `place`.
            least: log evidence of the pairs that count.
        """
        own = np.asarray(self.held)[found.pairs].all(axis=1)
        rows, before = np.flatnonzero(~own), _at_rest(self, scans)
        motions = found.on_host(rows).padded(rounded_up(len(rows)))
        motions = _contracted(self, before, motions)
        nodes = place(motions, self._num_nodes, averaging, least, scans.count)
        placed = _expanded(self, before, nodes)
        trusted = np.asarray(_agrees(found.padded(size), placed, least))[: len(own)]
        trusted = trusted & own
        trusted[rows] = np.asarray(joins(nodes.edge_weight))[: len(rows)]
        return placed, trusted

    @property
    def _num_nodes(self) -> int:
        return rows_for(2 + int(np.max(np.asarray(self.node))))

    def in_world(self, solution: ReconstructionSolution) -> ReconstructionSolution:
        """A solution in the world of those that stay, which have their very poses."""
        one = jnp.argmax(self.held)
        T_one_i = lie.between(solution.T_world_i[one], solution.T_world_i)
        T = jnp.where(
            solution.placed[:, None, None],
            self.T_world_i[one] @ T_one_i,
            solution.T_world_i,
        )
        T = jnp.where(self.held[:, None, None], self.T_world_i, T)
        return eqx.tree_at(lambda s: s.T_world_i, solution, T)


@kept_program
def _brought(hold: Held, scans: PreparedScans, found: Placement) -> Placement:
    """With the held poses; each other scan follows the held one nearest to it."""
    T_held = _centred(hold, scans)
    centre = lie.translation(found.T_world_i)

    def nearest(scan: tuple[Array, Array]) -> tuple[Array, Array]:
        here, part = scan
        beside = hold.held & (found.part == part)
        far = jnp.sum((centre - here) ** 2, axis=-1)
        return jnp.argmin(jnp.where(beside, far, jnp.inf)), jnp.any(beside)

    near, has_held = lax.map(nearest, (centre, found.part))
    T_near_i = lie.between(found.T_world_i[near], found.T_world_i)
    stays = hold.held | ~has_held
    T = jnp.where(hold.held[:, None, None], T_held, T_held[near] @ T_near_i)
    T = jnp.where((stays & ~hold.held)[:, None, None], found.T_world_i, T)
    with_held = hold.held | has_held
    part = jnp.where(with_held, jnp.argmax(with_held).astype(jnp.int32), found.part)
    return eqx.tree_at(lambda p: (p.T_world_i, p.part), found, (T, part))


def _centred(hold: Held, scans: PreparedScans) -> Float[Array, "v D D"]:
    """The poses that stay, of the centred frames, in the frame of the first."""
    ids = jnp.arange(scans.num_scans, dtype=jnp.int32)
    one = jnp.argmax(hold.held).astype(jnp.int32)
    T_one_i = lie.between(hold.T_world_i[one], hold.T_world_i)
    return scans.to_centred_frames(T_one_i, jnp.full_like(ids, one), ids)


@kept_program
def _at_rest(hold: Held, scans: PreparedScans) -> Placement:
    """Those that stay, in one part; each other scan alone."""
    ids, nothing = jnp.arange(scans.num_scans, dtype=jnp.int32), jnp.zeros(0, jnp.int32)
    T = _centred(hold, scans)
    eye = jnp.eye(T.shape[-1], dtype=T.dtype)
    return Placement(
        T_world_i=jnp.where(hold.held[:, None, None], T, eye[None]),
        part=jnp.where(hold.held, jnp.argmax(hold.held).astype(jnp.int32), ids),
        edge_weight=nothing.astype(T.dtype),
        mode=nothing,
        status=jnp.asarray(Status.CONVERGED, jnp.int32),
        trace=None,
        world=jnp.asarray(-1, jnp.int32),
        misfit=jnp.zeros_like(hold.held),
    )


@kept_program
def _agrees(
    motions: RelativeMotions, placed: Placement, least: Scalar
) -> Bool[Array, " e"]:
    return agreeing(motions, placed, least)[1]


@kept_program
def _contracted(
    hold: Held, before: Placement, motions: RelativeMotions
) -> RelativeMotions:
    """Motions between nodes; the frame of node 0 is the world."""
    i, j = motions.pairs[:, 0], motions.pairs[:, 1]
    T = before.T_world_i
    T = jnp.where(hold.held[:, None, None], T, jnp.eye(T.shape[-1], dtype=T.dtype))
    within = hold.held[i] & hold.held[j]
    return RelativeMotions(
        hold.node[motions.pairs],
        T[i][:, None] @ motions.T_i_j @ lie.inverse(T[j])[:, None],
        motions.overlap,
        jnp.where(within[:, None], NO_EVIDENCE, motions.log_evidence),
        motions.inlier_rmse,
    )


@kept_program
def _expanded(hold: Held, before: Placement, nodes: Placement) -> Placement:
    """Poses of the scans by those of the nodes."""
    beside = nodes.together(hold.node, jnp.zeros_like(hold.node))
    T = lie.between(nodes.T_world_i[0], nodes.T_world_i)[hold.node]
    moves = (beside & ~hold.held)[:, None, None]
    T = jnp.where(moves, T, before.T_world_i)
    ids = jnp.arange(len(beside), dtype=jnp.int32)
    part = jnp.where(beside, jnp.argmax(beside).astype(jnp.int32), ids)
    return eqx.tree_at(lambda p: (p.T_world_i, p.part), before, (T, part))
