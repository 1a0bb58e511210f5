"""Relative motions between pairs of scans: batches of the pairwise search."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core.brief import BriefModule
from jaxreg._core.programs import kept_program
from jaxreg._core.status import Status
from jaxreg._core.typing import Key
from jaxreg.batching.side_by_side import map_side_by_side
from jaxreg.matching import NO_EVIDENCE
from jaxreg.multiview.method import num_kept, solve
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.registrar import AbstractRegistrar


# What such a solution says of the scans is not said of the pose that it returns.
_NO_POSE = Status.TOO_FEW_POINTS, Status.NON_FINITE, Status.DIVERGED


class RelativeMotions(BriefModule):
    """What the search found for pairs of scans, scan j on scan i.

    Of JAX arrays, or of NumPy arrays where motions are kept in float64.

    Of each pair up to m modes of the posterior, the best first.

    Attributes:
        pairs: `(e, 2)` int32, the scans i < j.
        T_i_j: `(e, m, d+1, d+1)`.
        overlap: `(e, m)` see `RegistrationSolution`; 0 where there is no such mode.
        log_evidence: `(e, m)` see there; `NO_EVIDENCE` where there is no such mode.
        inlier_rmse: `(e, m)` in the unit of the motions.
    """

    pairs: Int[Array, "*e 2"]
    T_i_j: Float[Array, "*e m D D"]
    overlap: Float[Array, "*e m"]
    log_evidence: Float[Array, "*e m"]
    inlier_rmse: Float[Array, "*e m"]

    @classmethod
    def kept(cls, *arrays: np.ndarray) -> "RelativeMotions":
        """Of NumPy arrays, one for each attribute, as `on_pairs` was told them."""
        none = jnp.zeros((0, 1))
        ids = jnp.zeros((0, 2), jnp.int32)
        blank = cls(ids, jnp.zeros((0, 1, 3, 3)), none, none, none)
        leaves, structure = jax.tree.flatten(blank)
        assert len(arrays) == len(leaves)
        return jax.tree.unflatten(structure, arrays)

    @property
    def num_modes(self) -> int:
        """M."""
        return self.overlap.shape[-1]

    @property
    def log_odds(self) -> Float[Array, "*e m"]:
        """`(e, m)` of each mode against all others and against none being right.

        At equal odds before. How often modes of such odds are right, and of such log
        evidence alone: bench/studies/evidence.md.
        """
        one_more = jnp.pad(jnp.asarray(self.log_evidence), ((0, 0), (0, 1)))
        own = jnp.eye(self.num_modes, self.num_modes + 1, dtype=bool)
        others = jnp.where(own, -jnp.inf, one_more[:, None])
        return self.log_evidence - jax.nn.logsumexp(others, axis=-1)

    def of_modes(
        self, mode: Int[Array, " e"], alone: Bool[Array, " e"] | bool = True
    ) -> "RelativeMotions":
        """One mode of each pair, m = 1.

        Args:
            mode: which.
            alone: whether it has no rivals; where it has, its evidence is its log odds.
        """
        told = jnp.where(
            jnp.asarray(alone)[..., None], self.log_evidence, self.log_odds
        )
        e = jnp.arange(len(mode))
        parts = self.T_i_j, self.overlap, told, self.inlier_rmse
        return RelativeMotions(self.pairs, *(x[e, mode][:, None] for x in parts))

    def on_host(self, rows: Any = slice(None)) -> "RelativeMotions":
        """Some of them, of NumPy arrays."""
        return jax.tree.map(lambda x: np.asarray(x)[rows], self)

    def or_better(self, others: list["RelativeMotions | None"]) -> "RelativeMotions":
        """Where there is a likelier motion of a pair, that one; of NumPy arrays."""
        out = jax.tree.map(np.array, self)
        for k, other in enumerate(others):
            own = float(out.log_evidence[k, 0])
            if other is None or float(other.log_evidence[0, 0]) <= own:
                continue
            one = other.with_modes(self.num_modes).on_host()
            for x, y in zip(jax.tree.leaves(out), jax.tree.leaves(one), strict=True):
                x[k] = y[0]
        return out

    def with_modes(self, num: int) -> "RelativeMotions":
        """With the best so many modes, some of which may not overlap."""
        more = max(num - self.num_modes, 0)

        def of(x: Array, fill: float = 0) -> Array:
            rows = [(0, 0), (0, more)] + [(0, 0)] * (x.ndim - 2)
            return jnp.pad(x, rows, constant_values=fill)[:, :num]

        return RelativeMotions(
            self.pairs,
            of(self.T_i_j),
            of(self.overlap),
            of(self.log_evidence, NO_EVIDENCE),
            of(self.inlier_rmse),
        )

    def padded(self, num: int) -> "RelativeMotions":
        """With pairs of scan 0 and itself that do not overlap, to so many.

        On the host: there no program is compiled for each number.
        """
        known = len(self.overlap)

        def pad(x: Array | np.ndarray) -> np.ndarray:
            rows = [(0, num - known)] + [(0, 0)] * (x.ndim - 1)
            return np.pad(np.asarray(x), rows)

        out = jax.tree.map(pad, self)
        out.log_evidence[known:] = NO_EVIDENCE
        return jax.device_put(out)

    @staticmethod
    def joined(some: list["RelativeMotions"]) -> "RelativeMotions":
        """All of them, in ascending order of the scans; of NumPy arrays."""
        every = jax.tree.map(lambda *x: np.concatenate(list(map(np.asarray, x))), *some)
        return every.on_host(np.lexsort((every.pairs[:, 1], every.pairs[:, 0])))

    def in_input_frames(self, scans: PreparedScans) -> "RelativeMotions":
        """From the scans' centred frames and unit."""
        T_i_j = scans.to_input_frames(self.T_i_j, *self._scans())
        rmse = scans.radius * self.inlier_rmse
        return RelativeMotions(self.pairs, T_i_j, self.overlap, self.log_evidence, rmse)

    def told(self, scans: PreparedScans) -> "RelativeMotions":
        """`in_input_frames` in float64 on the host: `heard` gets the bits back."""
        T, rmse, radius, here, there = self._on_host(scans)
        t = radius * T[..., :-1, -1] + there - _turned(T, here)
        T[..., :-1, -1] = t
        return self._with(T, radius * rmse)

    def heard(self, scans: PreparedScans) -> "RelativeMotions":
        """What was `told`, as the search had it."""
        T, rmse, radius, here, there = self._on_host(scans)
        T[..., :-1, -1] = (T[..., :-1, -1] + _turned(T, here) - there) / radius
        found = self._with(T, rmse / radius)
        dtype = scans.mean.dtype
        return jax.tree.map(
            lambda x: jnp.asarray(x, dtype if x.dtype.kind == "f" else jnp.int32), found
        )

    def _on_host(self, scans: PreparedScans) -> tuple[np.ndarray, ...]:
        """Motions, residuals, the radius, the centres of scans j and of scans i."""
        mean, radius = (np.asarray(x, np.float64) for x in (scans.mean, scans.radius))
        i, j = (mean[x][:, None] for x in np.asarray(self.pairs).T)
        T, rmse = (np.array(x, np.float64) for x in (self.T_i_j, self.inlier_rmse))
        return T, rmse, radius, j, i

    def _with(self, T: np.ndarray, rmse: np.ndarray) -> "RelativeMotions":
        """NumPy arrays; not by the constructor: JAX without x64 has no float64."""
        held = jax.tree.map(np.asarray, self)
        return eqx.tree_at(lambda m: (m.T_i_j, m.inlier_rmse), held, (T, rmse))

    def _scans(self) -> tuple[Int[Array, "e m"], Int[Array, "e m"]]:
        """Scans i and j of every mode."""
        shape = self.overlap.shape
        i, j = (jnp.broadcast_to(x[:, None], shape) for x in self.pairs.T)
        return i, j


