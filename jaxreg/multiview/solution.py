"""What `reconstruct` returns."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.checks import is_concrete
from jaxreg._core.status import Status, counted
from jaxreg._core.typing import StatusArray
from jaxreg.averaging import AveragingTrace
from jaxreg.graph import PoseGraph
from jaxreg.multiview.averaged_pairs import AveragedPairs
from jaxreg.multiview.relative_motions import RelativeMotions


class ReconstructionSolution(eqx.Module):
    """One pose per scan, and every pair that was tried.

    Attributes:
        T_world_i: `(v, d+1, d+1)` maps scan i to the world of its component, which is
            the frame of the component's first scan, or that of what is known. Identity
            for scans alone.
        status: int32; CONVERGED if every scan is placed, AMBIGUOUS if some of them
            could as well lie otherwise, NO_AGREEMENT if no pairs agree with each other;
            DISCONNECTED if some are not placed; DEGENERATE if what is known of the
            world holds no part of them: poses are then relative ones.
        scan_status: `(v,)` int32; CONVERGED (or NO_AGREEMENT, see `status`) where
            placed, DISCONNECTED in another component; AMBIGUOUS where the surfaces of
            no two scans together keep a scan from slipping along the rest of its
            component, as of spheres, or where all its pairs overlap as much in another
            mode, as of cubes; of scans that join no other LOW_OVERLAP, TOO_FEW_POINTS,
            or UNIT_DIFFERS.
        placed: `(v,)` the scans of component 0.
        component: `(v,)` int32, the scans that trusted pairs join have one number: 0 is
            the component of most scans, or of those whose poses are held, or all that
            what is known brings into the world, -1 stands for scans alone. Nothing is
            known of how two components lie.
        graph: every pair that was registered, `T_i_j` in the input's frames and unit,
            of the mode that agrees with the other pairs, of the best mode if none does;
            prior weight the overlap where it is trusted and else 0.
        overlap: `(e,)` see `RegistrationSolution`.
        edge_weight: `(e,)` trust, 0 to 1: how well the pair's own motion agrees with
            the final poses, by a Gaussian of the displacement of the scan whose width
            is the sample spacing; 0 where the overlap is too small or the scans are
            of two components.
        inlier_rmse: `(e,)` distance of that share, in the unit of the input.
        mode: `(e,)` int32, which of the pair's modes that is, 0 the best.
        motions: every mode of every pair, in the input's frames and unit.
        averaged: the pairs that the poses rest on in the end, found by the search or
            not; their motions were measured anew.
        num_dropped: `(v,)` rows that were not finite.
        trace: how the averaging that chose the pairs came to rest, lengths in the unit
            of the input; None if its method takes no steps.
        prior_weight: `(p,)` how far each prior is trusted, then each control point,
            then each level, from 0 to 1; 0 for priors of scans that are fixed. None
            without any.
    """

    T_world_i: Float[Array, "v D D"]
    status: StatusArray
    scan_status: Int[Array, " v"]
    placed: Bool[Array, " v"]
    component: Int[Array, " v"]
    graph: PoseGraph
    overlap: Float[Array, " e"]
    edge_weight: Float[Array, " e"]
    inlier_rmse: Float[Array, " e"]
    mode: Int[Array, " e"]
    motions: RelativeMotions
    averaged: AveragedPairs
    num_dropped: Int[Array, " v"]
    trace: AveragingTrace | None = None
    prior_weight: Float[Array, " p"] | None = None

    @property
    def num_scans(self) -> int:
        """V."""
        return self.placed.shape[0]

    def of_pairs(self, num: int) -> "ReconstructionSolution":
        """With the first so many pairs; the others were padding."""

        def pairs_of(s: ReconstructionSolution) -> tuple[object, ...]:
            g = s.graph
            of_graph = g.edges, g.T_i_j, g.weight, g.mask
            of_pairs = s.overlap, s.edge_weight, s.inlier_rmse, s.mode
            return *of_graph, *of_pairs, s.motions

        parts = _first(pairs_of(self), num)
        return eqx.tree_at(pairs_of, self, parts)

    def of_scans(self, num: int) -> "ReconstructionSolution":
        """Of the first so many scans; the others were padding."""

        def scans_of(s: ReconstructionSolution) -> tuple[object, ...]:
            poses = s.T_world_i, s.scan_status, s.placed
            return *poses, s.component, s.num_dropped

        parts = _first(scans_of(self), num)
        graph = dataclasses.replace(self.graph, num_poses=num)
        return eqx.tree_at(lambda s: (*scans_of(s), s.graph), self, (*parts, graph))

    def __repr__(self) -> str:
        """One line: status, scans placed, what the others have, pairs trusted."""
        if not is_concrete(self.status):
            return f"ReconstructionSolution(T_world_i {self.T_world_i.shape})"
        if self.status.ndim:
            batch = f"batch={self.status.shape}, {counted(self.status)}"
            return f"ReconstructionSolution({batch})"
        component = np.asarray(self.component)
        others = np.bincount(component + 1)[2:]
        more = f", apart from them {' and '.join(map(str, others))}"
        left = np.asarray(self.scan_status)[component < 0]
        left = f" ({counted(left)})" if len(left) else ""
        return (
            f"ReconstructionSolution({Status(int(self.status)).name}, "
            f"{int(jnp.sum(self.placed))} of {self.placed.size} scans placed{left}"
            f"{more if len(others) else ''}, "
            f"{int(jnp.sum(self.edge_weight > 0.5))} of {self.overlap.size} pairs "
            "trusted)"
        )


def _first(parts: tuple[object, ...], num: int) -> tuple[object, ...]:
    """The first rows, cut on the host: there no program is compiled for each number.

    But for those with derivatives.
    """

    def cut(x: jax.Array) -> jax.Array | np.ndarray:
        return (np.asarray(x) if is_concrete(x) else x)[:num]

    return jax.device_put(jax.tree.map(cut, parts))
