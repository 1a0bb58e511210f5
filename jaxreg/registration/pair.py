"""One pair: prepared in frames of its own, solved, and back."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxreg._core import control
from jaxreg._core.status import Status
from jaxreg._core.typing import Motion
from jaxreg.cloud import Frames
from jaxreg.local import Curvature, tangent_unit
from jaxreg.matching import NO_EVIDENCE
from jaxreg.registrar import (
    AbstractRegistrar,
    GivenPair,
    Modes,
    PreparedPair,
    RegistrationSolution,
    prepare_pair,
)


# What clouds in different units end in, whatever the method.
_DOUBTED = Status.LOW_OVERLAP, Status.AMBIGUOUS, Status.DIVERGED


@control.over_devices
def register_pair(
    method: AbstractRegistrar,
    pair: GivenPair,
    init: Array | None,
    key: Array | None,
) -> RegistrationSolution:
    """Of sources, targets, their masks and viewpoints; traced."""
    ready, init = enter_pair(method, pair, init)
    solution = ready.method.solve(ready.source, ready.target, init, key)
    return leave_pair(ready, solution)


def enter_pair(
    method: AbstractRegistrar, pair: GivenPair, init: Array | None
) -> tuple[PreparedPair, Array | None]:
    """Prepared, in frames of its own; so is the guess."""
    ready = prepare_pair(method, pair)
    return ready, None if init is None else ready.frames.enter(init)


def leave_pair(
    ready: PreparedPair, solution: RegistrationSolution
) -> RegistrationSolution:
    """What the method answers, in frames, units and statuses of what was given."""
    doubted = jnp.isin(solution.status, jnp.array(_DOUBTED))
    status = jnp.where(
        ready.unit_differs & doubted, Status.UNIT_DIFFERS, solution.status
    )
    solution = dataclasses.replace(solution, status=status.astype(jnp.int32))
    return _in_input_frames(solution, ready.frames, ready.enough)


def _in_input_frames(
    solution: RegistrationSolution, frames: Frames, enough: Bool[Array, ""]
) -> RegistrationSolution:
    """A solution in the frames and unit of the input; none if not `enough`."""

    def back(T: Motion) -> Motion:
        T = frames.leave(T)
        return jnp.where(enough, T, jnp.eye(len(T), dtype=T.dtype))

    status = jnp.where(enough, solution.status, Status.TOO_FEW_POINTS)
    curvature = Curvature(
        solution.H, solution.b, solution.error, solution.covariance
    ).scaled(frames.radius)
    modes = solution.modes
    trace = solution.trace
    if trace is not None:
        width = frames.radius * trace.kernel_width
        trace = dataclasses.replace(trace, kernel_width=width)
    unit = tangent_unit(frames.radius, modes.covariance.shape[-1])
    return RegistrationSolution(
        T_target_source=back(solution.T_target_source),
        status=status.astype(jnp.int32),
        fitness=jnp.where(enough, solution.fitness, 0),
        inlier_rmse=frames.radius * solution.inlier_rmse,
        num_inliers=jnp.where(enough, solution.num_inliers, 0),
        overlap=jnp.where(enough, solution.overlap, 0),
        log_evidence=jnp.where(enough, solution.log_evidence, NO_EVIDENCE),
        num_steps=solution.num_steps,
        H=curvature.H,
        b=curvature.b,
        error=curvature.error,
        covariance=curvature.covariance,
        modes=Modes(
            jax.vmap(back)(modes.T_target_source),
            modes.weight,
            modes.fitness,
            modes.overlap,
            frames.radius * modes.inlier_rmse,
            modes.log_evidence,
            modes.covariance * jnp.outer(unit, unit)[None],
        ),
        trace=trace,
    )
