"""Scans made ready for pairs: what every stage reads of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.programs import kept_program
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
        feature_spacing: of the samples that local features are made for, held or not;
            None where no pairs are searched for.
        fault: `(v,)` int32, what is wrong with a scan: TOO_FEW_POINTS, fewer than d + 1
            valid ones; UNIT_DIFFERS, its radius is not of the others' order; CONVERGED,
            nothing.
        num_dropped: `(v,)` rows of the input that were not finite.
        ids: `(v,)` int32, number of each scan; of some scans, those among all.
        count: int32, how many scans there are: further rows are padding, of no points.
        positions: about where their scanners stood, None if unknown.
    """

    clouds: PointCloud
    tables: AbstractIndex | None
    exact: AbstractIndex
    mean: Float[Array, "v d"]
    radius: Scalar
    spacing: Float[Array, " v"]
    feature_spacing: Scalar | None
    fault: Int[Array, " v"]
    num_dropped: Int[Array, " v"]
    ids: Int[Array, " v"]
    count: Int[Array, ""]
    positions: ScanPositions | None = None

    @property
    def num_scans(self) -> int:
        """V, with those that are padding."""
        return self.mean.shape[0]

    @property
    def num_present(self) -> int:
        """How many there are; outside of `jit`."""
        return int(self.count)

    @property
    def present(self) -> Bool[Array, " v"]:
        """Which rows are no padding."""
        return jnp.arange(self.num_scans) < self.count

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

    def of_pairs(
        self, pairs: Int[np.ndarray, "e 2"]
    ) -> tuple["PreparedScans", Int[Array, "e 2"]]:
        """The scans of some pairs alone, and the pairs by their rows; outside of `jit`.

        So programs of pairs do not depend on how many scans there are.
        """
        rows = np.arange(pairs.size, dtype=np.int32).reshape(pairs.shape)
        return _some(self, jax.device_put(pairs.ravel())), jax.device_put(rows)

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


@kept_program
def _some(scans: PreparedScans, rows: Int[Array, " r"]) -> PreparedScans:
    def each(s: PreparedScans) -> tuple[object, ...]:
        made = s.clouds, s.tables, s.exact
        return *made, s.mean, s.spacing, s.fault, s.num_dropped, s.ids

    def none(x: object) -> bool:
        return x is None

    some = jax.tree.map(lambda x: x[rows], each(scans))
    out = eqx.tree_at(each, scans, some, is_leaf=none)
    if scans.positions is None:
        return out
    return eqx.tree_at(lambda s: s.positions, out, scans.positions.some(rows))
