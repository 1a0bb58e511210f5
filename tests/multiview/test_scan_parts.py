"""Parts and bodies of scans, against the tables of all pairs of scans."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxreg.multiview.parts import in_main_body, part_numbers, part_sizes


NUM = 12
_SIZES, _MAIN, _NUMBERS = map(jax.jit, (part_sizes, in_main_body, part_numbers))
_LABELS = st.lists(st.integers(0, 4), min_size=NUM, max_size=NUM)


def _lowest(label: np.ndarray) -> np.ndarray:
    """The lowest number of the scans of each label."""
    return np.argmax(label[:, None] == label, axis=1).astype(np.int32)


@settings(max_examples=50, deadline=None)
@given(label=_LABELS)
def test_sizes(label: list[int]):
    part = _lowest(np.array(label))
    np.testing.assert_array_equal(_SIZES(part), [label.count(x) for x in label])


@settings(max_examples=50, deadline=None)
@given(label=_LABELS, finer=_LABELS)
def test_the_main_body_is_the_largest_and_of_equal_ones_the_first(
    label: list[int], finer: list[int]
):
    part = _lowest(np.array(label))
    body = _lowest(5 * np.array(label) + np.array(finer))
    size = np.bincount(body)[body]
    largest = np.argmax(np.where(part[:, None] == part, size, 0), axis=1)
    np.testing.assert_array_equal(_MAIN(body, part), body == body[largest])


@settings(max_examples=50, deadline=None)
@given(label=_LABELS, which=st.integers(-1, NUM - 1))
def test_parts_are_numbered_from_the_largest_and_the_known_world_first(
    label: list[int], which: int
):
    part = _lowest(np.array(label))
    world = -1 if which < 0 else int(part[which])
    sizes = {k: np.sum(part == k) for k in np.unique(part)}
    ranked = sorted(sizes, key=lambda k: (k != world, -sizes[k], k))
    alone = [k for k in ranked[1:] if sizes[k] == 1]
    number = [-1 if k in alone else ranked.index(k) for k in part]
    np.testing.assert_array_equal(_NUMBERS(part, np.int32(world)), number)
