"""Trees of arrays in a file: the same when read, and not copied."""

import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jaxreg.multiview.mapped_file import read_tree, write_tree


TREE = {
    "points": np.arange(3_000, dtype=np.float32).reshape(500, 6)[:, ::2],
    "mask": np.arange(7) % 2 == 0,
    "none": np.zeros((0, 3), np.int32),
    "radius": np.asarray(0.25, np.float32),
    "keys": np.arange(5, dtype=np.uint32),
    "absent": None,
}


def _there_and_back(path: Path, tree: Any) -> Any:
    with path.open("wb") as file:
        write_tree(file, tree)
    with path.open("rb") as file:
        return read_tree(file)


def test_a_tree_is_read_as_it_was_written(tmp_path: Path):
    found = _there_and_back(tmp_path / "tree", TREE)
    assert jax.tree.structure(found) == jax.tree.structure(TREE)
    for before, after in zip(
        jax.tree.leaves(TREE), jax.tree.leaves(found), strict=True
    ):
        assert after.dtype == before.dtype
        np.testing.assert_array_equal(after, before)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="no list of maps")
def test_arrays_lie_in_the_file_and_outlive_its_name(tmp_path: Path):
    path, points = tmp_path / "tree", np.arange(30_000, dtype=np.float32)
    _, found = jax.device_put(_there_and_back(path, (np.arange(3), points)))
    lines = Path("/proc/self/maps").read_text().splitlines()
    spans = [line.split()[0].split("-") for line in lines if line.endswith(str(path))]
    at = found.unsafe_buffer_pointer()
    assert any(int(low, 16) <= at < int(high, 16) for low, high in spans)
    os.remove(path)
    np.testing.assert_array_equal(found, points)
