"""Scans made ready for pairs: what every stage reads of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.status import Status
from jaxreg._core.typing import Motions, Scalar
from jaxreg.cloud import Frames, PointCloud
from jaxreg.geometry import lie
from jaxreg.matching import Problem, Witness
from jaxreg.multiview.method import index_of
from jaxreg.multiview.positions import ScanPositions
from jaxreg.neighbours import AbstractIndex, exact_index
from jaxreg.registrar import AbstractRegistrar


class PreparedScans(eqx.Module):
    """Scans with a leading axis, each in its own centred frame, in one common scale.

    Attributes:
        clouds: `(v, n, d)` thinned points with normals; the unit is `radius`. With what
            was seen from the viewpoints, where these are given, and with local features
            where many pairs are to be searched.
        tables: their indexes, of the method's kind; None of very many scans.
        exact: indexes that miss no near point, for the evidence.
        mean: `(v, d)` centroid of each scan in its input frame.
        radius: the median root mean square radius of the scans, in the input's unit.
        spacing: `(v,)` distance between thinned points, in units of `radius`.
        fault: `(v,)` int32, what is wrong with a scan: TOO_FEW_POINTS, fewer than d + 1
            valid ones; UNIT_DIFFERS, its radius is not of the others' order; CONVERGED,
            nothing.
        num_dropped: `(v,)` rows of the input that were not finite.
        positions: about where their scanners stood, None if unknown.
    """

    clouds: PointCloud
    tables: AbstractIndex | None
    exact: AbstractIndex
    mean: Float[Array, "v d"]
    radius: Scalar
    spacing: Float[Array, " v"]
    fault: Int[Array, " v"]
    num_dropped: Int[Array, " v"]
    positions: ScanPositions | None = None

    @property
    def num_scans(self) -> int:
        """V."""
        return self.mean.shape[0]

    @property
    def num_rows(self) -> int:
        """Points of a pair."""
        return 2 * self.clouds.points.shape[1]

    @property
    def usable(self) -> Bool[Array, " v"]:
        """Which scans can be registered."""
        return self.fault == Status.CONVERGED

    @property
    def coarsest(self) -> Scalar:
        """The largest spacing of the scans that can be registered."""
        return jnp.max(jnp.where(self.usable, self.spacing, 0))

    def cloud(self, i: Int[Array, ""]) -> PointCloud:
        """One scan's thinned points."""
        return jax.tree.map(lambda x: x[i], self.clouds)

    def table(self, method: AbstractRegistrar, i: Int[Array, ""]) -> AbstractIndex:
        """One scan's index, of the method's kind."""
        if self.tables is None:
            return index_of(method.in_frames(self.frames(i, i)), self.cloud(i))
        return jax.tree.map(lambda x: x[i], self.tables)

    def problem(
        self, i: Int[Array, ""], j: Int[Array, ""], *, exact: bool = False
    ) -> Problem:
        """Scan j as the source, scan i as the target, its closest points from a table.

        Args:
            i: of the target.
            j: of the source.
            exact: no near point is missed; so it is where no tables are held.
        """
        source, target = self.cloud(j), self.cloud(i)
        if not exact and self.tables is not None:
            return Problem.of(source, target, jax.tree.map(lambda x: x[i], self.tables))
        if target.judged is None:  # whose index is that of the evidence
            return Problem.of(source, target, jax.tree.map(lambda x: x[i], self.exact))
        kind = exact_index(target.points.shape[0])
        return Problem.of(source, target, kind.build(target.points, target.mask))

    def witness(self, i: Int[Array, ""], j: Int[Array, ""]) -> Witness:
        """Who tells how likely motions of scan j into scan i are."""
        clouds = self.cloud(j).as_judged, self.cloud(i).as_judged
        near = (jax.tree.map(lambda x, k=k: x[k], self.exact) for k in (j, i))
        return Witness.of(*clouds, *near)

    def method_of(
        self, method: AbstractRegistrar, i: Int[Array, ""], j: Int[Array, ""]
    ) -> AbstractRegistrar:
        """The method for scan j as the source and scan i as the target."""
        if self.positions is not None:
            method = self.positions.of_pair(method, i, j)
        return method.in_frames(self.frames(i, j))

    def frames(self, i: Int[Array, ""], j: Int[Array, ""]) -> Frames:
        """Those of scan j as the source and scan i as the target."""
        return Frames(self.mean[j], self.mean[i], self.radius)

    def to_input_frames(
        self, T_i_j: Motions, i: Int[Array, "*b"], j: Int[Array, "*b"]
    ) -> Motions:
        """Motions between centred, scaled frames as motions between input frames."""
        R = lie.rotation(T_i_j)
        t = self.radius * lie.translation(T_i_j) + self.mean[i]
        return lie.compose(R, t - jnp.einsum("...ij,...j->...i", R, self.mean[j]))

    def to_centred_frames(
        self, T_i_j: Motions, i: Int[Array, "*b"], j: Int[Array, "*b"]
    ) -> Motions:
        """The other way."""
        R = lie.rotation(T_i_j)
        moved = jnp.einsum("...ij,...j->...i", R, self.mean[j])
        t = lie.translation(T_i_j) + moved - self.mean[i]
        return lie.compose(R, t / self.radius)

    def to_world(self, T_world_i: Motions) -> Motions:
        """Poses of the centred frames, in radii, as those of the input frames."""
        R = lie.rotation(T_world_i)
        t = self.radius * lie.translation(T_world_i)
        return lie.compose(R, t - jnp.sum(R * self.mean[:, None], axis=-1))
