"""The pairs whose motions poses are an average of."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxreg._core.programs import kept_program
from jaxreg._core.typing import Scalar
from jaxreg.multiview.place import Placement
from jaxreg.multiview.relative_motions import RelativeMotions
from jaxreg.multiview.which_join import prior_weight


class AveragedPairs(eqx.Module):
    """Pairs of placed scans that overlap, each measured anew from the poses of all.

    Attributes:
        pairs: `(p, 2)` int32 scans i and j; those of a scan and itself are padding.
        weight: `(p,)` what each counted for: its overlap, the probability that it is
            right, and the trust that averaging left it, multiplied.
    """

    pairs: Int[Array, "p 2"]
    weight: Float[Array, " p"]

    @classmethod
    def of(
        cls, motions: RelativeMotions, average: Placement, least: Scalar
    ) -> "AveragedPairs":
        """Those of an average of motions, m = 1.

        Args:
            motions: of the pairs.
            average: of these.
            least: log evidence of the pairs that count.
        """
        weight = _weight(motions, average.edge_weight, least)
        return cls(motions.pairs, jax.lax.stop_gradient(weight))

    def beside(self, other: "AveragedPairs") -> "AveragedPairs":
        """These and others, without padding; outside of `jit`."""
        every = jax.tree.map(lambda *x: np.concatenate(x), self, other)
        return every.without_padding()

    def without_padding(self) -> "AveragedPairs":
        """Cut on the host; outside of `jit`."""
        real = np.asarray(self.pairs[:, 0] != self.pairs[:, 1])
        return jax.device_put(jax.tree.map(lambda x: np.asarray(x)[real], self))


@kept_program
def _weight(
    motions: RelativeMotions, trust: Float[Array, " p"], least: Scalar
) -> Float[Array, " p"]:
    return trust * prior_weight(motions, least)
