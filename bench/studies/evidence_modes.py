"""What the evidence is made of, of each mode that `register` finds."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from bench.studies.evidence_pairs import Pair
from jaxreg import ParticleFilter, Status, register
from jaxreg.neighbours import BruteForce
from jaxreg.particle.conclude import Pair as Prepared
from jaxreg.registrar import GivenPair, prepare_pair


#: What evidence is made of.
NUMBERS = "log_gain", "near", "firm"
# Sizes that clouds are padded to: each is compiled once.
_SIZES = 8192, 32768, 49152, 98304, 327680


def modes_of(pair: Pair, key: int) -> dict[str, Any]:
    """Modes with their numbers, and errors in degrees and tolerances; for JSON."""
    clouds = padded(pair.source, pair.target)
    source, target, *masks = clouds
    found = register(
        source,
        target,
        key=jax.random.key(key),
        source_mask=masks[0],
        target_mask=masks[1],
    )
    T = found.modes.T_target_source
    numbers = found.modes.log_evidence, *_numbers(clouds, T)
    told = zip(*map(np.asarray, numbers), strict=True)
    names = "log_evidence", *NUMBERS, "holds", "degrees", "tolerances"
    modes = [
        dict(zip(names, map(float, (*five, *pair.errors(pose))), strict=True))
        for five, pose, weight in zip(
            told, np.asarray(T, float), np.asarray(found.modes.weight), strict=True
        )
        if weight > 0
    ]
    return {
        "pair": pair.name,
        "key": key,
        "status": Status(int(found.status)).name,
        "log_evidence": float(found.log_evidence),
        "overlap": float(found.overlap),
        "modes": modes,
    }


def padded(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, ...]:
    """Clouds of one of a few sizes, and their masks."""
    num = next(n for n in _SIZES if n >= max(len(source), len(target)))
    clouds, masks = [], []
    for points in (source, target):
        points = np.asarray(points, np.float32)
        points = points[np.isfinite(points).all(axis=1)]
        clouds.append(np.pad(points, ((0, num - len(points)), (0, 0))))
        masks.append(np.arange(num) < len(points))
    return *clouds, *masks


@eqx.filter_jit
def _numbers(clouds: tuple, T: jax.Array) -> tuple[jax.Array, ...]:
    """`(q,)` the numbers of poses `(q, 4, 4)`, as the evidence has them, and holds."""
    ready = prepare_pair(ParticleFilter(), GivenPair(*map(jnp.asarray, clouds)))
    index = BruteForce.build(ready.target.points, ready.target.mask)
    witness = Prepared.of(ready.source, ready.target, index).judged.exact.witness

    def of_pose(T: jax.Array) -> tuple[jax.Array, ...]:
        there, back = witness._ways(T[None], jnp.ones(1, bool))
        said = witness._said(there, back)
        told = said.log_gain, said.near, said.firm, there.grip.holds
        return tuple(x[0] for x in told)

    return lax.map(of_pose, jax.vmap(ready.frames.enter)(T))
