"""Scans in a world that is known: poses, fixed or nearly, surveyed points, levels.

The motions between scans that were measured last are averaged once more, together with
what is known (`average` with `priors`, `fixed`, `control` and `levels`). They weigh by
the noise that they show.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.checks import is_concrete
from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Scalar
from jaxreg.averaging import AbstractAverager, Correntropy
from jaxreg.averaging.world.adjusted import Told
from jaxreg.averaging.world.adjustment import shown_information
from jaxreg.averaging.world.arguments import check_known
from jaxreg.averaging.world.known import Known
from jaxreg.averaging.world.solve import average_in_world, moved_back
from jaxreg.geometry import lie
from jaxreg.graph import PoseGraph
from jaxreg.linear.small import product
from jaxreg.multiview.pair_trust import pair_trust
from jaxreg.multiview.place import Placement
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.solution import ReconstructionSolution
from jaxreg.multiview.which_join import joins, prior_weight


class KnownWorld(eqx.Module):
    """What is known, in the frames of the scans and their unit.

    Attributes:
        known: less its origin.
    """

    known: Known

    @classmethod
    def of(
        cls,
        priors: Told,
        fixed: Told,
        control: Told,
        levels: Told,
        shape: tuple[int, int],
        dtype: np.dtype,
    ) -> "KnownWorld | None":
        """From the arguments of `reconstruct`; None if they are.

        Args:
            priors: as there.
            fixed: as there.
            control: as there.
            levels: as there.
            shape: the number of scans, and that of dimensions.
            dtype: of the scans.
        """
        if all(x is None for x in (priors, fixed, control, levels)):
            return None
        num_scans, d = shape
        edges, eye = np.zeros((1, 2), np.int32), np.eye(d + 1, dtype=dtype)[None]
        parts = edges, eye, np.ones(1, dtype), np.ones(1, bool)
        frames, eye, one, mask = map(jax.device_put, parts)
        blank = PoseGraph(frames, eye, one, mask, None, num_scans)
        known = check_known(priors, fixed, control, levels, blank, padded=True)
        return None if known is None else cls(known)

    @property
    def fixed(self) -> Bool[Array, " v"]:
        """Which scans are."""
        return self.known.poses.fixed

    def padded(self, num: int) -> "KnownWorld":
        """Of so many scans; nothing is known of those that are padding."""
        poses = self.known.poses.padded(num)
        return KnownWorld(dataclasses.replace(self.known, poses=poses))

    def place(
        self,
        scans: PreparedScans,
        found: Placement,
        motions: RelativeMotions,
        averaging: AbstractAverager | None,
        least: Scalar,
    ) -> tuple[Placement, Float[Array, " k"]]:
        """Poses in the world, and the trust in each prior, then point, then level.

        Args:
            scans: prepared scans.
            found: where they lie beside each other.
            motions: between them, near the poses, m = 1.
            averaging: None for `Correntropy`.
            least: log evidence of the pairs that count.
        """
        averaging = Correntropy() if averaging is None else averaging
        known = dataclasses.replace(self.known.of_any_number, origin=None)
        told = known, scans, found, motions, averaging, least
        placement, trust = _placed(*told)
        return placement, self.known.without_padding(trust)

    def origin_of(self, solution: ReconstructionSolution) -> np.ndarray | None:
        """What is to be added to poses in the world, None where none lies in it."""
        if not is_concrete(solution.status):
            return None
        inside = int(solution.status) != Status.DEGENERATE
        return self.known.origin if inside else None

    def in_world(
        self, solution: ReconstructionSolution, fixed: Told, *, moved: bool
    ) -> ReconstructionSolution:
        """Where the world's own origin is, and fixed poses as they were given.

        Args:
            solution: of scans in the frames of the input.
            fixed: the argument of `reconstruct`.
            moved: whether the world's origin is there already.
        """
        T, origin = solution.T_world_i, self.known.origin
        if origin is not None and not moved:
            inside = solution.placed & (solution.status != Status.DEGENERATE)
            T = moved_back(T, inside, origin)
        if isinstance(T, np.ndarray):
            T = T.copy()
        for frame, pose in fixed or ():
            if isinstance(T, np.ndarray):
                T[frame] = pose
            else:
                T = T.at[frame].set(jnp.asarray(pose, T.dtype))
        return eqx.tree_at(lambda s: s.T_world_i, solution, T)


@kept_program
def _placed(
    known: Known,
    scans: PreparedScans,
    found: Placement,
    motions: RelativeMotions,
    averaging: AbstractAverager,
    least: Scalar,
) -> tuple[Placement, Array]:
    weight = prior_weight(motions, least)
    i, j = motions.pairs[:, 0], motions.pairs[:, 1]
    weight = jnp.where(found.together(i, j), weight, 0)
    trust = pair_trust(scans, motions, found, weight)
    graph = PoseGraph(
        motions.pairs, motions.T_i_j[:, 0], weight, weight > 0, None, scans.num_scans
    )
    held = jax.lax.stop_gradient((found.T_world_i, trust))
    graph = eqx.tree_at(
        lambda g: g.information,
        graph,
        shown_information(graph, *held),
        is_leaf=lambda x: x is None,
    )
    out = average_in_world(graph, averaging, centred(known, scans), found.T_world_i)
    beside = out.status != Status.DEGENERATE
    joined = out.placed & beside
    root = jnp.argmax(joined).astype(jnp.int32)
    placement = eqx.tree_at(
        lambda p: (p.T_world_i, p.part, p.world, p.status),
        found,
        (
            jnp.where(joined[:, None, None], out.T_world_i, found.T_world_i),
            jnp.where(joined, root, found.part),
            jnp.where(beside, root, -1),
            out.status,
        ),
    )
    # Edges between fixed frames are none of the average's.
    both = known.poses.fixed[i] & known.poses.fixed[j]
    given = pair_trust(scans, motions, placement, weight)
    had = joins(_best(motions, trust, scans.num_scans))
    still = jnp.where(both, given, out.edge_weight)
    fits = joins(_best(motions, jnp.where(weight > 0, still, 0), scans.num_scans))
    misfit = known.poses.fixed & had & ~fits
    placement = eqx.tree_at(lambda p: p.misfit, placement, misfit)
    assert out.prior_weight is not None
    return placement, out.prior_weight


def _best(
    motions: RelativeMotions, trust: Float[Array, " e"], num_scans: int
) -> Float[Array, " v"]:
    """The largest trust in a pair of each scan."""
    none = jnp.zeros(num_scans, trust.dtype)
    return none.at[motions.pairs].max(trust[:, None])


def centred(known: Known, scans: PreparedScans) -> Known:
    """What is known of the centred frames, with their radius as the unit.

    A small motion e of a frame is `inv(S) Ad(inv(C)) e` of its centred frame, which is
    shifted by C and scaled by S.
    """
    p, r, d = known.poses, scans.radius, scans.mean.shape[-1]
    info = p.information
    if info is not None:
        shift = jnp.broadcast_to(jnp.eye(d, dtype=r.dtype), (len(p.frame), d, d))
        size = jnp.where(jnp.arange(info.shape[-1]) < d, r, 1)
        J = lie.adjoint(lie.compose(shift, scans.mean[p.frame])) * size
        info = product(product(jnp.swapaxes(J, -1, -2), info), J)
    poses = dataclasses.replace(
        p,
        T_world_prior=_of_middle(p.T_world_prior, scans, p.frame),
        information=info,
        T_world_fixed=_of_middle(p.T_world_fixed, scans, jnp.arange(scans.num_scans)),
    )
    points = known.points
    if points is not None:
        W = points.information
        points = dataclasses.replace(
            points,
            in_frame=(points.in_frame - scans.mean[points.frame]) / r,
            in_world=points.in_world / r,
            information=None if W is None else W * r**2,
        )
    return dataclasses.replace(known, poses=poses, points=points)


def _of_middle(
    T: Float[Array, "n D D"], scans: PreparedScans, frame: Int[Array, " n"]
) -> Float[Array, "n D D"]:
    """Of the centred frame, in radii."""
    R = lie.rotation(T)
    moved = jnp.sum(R * scans.mean[frame][:, None], axis=-1)
    return lie.compose(R, (lie.translation(T) + moved) / scans.radius)
