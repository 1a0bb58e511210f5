"""Pairs over the devices of several hosts: start this once on each.

    python notebooks/hosts.py HOST:PORT 2 0      # on the first of two hosts
    python notebooks/hosts.py HOST:PORT 2 1      # on the second

HOST:PORT is where the first listens. Each host makes (or reads) the same pairs,
registers those that its devices hold, and prints them; nothing is exchanged but the
addresses of devices. Where one does not come the others end after a minute.
"""

import sys

import jax
import numpy as np

import jaxreg as jr
from jaxreg.datasets import horse_like_points


PAIRS = 8
SECONDS = 60  # to wait for a host that does not come


def main(coordinator: str, num_hosts: int, host: int) -> None:
    """Registers pairs of one model, each turned about another angle."""
    # JAX ends the process where they do not come, and does not say who was missing.
    print(  # noqa: T201
        f"host {host} waits {SECONDS} s at most for {num_hosts} hosts at {coordinator}",
        flush=True,
    )
    jax.distributed.initialize(
        coordinator, num_hosts, host, initialization_timeout=SECONDS
    )
    mesh = jax.make_mesh((jax.device_count(),), ("pair",))
    points = horse_like_points(512).astype(np.float32)
    target = np.tile(points - points.mean(axis=0), (PAIRS, 1, 1))
    angles = np.linspace(0.02, 0.1, PAIRS, dtype=np.float32)
    source = np.stack([x @ turn(a) for x, a in zip(target, angles, strict=True)])
    found = jr.register(source, target, jr.ICP(), mesh=mesh)
    for part in found.T_target_source.addressable_shards:
        for pair, T in zip(
            range(*part.index[0].indices(PAIRS)), part.data, strict=True
        ):
            print(f"host {host}, pair {pair}: {np.arctan2(T[1, 0], T[0, 0]):.3f} rad")  # noqa: T201


def turn(angle: float) -> np.ndarray:
    """The rotation that takes a turned source back, about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
