"""The contract of registration methods and what they return."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxreg._core.status import Status
from jaxreg._core.typing import Key, Mask, Motion, Points, Scalar
from jaxreg.cloud import PointCloud


class Modes(eqx.Module):
    """Distinct poses that the search ended in, best first.

    Attributes:
        T_target_source: `(q, d+1, d+1)`.
        weight: `(q,)` share of the posterior; zero marks an unused row.
        fitness: `(q,)` as in the solution.
        covariance: `(q, k, k)` of each, as in the solution.
    """

    T_target_source: Float[Array, "*b q D D"]
    weight: Float[Array, "*b q"]
    fitness: Float[Array, "*b q"]
    covariance: Float[Array, "*b q k k"]

    @classmethod
    def alone(
        cls,
        T_target_source: Motion,
        fitness: Float[Array, ""],
        covariance: Float[Array, "k k"],
    ) -> "Modes":
        """One pose with all the weight."""
        one = jnp.ones(1, fitness.dtype)
        return cls(T_target_source[None], one, fitness[None], covariance[None])

    @property
    def margin(self) -> Float[Array, "*b"]:
        """Weight of the first less that of the best other: one where it is alone."""
        others = jnp.max(self.weight[..., 1:], axis=-1, initial=0)
        return self.weight[..., 0] - others

    @property
    def effective_size(self) -> Float[Array, "*b"]:
        """(sum w)^2 / sum w^2: how many modes share the posterior."""
        return jnp.sum(self.weight, -1) ** 2 / jnp.sum(self.weight**2, -1)


class RegistrationSolution(eqx.Module):
    """The pose of a source in the frame of a target, and how far to trust it.

    Attributes:
        T_target_source: `(d+1, d+1)` maps source coordinates to target coordinates.
        status: int32, see `Status`.
        fitness: share of the source that lies on the target at this pose.
        inlier_rmse: root mean square distance of that share to the target's tangent
            planes, in the unit of the input.
        num_inliers: int32, points of the (thinned) source in that share.
        overlap: the lesser of the shares of source and target that lie on the other.
        num_steps: int32, steps of the local optimiser along the winning path.
        H: `(k, k)` Gauss-Newton matrix of the weighted energy of the last step, for a
            tangent (v, w), translation first: R -> exp(w) R, c -> c + v, where c is
            the image of the source's centroid.
        b: `(k,)` its descent direction, nearly zero at a minimum.
        error: that energy, the weighted sum of half squared residuals.
        covariance: `(k, k)` of the same tangent, by Huber's sandwich: right for
            independent errors of any size, too small where neighbouring points err
            together. Lengths are in the unit of the input.
        modes: distinct poses with weights; one for a local method.
    """

    T_target_source: Float[Array, "*b D D"]
    status: Int[Array, "*b"]
    fitness: Float[Array, "*b"]
    inlier_rmse: Float[Array, "*b"]
    num_inliers: Int[Array, "*b"]
    overlap: Float[Array, "*b"]
    num_steps: Int[Array, "*b"]
    H: Float[Array, "*b k k"]
    b: Float[Array, "*b k"]
    error: Float[Array, "*b"]
    covariance: Float[Array, "*b k k"]
    modes: Modes

    def __repr__(self) -> str:
        """One line: status, fitness, residual."""
        if isinstance(self.status, Array) and self.status.ndim == 0:
            try:
                status = Status(int(self.status)).name
                return (
                    f"RegistrationSolution({status}, "
                    f"fitness={float(self.fitness):.3f}, "
                    f"overlap={float(self.overlap):.3f}, "
                    f"inlier_rmse={float(self.inlier_rmse):.4g})"
                )
            except TypeError:  # a tracer has a shape but no value
                pass
        return f"RegistrationSolution(batch={np.shape(self.status)})"


class AbstractRegistrar(eqx.Module):
    """A method for `register`.

    `solve` works in frames prepared by `register`: both clouds centred at their
    centroids and scaled so that the target's root mean square radius is one.
    """

    def in_unit(self, length: Scalar) -> "AbstractRegistrar":
        """The method with its lengths, given in the unit of the input, in `length`s.

        Most methods have none: their lengths follow from the data.
        """
        return self

    def in_frames(
        self, centred: Callable[[Motion], Motion], d: int
    ) -> "AbstractRegistrar":
        """The method with its poses, given in the frames of the input, in `solve`'s.

        Most methods have none.

        Args:
            centred: maps a pose from the former frames to the latter.
            d: dimension of the points.
        """
        return self

    @abc.abstractmethod
    def prepare(self, points: Points, mask: Mask) -> PointCloud:
        """The cloud that `solve` expects: thinned, with normals."""

    @abc.abstractmethod
    def solve(
        self,
        source: PointCloud,
        target: PointCloud,
        init: Motion | None,
        key: Key | None,
    ) -> RegistrationSolution:
        """Registers two prepared clouds."""
