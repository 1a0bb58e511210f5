"""The contract of registration methods and what they return."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammainc
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.brief import BriefModule
from jaxreg._core.checks import is_concrete
from jaxreg._core.status import Status, counted
from jaxreg._core.typing import Key, Mask, Motion, Points
from jaxreg.cloud import Frames, PointCloud
from jaxreg.geometry import lie
from jaxreg.linear.small import solve_semidefinite
from jaxreg.registrar.trace import SearchTrace


class Modes(BriefModule):
    """Distinct poses that the search ended in, best first.

    Attributes:
        T_target_source: `(q, d+1, d+1)`.
        weight: `(q,)` share of the posterior; zero marks an unused row.
        fitness: `(q,)` as in the solution, as the next four.
        overlap: `(q,)`; zero of unused rows.
        inlier_rmse: `(q,)`.
        log_evidence: `(q,)`; `NO_EVIDENCE` of unused rows.
        covariance: `(q, k, k)` of each, as in the solution.
    """

    T_target_source: Float[Array, "*b q D D"]
    weight: Float[Array, "*b q"]
    fitness: Float[Array, "*b q"]
    overlap: Float[Array, "*b q"]
    inlier_rmse: Float[Array, "*b q"]
    log_evidence: Float[Array, "*b q"]
    covariance: Float[Array, "*b q k k"]

    @classmethod
    def alone(
        cls,
        T_target_source: Motion,
        fitness: Float[Array, ""],
        overlap: Float[Array, ""],
        inlier_rmse: Float[Array, ""],
        log_evidence: Float[Array, ""],
        covariance: Float[Array, "k k"],
    ) -> "Modes":
        """One pose with all the weight."""
        told = jnp.ones_like(fitness), fitness, overlap, inlier_rmse, log_evidence
        return cls(*(x[None] for x in (T_target_source, *told, covariance)))

    @property
    def margin(self) -> Float[Array, "*b"]:
        """Weight of the first less that of the best other: one where it is alone."""
        others = jnp.max(self.weight[..., 1:], axis=-1, initial=0)
        return self.weight[..., 0] - others

    @property
    def effective_size(self) -> Float[Array, "*b"]:
        """(sum w)^2 / sum w^2: how many modes share the posterior."""
        return jnp.sum(self.weight, -1) ** 2 / jnp.sum(self.weight**2, -1)

    def contains(
        self,
        T_target_source: Motion,
        centroid: Float[Array, " d"],
        probability: Float[Array, ""] | float = 0.95,
    ) -> Bool[Array, ""]:
        """Whether a pose lies in the region that holds the truth with a probability.

        The region is the ellipsoids of that probability about the fewest modes that
        together weigh as much. For the modes of one pair; `vmap` for those of many.

        Args:
            T_target_source: `(d+1, d+1)` the pose.
            centroid: `(d,)` mean of the source's points, which the covariances are
                about.
            probability: in (0, 1).
        """
        R, t = lie.rotation(T_target_source), lie.translation(T_target_source)
        R_modes = lie.rotation(self.T_target_source)
        t_modes = lie.translation(self.T_target_source)
        turn = jax.vmap(lie.rotation_log)(jnp.einsum("ij,qkj->qik", R, R_modes))
        shift = (R - R_modes) @ centroid + t - t_modes
        error = jnp.concatenate([shift, turn], axis=1)
        # Of unit diagonal: lengths may be of any unit.
        unit = jnp.sqrt(jnp.diagonal(self.covariance, axis1=1, axis2=2))
        error, shape = error / unit, self.covariance / unit[:, :, None] / unit[:, None]
        sq = jnp.sum(error * solve_semidefinite(shape, error), axis=1)
        near = gammainc(error.shape[1] / 2, sq / 2) <= probability
        heavier = self.weight[:, None] > self.weight
        before = jnp.sum(jnp.where(heavier, self.weight[:, None], 0), axis=0)
        return jnp.any(near & (before < probability) & (self.weight > 0))


class RegistrationSolution(eqx.Module):
    """The pose of a source in the frame of a target, and how far to trust it.

    Attributes:
        T_target_source: `(d+1, d+1)` maps source coordinates to target coordinates.
        status: int32, see `Status`.
        fitness: share of the source that lies on the target at this pose, within the
            noise that the pair shows.
        inlier_rmse: root mean square distance of that share to the target's tangent
            planes, in the unit of the input.
        num_inliers: int32, points of the (thinned) source in that share.
        overlap: share of the source that the target saw: points within the local
            spacing of a sample and of its plane.
        log_evidence: log of how much likelier the clouds are if their surfaces
            coincide at this pose than if it is the best of wrong ones; comparable
            between pairs, and above one of right poses (`jaxreg.matching.evidence`).
        num_steps: int32, steps of the local optimiser along the winning path.
        H: `(k, k)` Gauss-Newton matrix of the weighted energy of the last step, for a
            tangent (v, w), translation first: R -> exp(w) R, c -> c + v, where c is
            the image of the source's centroid.
        b: `(k,)` its descent direction, nearly zero at a minimum.
        error: that energy, the weighted sum of half squared residuals.
        covariance: `(k, k)` of the pose's error in the same tangent, by a sandwich of
            estimating equations (`pose_covariance` in `jaxreg.local.covariance`);
            lengths are in the unit of the input.
        modes: distinct poses with weights; one for a local method.
        trace: how a particle filter came to rest; None for other methods.

    Gradients: of the poses, as the method says. Scores and evidence are held: that of a
    pose has a derivative by `jaxreg.matching.Witness.of_pose`.
    """

    T_target_source: Float[Array, "*b D D"]
    status: Int[Array, "*b"]
    fitness: Float[Array, "*b"]
    inlier_rmse: Float[Array, "*b"]
    num_inliers: Int[Array, "*b"]
    overlap: Float[Array, "*b"]
    log_evidence: Float[Array, "*b"]
    num_steps: Int[Array, "*b"]
    H: Float[Array, "*b k k"]
    b: Float[Array, "*b k"]
    error: Float[Array, "*b"]
    covariance: Float[Array, "*b k k"]
    modes: Modes
    trace: SearchTrace | None = None

    def __repr__(self) -> str:
        """One line: status, fitness, residual; of a batch the number of each status."""
        if isinstance(self.status, Array) and self.status.ndim == 0:
            try:
                status = Status(int(self.status)).name
                return (
                    f"RegistrationSolution({status}, "
                    f"fitness={float(self.fitness):.3f}, "
                    f"overlap={float(self.overlap):.3f}, "
                    f"log_evidence={float(self.log_evidence):.1f}, "
                    f"inlier_rmse={float(self.inlier_rmse):.4g})"
                )
            except TypeError:  # a tracer has a shape but no value
                pass
        counts = ""
        if isinstance(self.status, Array | np.ndarray) and is_concrete(self.status):
            counts = f", {counted(self.status)}"
        return f"RegistrationSolution(batch={np.shape(self.status)}{counts})"


class AbstractRegistrar(BriefModule):
    """A method for `register`.

    `solve` works in frames prepared by `register`: both clouds centred at their
    centroids and scaled so that the target's root mean square radius is one.
    """

    described: ClassVar[str] = "a registration method such as ICP()"

    @abc.abstractmethod
    def in_frames(self, frames: Frames) -> "AbstractRegistrar":
        """The method with its own lengths and poses in the frames of `solve`.

        Users give them in the frames and the unit of the input. The method itself if
        it has none, because its lengths follow from the data.
        """

    @abc.abstractmethod
    def prepare(self, points: Points, mask: Mask) -> PointCloud:
        """The cloud that `solve` expects: thinned, with normals, valid rows first."""

    @abc.abstractmethod
    def solve(
        self,
        source: PointCloud,
        target: PointCloud,
        init: Motion | None,
        key: Key | None,
    ) -> RegistrationSolution:
        """Registers two prepared clouds."""
