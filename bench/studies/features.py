"""What local features add to the search: pairs of sensors, with and without proposals.

    python -m bench.studies.features --data ../shared/data

prints a line per pair: where the true pose is among the proposals, how many
correspondences agree with it and with the best other one, what `register` finds with
three keys without proposals and with them (R right, w wrong, + believed, - not), and
the times of the quickest calls. The constants of `jaxreg.features` were chosen on pairs
of even number and checked on the others.
"""

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxreg as jr
from jaxreg.features import Agreed, propose
from jaxreg.particle.candidates import APART
from jaxreg.particle.modes import distinct_modes
from jaxreg.particle.pair import Pair
from jaxreg.particle.state import Particles
from jaxreg.registrar import Frames, GivenPair, prepare_pair


KEYS = 3
#: Degrees and radii within which refinement finds the pose.
NEAR = 10.0, 0.2
METHODS = jr.ParticleFilter(num_proposals=0), jr.ParticleFilter()


class SensorPair(NamedTuple):
    """Padded points, masks, and what counts as right."""

    clouds: tuple[np.ndarray, ...]
    T_target_source: np.ndarray
    centroid: np.ndarray
    tolerance: float

    def errors(self, T: np.ndarray) -> tuple[float, float]:
        """Degrees, and a length at the centroid of the source."""
        apart = (T - self.T_target_source)[:3] @ [*self.centroid, 1]
        chord = np.linalg.norm((T - self.T_target_source)[:3, :3]) / np.sqrt(8)
        turn = np.degrees(2 * np.arcsin(min(chord, 1)))
        return float(turn), float(np.linalg.norm(apart))


def read(path: Path) -> SensorPair:
    """A pair as published."""
    with np.load(path) as file:
        points = [np.asarray(file[side], np.float32) for side in ("source", "target")]
        T, tolerance = file["T_target_source"], float(file["tolerance"])
    num = 1 << (max(map(len, points)) - 1).bit_length()  # few programs
    padded = [np.pad(x, ((0, num - len(x)), (0, 0))) for x in points]
    masks = [np.arange(num) < len(x) for x in points]
    return SensorPair((*padded, *masks), T, points[0].mean(0, dtype=float), tolerance)


@eqx.filter_jit
def proposed(clouds: tuple[jax.Array, ...]) -> tuple[Agreed, Frames, jax.Array]:
    """Proposals in the frames of the search, and the rows of distinct ones."""
    method = METHODS[1]
    ready = prepare_pair(method, GivenPair(*clouds))
    index = method.index_of(ready.target)
    spacing = Pair.of(ready.source, ready.target, index).spacing
    agreed = propose(ready.source, ready.target, spacing)
    T = agreed.T_target_source
    particles = Particles.at(T, len(T)).valued(-agreed.num_agreeing.astype(T.dtype))
    limit = jnp.asarray(APART, T.dtype)
    rows = distinct_modes(particles, 16, angle=limit, distance=limit)[0]
    return agreed, ready.frames, rows


def place_of_truth(pair: SensorPair) -> str:
    """The true pose's place among distinct proposals, its count and that of others."""
    agreed, frames, rows = proposed(tuple(map(jnp.asarray, pair.clouds)))
    number = np.asarray(agreed.num_agreeing)[rows]
    right = []
    for T in agreed.T_target_source[rows]:
        turn, shift = pair.errors(np.asarray(frames.leave(T), float))
        right.append(turn < NEAR[0] and shift < NEAR[1] * float(frames.radius))
    if not any(right):
        return f"- ({number.max()})"
    others = number[~np.array(right)]
    first = right.index(True)
    return f"{first} ({number[first]}, {others.max() if others.size else 0})"


def outcome(pair: SensorPair, method: jr.ParticleFilter) -> tuple[str, float]:
    """A letter and a sign for each key, and seconds."""
    source, target, source_mask, target_mask = map(jnp.asarray, pair.clouds)
    told, seconds = "", np.inf
    for seed in range(KEYS):

        def run(seed: int = seed) -> jr.RegistrationSolution:
            return jr.register(
                source,
                target,
                method,
                key=jax.random.key(seed),
                source_mask=source_mask,
                target_mask=target_mask,
            )

        solution, once = timed(run)
        seconds = min(seconds, once)
        turn, shift = pair.errors(np.asarray(solution.T_target_source, float))
        told += "R" if turn < 5 and shift < pair.tolerance else "w"
        told += "+" if solution.status == jr.Status.CONVERGED else "-"
    return told, seconds


def timed(
    run: Callable[[], jr.RegistrationSolution],
) -> tuple[jr.RegistrationSolution, float]:
    """The solution, and the seconds of a second call."""
    jax.block_until_ready(run().status)
    begin = time.perf_counter()
    solution = run()
    jax.block_until_ready(solution.status)
    return solution, time.perf_counter() - begin


def main() -> None:
    """Prints a line for each pair."""
    parser = argparse.ArgumentParser()
    default = Path(os.environ.get("JAXREG_DATA", "../shared/data"))
    parser.add_argument("--data", type=Path, default=default)
    folder = parser.parse_args().data / "sensor_pairs"
    names = sorted(x for x in folder.glob("*.npz") if not x.name.startswith("seq_"))
    for number, path in enumerate(names):
        pair = read(path)
        (before, slow), (after, slower) = (outcome(pair, m) for m in METHODS)
        half = "check" if number % 2 else "choose"
        print(
            f"{path.stem} ({half}): truth at {place_of_truth(pair)}, {before} "
            f"{slow:.2f} s without, {after} {slower:.2f} s with",
            flush=True,
        )


if __name__ == "__main__":
    main()
