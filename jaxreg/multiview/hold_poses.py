"""New scans beside old ones whose poses are held.

The old frames are one body: motions between them count no more, and those of new scans
to any of them say where the new scan lies in the old world.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar
from jaxreg.averaging import AbstractAverager
from jaxreg.batching.padding import rounded_up
from jaxreg.geometry import lie
from jaxreg.matching import NO_EVIDENCE
from jaxreg.multiview.averaged_pairs import AveragedPairs
from jaxreg.multiview.place import Placement, agreeing, place
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.refine import measured, wide_unless_given
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.scan_blocks import rows_for
from jaxreg.multiview.solution import ReconstructionSolution
from jaxreg.multiview.which_join import roughly


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
        motions: RelativeMotions,
        averaging: AbstractAverager | None,
        least: Scalar,
        within: Scalar | None = None,
    ) -> Placement:
        """Where all scans lie by what was found; averages what is new alone.

        Pairs of two that stay are trusted where they agree with their poses.

        Args:
            scans: prepared scans.
            motions: of pairs, some of them padding.
            averaging: as in `place`.
            least: log evidence of the pairs that count.
            within: as in `place`.
        """
        pairs = np.asarray(motions.pairs)
        held, padding = np.asarray(self.held)[pairs], pairs[:, 0] == pairs[:, 1]
        (rows,) = np.nonzero(~(held.all(axis=1) | padding))
        before = _at_rest(self, scans)
        new = motions.on_host(rows).padded(rounded_up(len(rows)))
        new = _contracted(self, before, new)
        told = averaging, least, scans.count, None, within
        nodes = place(new, self._num_nodes, *told)
        placed = _expanded(self, scans.present, before, nodes)
        mode, agrees = map(np.array, _agreeing(motions, placed, least))
        agrees[padding] = False
        status, some = nodes.status, bool(np.any(np.delete(agrees, rows)))
        if some and int(status) == Status.NO_AGREEMENT:
            status = jnp.asarray(Status.CONVERGED, jnp.int32)
        trust = agrees.astype(before.T_world_i.dtype)
        trust[rows] = np.asarray(nodes.edge_weight)[: len(rows)]
        mode[rows] = np.asarray(nodes.mode)[: len(rows)]
        told = jnp.asarray(trust), jnp.asarray(mode), status, nodes.trace
        return eqx.tree_at(
            lambda p: (p.edge_weight, p.mode, p.status, p.trace),
            placed,
            told,
            is_leaf=lambda x: x is None,
        )

    def refine(
        self,
        scans: PreparedScans,
        placed: Placement,
        averaging: AbstractAverager | None,
        least: Scalar,
        pairs: Int[Array, "p 2"],
    ) -> tuple[Placement, AveragedPairs]:
        """The others by pairs measured anew, beside those that stay; and these pairs.

        Args:
            scans: prepared scans.
            placed: by `place`.
            averaging: as in `refine`.
            least: log evidence of the pairs that count.
            pairs: those that may overlap (`near_pairs`), of scans that do not stay.
        """
        averaging = wide_unless_given(averaging)
        count = jnp.max(jnp.where(scans.present, self.node, 0)) + 1
        told = averaging, least, count, None, roughly(least)
        for exact in (False, True):
            motions, log_odds = measured(scans, placed, least, pairs, exact=exact)
            of_nodes = _contracted(self, placed, motions)
            nodes = place(of_nodes, self._num_nodes, *told, log_odds)
            placed = _expanded(self, scans.present, placed, nodes)
        return placed, AveragedPairs.of(motions, nodes, least)

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


_agreeing = kept_program(agreeing)


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
def _expanded(
    hold: Held, present: Bool[Array, " v"], before: Placement, nodes: Placement
) -> Placement:
    """Poses of the scans by those of the nodes, in the world of those that stay."""
    T = lie.between(nodes.T_world_i[0], nodes.T_world_i)[hold.node]
    T = jnp.where(hold.held[:, None, None], before.T_world_i, T)
    part = nodes.part[hold.node]
    ids = jnp.arange(len(part), dtype=jnp.int32)
    part = jax.ops.segment_min(ids, part, len(part))[part]
    part = jnp.where(present, part, ids)
    world = part[jnp.argmax(hold.held)]
    return eqx.tree_at(
        lambda p: (p.T_world_i, p.part, p.world), before, (T, part, world)
    )