def _turned(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.sum(T[..., :-1, :-1] * points[..., None, :], axis=-1)


@kept_program
def relative_motions(
    method: AbstractRegistrar,
    scans: PreparedScans,
    pairs: Int[Array, "e 2"],
    key: Key,
) -> RelativeMotions:
    """Registers scan j to scan i for each pair (i, j).

    In the scans' centred frames; pairs by the rows of the scans. The random numbers of
    a pair depend on its ids alone, not on the number of scans nor on its place in the
    batch, so any division of the pairs into batches gives the same answer.
    """

    def one(pair: Array) -> RelativeMotions:
        i, j = pair
        solution = solve(
            scans.method_of(method, i, j),
            (scans.cloud(j), scans.cloud(i)),
            scans.table(method, i),
            jax.random.fold_in(jax.random.fold_in(key, scans.ids[i]), scans.ids[j]),
        )
        modes = jax.tree.map(lambda x: x[: num_kept(method)], solution.modes)
        T, usable = modes.T_target_source, scans.usable[i] & scans.usable[j]
        eye = jnp.eye(T.shape[-1], dtype=T.dtype)[None]
        for status in _NO_POSE:
            usable = usable & (solution.status != status)
        sound = usable & jnp.all(jnp.isfinite(T), axis=(1, 2))
        return RelativeMotions(
            scans.ids[pair],
            jnp.where(sound[:, None, None], T, eye),
            jnp.where(sound, modes.overlap, 0),
            jnp.where(sound, modes.log_evidence, NO_EVIDENCE),
            jnp.where(sound, modes.inlier_rmse, 0),
        )

    return map_side_by_side(one, pairs, scans.num_rows)
