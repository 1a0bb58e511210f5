"""What cells of the surfaces of scans add to the motions between them.

The pulls of the points of a pair, in sums over cells of the world that all pairs share,
and what the steps that measured the pair make of them.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxreg._core.arrays import full_matmul
from jaxreg.geometry import lie
from jaxreg.linear.small import product
from jaxreg.local.answer import answer
from jaxreg.local.held_directions import after_steps, whitening
from jaxreg.local.leverage import share_left
from jaxreg.matching.problem import match
from jaxreg.matching.residuals.gram import along
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.refine import NUM_STEPS, WIDTH_END, optimiser_of


#: Edge of a cell in sample spacings: some five points of a scan. With three as many
#: poses are inside, and of 48 views fewer together (bench/studies/coverage.md).
CELL = 2.0
#: Of wide cells, over which errors may have one sign. With 12 fewer poses of scans
#: nearly without noise are inside (86 % for 96).
WIDE_CELL = 16.0
# Sums that cells are kept in. Variances from so many have errors of sqrt(2 / number):
# a fiftieth from the most, a tenth from the fewest. In between as many as have room,
# which is counted in sums times scans.
_MOST, _LEAST, _ROOM = 4096, 256, 2**22
_PRIMES = (73_856_093, 19_349_663, 83_492_791)  # Teschner et al. 2003


class SurfaceErrors(eqx.Module):
    """What the surfaces of pairs say of their motions.

    Attributes:
        scans: prepared scans.
        T: `(v, d+1, d+1)` poses of the centred frames, in radii.
    """

    scans: PreparedScans
    T: Float[Array, "v D D"]

    @property
    def to_own_axes(self) -> Float[Array, "v k k"]:
        """From the axes of the world to those of each pose."""
        R = jnp.swapaxes(lie.rotation(self.T), -1, -2)
        return lie.adjoint(lie.compose(R, jnp.zeros_like(R[:, 0])))

    def errors(
        self,
        i: Array,
        j: Array,
        around: Float[Array, "r v k"],
        sizes: Float[Array, " r"],
        num: int,
    ) -> tuple[Float[Array, "r k c"], Float[Array, "k k"]]:
        """What the cells of each sum add to the motion of a pair, at frame j.

        And how far the motion does not follow the poses that it is measured from. In
        the axes of the world, at poses moved by some tangents, from cells of a size for
        each, in spacings. A cell is in one of `num` sums, with a sign drawn at random:
        then products of two that meet there are as often below 0 as above. For each of
        the tangents cells lie elsewhere: of many scans there are fewer of them than
        errors are told in directions.
        """
        optimiser, problem = optimiser_of(self.T), self.scans.problem(i, j, exact=True)
        width = WIDTH_END * jnp.max(self.scans.spacing)
        ends, places = jnp.stack([i, j]), jnp.arange(len(around)) / len(around)

        def at(told: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            move, place, size = told
            column, sign = self._cells(i, place, size, num)
            T_i, T_j = product(self.T[ends], lie.exp(move[ends]))
            T_i_j = lie.between(T_i, T_j)
            found = match(problem, T_i_j)
            weight = optimiser.weights(found, width)
            H, _ = optimiser.residual.normal_equations(found, weight)
            A = answer(optimiser, problem, T_i_j, found, width, weight, H)
            signed, cell = weight * sign[found.row], column[found.row]
            pulls = (optimiser.residual.descents(found) * signed).T
            pulls = jax.ops.segment_sum(pulls, cell, num)
            # What a cell decides alone does not show in its pull.
            led = _led(pulls, H)
            rows = along(found.normal, found)[:-1]
            left = share_left(led, rows, weight, cell)
            return A, H, pulls / jnp.sqrt(left)[:, None]

        A, H, pulls = lax.map(at, (around, places.astype(around.dtype), sizes))
        A, H, turn = jnp.mean(A, axis=0), jnp.mean(H, axis=0), self.to_own_axes[i].T
        gain, share = (full_matmul(turn, x) for x in after_steps(A, H, NUM_STEPS))
        return jnp.einsum("ab,rcb->rac", gain, pulls), full_matmul(share, turn.T)

    def _cells(
        self, i: Array, corner: Array, size: Array, num: int
    ) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        """Of the cell of the world that each point of a scan lies in: sum and sign.

        `corner` is the part of a cell by which all are moved.
        """
        edge = size * jnp.max(self.scans.spacing)
        place = lie.act(self.T[i], self.scans.cloud(i).points)
        place = jnp.floor(place / edge + corner).astype(jnp.int32)
        primes = jnp.asarray(_PRIMES[: place.shape[1]], jnp.int32)
        code = jnp.sum(place * primes, axis=1)
        sign = 1 - 2 * ((code // _MOST) % 2).astype(self.T.dtype)
        return code % num, sign


def _led(pulls: Float[Array, "c k"], H: Float[Array, "k k"]) -> Float[Array, "c k"]:
    """Where the pulls of each sum lead to."""
    white = whitening(H)
    return full_matmul(full_matmul(pulls, white), white.T)


def num_sums(num_scans: int) -> int:
    """How many sums of cells are kept; of very many scans fewer."""
    return max(min(_MOST, 2 ** int(math.log2(_ROOM / num_scans))), _LEAST)
