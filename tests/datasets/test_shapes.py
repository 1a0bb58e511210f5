"""Letters, cube, truck and horse: sizes, determinism, truth and lack of symmetry."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxreg.datasets import (
    cube_points,
    horse_like_points,
    letter_offset,
    truck_front,
    truck_points,
    word_points,
)


WORDS = "CVPR ALASKA"


def test_the_letter_alone_lies_on_the_letter_of_the_words():
    for text in (WORDS, "CVPR\nALASKA"):
        words, letter = word_points(text), word_points("S")
        assert words.dtype == np.float64
        assert words.shape[1] == 2
        placed = letter + letter_offset(text, text.index("S"))
        distance, row = KDTree(words).query(placed)
        assert distance.max() < 1e-12
        # The rest of the text keeps clear of it.
        others = np.delete(words, row, axis=0)
        assert len(others) == len(words) - len(letter)
        assert KDTree(others).query(placed)[0].min() > 2
    assert not np.allclose(letter_offset(WORDS, 2), letter_offset(WORDS, 7))


def test_letters_scale_with_their_height_and_fill_with_the_spacing():
    words = word_points(WORDS)
    assert 1000 < len(words) < 2000
    assert words[:, 1].min() == pytest.approx(-1, abs=0.1)
    assert words[:, 1].max() == pytest.approx(21, abs=0.1)
    np.testing.assert_array_equal(words, word_points(WORDS))
    np.testing.assert_allclose(word_points(WORDS, height=1.0), words / 20, atol=1e-12)
    for spacing in (0.5, 1.0, 2.0, 4.0):
        letter = word_points("S", spacing=spacing)
        nearest = KDTree(letter).query(letter, 2)[0][:, 1]
        assert np.median(nearest) == pytest.approx(spacing, rel=0.2)


def test_letters_differ():
    for char in "ACEIKLPRTV":
        distance = KDTree(word_points(char)).query(word_points("S"))[0]
        assert np.mean(distance > 1) > 0.2


@pytest.mark.parametrize(
    ("text", "settings", "message"),
    [
        ("CV?", {}, "letters among"),
        (" ", {}, "at least one letter"),
        ("S", {"spacing": 0.0}, "spacing"),
        ("S", {"spacing": 30.0}, "spacing"),
    ],
)
def test_what_cannot_be_drawn_is_refused(text, settings, message):
    with pytest.raises(ValueError, match=message):
        word_points(text, **settings)


@pytest.mark.parametrize("draw", [cube_points, truck_points, horse_like_points])
def test_solids_have_the_count_asked_for_and_repeat(draw):
    points = draw(301, 4)
    assert points.shape == (301, 3)
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points, draw(301, 4))
    assert not np.allclose(points, draw(301, 5))


def test_cube_lies_on_its_six_faces():
    cube = cube_points(400, side=6.0)
    np.testing.assert_allclose(np.abs(cube).max(axis=1), 3)
    face = np.argmax(np.abs(cube), axis=1)
    for axis in range(3):
        for sign in (-1, 1):
            assert 40 < np.sum((face == axis) & (cube[:, axis] == 3 * sign)) < 95


def test_truck_has_its_size_and_a_front():
    truck = truck_points(4000)
    np.testing.assert_allclose(np.ptp(truck, axis=0), [8.2, 2.9, 3.6], atol=0.15)
    assert truck[:, 2].min() == pytest.approx(0, abs=0.02)
    front = truck[truck_front(truck)]
    assert 0.2 < len(front) / len(truck) < 0.4
    assert front[:, 2].max() < 2.6
    # Wheels stand on the ground in both parts.
    assert front[:, 2].min() < 0.05
    assert truck[~truck_front(truck)][:, 2].min() < 0.05
    # Nothing lies within the cargo box.
    inside = np.all(np.abs(truck - [-1.57, 0, 2.1]) < [2.5, 1.1, 1.1], axis=1)
    assert not inside.any()


def test_horse_has_the_extent_of_the_paper():
    horse = horse_like_points(5000)
    np.testing.assert_allclose(horse.min(axis=0), [-36, -67, -75], atol=1)
    np.testing.assert_allclose(horse.max(axis=0), [33, 74, 82], atol=1)


def _misfit(points: np.ndarray) -> np.ndarray:
    """Mean distance to itself after rotations over SO(3) by more than 0.5 rad."""
    cloud = points - points.mean(axis=0)
    tree = KDTree(cloud)
    turns = Rotation.random(600, rng=np.random.default_rng(0))
    turns = [r.as_matrix() for r in turns if r.magnitude() > 0.5]
    half_turns = [np.diag(s) for s in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    return np.array([tree.query(cloud @ R.T)[0].mean() for R in turns + half_turns])


def test_no_rotation_maps_horse_or_truck_on_itself():
    for points, size in ((horse_like_points(800), 157.0), (truck_points(800), 8.2)):
        nearest = KDTree(points).query(points, 2)[0][:, 1].mean()
        assert _misfit(points).min() > max(0.02 * size, 1.4 * nearest)


def test_no_mirror_maps_the_horse_on_itself():
    horse = horse_like_points(2000)
    distance = KDTree(horse).query(horse * [-1, 1, 1])[0]
    assert np.mean(distance) > 4
    assert np.mean(distance > 8) > 0.15


def test_no_points_are_refused():
    with pytest.raises(ValueError, match="num"):
        truck_points(0)
