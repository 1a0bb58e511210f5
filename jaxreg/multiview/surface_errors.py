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
from jaxreg.local.held_directions import after_steps
from jaxreg.matching.problem import match
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.refine import NUM_STEPS, WIDTH_END, optimiser_of


# Edge of a cell in sample spacings: some five points of a scan. With three as many
# poses are inside, and of 48 views fewer together (bench/studies/coverage.md).
_CELL = 2.0
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
        self, i: Array, j: Array, around: Float[Array, "r v k"], num: int
    ) -> tuple[Float[Array, "r k c"], Float[Array, "k k"]]:
        """What the cells of each sum add to the motion of a pair, at frame j.

        And how far the motion does not follow the poses that it is measured from. In
        the axes of the world, at poses moved by some tangents. A cell is in one of
        `num` sums, with a sign drawn at random: then products of two that meet there
        are as often below 0 as above. For each of the tangents cells lie elsewhere: of
        many scans there are fewer of them than errors are told in directions.
        """
        optimiser, problem = optimiser_of(self.T), self.scans.problem(i, j, exact=True)
        width = WIDTH_END * jnp.max(self.scans.spacing)
        ends, places = jnp.stack([i, j]), jnp.arange(len(around)) / len(around)

        def at(told: tuple[Array, Array]) -> tuple[Array, Array, Array]:
            move, place = told
            column, sign = self._cells(i, place, num)
            T_i, T_j = product(self.T[ends], lie.exp(move[ends]))
            T_i_j = lie.between(T_i, T_j)
            found = match(problem, T_i_j)
            weight = optimiser.weights(found, width)
            H, _ = optimiser.residual.normal_equations(found, weight)
            A = answer(optimiser, problem, T_i_j, found, width, weight, H)
            signed = weight * sign[found.row]
            pulls = (optimiser.residual.descents(found) * signed).T
            return A, H, jax.ops.segment_sum(pulls, column[found.row], num)

        A, H, pulls = lax.map(at, (around, places.astype(around.dtype)))
        A, H, turn = jnp.mean(A, axis=0), jnp.mean(H, axis=0), self.to_own_axes[i].T
        gain, share = (full_matmul(turn, x) for x in after_steps(A, H, NUM_STEPS))
        return jnp.einsum("ab,rcb->rac", gain, pulls), full_matmul(share, turn.T)

    def _cells(
        self, i: Array, corner: Array, num: int
    ) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        """Of the cell of the world that each point of a scan lies in: sum and sign.

        `corner` is the part of a cell by which all are moved.
        """
        size = _CELL * jnp.max(self.scans.spacing)
        place = lie.act(self.T[i], self.scans.cloud(i).points)
        place = jnp.floor(place / size + corner).astype(jnp.int32)
        primes = jnp.asarray(_PRIMES[: place.shape[1]], jnp.int32)
        code = jnp.sum(place * primes, axis=1)
        sign = 1 - 2 * ((code // _MOST) % 2).astype(self.T.dtype)
        return code % num, sign


def num_sums(num_scans: int) -> int:
    """How many sums of cells are kept; of very many scans fewer."""
    return max(min(_MOST, 2 ** int(math.log2(_ROOM / num_scans))), _LEAST)
