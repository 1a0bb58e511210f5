"""The contract of priors."""

import abc
from typing import Any, ClassVar

from jaxtyping import Array, Float

from jaxreg._core.brief import BriefModule
from jaxreg._core.typing import Key, Motion, Scalar
from jaxreg.registrar import Frames


class AbstractPrior(BriefModule):
    """pi_0: where the particles are at t = 0 (PF paper, section 4.2)."""

    described: ClassVar[str] = "a prior such as UniformPrior()"

    @abc.abstractmethod
    def draw(
        self, key: Key, num: int, d: int, init: Motion | None, dtype: Any
    ) -> Float[Array, "p D D"]:
        """`num` poses in the frames of the search.

        Args:
            key: randomness.
            num: how many.
            d: dimension of the points.
            init: the initial guess, if there is one.
            dtype: of the result.
        """

    @abc.abstractmethod
    def in_frames(self, frames: Frames) -> "AbstractPrior":
        """The prior with its poses in the frames of the search.

        Users give them in the frames of the input. The prior itself if it has none.
        """

    @abc.abstractmethod
    def log_density(self, T_target_source: Motion) -> Scalar:
        """What it has against a pose in the frames of the search: zero at most.

        It is added to the pose's `log_evidence`. Zero of priors that only say where to
        begin.
        """
