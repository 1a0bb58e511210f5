"""`jaxreg register`: one scan onto another."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

import jaxreg
from jaxreg._core.status import Status
from jaxreg.app.advice import terminal_advice
from jaxreg.app.cli import outputs
from jaxreg.app.cli.guess import read_guess
from jaxreg.app.cli.inputs import Scans, check_point, load_scans
from jaxreg.app.cli.options import UNITS, Register
from jaxreg.app.cli.runtime import Session, compile_in_a_hurry, key_of, method_of
from jaxreg.app.plot.results import result_of
from jaxreg.app.result import Result
from jaxreg.io.errors import InputError


def run(command: Register, session: Session) -> int:
    """Runs the command; returns the exit code."""
    command.check_method()
    command.check_model()
    units = _units(command)
    with session.timed("read"):
        scans = load_scans(
            [command.target, command.source], units, any_size=command.scale
        )
    if len(scans.names) != 2:
        raise InputError(
            f"{command.target} and {command.source}: hold {len(scans.names)} scans.\n"
            "Name one of each (FILE.npz:KEY), or use: jaxreg multiview"
        )
    for note in scans.notes:
        session.console.print(note)
    dim = scans.points[0].shape[1]
    command.check_known(dim)
    check_point(command.position, dim, "--position")
    scans.check_viewpoint(command.viewpoint, units)
    if command.budget <= Register.budget:
        compile_in_a_hurry()
    key, method = key_of(command), _method(command, scans)
    init = _guess(command, scans, units)
    with session.progress() as progress, session.timed("run", computes=True):
        progress("registering", 0, 1)
        eyes = _viewpoints(command, scans, units)
        result, modes, covariances = _register(scans, key, method, init, eyes)
        progress("registering", 1, 1)
    result = dataclasses.replace(result, units=np.asarray(units))
    result = outputs.write_files(
        session,
        result,
        scans.points,
        modes=modes,
        covariances=covariances,
        read=scans,
    )
    if not result.believed:
        who = f"{command.source} onto {command.target}: {result.status.name}"
        return outputs.tell_failure(session, result, who, result.status)
    _show(session, result, f" {command.unit[1]}" if command.unit else "")
    if command.method != "filter" and command.init is None:
        session.console.print(
            f"{command.method} began where the middles meet and goes to the nearest "
            "fit, right or wrong: give a guess (--init), or leave --method out."
        )
    return 0


def _units(command: Register) -> list[float]:
    """What coordinates of target and source are multiplied by."""
    if command.unit is None:
        return [1.0, 1.0]
    source, target = (UNITS[name] for name in command.unit)
    return [1.0, source / target]


def _method(command: Register, scans: Scans) -> jaxreg.AbstractRegistrar:
    if command.method == "filter":
        return _located(command, scans)
    if command.method == "correlation":
        return jaxreg.KernelCorrelation()
    farthest = command.max_distance or float("inf")
    return jaxreg.ICP(max_correspondence_distance=farthest, with_scale=command.scale)


def _located(command: Register, scans: Scans) -> jaxreg.ParticleFilter:
    """Knowing `position`, between scans that are moved to their middles."""
    method = method_of(command)
    if command.position is None:
        return method
    target, source = (-middle for middle in scans.centred()[1])
    prior = jaxreg.PartialPose(
        up=(0, 0, 1) if command.upright else None,
        position=command.position,
        deviation=command.deviation,
        source_scanner=source,
        target_scanner=target,
    )
    return dataclasses.replace(method, prior=prior)


def _guess(
    command: Register, scans: Scans, units: Sequence[float]
) -> np.ndarray | None:
    """`--init` between scans in the target's unit that are moved to their middles."""
    if command.init is None:
        return None
    dim, (target, source) = scans.points[0].shape[1], scans.names
    scaled = command.scale or units[1] != 1
    T = read_guess(command.init, (target, source), dim, scaled)
    # Of coordinates as they are in the files, or of the source in the target's unit.
    size = np.abs(np.linalg.det(T[:dim, :dim])) ** (1 / dim)
    if units[1] != 1 and abs(np.log(size / units[1])) < abs(np.log(size)):
        T[:dim, :dim] /= units[1]
    to, start = scans.centred()[1]
    T[:dim, dim] += T[:dim, :dim] @ start - to
    return T


def _viewpoints(
    command: Register, scans: Scans, units: Sequence[float]
) -> list[np.ndarray] | None:
    """`--viewpoint` of source and target, in scans that are moved to their middles."""
    if command.viewpoint is None:
        return None
    eyes = np.outer(units, command.viewpoint) - scans.centred()[1]
    return list(eyes[::-1])


def _register(
    scans: Scans,
    key: jax.Array,
    method: jaxreg.AbstractRegistrar,
    init: np.ndarray | None,
    viewpoints: list[np.ndarray] | None,
) -> tuple[Result, tuple[np.ndarray, ...], np.ndarray]:
    """The result, the modes of the posterior, and the covariances of both poses."""
    centred, middles = scans.centred()
    target, source = (x[np.isfinite(x).all(axis=1)] for x in centred)
    sol = jaxreg.register(
        source, target, method, key=key, init=init, viewpoints=viewpoints
    )
    scaled = isinstance(method, jaxreg.ICP) and method.with_scale
    T_target_source = outputs.uncentre(
        np.asarray(sol.T_target_source)[None], middles[0], middles[1], scaled
    )
    result = dataclasses.replace(
        result_of(sol, scans.points, scans.names),
        T_world_i=np.stack([np.eye(len(T_target_source[0])), T_target_source[0]]),
        T_i_j=T_target_source,
    )
    moved = outputs.uncentre(
        np.asarray(sol.modes.T_target_source), middles[0], middles[1], scaled
    )
    modes = (moved, np.asarray(sol.modes.weight), np.asarray(sol.modes.fitness))
    covariance = np.asarray(sol.covariance)
    return result, modes, np.stack([np.zeros_like(covariance), covariance])


def _show(session: Session, result: Result, unit: str) -> None:
    target, source = result.names
    session.console.print(
        f"{result.status.name}: {source} lies on {target} with overlap "
        f"{result.overlap[0]:.3f} and inlier RMSE {result.inlier_rmse[0]:.4g}{unit}."
    )
    if result.status != Status.CONVERGED:
        session.console.print(terminal_advice(result.status))
    dropped = int(result.num_dropped.sum())
    if dropped:
        session.console.print(f"{dropped:,} rows with NaN or inf were left out.")
    session.console.print(f"T_{target}_{source} =")
    for row in result.T_file[1]:
        session.console.print("  " + " ".join(f"{x:16.12g}" for x in row))
    outputs.show_end(session, result.files, session.options.out)
