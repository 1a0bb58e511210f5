"""`reconstruct`: many scans into one frame, without an initial guess.

    scans -> pairs -> particle filter -> motion averaging -> pairs again -> averaging

Every stage is one compiled function. Under `jit` the stages run as one program, with
all pairs; called with arrays, a thin loop chooses the pairs round by round, runs two
batches of them at a time, and reports progress.
"""

import contextlib
from concurrent.futures import Executor
from typing import Any

import equinox as eqx
import jax

from jaxreg._core.arrays import cast_floats
from jaxreg._core.checks import (
    check_callable,
    check_flag,
    check_instance,
    check_key,
    check_method,
    is_concrete,
    shown,
)
from jaxreg._core.log import log_solution, log_stage
from jaxreg._core.typing import ArrayLike, Key, Progress
from jaxreg.averaging import AbstractAverager
from jaxreg.averaging.world.adjusted import Told
from jaxreg.multiview.choose_pairs import Order, all_pairs
from jaxreg.multiview.conclude import finish
from jaxreg.multiview.earlier import check_can_hold, known_before
from jaxreg.multiview.given_scans import GivenScans
from jaxreg.multiview.hold_poses import Held
from jaxreg.multiview.known_world import KnownWorld
from jaxreg.multiview.positions import ScanPositions
from jaxreg.multiview.prepare import prepare_scans
from jaxreg.multiview.register_pairs import OnPairs, Rounds
from jaxreg.multiview.relative_motions import relative_motions
from jaxreg.multiview.scan_set import OUTSIDE, ScanSet
from jaxreg.multiview.solution import ReconstructionSolution
from jaxreg.multiview.workers import Workers, check_executor
from jaxreg.particle import ParticleFilter
from jaxreg.registrar import AbstractRegistrar


