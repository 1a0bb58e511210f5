"""Generators and paths that several tests share."""

import os
from pathlib import Path

import pytest


def data_dir(*parts: str) -> Path:
    """A folder or file of the real data; skips the test where it is absent."""
    root = Path(
        os.environ.get(
            "JAXREG_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"
        )
    )
    path = root.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"real data not found: {'/'.join(parts)} (set JAXREG_DATA)")
    return path
