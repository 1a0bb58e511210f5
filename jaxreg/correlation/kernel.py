"""Registration by kernel correlation, the rival in the PF paper's section 5.1."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.arrays import cast_floats, traced
from jaxreg._core.checks import check_counts, check_not_negative, check_positive
from jaxreg._core.loop import iterate, status_of
from jaxreg._core.restarts import MAX_STARTS
from jaxreg._core.solver import Solver
from jaxreg._core.status import Status
from jaxreg._core.typing import Key, Mask, Motion, Points
from jaxreg.cloud import PointCloud, median_spacing, thin, without_noise
from jaxreg.correlation.ascent import Ascending, Maximum, is_free, newton_step
from jaxreg.correlation.by_solver import Restarting
from jaxreg.correlation.quadratic import Quadratic, pull_on_target
from jaxreg.geometry import lie
from jaxreg.local import at_rest, sandwich, turn_and_shift
from jaxreg.matching import Witness
from jaxreg.registrar import AbstractRegistrar, Frames, Modes, RegistrationSolution


# The bandwidth where none is given, in root mean square radii of the target and, where
# that is more, in spacings of the coarser cloud's samples.
_RADII = 0.2
_SPACINGS = 2.0


def _solver(found: object) -> Solver | None:
    return None if found is None else Solver.of(found, "KernelCorrelation: solver")


class KernelCorrelation(AbstractRegistrar):
    """Local registration without correspondences: all pairs count, the close ones more.

    Maximises the sum over all pairs of exp(-|T p - q|^2 / (2 bandwidth^2)), that is
    the correlation of the two sets' kernel density estimates: a multiply-linked ICP,
    with Welsch's kernel on every link. Starts from an initial guess (identity of
    centred clouds if none), by damped Newton steps on SE(d). Time is O(n m) a step,
    memory O(n + m).

    A wide kernel reaches farther and smooths more: it aligns where the points are
    dense, so a part is drawn to the middle of the whole, and sets of different density
    do not meet exactly (PF paper, section 5.1). Copies of each other meet exactly at
    any width.

    Attributes:
        bandwidth: of the kernel, in the unit of the input. None: 0.2 root mean square
            radii of the target, at least two sample spacings of the coarser cloud.
        max_steps: passes over all pairs at most.
        max_points: both clouds are thinned to about this many points.
        tolerance: stop when a step turns by at most so many radians and shifts by at
            most so many radii (the target's root mean square radius).

    In the solution `error` is the energy of those links, the sum over all pairs of
    bandwidth^2 (1 - exp(...)), H its exact Hessian and b its descent direction.
    `covariance` is H^-1 (sum of g g') H^-1, with g the share in b of each source point
    and of each target point: right if both sets are independent samples, too large
    if one is a copy of the other. `num_steps` counts passes.

    Fails: TOO_FEW_POINTS, NON_FINITE, MAX_STEPS; LOW_OVERLAP where nothing agrees, for
    instance where all pairs are so many widths apart that the kernel underflows;
    DEGENERATE where the correlation leaves a direction free (a ring, a sphere).

    Gradients: of the pose with respect to both clouds and the bandwidth, exact by the
    implicit function theorem at the maximum, in O(n + m) memory, in forward and reverse
    mode and of any order; free directions do not follow. The default bandwidth follows
    the spacing that it is taken from, and thinned points the means that they are;
    which points are merged is held. Nothing flows to `init`; the other fields are cut.

    Reference: Tsin and Kanade, ECCV 2004. The steps are ours, see
    `jaxreg.correlation.ascent` for why.
    """

    bandwidth: Array | float | None = traced(None)
    max_steps: int = eqx.field(default=60, static=True)
    max_points: int = eqx.field(default=2048, static=True)
    tolerance: Array | float = traced(1e-4)
    solver: Solver | None = eqx.field(default=None, converter=_solver)

    def __check_init__(self) -> None:
        """Refuses counts and widths that leave nothing to do."""
        check_counts(self, max_steps=1, max_points=1)
        check_not_negative(self, "tolerance")
        if self.bandwidth is not None:
            check_positive(self, "bandwidth")

    def in_frames(self, frames: Frames) -> "KernelCorrelation":
        """With the bandwidth in radii."""
        if self.bandwidth is None:
            return self
        radius = frames.radius
        bandwidth = jnp.asarray(self.bandwidth, radius.dtype) / radius
        return eqx.tree_at(lambda m: m.bandwidth, self, bandwidth)

    def prepare(self, points: Points, mask: Mask) -> PointCloud:
        """Thinned to `max_points`; the normals serve the scores alone."""
        return thin(points, without_noise(points, mask), self.max_points)

    def solve(
        self,
        source: PointCloud,
        target: PointCloud,
        init: Motion | None,
        key: Key | None = None,
    ) -> RegistrationSolution:
        """Ascends from `init` in the prepared frames."""
        dtype = source.points.dtype
        self = cast_floats(self, dtype)
        if init is None:
            init = lie.identity(source.points.shape[1], dtype)
        spacing = jnp.maximum(
            median_spacing(source.points, source.mask),
            median_spacing(target.points, target.mask),
        )
        width = self.width(spacing)
        fixed = lax.stop_gradient((source, target, init, width, self.tolerance))
        end = self._ascended(*fixed[:2], fixed[3], fixed[2])

        held = Quadratic.at(end.T, *fixed[:2], fixed[3])
        T = turn_and_shift(end.T, newton_step(held, held.b))
        T = jnp.where(end.converged, T, end.T)
        T = at_rest(Maximum(source=source, target=target, bandwidth=width, T=T))[0]

        evidence = Witness.of_some(*fixed[:2]).of_pose(lax.stop_gradient(T))
        status = jnp.where(is_free(held), Status.DEGENERATE, status_of(end.converged))
        status = jnp.where(evidence.overlap > 0, status, Status.LOW_OVERLAP)
        status = jnp.where(jnp.all(jnp.isfinite(T)), status, Status.NON_FINITE)
        num_pairs = jnp.sum(source.mask, dtype=dtype) * jnp.sum(
            target.mask, dtype=dtype
        )
        covariance = _covariance(held, end.T, *fixed[:2], fixed[3])
        e = evidence
        told = e.fitness, e.overlap, e.inlier_rmse, e.log_evidence
        return RegistrationSolution(
            T_target_source=T,
            status=status.astype(jnp.int32),
            fitness=evidence.fitness,
            inlier_rmse=evidence.inlier_rmse,
            num_inliers=evidence.num_inliers,
            overlap=evidence.overlap,
            log_evidence=evidence.log_evidence,
            num_steps=end.num_steps,
            H=held.H,
            b=held.b,
            error=fixed[3] ** 2 * (num_pairs - held.correlation),
            covariance=covariance,
            modes=Modes.alone(T, *told, covariance),
        )

    def _ascended(
        self,
        source: PointCloud,
        target: PointCloud,
        width: Float[Array, ""],
        init: Motion,
    ) -> "_Ascended":
        """By Newton's steps or by those of the solver."""
        tolerance = lax.stop_gradient(jnp.asarray(self.tolerance))
        if self.solver is None:
            steps = Ascending(source, target, width, tolerance)
            ended = iterate(steps, steps.init(init), max_steps=self.max_steps)
            return _Ascended(ended.state.T, ended.converged, ended.state.num_steps)
        # At a maximum a step of that size gains about its square.
        limit = jnp.maximum(tolerance**2, 4 * jnp.finfo(init.dtype).eps)
        starts = Restarting(
            solver=lax.stop_gradient(self.solver),
            source=source,
            target=target,
            bandwidth=width,
            limit=limit,
            max_steps=self.max_steps,
        )
        ended = iterate(starts, starts.init(init), max_steps=MAX_STARTS)
        return _Ascended(ended.state.T, ended.converged, ended.state.taken)

    def width(self, spacing: Float[Array, ""]) -> Float[Array, ""]:
        """The bandwidth in the prepared frames, where the target's radius is one.

        Args:
            spacing: of the coarser cloud's samples, there.
        """
        if self.bandwidth is None:
            return jnp.maximum(_RADII, _SPACINGS * spacing)
        return jnp.asarray(self.bandwidth)


class _Ascended(NamedTuple):
    """Where the steps ended."""

    T: Motion
    converged: Bool[Array, ""]
    num_steps: Int[Array, ""]


def _covariance(
    model: Quadratic,
    T_target_source: Motion,
    source: PointCloud,
    target: PointCloud,
    bandwidth: Float[Array, ""],
) -> Float[Array, "k k"]:
    """Huber's sandwich over the points of both sets."""
    by_target = pull_on_target(T_target_source, source, target, bandwidth)
    pulls = jnp.concatenate([model.by_source, by_target], axis=1)
    meat = jnp.matmul(pulls, pulls.T, precision=lax.Precision.HIGHEST)
    return sandwich(model.H, meat)
