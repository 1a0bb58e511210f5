"""Settings of papers."""

import numpy as np

from jaxreg._core.checks import check_count, shown
from jaxreg.local import GaussNewton, GradientDescent
from jaxreg.matching import PointToPoint
from jaxreg.particle.dynamics import (
    AbstractDynamics,
    MeasuredSpread,
    StochasticDynamics,
)
from jaxreg.particle.energies import SquaredEnergy
from jaxreg.particle.filter import ParticleFilter
from jaxreg.particle.priors import AbstractPrior, GaussianPrior
from jaxreg.particle.resamplers import Systematic
from jaxreg.robust import L2


def sandhu2010(
    d: int,
    num_particles: int = 200,
    dynamics: AbstractDynamics | None = None,
    *,
    prior: AbstractPrior | None = None,
    num_times: int = 50,
    num_points: int = 4096,
) -> ParticleFilter:
    """The filter of Sandhu, Dambreville, Tannenbaum 2010 with the settings printed.

    Point-to-point ICP with least squares; R = 7 steps of gradient descent in 2D, R = 3
    of Gauss-Newton in 3D (sections 3.4, 4.1); every particle drawn is carried on;
    likelihoods of the squared energy (section 3.3); resampled at every time, by the
    systematic method of its reference [18]; the diffusion of Eq. 8 with alpha = 1; the
    answer is the particle of least energy at the end.

    Not printed, so chosen here, as what comes nearest to the paper's figures: that the
    expectation of Eq. 7 is over all particles measured, and that three tenths of them
    are an effective sample at each time: so the temperature of the likelihoods is
    learned (the printed exponent has the wrong sign and underflows). The prior and the
    number of times are not printed either. `python -m bench --only paper_readings`
    compares readings.

    Args:
        d: 2 or 3.
        num_particles: N; the paper has 40 to 200.
        dynamics: `NoDynamics()`, `ConstantVelocity()` or, the default,
            `StochasticDynamics(spread=MeasuredSpread())` (the comparison of section
            5.2.1).
        prior: by default Gaussian around the guess with a deviation of half a radius
            and half a radian.
        num_times: steps t at most.
        num_points: source points that particles are measured on, the paper's all.

    Raises: ValueError for another d; when it is used, for points that are not of
    dimension d.

    Fails: TOO_FEW_POINTS for fewer than d + 1 points, which do not tell a rotation.
    """
    if dynamics is None:  # not at import, as numbers become arrays on a device
        dynamics = StochasticDynamics(spread=MeasuredSpread())
    if not isinstance(d, int | np.integer) or d not in (2, 3):
        raise ValueError(f"sandhu2010: d must be 2 or 3, found {shown(d)}.")
    check_count(num_particles, "sandhu2010: num_particles", 2)
    R = 7 if d == 2 else 3
    return ParticleFilter(
        num_prior=num_particles,
        num_particles=num_particles,
        num_times=num_times,
        prior_steps=R,
        inner_steps=R,
        refine_steps=0,
        num_agreeing=0,
        num_points=num_points,
        prior=GaussianPrior(0.5, 0.5) if prior is None else prior,
        dynamics=dynamics,
        resampler=Systematic(),
        energy=SquaredEnergy(),
        residual=PointToPoint(),
        kernel=L2(),
        step=GradientDescent() if d == 2 else GaussNewton(),
        prior_error_share=1.0,
        sample_share=0.3,
        dim=int(d),
    )
