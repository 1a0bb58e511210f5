"""What is believed of scans in the plane."""

import jax
import numpy as np
import pytest

from bench.studies.flat_pairs import Pair, strangers
from bench.studies.flat_scenes import Floor, Lidar
from jaxreg import Status, reconstruct, register


@pytest.fixture(scope="module")
def room() -> tuple[list[np.ndarray], np.ndarray]:
    """What a lidar sees of one floor from five places, three of them in a room."""
    rng = np.random.default_rng(5)
    floor = Floor.drawn(rng)
    T = floor.poses(100, rng)[[0, 1, 2, 50, 99]]
    return [Lidar().scan(floor.walls, x, rng) for x in T], T


def _answers(pairs: list[Pair]) -> list[bool]:
    """Whether each is believed."""
    sources, targets = [x.source for x in pairs], [x.target for x in pairs]
    found = register(sources, targets, key=jax.random.key(0))
    return [int(x.status) == Status.CONVERGED for x in found]


def test_rooms_of_different_floors_are_not_taken_for_one():
    # Walls lie on walls of any other room, at right angles.
    assert not any(_answers(list(strangers(12))))


def test_scans_of_one_room_are_joined_and_those_of_others_left_apart(room):
    scans, T = room
    found = reconstruct(scans, key=jax.random.key(0), viewpoints=np.zeros((5, 2)))
    component = np.asarray(found.component)
    assert component[:3].tolist() == [0, 0, 0]
    assert 0 not in component[3:]
    T_0_i = np.linalg.inv(T[0]) @ T[:3]
    np.testing.assert_allclose(found.T_world_i[:3], T_0_i, atol=0.03)