def reconstruct(
    scans: ArrayLike | ScanSet,
    *,
    key: Key,
    method: AbstractRegistrar | None = None,
    averaging: AbstractAverager | None = None,
    mask: ArrayLike | None = None,
    viewpoints: ArrayLike | None = None,
    positions: ScanPositions | None = None,
    order: Order | str = "any",
    previous: object = None,
    hold_previous: bool = False,
    priors: Told = None,
    fixed: Told = None,
    control: Told = None,
    levels: Told = None,
    progress: Progress | None = None,
    on_pairs: OnPairs | None = None,
    executor: Executor | None = None,
) -> ReconstructionSolution:
    """Brings scans into one frame, without an initial guess.

    Each scan is first registered with a few others that look like it, then pairs follow
    that join parts, close loops, or hold scans that hang by a thread: of up to 20 scans
    at most all pairs, of more ten a scan. Methods other than `ParticleFilter` in 3D do
    not tell which scans look alike: there all pairs of up to 20 scans are registered,
    and of more the first ones are drawn at random.

    Args:
        scans: a list of `(n_i, d)` point sets, or a padded array `(v, n, d)`. Of a
            scan in a list that has more than 524,288 points so many are drawn. Or a
            `ScanSet`, which is made ready once for many calls; not under `jit`.
        key: a `jax.random.key`; the same key gives the same answer.
        method: registers pairs, `ParticleFilter()` by default; any method of `register`
            does. Of an `AbstractIndexedRegistrar` several modes of a pair are kept.
        averaging: how relative motions become poses; None for `Correntropy` from the
            spanning tree of largest overlap.
        mask: `(v, n)` True for valid points, for a padded array only.
        viewpoints: where each scan's scanner stood, in the scan's own frame: `(v, d)`,
            or a list with None for those that are not known. A scan saw free space
            between its viewpoint and its points, and poses that put points of others
            there count as contradicted. Only for scans from one place each, of what
            does not move.
        positions: about where the scanners stood, of satellite fixes for instance.
        order: "sequential" if each scan overlaps the next: only neighbours are
            registered to begin with, of any number of scans, where the scanner moved on
            as before without a search; not under `jit`.
        previous: a `ReconstructionSolution` of the first of these scans, whose pairs
            are not registered again; or the `RelativeMotions` that `on_pairs` got in a
            run that was interrupted, which leads to the same answer. Not under `jit`.
        hold_previous: whether the scans that are placed in the `previous` solution keep
            the poses that they have there, to the last digit, and new ones lie beside
            them in its world; else all poses are found anew.
        priors: what is nearly known of poses, a list of `(i, T_world_i)` or
            `(i, T_world_i, information)` of the right tangent error. The answer is then
            in their world. Wrong ones are not trusted: see `prior_weight`.
        fixed: poses that are known exactly, a list of `(i, T_world_i)`.
        control: surveyed points, a list of `(i, p_i, p_world)` or
            `(i, p_i, p_world, information)`: scan i sees at `p_i` what lies at
            `p_world`, such as a target or, with `p_i` the place of the antenna, a
            satellite fix. Parts that no overlap joins meet in the world.
        levels: tilts, a list of `(i, up_i, deviation)`: what points up in scan i, with
            the deviation of its angles in radians. See `average`, which takes the same
            four.
        progress: called as `progress(stage, done, total)`; not under `jit`.
        on_pairs: called with the `RelativeMotions` of every few pairs as they are
            found, in the input's frames and unit, as NumPy arrays with motions in
            float64: from these `previous` gets the very bits; not under `jit`.
        executor: registers pairs in other processes, on machines alike to the same
            bits: a `concurrent.futures.ProcessPoolExecutor` that spawns its processes,
            or any other `Executor`, such as `get_executor()` of a client of
            `dask.distributed`. They read the scans in the folder for temporary files
            (TMPDIR), and share the programs that `jaxreg.cache()` keeps. `on_pairs` is
            told what they found before one of them failed. Not under `jit`.

    Returns:
        A `ReconstructionSolution`. Of NumPy arrays of float64 in map coordinates, see
        `register`, its poses and motions are NumPy arrays of float64.

    Raises:
        ValueError, TypeError: while tracing, for shapes and types that do not fit.

    Fails:
        DISCONNECTED where some scans could not be placed, AMBIGUOUS where some can slip
        along the others; `scan_status` says which, and what is wrong with them.
        NO_AGREEMENT where no pairs agree with each other: scans then lie as the
        likeliest pairs have them; or of priors and control points, or of levels,
        without fixed scans, no more than half agree, or all had to bend (see
        `average`); and of a scan that is fixed where
        none of its pairs has it. DEGENERATE where what is known holds no part of the
        scans, as of points on a line.

    Gradients:
        Of `T_world_i`, by the points of all scans: implicit where the last steps of
        each pair came to rest, with matches and trust in pairs held, and through the
        averaging, as that method says. All pairs are then registered, as under `jit`.
        Of scans that are not placed they are finite, but mean nothing. Settings have no
        influence, and what else the solution holds has no derivative.

    Reference:
        Sandhu, Dambreville, Tannenbaum for the pairs; Zhu et al. for the averaging.
    """
    check_instance(positions, "positions", ScanPositions | None)
    check_flag(hold_previous, "hold_previous")
    check_callable(progress, "progress")
    check_callable(on_pairs, "on_pairs")
    check_executor(executor)
    given, method = _checked_scans(scans, mask, viewpoints, method)
    far, shape = given.far, given.shape
    held = None
    if hold_previous and isinstance(previous, ReconstructionSolution):
        held = previous
    positions, previous = far.positions(positions), far.previous(previous)
    on_pairs = far.hears(on_pairs)
    check_instance(averaging, "averaging", AbstractAverager | None)
    known = KnownWorld.of(priors, fixed, control, levels, shape, given.dtype)
    if hold_previous:
        check_can_hold(previous, known)
    if positions is not None:
        positions.check_fits(shape, method)
        positions = cast_floats(positions, given.dtype)
    if far.moved:
        moved = far.known(priors, fixed, control, levels)
        known = KnownWorld.of(*moved, shape, given.dtype)
    key, order = check_key(key), _checked(order)
    if not (given.is_concrete and is_concrete(key)):
        _check_can_trace(order, (previous, on_pairs, executor), given)
        assert isinstance(given, GivenScans)
        inputs = given.points, given.mask, given.viewpoints, positions
        solution = _of_all_pairs(method, averaging, inputs, key, known)
    else:
        told = order, previous, hold_previous, progress, on_pairs, executor
        inputs = given, positions
        solution = _of_chosen_pairs(method, averaging, inputs, key, known, *told)
    origin = None if known is None else known.origin_of(solution)
    solution = far.back(solution, origin, held)
    if known is not None:
        solution = known.in_world(solution, fixed, moved=far.moved)
    log_solution("reconstruct", solution)
    return solution


