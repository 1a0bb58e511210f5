"""`ParticleFilter`: registration without an initial guess (the PF paper's algorithm).

    t = 0        draw from the prior, measure, weigh, resample       (section 4.2)
    t = 1, 2, .. diffuse along the motion error (Eq. 6-8), measure, weigh (Eq. 9),
                 resample

A measurement is a few steps of a local optimiser; what it moved a particle by is the
particle's motion error, whose size and direction the next diffusion takes. The
distinct poses that are left are refined by many steps on more points and scored.

Differences from the paper: many more particles are drawn at t = 0 than are carried on;
the energy is bounded and asks that normals agree, as partial overlap needs it; the
temperature of the weights is learned from the energies; the kernel width of the
optimiser falls over time.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.arrays import cast_floats, traced
from jaxreg._core.checks import check_key
from jaxreg._core.status import Status
from jaxreg._core.typing import Key, Mask, Motion, Points, Scalar
from jaxreg.cloud import PointCloud, median_spacing, thin
from jaxreg.geometry import lie
from jaxreg.local import (
    AbstractRegistrar,
    Curvature,
    GaussNewton,
    LocalOptimiser,
    Modes,
    PointToPlane,
    Problem,
    RegistrationSolution,
    match,
    score_both_ways,
)
from jaxreg.neighbours import AbstractIndex, VoxelTable
from jaxreg.particle import prior
from jaxreg.particle.measure import measure
from jaxreg.particle.modes import distinct_modes
from jaxreg.particle.predict import diffuse
from jaxreg.particle.resample import systematic, tempered_weights
from jaxreg.particle.state import Particles
from jaxreg.robust import AbstractKernel, GemanMcClure


_REFINE_STEPS = 24
# The agreement of normals decides what is believed: the careful estimate.
_NORMAL_NEIGHBOURS = 10


class ParticleFilter(AbstractRegistrar):
    """Global registration by a particle filter over ICP.

    Lengths are in units of the target's root mean square radius, so the unit of the
    input does not matter. One search looks up
    `num_points * (num_prior * (prior_steps + 1)
    + num_particles * num_times * (inner_steps + 1))` closest points.

    Attributes:
        num_prior: particles drawn from the prior and measured at t = 0.
        num_particles: particles carried on from there (N).
        num_times: steps t = 1 .. num_times of the filter.
        prior_steps: local steps at t = 0.
        inner_steps: local steps R of every later measurement.
        num_points: source points that a particle is measured on.
        num_modes: distinct poses that are refined and returned.
        max_points: both clouds are thinned to about this many points.
        batch_size: particles in one vectorised block; small enough for a CPU's cache.
        diffusion: alpha of Eq. 8; zero is no dynamics.
        sample_share: effective sample size asked of the weights, as a share of N.
        width_start, width_end: kernel width at t = 0 and at the last step.
        translation_spread: deviation of the prior's translation between centroids.
        init_spread: deviation around `init`, in radians and radii, where it is given.
        min_overlap: share of both clouds that must agree for a pose to be believed.
        residual, kernel: parts of the local optimiser, a Gauss-Newton step.

    Fails: TOO_FEW_POINTS, NON_FINITE; LOW_OVERLAP where the best pose is supported by
    less than `min_overlap` of either cloud; AMBIGUOUS where a second mode is nearly
    as good.

    Gradients: none; refine with `ICP` from the answer to differentiate it.
    """

    num_prior: int = eqx.field(default=2048, static=True)
    num_particles: int = eqx.field(default=128, static=True)
    num_times: int = eqx.field(default=8, static=True)
    prior_steps: int = eqx.field(default=4, static=True)
    inner_steps: int = eqx.field(default=3, static=True)
    num_points: int = eqx.field(default=400, static=True)
    num_modes: int = eqx.field(default=4, static=True)
    max_points: int = eqx.field(default=4096, static=True)
    batch_size: int = eqx.field(default=32, static=True)
    diffusion: Array | float = traced(1.0)
    sample_share: Array | float = traced(0.5)
    width_start: Array | float = traced(0.3)
    width_end: Array | float = traced(0.06)
    translation_spread: Array | float = traced(0.5)
    init_spread: Array | float = traced(0.3)
    min_overlap: Array | float = traced(0.12)
    residual: PointToPlane = eqx.field(default_factory=lambda: PointToPlane(0.2))
    kernel: AbstractKernel = eqx.field(default_factory=GemanMcClure)

    def __check_init__(self) -> None:
        """Refuses counts that leave nothing to do."""
        for name in (
            "num_prior",
            "num_particles",
            "num_times",
            "prior_steps",
            "inner_steps",
            "num_points",
            "num_modes",
            "batch_size",
        ):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"ParticleFilter: {name} must be at least 1, found "
                    f"{getattr(self, name)}."
                )
        if not 2 <= self.num_particles <= self.num_prior:
            raise ValueError(
                "ParticleFilter: num_particles must be from 2 to num_prior = "
                f"{self.num_prior}, found {self.num_particles}."
            )
        if self.num_prior % self.batch_size:
            raise ValueError(
                f"ParticleFilter: batch_size {self.batch_size} must divide num_prior "
                f"= {self.num_prior}."
            )

    def prepare(self, points: Points, mask: Mask) -> PointCloud:
        """Thinned to `max_points`, with normals."""
        return thin(points, mask, self.max_points, _NORMAL_NEIGHBOURS)

    def solve(
        self,
        source: PointCloud,
        target: PointCloud,
        init: Motion | None,
        key: Key | None,
    ) -> RegistrationSolution:
        """Searches, refines and scores in the prepared frames."""
        target_index = VoxelTable.build(target.points, target.mask)
        source_index = VoxelTable.build(source.points, source.mask)
        return self.solve_indexed(
            source, target, source_index, target_index, init, check_key(key)
        )

    def solve_indexed(
        self,
        source: PointCloud,
        target: PointCloud,
        source_index: AbstractIndex,
        target_index: AbstractIndex,
        init: Motion | None,
        key: Key,
    ) -> RegistrationSolution:
        """`solve` with indexes built before, for clouds that enter many pairs."""
        self = cast_floats(self, source.points.dtype)
        key_points, key_search = jax.random.split(key)
        problem = Problem.of(source, target, target_index)
        few = _some_points(key_points, problem, self.num_points)
        particles, weight = self._search(key_search, few, init)
        rows, mass = distinct_modes(
            particles,
            weight,
            self.num_modes,
            angle=jnp.asarray(0.3, weight.dtype),
            distance=jnp.asarray(0.3, weight.dtype),
        )
        spacing = jnp.maximum(
            median_spacing(target.points, target.mask),
            median_spacing(source.points, source.mask),
        )
        T_modes = self._refine(problem, particles.T_target_source[rows], spacing)
        there, back = lax.map(
            lambda T: score_both_ways(
                source, target, source_index, target_index, T, spacing
            ),
            T_modes,
        )
        overlap = jnp.where(mass > 0, jnp.minimum(there.fitness, back.fitness), -1)
        order = jnp.argsort(-overlap)
        best = order[0]
        T = T_modes[best]
        modes = Modes(T_modes[order], mass[order], there.fitness[order])
        curvature = self._curvature(problem, T, spacing)
        return RegistrationSolution(
            T_target_source=T,
            status=self._status(T, overlap[order], modes, source, target),
            fitness=there.fitness[best],
            inlier_rmse=there.inlier_rmse[best],
            num_inliers=there.num_inliers[best],
            overlap=jnp.maximum(overlap[best], 0),
            num_steps=jnp.asarray(self._steps_of_a_path(), jnp.int32),
            H=curvature.H,
            b=curvature.b,
            error=curvature.error,
            covariance=curvature.covariance,
            modes=modes,
        )

    def _steps_of_a_path(self) -> int:
        return self.prior_steps + self.num_times * self.inner_steps + _REFINE_STEPS

    def _search(
        self, key: Key, problem: Problem, init: Motion | None
    ) -> tuple[Particles, Float[Array, " p"]]:
        """The filter; returns measured particles and their weights."""
        n, dtype = self.num_particles, problem.source.dtype
        key_prior, key_loop = jax.random.split(key)
        if init is None:
            d = problem.source.shape[0]
            T = prior.uniform(
                key_prior, self.num_prior, d, self.translation_spread, dtype
            )
        else:
            spread = self.init_spread
            T = prior.gaussian(key_prior, self.num_prior, init, spread, spread)
        optimiser = LocalOptimiser(self.residual, self.kernel, GaussNewton())
        optimiser = cast_floats(optimiser, dtype)
        share = jnp.linspace(0, 1, self.num_times + 1, dtype=dtype)
        widths = self.width_start * (self.width_end / self.width_start) ** share

        # At t = 0 the whole prior is measured, later the first n rows; one loop with a
        # varying number of rows compiles the measurement once.
        first = jnp.arange(self.num_times + 1) == 0
        num_rows = jnp.where(first, self.num_prior, n)
        num_steps = jnp.where(first, self.prior_steps, self.inner_steps)
        # The prior's motion error spans a descent from nowhere in particular.
        alpha = jnp.where(first, 0, self.diffusion)
        alpha = alpha.at[1].divide(self.prior_steps).astype(dtype)
        size = jnp.where(first, n, self.sample_share * n).astype(dtype)

        def step(
            carry: tuple[Particles, Array], at: tuple[Array, ...]
        ) -> tuple[tuple[Particles, Array], None]:
            # Resampling opens a step, so the last particles keep their weights.
            particles, weight = carry
            key, width, rows, steps, alpha, size = at
            key_resample, key_diffuse = jax.random.split(key)
            ancestors = systematic(key_resample, weight, rows)
            particles = particles.rows(ancestors)
            T_predicted = diffuse(key_diffuse, particles, alpha)
            particles = measure(
                problem,
                optimiser,
                T_predicted,
                width,
                num_rows=rows,
                num_steps=steps,
                batch_size=self.batch_size,
            )
            return (particles, tempered_weights(particles.energy, size)), None

        zero = jnp.zeros((self.num_prior, lie.tangent_dim(T.shape[-1] - 1)), dtype)
        start = (
            Particles(T, zero, zero[:, 0]),
            jnp.full(self.num_prior, 1 / self.num_prior, dtype),
        )
        keys = jax.random.split(key_loop, self.num_times + 1)
        schedule = (keys, widths, num_rows, num_steps, alpha, size)
        particles, weight = lax.scan(step, start, schedule)[0]
        return particles.rows(jnp.arange(n)), weight[:n]

    def _refine(
        self, problem: Problem, T: Float[Array, "q D D"], spacing: Scalar
    ) -> Float[Array, "q D D"]:
        """Many steps on all points, the width falling to the sample spacing."""
        optimiser = LocalOptimiser(PointToPlane(), self.kernel, GaussNewton())
        optimiser = cast_floats(optimiser, T.dtype)
        widths = spacing * jnp.geomspace(2, 0.5, _REFINE_STEPS, dtype=T.dtype)
        refined = lax.map(lambda T: optimiser.repeat(problem, T, widths), T)
        return lie.orthonormalise(refined)

    def _curvature(self, problem: Problem, T: Motion, spacing: Scalar) -> Curvature:
        """Of the last refinement's energy."""
        optimiser = cast_floats(
            LocalOptimiser(PointToPlane(), self.kernel, GaussNewton()), T.dtype
        )
        found = match(problem, T)
        weight = optimiser.weights(found, 0.5 * spacing)
        return Curvature.of(optimiser.residual, found, weight)

    def _status(
        self,
        T: Motion,
        overlap: Float[Array, " q"],
        modes: Modes,
        source: PointCloud,
        target: PointCloud,
    ) -> Array:
        status = jnp.asarray(Status.CONVERGED, jnp.int32)
        if self.num_modes > 1:
            rival = overlap[1] > 0.95 * overlap[0]
            status = jnp.where(rival, Status.AMBIGUOUS, status)
        status = jnp.where(overlap[0] < self.min_overlap, Status.LOW_OVERLAP, status)
        d = T.shape[-1] - 1
        few = jnp.minimum(jnp.sum(source.mask), jnp.sum(target.mask)) < d + 1
        status = jnp.where(few, Status.TOO_FEW_POINTS, status)
        return jnp.where(jnp.all(jnp.isfinite(T)), status, Status.NON_FINITE).astype(
            jnp.int32
        )


def _some_points(key: Key, problem: Problem, num: int) -> Problem:
    """The problem on a random subset of the valid source points."""
    if problem.source.shape[1] <= num:
        return problem
    order = jax.random.uniform(key, problem.source_mask.shape, problem.source.dtype)
    rows = jnp.argsort(jnp.where(problem.source_mask, order, 2))[:num]
    return problem.of_rows(rows)
