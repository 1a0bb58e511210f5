"""The PF paper's horse without a guess: its own protocol, any rotation, halves.

The horse is its own mirror image, but no rotation maps it on itself, so poses that look
alike count as wrong.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bench.case import Case, Judged, Method, Options, Solve
from bench.peers.global_pairs import GicpStarts, Peer, horse_peers
from bench.records import error, share
from bench.workloads.filter_data import Trials, horse, horse_model, horse_name
from bench.workloads.filter_outcome import outcome, shift_of_model
from bench.workloads.global_data import half, so3
from bench.workloads.local_pairs import written_out
from bench.workloads.prepared_model import ours, prepare, search
from jaxreg import register
from jaxreg.particle import AbstractSearch, ParticleFilter


# Sparse points and few particles: the source has no normals, all of it is compared.
PREPARED = ParticleFilter(
    num_prior=768,
    num_particles=64,
    num_times=3,
    prior_steps=5,
    num_points=128,
    num_modes=6,
    refine_steps=10,
    width_start=0.4,
    width_end=0.1,
)
#: Trials of seed 0 served to choose settings.
SEED = 1
#: Name, how trials are drawn, shares of noise, the filter on the prepared model.
PROTOCOLS: tuple[tuple[str, Callable[..., Trials], tuple, Callable], ...] = (
    ("protocol", horse, (0.05, 0.10, 0.25, 0.35), ours),
    ("any rotation", so3, (0.10, 0.25, 0.35), lambda: PREPARED),
    ("half", half, (0.25,), lambda: PREPARED),
)


def cases(options: Options) -> Iterator[Case]:
    """A case per protocol and share of noise."""
    folder = None if options.quick else options.data / "horse"
    model = horse_model(folder)
    for name, draw, noises, method in PROTOCOLS:
        if options.quick and name != "half":
            continue
        for noise in (0.25,) if options.quick else noises:
            num = 10 if options.quick else 50
            trials = draw(num, noise, model, SEED)
            yield Case(
                name=f"{name}, {noise:.0%} noise",
                data=horse_name(folder),
                methods=methods(method(), trials, options.quick),
                trials=[(points, k) for k, points in enumerate(trials.source)],
                judge=partial(judge, trials),
                repeats=2 if options.quick else 1,
                reference="small_gicp PLANE, 40 starts",
                x=noise,
                x_label=f"share of noise, {name}",
            )


def methods(search: AbstractSearch, trials: Trials, quick: bool) -> list[Method]:
    """Of this package and of others."""
    found = [prepared("jaxreg, model prepared once", search, trials.target)]
    if not quick:
        settings = written_out(ParticleFilter())
        solve = partial(_register, trials.target)
        found.append(Method("jaxreg register()", "jaxreg", settings, solve))
    for name, (library, peer) in horse_peers().items():
        setting = f"{peer}"
        make = partial(peer_solve, peer, trials.target)
        found.append(Method(name, library, setting, prepare=make))
        if isinstance(peer, GicpStarts) and not quick:
            # From the pose in which the source is given: enough for the protocol.
            one = peer._replace(starts=1, reach=(100.0, 12.0))
            make = partial(_from_identity, one, trials.target)
            label = "small_gicp PLANE from the identity"
            text = f"{one}, first start the identity"
            found.append(Method(label, library, text, prepare=make))
    return found


def prepared(name: str, method: AbstractSearch, target: np.ndarray) -> Method:
    """The search against a target that is prepared once."""

    def make() -> Solve:
        model = jax.block_until_ready(prepare(method, jnp.asarray(target)))

        def solve(points: np.ndarray, seed: int) -> np.ndarray:
            key = jax.random.key(seed)
            T = search(method, model, jnp.asarray(points)[None], key)
            return np.asarray(T[0], float)

        return solve

    return Method(name, "jaxreg", written_out(method), prepare=make)


def _register(target: np.ndarray, points: np.ndarray, seed: int) -> np.ndarray:
    found = register(points, target, key=jax.random.key(seed))
    return np.asarray(found.T_target_source, float)


def peer_solve(peer: Peer, target: np.ndarray) -> Solve:
    """Solves trials against the target prepared once."""
    fixed = peer.prepare(target)

    def solve(points: np.ndarray, seed: int) -> np.ndarray:
        return peer.solve(peer.prepare(points), fixed, seed).T_target_source

    return solve


def _from_identity(peer: GicpStarts, target: np.ndarray) -> Solve:
    fixed = peer.prepare(target)

    def solve(points: np.ndarray, _: int) -> np.ndarray:
        return peer.descend(peer.prepare(points), fixed, np.eye(4))

    return solve


def judge(trials: Trials, answers: list[Any]) -> Judged:
    """Success within the paper's bounds; errors of those that succeed."""
    T = np.array(answers)
    found = outcome(T, trials)
    shift = shift_of_model(found, trials)
    right = (found.degrees <= trials.degrees) & (shift <= trials.shift)
    metrics = [share("success", right, 100 * max(1.0, 0.05 * len(T)) / len(T) + 1e-6)]
    if right.any():
        metrics += [
            error("e_rot", float(np.median(found.degrees[right])), "deg", 0.02),
            error("e_trans", float(np.median(shift[right])), "units", 0.02),
        ]
    return Judged(metrics, {"e_rot": found.degrees.tolist()})
