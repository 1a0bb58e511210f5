"""What methods are made of is checked when they are made, and named when wrong."""

import dataclasses
import inspect
import re
from collections.abc import Iterator
from typing import get_args, get_type_hints

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from protocols import AVERAGERS, REGISTRARS

import jaxreg as jr
from jaxreg.particle import (
    AbsoluteEnergy,
    BoundedEnergy,
    GaussianPrior,
    StochasticDynamics,
    Systematic,
)
from jaxreg.robust import Huber, Trimmed


@pytest.fixture(autouse=True)
def _as_users_run_it() -> Iterator[None]:
    """Without the run-time check of types that the other tests are under."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


METHODS = {
    type(row.make(2)): None for row in (*REGISTRARS.values(), *AVERAGERS.values())
}


def _contract(kind: type, field: str) -> type | None:
    """The abstract class that a field of a method wants, if it wants one."""
    hint = get_type_hints(kind)[field]
    kinds = [x for x in get_args(hint) or (hint,) if inspect.isclass(x)]
    return next((x for x in kinds if issubclass(x, eqx.Module)), None)


PARTS = [
    (kind, field.name, contract)
    for kind in METHODS
    for field in dataclasses.fields(kind)
    if (contract := _contract(kind, field.name)) is not None
]


def test_every_kind_of_part_is_met():
    wanted = {contract.__name__ for _, _, contract in PARTS}
    parts = "Kernel Residual Step Prior Dynamics Resampler Energy Adjoint Averager Rows"
    ours = {f"Abstract{name}" for name in [*parts.split(), "EdgeError"]}
    assert wanted == {*ours, "Solver", "LinearSolver", "SoftMatches"}


@pytest.mark.parametrize(("kind", "field", "contract"), PARTS)
def test_a_class_and_a_foreign_part_are_refused(kind, field, contract):
    name, wanted = f"{kind.__name__}: {field}: ", re.escape(contract.described)
    named = re.findall(r"(\w+)\(\)", contract.described)
    example = getattr(jr, named[0], None) if named else None
    if example is not None:
        words = f"^{name}wanted {wanted}.*found the class {example.__name__}; add ()"
        with pytest.raises(TypeError, match=words.replace("()", r"\(\)")):
            kind(**{field: example})
    with pytest.raises(TypeError, match=f"^{name}wanted {wanted}.* found 'l2'"):
        kind(**{field: "l2"})
    foreign = jr.PointToPoint() if field != "residual" else Huber()
    with pytest.raises(TypeError, match=f"^{name}wanted {wanted}.* found an object of"):
        kind(**{field: foreign})


COUNTS = [
    (kind, field.name)
    for kind in METHODS
    for field in dataclasses.fields(kind)
    if field.type in (int, "int")
]


@pytest.mark.parametrize(("kind", "field"), COUNTS)
def test_counts_are_integers_and_leave_something_to_do(kind, field):
    with pytest.raises(ValueError, match=rf"{field}: wanted .*at least"):
        kind(**{field: -1})
    with pytest.raises(TypeError, match=rf"{field}: wanted an integer.*2\.5"):
        kind(**{field: 2.5})


OF_ANY_SIGN = ("min_log_evidence",)
NUMBERS = [
    (kind, field.name)
    for kind in METHODS
    for field in dataclasses.fields(kind)
    if float in get_args(get_type_hints(kind)[field.name])
    and field.name not in OF_ANY_SIGN
]
OF_PARTS = [
    (AbsoluteEnergy, "epsilon"),
    (BoundedEnergy, "slide"),
    (BoundedEnergy, "narrow"),
    (GaussianPrior, "rotation_spread"),
    (StochasticDynamics, "scale"),
    (Systematic, "threshold"),
    (Trimmed, "share"),
    (jr.GaussNewton, "damping"),
    (jr.LevenbergMarquardt, "damping"),
    (jr.PlaneToPlane, "epsilon"),
    (jr.PointToPlane, "point_share"),
]


@pytest.mark.parametrize(("kind", "field"), NUMBERS + OF_PARTS)
def test_numbers_that_make_no_sense_are_refused(kind, field):
    name = f"^{kind.__name__}: {field}: wanted a"
    for value in (-1.0, float("nan")):
        with pytest.raises(ValueError, match=f"{name}.*{value}"):
            kind(**{field: value})
    with pytest.raises(TypeError, match=f"{name}.*'1'"):
        kind(**{field: "1"})


@pytest.mark.parametrize("kind", [jr.ParticleFilter, jr.MultiStart])
def test_a_logarithm_may_have_any_sign(kind):
    assert kind(min_log_evidence=-1.0).min_log_evidence == -1
    with pytest.raises(ValueError, match="min_log_evidence: wanted a number, found"):
        kind(min_log_evidence=float("nan"))
    with pytest.raises(TypeError, match="min_log_evidence: wanted a number, found '1'"):
        kind(min_log_evidence="1")


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        (jr.MCC, "alpha"),
        (jr.PoseGraphLM, "kernel_width"),
        (jr.LowRankSparse, "threshold"),
        (jr.ICP, "width_end"),
        (jr.ICP, "max_correspondence_distance"),
        (jr.KernelCorrelation, "bandwidth"),
        (jr.MultiStart, "width_start"),
        (jr.ParticleFilter, "width_end"),
    ],
)
def test_widths_are_not_zero(kind, field):
    with pytest.raises(ValueError, match=f"{field}: wanted a positive number"):
        kind(**{field: 0.0})


def test_numbers_may_be_traced_and_have_batch_axes():
    widths = jnp.array([0.5, 1.0])
    alone = jax.vmap(lambda w: jr.ICP(width_end=w).width_end)(widths)
    np.testing.assert_array_equal(alone, jr.ICP(width_end=widths).width_end)
    with pytest.raises(ValueError, match=r"width_end.*\[0.5, -1.0\]"):
        jr.ICP(width_end=jnp.array([0.5, -1.0]))


def test_an_index_is_a_class():
    assert jr.ICP(index=jr.BoxTree).index is jr.BoxTree
    with pytest.raises(TypeError, match="index: wanted the class of an index"):
        jr.ICP(index="box tree")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="ParticleFilter: index: wanted the class of"):
        jr.ParticleFilter(index=jr.ParticleFilter)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="IndexOptions: kind: wanted the class"):
        jr.neighbours.IndexOptions("box tree")  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="method: wanted a registration method"):
        jr.reconstruct(
            np.zeros((2, 5, 2), np.float32),
            key=jax.random.key(0),
            method=jr.MotionAveraging(),  # pyright: ignore[reportArgumentType]
        )


def test_methods_and_keys_are_checked_when_called():
    points, motion = np.eye(3, dtype=np.float32), np.eye(4, dtype=np.float32)
    graph = jr.PoseGraph.from_edges([(0, 1)], motion[None])
    calls = {
        "a registration method such as ICP()": lambda m, k: jr.register(
            points, points, m, key=k
        ),
        "an averaging method such as Correntropy()": lambda m, k: jr.average(
            graph, m, key=k
        ),
    }
    for (wanted, call), method in zip(calls.items(), [jr.ICP, jr.MCC], strict=True):
        words = re.escape(f"method: wanted {wanted}, found the class {method.__name__}")
        with pytest.raises(TypeError, match=words):
            call(method, None)
        with pytest.raises(TypeError, match=re.escape(f"wanted {wanted}, found 'icp'")):
            call("icp", None)
        with pytest.raises(TypeError, match=r"key: wanted jax.random.key.*found int"):
            call(method(), 0)
    with pytest.raises(TypeError, match="key: wanted"):
        jr.reconstruct([points, points], key=0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"averaging: wanted .*found the class MCC"):
        jr.reconstruct([points] * 2, key=jax.random.key(0), averaging=jr.MCC)  # pyright: ignore[reportArgumentType]
