"""Pairs of other people's sensors without a guess: found, and believed."""

from collections.abc import Iterator
from functools import partial

from bench.case import Case, Method, Options
from bench.peers.global_pairs import Features, Kiss, Peer
from bench.workloads.global_scans import BELIEVED
from bench.workloads.local_pairs import written_out
from bench.workloads.sensor_data import (
    Answer,
    SensorPair,
    by_register,
    judge,
    sensor_pairs,
)
from jaxreg import ParticleFilter


PEER = "RANSAC"


def cases(options: Options) -> Iterator[Case]:
    """A case per pair."""
    for pair in sensor_pairs(options.data):
        method = ParticleFilter()
        own = partial(by_register, method, pair, None)
        camera = pair.camera_at_origin
        peers: dict[str, tuple[str, Peer]] = {
            "KISS-Matcher": ("kiss-matcher", Kiss(pair.voxel)),
            "FGR": ("open3d", Features("FGR", pair.voxel, camera_at_origin=camera)),
            PEER: ("open3d", Features("RANSAC", pair.voxel, camera_at_origin=camera)),
        }
        yield Case(
            name=pair.name,
            data=f"{pair.kind}, {len(pair.source)} on {len(pair.target)} points",
            methods=[
                Method("jaxreg", "jaxreg", written_out(method), own),
                *(
                    Method(name, library, f"{peer}", partial(by_peer, peer, pair))
                    for name, (library, peer) in peers.items()
                ),
            ],
            trials=[(seed,) for seed in range(3)],
            judge=partial(judge, pair),
            long=True,
            reference=PEER,
        )


def by_peer(peer: Peer, pair: SensorPair, seed: int) -> Answer:
    """From raw points to a pose, as `register`."""
    source, target = (peer.prepare(points) for points in (pair.source, pair.target))
    T, score = peer.solve(source, target, seed)
    return Answer(T, score > BELIEVED)
