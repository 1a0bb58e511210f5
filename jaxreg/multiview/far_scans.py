"""Scans far from their origins, such as map coordinates: moved there and back."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.checks import as_host_numbers
from jaxreg.averaging.world.adjusted import Told
from jaxreg.multiview.positions import ScanPositions
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.solution import ReconstructionSolution
from jaxreg.registration.far import pose_back, pose_moved


_Known = tuple[Told, Told, Told, Told]
OnPairs = Callable[[RelativeMotions], None]


class FarScans:
    """Scans of which those that were far are about their middles.

    Args:
        origin: `(v, d)` float64, what was subtracted from each (`near_origin`); None if
            nothing was.

    Attributes:
        moved: whether any were far; else nothing is changed.
        origin: likewise, without rows if nothing was moved.
    """

    def __init__(self, origin: np.ndarray | None) -> None:
        self.moved = origin is not None
        self.origin = np.zeros((0, 0)) if origin is None else origin

    def viewpoints(self, viewpoints: object) -> object:
        """In the moved frames."""
        if viewpoints is None or not self.moved:
            return viewpoints
        if not isinstance(viewpoints, list | tuple):
            return self._less_origin(as_host_numbers(viewpoints, "viewpoints"))
        if len(viewpoints) != len(self.origin):
            return viewpoints
        known = [x is not None for x in viewpoints]
        rows = [
            as_host_numbers(x, f"viewpoints[{i}]") if known[i] else self.origin[i]
            for i, x in enumerate(viewpoints)
        ]
        if any(x.shape != self.origin[0].shape for x in rows):
            return viewpoints
        moved = self._less_origin(np.stack(rows))
        return [x if known[i] else None for i, x in enumerate(moved)]

    def _less_origin(self, x: np.ndarray) -> np.ndarray:
        """Places of the scans; those of another number are refused by who gets them."""
        return x - self.origin if x.shape == self.origin.shape else x

    def positions(self, positions: ScanPositions | None) -> ScanPositions | None:
        """With antennas in the moved frames."""
        if positions is None or not self.moved:
            return positions
        if positions.antenna is None:
            raise ValueError(
                "positions: scans far from their origins were taken from elsewhere: "
                "wanted ScanPositions(..., antenna=...) in each scan's own frame."
            )
        antenna = self._less_origin(np.asarray(positions.antenna, np.float64))
        return dataclasses.replace(positions, antenna=antenna)

    def previous(self, previous: object) -> object:
        """An earlier solution, or motions, between the moved frames."""
        if not self.moved:
            return previous
        if isinstance(previous, RelativeMotions):
            return self._motions(previous, pose_moved)
        if not isinstance(previous, ReconstructionSolution):
            return previous
        if previous.num_scans > len(self.origin):  # refused later
            return previous
        return self._solution(previous, pose_moved)

    def known(self, priors: Told, fixed: Told, control: Told, levels: Told) -> _Known:
        """What is known, checked before, of the moved frames."""
        if not self.moved:
            return priors, fixed, control, levels
        for n, row in enumerate(priors or ()):
            if self.origin[row[0]].any() and len(row) > 2 and row[2] is not None:
                raise ValueError(
                    f"priors[{n}]: information: scan {row[0]} is far from its origin, "
                    "where a turn is a large shift: leave it out, or give control "
                    "points."
                )
        poses, held = (
            [(row[0], self._pose_moved(*row[:2]), *row[2:]) for row in rows or ()]
            for rows in (priors, fixed)
        )
        points = [
            (row[0], np.asarray(row[1], np.float64) - self.origin[row[0]], *row[2:])
            for row in control or ()
        ]
        return poses, held, points, levels

    def _pose_moved(self, frame: int, T: object) -> np.ndarray:
        T = as_host_numbers(T, "T")
        return pose_moved(T, self.origin[frame], np.zeros(T.shape[-1] - 1))

    def hears(self, on_pairs: OnPairs | None) -> OnPairs | None:
        """Tells of motions between the frames of the input."""
        if on_pairs is None or not self.moved:
            return on_pairs
        return lambda motions: on_pairs(self._motions(motions, pose_back))

    def back(
        self,
        solution: ReconstructionSolution,
        world: np.ndarray | None = None,
        held: ReconstructionSolution | None = None,
    ) -> ReconstructionSolution:
        """Between the frames of the input, in float64 on the host.

        Args:
            solution: between the moved frames.
            world: the origin of what component 0 lies in, if that is a known world.
            held: whose poses were held: there and back they would be rounded.
        """
        if not self.moved:
            return solution
        solution = self._solution(solution, pose_back, world)
        if held is not None:
            rows = np.flatnonzero(held.placed)
            T = np.asarray(solution.T_world_i).copy()
            T[rows] = np.asarray(held.T_world_i)[rows]
            solution = eqx.tree_at(lambda s: s.T_world_i, solution, T)
        return solution

    def _motions(self, motions: RelativeMotions, change: Callable) -> RelativeMotions:
        i, j = (self.origin[x] for x in np.asarray(motions.pairs).T)
        T = change(np.asarray(motions.T_i_j), j[:, None], i[:, None])
        return eqx.tree_at(lambda m: m.T_i_j, motions, T)

    def _solution(
        self,
        solution: ReconstructionSolution,
        change: Callable,
        world: np.ndarray | None = None,
    ) -> ReconstructionSolution:
        # The world of a component is the frame of its first scan.
        component = np.asarray(solution.component)
        _, first, row = np.unique(component, return_index=True, return_inverse=True)
        first = first[row]
        origin = self.origin[: len(component)]
        there = origin[first]
        if world is not None:
            there = np.where((component == 0)[:, None], world, there)
        T = change(np.asarray(solution.T_world_i), origin, there)
        alone = component < 0
        T[alone] = np.eye(T.shape[-1])
        i, j = (self.origin[x] for x in np.asarray(solution.graph.edges).T)
        edges = change(np.asarray(solution.graph.T_i_j), j, i)
        return eqx.tree_at(
            lambda s: (s.T_world_i, s.graph.T_i_j, s.motions),
            solution,
            (
                _told(T, change),
                _told(edges, change),
                self._motions(solution.motions, change),
            ),
        )


def _told(T: np.ndarray, change: Callable) -> np.ndarray | jax.Array:
    """For the search as JAX has it; for the user in float64."""
    return jnp.asarray(T, jnp.result_type(float)) if change is pose_moved else T
