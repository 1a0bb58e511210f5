"""What Python tells: reprs of batches, words on other libraries' objects, the log."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg as jr
from jaxreg._core.status import counted


GRAPH = jr.PoseGraph.from_edges([(0, 1), (1, 2)], np.tile(np.eye(3), (2, 1, 1)))


def test_batches_tell_how_many_have_each_status():
    assert counted([0, 5, 0, 0]) == "CONVERGED 3, LOW_OVERLAP 1"
    one = jr.average(GRAPH, jr.SpanningTree())
    many = jax.tree.map(lambda x: jnp.stack([x, x]), one)
    assert repr(many) == "AveragingSolution(batch=(2,), CONVERGED 2)"
    seen = []
    jax.vmap(lambda sol: (seen.append(repr(sol)), sol.status)[1])(many)
    assert "batch" not in seen[0]  # traced: nothing is known


def test_a_status_prints_its_name():
    assert f"{jr.Status(0)}" == "CONVERGED"


class _OnDevice:
    """As a tensor that NumPy cannot read behaves."""

    def __dlpack__(self, **_: object) -> object:
        raise BufferError("it requires grad")

    def __dlpack_device__(self) -> tuple[int, int]:
        return 1, 0


def test_a_tensor_that_cannot_be_read_says_what_to_call():
    with pytest.raises(ValueError, match=r"requires grad.*source\.detach\(\)\.cpu\(\)"):
        jr.register(_OnDevice(), np.eye(3), jr.ICP())


def test_points_in_columns_are_hinted_at():
    with pytest.raises(ValueError, match=r"found \(3, 40\)\. .*try source\.T"):
        jr.register(np.zeros((3, 40)), np.eye(3), jr.ICP())


def test_the_log_is_quiet_unless_it_is_asked(
    caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
):
    jr.average(GRAPH, jr.SpanningTree())
    jr.average([GRAPH], jr.SpanningTree())
    assert caplog.records == []
    assert capsys.readouterr() == ("", "")
    with caplog.at_level(logging.INFO, logger="jaxreg"):
        jr.average(GRAPH, jr.SpanningTree())
        jr.average([GRAPH, GRAPH], jr.SpanningTree())
        jax.jit(lambda g: jr.average(g, jr.SpanningTree()).status)(GRAPH)
    told = [record.getMessage() for record in caplog.records]
    assert told[0].startswith("average: AveragingSolution(CONVERGED: 3 of 3")
    assert told[-1].endswith("2 of 2")
    assert len(told) == 3
