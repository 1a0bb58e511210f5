"""How a search came to rest: one row a step of the particle filter."""

from jaxtyping import Array, Float, Int

from jaxreg._core.brief import BriefModule


class SearchTrace(BriefModule):
    """The steps t = 0, 1, ... of a particle filter; of no influence on the answer.

    A filter that is sure of its first particles takes only one.

    Attributes:
        num_rows: int32, rows in use; the others are zero.
        num_measured: `(t,)` int32, particles that the step measured.
        least_energy: `(t,)` of them. `BoundedEnergy` has no unit; energies that are
            distances are in the target's root mean square radius, or its square.
        median_energy: `(t,)` likewise.
        effective_size: `(t,)` effective sample size of their weights.
        kernel_width: `(t,)` of the local optimiser, in the unit of the input; energies
            that depend on it are not compared from step to step.

    Gradients: none.
    """

    num_rows: Int[Array, "*b"]
    num_measured: Int[Array, "*b t"]
    least_energy: Float[Array, "*b t"]
    median_energy: Float[Array, "*b t"]
    effective_size: Float[Array, "*b t"]
    kernel_width: Float[Array, "*b t"]
