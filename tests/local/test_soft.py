"""Soft matches: answers that change smoothly, and gradients that say how."""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import pose_error, switched_on

import jaxreg as jr
from jaxreg.testing import problems


EYE = np.array([0.3, -3.0, 0.5])  # where the sensor stands
T_TRUE = problems.motion(3, 0.15, 0.05, 1)
#: Changes of both clouds: by range bias, radial distortion, scale of an axis, and of
#: single points of the target.
CHANGES = 4
METHODS = {
    "closest": jr.ICP(tolerance=1e-9, max_steps=300),
    "soft": jr.ICP(tolerance=1e-9, max_steps=300, soft=jr.SoftMatches()),
}


@pytest.fixture(autouse=True, scope="module")
def _in_double_precision() -> Iterator[None]:
    with switched_on("jax_enable_x64"):
        yield


def changed(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two clouds of 300 points, a third of the spacing off their surface."""
    rng = np.random.default_rng(1)
    source = problems.surface(300, 3, 1)
    target = source + 0.05 * rng.standard_normal(source.shape)
    target = problems.move(T_TRUE, target)

    def seen(points: jax.Array) -> jax.Array:
        ray = points - EYE
        length = jnp.linalg.norm(ray, axis=1, keepdims=True)
        points = EYE + ray * (1 + x[0] / length + x[1] * length)
        return points * jnp.asarray([1, 1 + x[2], 1])

    moved = jnp.asarray(target) + x[3] * rng.standard_normal(target.shape)
    return seen(jnp.asarray(source)), seen(jnp.asarray(moved))


@eqx.filter_jit
def followed(x: np.ndarray, method: jr.ICP) -> tuple[jax.Array, jax.Array]:
    """The answer, and its slopes by each change `(4, 4, CHANGES)`: one program."""

    def answer(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        T = jr.register(*changed(x), method).T_target_source
        return T, T

    slopes, T = jax.jacfwd(answer, has_aux=True)(jnp.asarray(x))
    return T, slopes


def answer(x: np.ndarray, method: jr.ICP) -> np.ndarray:
    return np.asarray(followed(x, method)[0])


@pytest.fixture(scope="module")
def slopes() -> dict[str, np.ndarray]:
    """Of the answer at no change, by each."""
    zero = np.zeros(CHANGES)
    return {name: np.asarray(followed(zero, of)[1]) for name, of in METHODS.items()}


def off(slopes: np.ndarray, method: jr.ICP, step: float) -> np.ndarray:
    """Of each change, how far differences are from what slopes say, as a share."""
    shares = []
    for k, one in enumerate(np.eye(CHANGES)):
        there, back = (answer(s * step * one, method) for s in (1, -1))
        found = np.asarray(there - back) / (2 * step)
        miss = np.linalg.norm(found - slopes[..., k])
        shares.append(miss / np.linalg.norm(found))
    return np.array(shares)


@pytest.mark.parametrize("step", [1e-3, 3e-3])
def test_slopes_predict_changes_that_exchange_the_closest_points(slopes, step):
    assert np.all(off(slopes["soft"], METHODS["soft"], step) < 0.1)


def test_slopes_are_those_of_small_differences(slopes):
    assert np.all(off(slopes["soft"], METHODS["soft"], 1e-6) < 1e-4)


def test_those_of_the_closest_points_predict_small_differences_only(slopes):
    assert np.all(off(slopes["closest"], METHODS["closest"], 1e-7) < 1e-4)
    assert np.all(off(slopes["closest"], METHODS["closest"], 1e-3) > 0.5)


def test_soft_matches_find_the_pose_as_well():
    errors = {}
    for name, method in METHODS.items():
        T = answer(np.zeros(CHANGES), method)
        errors[name], _ = pose_error(T, T_TRUE)
    assert errors["soft"] < 1.2 * errors["closest"] + 1e-3


def test_settings_are_followed():
    @jax.jit
    @jax.value_and_grad
    def turned(softness: jax.Array) -> jax.Array:
        method = jr.ICP(soft=jr.SoftMatches(softness=softness), tolerance=1e-9)
        clouds = changed(jnp.zeros(CHANGES))
        return jr.register(*clouds, method).T_target_source[0, 1]

    slope = turned(0.5)[1]
    there, back = turned(0.5 + 1e-5)[0], turned(0.5 - 1e-5)[0]
    np.testing.assert_allclose(slope, (there - back) / 2e-5, rtol=1e-3)


@jax.jit
def blended(
    points: jax.Array, moved: jax.Array, row: jax.Array, width: jax.Array
) -> jax.Array:
    """Means of points alone."""
    around = jr.SoftMatches().among(points, jnp.ones(len(points), bool))
    target = jnp.concatenate([points.T, jnp.zeros_like(points.T)])
    return around.blended(target, moved.T, row, jnp.asarray(width))[:3].T


@pytest.mark.parametrize("width", [0.3, np.inf])
@pytest.mark.parametrize("height", [0.0, 0.1])
def test_means_do_not_jump_where_the_closest_point_changes(width, height):
    points = problems.surface(400, 3, 0)
    # From one sample along the surface to its 30th neighbour, or beside it.
    end = points[np.argsort(np.sum((points - points[0]) ** 2, axis=1))[30]]
    way = points[0] + np.linspace(0, 1, 4001)[:, None] * (end - points[0])
    way = way + height * points[0] / np.linalg.norm(points[0])
    row = np.argmin(np.sum((way[:, None] - points) ** 2, axis=-1), axis=1)
    assert len(np.unique(row)) > 3
    means = blended(points, way, row.astype(np.int32), width)
    steps = np.linalg.norm(np.diff(means, axis=0), axis=1)
    assert steps.max() < 5 * np.median(steps)


def test_few_points_and_points_that_coincide_leave_numbers():
    points = np.repeat(problems.surface(3, 3, 0), 4, axis=0)

    @jax.jit
    @jax.value_and_grad
    def total(moved: jax.Array) -> jax.Array:
        around = jr.SoftMatches().among(jnp.asarray(points), jnp.arange(12) < 11)
        target = jnp.concatenate([points.T, points.T])
        blended = around.blended(target, moved, jnp.arange(11), jnp.asarray(0.2))
        return jnp.sum(blended)

    value, slope = total(points[:11].T)
    assert np.isfinite(value)
    assert np.all(np.isfinite(slope))


@pytest.mark.parametrize("wrong", [{"num": 1}, {"softness": 0.0}, {"softness": -1.0}])
def test_what_no_mean_is_taken_by_is_refused(wrong):
    with pytest.raises(ValueError, match="SoftMatches"):
        jr.SoftMatches(**wrong)
    with pytest.raises(TypeError, match="soft"):
        jr.ICP(soft=8)  # pyright: ignore[reportArgumentType]
