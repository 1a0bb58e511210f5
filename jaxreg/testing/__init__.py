"""Whether an object keeps the promises of its contract.

    from jaxreg.testing import check_kernel
    check_kernel(MyKernel())

Each check runs the protocol on small problems in double precision and raises an
AssertionError on the first promise that is broken, in a sentence. The methods and parts
of the package are checked by the same functions.
"""

from jaxreg.testing.averager import check_averager as check_averager
from jaxreg.testing.dynamics import check_dynamics as check_dynamics
from jaxreg.testing.energy import check_energy as check_energy
from jaxreg.testing.index import check_index as check_index
from jaxreg.testing.kernel import check_kernel as check_kernel
from jaxreg.testing.prior import check_prior as check_prior
from jaxreg.testing.registrar import check_registrar as check_registrar
from jaxreg.testing.resampler import check_resampler as check_resampler
from jaxreg.testing.residual import check_residual as check_residual
from jaxreg.testing.step import check_step as check_step
