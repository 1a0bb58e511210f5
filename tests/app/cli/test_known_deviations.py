"""What the terminal makes of edges that tell no deviations."""

import numpy as np
import pytest

import jaxreg
from jaxreg.app.cli.known import with_shown_noise


def ring(chords: int, information: float | None) -> jaxreg.PoseGraph:
    """Thirteen poses at one place, in a ring with chords: a loop more than these."""
    edges = [(k, (k + 1) % 13) for k in range(13)] + [(0, k + 2) for k in range(chords)]
    T = np.broadcast_to(np.eye(4), (len(edges), 4, 4))
    told = np.broadcast_to(np.eye(6), (len(edges), 6, 6))
    if information is None:
        return jaxreg.PoseGraph.from_edges(np.array(edges), T)
    return jaxreg.PoseGraph.from_edges(
        np.array(edges), T, information=information * told
    )


def test_the_identity_is_no_deviation_where_loops_show_one():
    graph, note = with_shown_noise(ring(chords=9, information=1.0))
    assert graph.information is None
    assert "what their loops show" in note


@pytest.mark.parametrize(
    ("chords", "information", "told"),
    [(8, 1.0, "bend to whatever is known"), (9, 2.0, ""), (9, None, "")],
)
def test_what_is_told_or_not_shown_stays(
    chords: int, information: float | None, told: str
):
    given = ring(chords, information)
    graph, note = with_shown_noise(given)
    assert graph is given
    assert told in note
    assert bool(told) == bool(note)