def _checked_scans(
    scans: ArrayLike | ScanSet,
    mask: ArrayLike | None,
    viewpoints: ArrayLike | None,
    method: AbstractRegistrar | None,
) -> tuple[GivenScans | ScanSet, AbstractRegistrar]:
    """The scans, and the method that registers their pairs."""
    if isinstance(scans, ScanSet):
        scans.check_usable(method, mask, viewpoints)
        return scans, scans.method
    given = GivenScans.of(scans, mask, viewpoints)
    method = ParticleFilter() if method is None else method
    check_method(method, AbstractRegistrar)
    return given, method


def _check_can_trace(
    order: Order, told: tuple[object, ...], given: GivenScans | ScanSet
) -> None:
    if isinstance(given, ScanSet):
        raise ValueError(OUTSIDE)
    if order != "any" or any(x is not None for x in told):
        raise ValueError(
            "order, previous, on_pairs, executor: pairs are chosen outside of jit only."
        )
    if given.far.moved:
        raise ValueError("scans: far from their origins, moved outside of jit only.")


def _of_chosen_pairs(
    method: AbstractRegistrar,
    averaging: AbstractAverager | None,
    inputs: tuple[GivenScans | ScanSet, ScanPositions | None],
    key: Key,
    known: KnownWorld | None,
    order: Order,
    previous: object,
    hold_previous: bool,
    progress: Progress | None,
    on_pairs: OnPairs | None,
    executor: Executor | None,
) -> ReconstructionSolution:
    """Round by round, each of pairs that those before ask for."""

    def report(stage: str, done: int, total: int) -> None:
        log_stage(stage, done, total)
        if progress is not None:
            progress(stage, done, total)

    report("preparing scans", 0, 1)
    given, positions = inputs
    prepared, said = given.prepared(method, positions, to_search=order == "any")
    report("preparing scans", 1, 1)
    words = None if said is None else said.used
    before, first = known_before(previous, prepared, order, words)
    hold = None
    if hold_previous and isinstance(previous, ReconstructionSolution):
        hold = Held.of(previous, prepared)
    with contextlib.ExitStack() as stack:
        workers = None
        if executor is not None:
            workers = stack.enter_context(Workers(executor, method, prepared, key))
        told = before, on_pairs, report, workers, hold
        rounds = Rounds(method, averaging, prepared, key, *told)
        motions = rounds.run(order, first, words)
    report("averaging and refining", 0, 1)
    motions_padded = motions.padded(rounds.num_rows)
    if known is not None:
        known = known.padded(prepared.num_scans)
    told = hold, known, rounds.overlaps
    solution = finish(method, averaging, prepared, motions_padded, *told)
    averaged = solution.averaged.without_padding()
    if hold is not None and isinstance(previous, ReconstructionSolution):
        averaged = previous.averaged.beside(averaged)
    solution = eqx.tree_at(lambda s: s.averaged, solution, averaged)
    solution = jax.block_until_ready(solution)
    report("averaging and refining", 1, 1)
    return solution.of_pairs(len(motions.overlap)).of_scans(prepared.num_present)


def _of_all_pairs(
    method: AbstractRegistrar,
    averaging: AbstractAverager | None,
    inputs: tuple[Any, ...],
    key: Key,
    known: KnownWorld | None,
) -> ReconstructionSolution:
    """What can be traced: no pair is chosen by what others told."""
    prepared = prepare_scans(method, *inputs, to_search=True)
    pairs = jax.device_put(all_pairs(prepared.num_scans))
    method, held = jax.lax.stop_gradient((method, prepared))
    motions = relative_motions(method, held, pairs, key)
    return finish(method, averaging, prepared, motions, None, known)


def _checked(order: str) -> Order:
    if isinstance(order, str) and (order == "any" or order == "sequential"):
        return order
    raise ValueError(f"order: wanted 'any' or 'sequential', found {shown(order)}.")
