"""Sets of scans on disk."""

from pathlib import Path

import jax
import numpy as np
import pytest

import jaxreg as jr
from jaxreg import io
from jaxreg.io.scan_sets import _MARK


FAR = np.array([4e5, 5e6, 100.0])


@pytest.fixture(scope="module")
def ready() -> jr.ScanSet:
    """Of two scans in map coordinates."""
    rng = np.random.default_rng(0)
    return jr.ScanSet.of(list(rng.normal(size=(2, 60, 3)) + FAR), method=jr.ICP())


@pytest.fixture
def path(ready: jr.ScanSet, tmp_path: Path) -> Path:
    """Where it lies."""
    io.write_scan_set(tmp_path / "map.scans", ready)
    return tmp_path / "map.scans"


def test_a_set_is_read_as_it_was_written(ready, path):
    found = io.read_scan_set(path)
    assert repr(found) == repr(ready)
    assert jax.tree.structure(found) == jax.tree.structure(ready)
    for mine, other in zip(jax.tree.leaves(found), jax.tree.leaves(ready), strict=True):
        assert np.asarray(mine).dtype == np.asarray(other).dtype
        np.testing.assert_array_equal(mine, other)
    # What was subtracted is longer than float32.
    assert found.origin is not None
    np.testing.assert_array_equal(found.origin, ready.origin)
    assert found.origin.dtype == np.float64


def test_scans_join_what_was_read(path):
    rng = np.random.default_rng(1)
    more = io.read_scan_set(path).joined([rng.normal(size=(50, 3))])
    assert len(more) == 3
    io.write_scan_set(path, more)  # over the file that its arrays lie in
    again = io.read_scan_set(path)
    assert len(again) == 3
    np.testing.assert_array_equal(more.scans.mean, again.scans.mean)


def test_a_set_that_cannot_be_written_leaves_the_old_one(ready, path, monkeypatch):
    old = path.read_bytes()

    def fails(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxreg.io.scan_sets.write_tree", fails)
    with pytest.raises(KeyboardInterrupt):
        io.write_scan_set(path, ready)
    assert path.read_bytes() == old
    assert [x.name for x in path.parent.iterdir()] == [path.name]


def test_a_set_of_another_version_is_refused(path):
    whole = path.read_bytes()
    path.write_bytes(whole.replace(jr.__version__.encode(), b"0.0.9", 1))
    with pytest.raises(io.InputError, match=r"is of jaxreg 0\.0\.9, this is"):
        io.read_scan_set(path)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.5, 0.999])
def test_a_file_that_ends_too_early_is_refused(path, share):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(io.InputError, match="damaged|is no file of"):
        io.read_scan_set(path)


def test_what_is_no_set_is_refused(tmp_path):
    path = tmp_path / "x"
    with pytest.raises(io.InputError, match="cannot be read"):
        io.read_scan_set(path)
    path.write_text("ply\n")
    with pytest.raises(io.InputError, match="is no file of jaxreg.io.write_scan_set"):
        io.read_scan_set(path)
    path.write_bytes(_MARK + f"{jr.__version__}\n".encode() + b"garbage" * 9)
    with pytest.raises(io.InputError, match="is damaged"):
        io.read_scan_set(path)
