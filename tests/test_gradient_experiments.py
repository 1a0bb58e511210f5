"""The notebook on gradients, at the small sizes that it names: what it learns."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest


NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "05_gradients.ipynb"


@pytest.fixture(scope="module")
def names() -> Iterator[dict[str, Any]]:
    """What its cells leave behind."""
    import matplotlib.pyplot as plt

    document = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    found: dict[str, Any] = {}
    for cell in document["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "code" and "plt.show()" not in source:
            exec(compile(source, NOTEBOOK.name, "exec"), found)
        if "parameters" in cell["metadata"].get("tags", []):
            exec(document["metadata"]["jaxreg_quick"], found)
    yield found
    plt.close("all")


def test_learned_weights_and_width_bring_held_out_poses_nearer(names):
    before, after = names["learned"][[0, -1], 1]
    assert after < 0.6 * before


def test_mount_and_range_scale_are_found_through_register(names):
    np.testing.assert_allclose(names["tried"][-1], names["TRUE_MOUNT"], atol=5e-3)
    assert np.abs(names["tried"][0] - names["TRUE_MOUNT"]).min() > 0.03


def test_sensitivities_say_what_an_error_does_and_what_a_closure_is_worth(names):
    sensitivity, none, ones = (names[k] for k in ("sensitivity", "none", "ones"))
    closure = 19  # the first after the links of the chain
    error = none.at[closure, 1].set(0.01)
    moved = names["positions"](error, ones) - names["positions"](none, ones)
    told = 0.01 * sensitivity[:, :, closure, 1]
    size = float(jnp.abs(told).max())
    assert size > 1e-3
    np.testing.assert_allclose(moved, told, atol=0.02 * size)
    # To lose any makes positions less certain; the loop's end matters most.
    assert np.all(names["worth"] > 1)
    assert np.argmax(names["worth"]) == 0


def test_filter_settings_fitted_over_trials_do_better_on_others(names):
    assert names["after"] < 0.7 * names["before"]
