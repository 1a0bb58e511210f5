"""Gradients of ICP by points, sensors and settings, beside central differences."""

from collections.abc import Iterator
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import switched_on
from jax import lax

import jaxreg as jr
from jaxreg import robust
from jaxreg.matching.residuals import AbstractResidual
from jaxreg.robust import AbstractKernel
from jaxreg.testing import problems


N = 48
STEP = 1e-6
EYE = np.array([0.3, -3.0, 0.5])  # where the sensor stands
RESIDUALS = [
    jr.PointToPoint(),
    jr.PointToPlane(0.05),
    jr.PlaneToPlane(0.01),
    jr.Symmetric(),
]
KERNELS = [
    robust.L2(),
    robust.L1(),
    robust.Huber(),
    robust.Cauchy(),
    robust.GemanMcClure(),
    robust.Tukey(),
    robust.Welsch(),
    robust.Trimmed(0.8),
]
STEPS = [jr.GaussNewton(), jr.LevenbergMarquardt(), jr.GradientDescent()]
#: Residual, kernel and step: every residual with every kernel, and the other steps.
CASES = [(r, k, 0) for r in range(len(RESIDUALS)) for k in range(len(KERNELS))]
OTHER_STEPS = [(1, 3, 1), (0, 3, 2), (0, 3, 3)]


@pytest.fixture(autouse=True, scope="module")
def _quickly_compiled() -> Iterator[None]:
    """In double precision; these programs run once."""
    with switched_on("jax_enable_x64", "jax_disable_most_optimizations"):
        yield


def _switched(parts: list[Any], at: Any, call: Any) -> Any:
    """What `call` makes of the part of that number, so that one program has all."""
    return lax.switch(at, [lambda _, part=part: call(part) for part in parts], 0)


class _AnyResidual(AbstractResidual):
    """The residual of a number, with its setting larger by a share."""

    uses_normals: ClassVar[bool] = True
    at: Any
    more: Any

    def _of(self, call: Any) -> Any:
        one, two, three, four = RESIDUALS
        share = (two.point_share * (1 + self.more)).astype(float)
        epsilon = (three.epsilon * (1 + self.more)).astype(float)
        parts = [one, jr.PointToPlane(share), jr.PlaneToPlane(epsilon), four]
        return _switched(parts, self.at, call)

    def normal_equations(self, match, weight):
        return self._of(lambda part: part.normal_equations(match, weight))

    def descents(self, match):
        return self._of(lambda part: part.descents(match))

    def energy(self, match, weight):
        return self._of(lambda part: part.energy(match, weight))


class _AnyKernel(AbstractKernel):
    """The kernel of a number."""

    at: Any

    def rho(self, sq_residual, width):
        return _switched(KERNELS, self.at, lambda part: part.rho(sq_residual, width))

    def weight(self, sq_residual, width):
        return _switched(KERNELS, self.at, lambda part: part.weight(sq_residual, width))

    def width_of(self, sq_residual, mask):
        return _switched(
            KERNELS, self.at, lambda part: part.width_of(sq_residual, mask)
        )


class _AnyStep(jr.AbstractStep):
    """The step of a number; the last is in closed form, of points."""

    at: Any

    def __call__(self, T, match, weight, residual):
        def closed(T, match, weight, residual):
            return jr.ClosedForm()(T, match, weight, jr.PointToPoint())

        return _switched(
            [*STEPS, closed], self.at, lambda part: part(T, match, weight, residual)
        )


def _clouds(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Two noisy samples, near enough for matches that a little change leaves."""
    rng = np.random.default_rng(seed)
    source = problems.surface(N, 3, seed)
    noise = 0.03 * rng.standard_normal(source.shape)
    return source, problems.move(problems.motion(3, 0.1, 0.1, seed), source + noise)


#: Arguments of `_sensed` and `_answer`.
CHANGES = [
    "a source point",
    "a target point",
    "range bias",
    "radial distortion",
    "scale of an axis",
    "scale",
    "width_end",
    "setting of the residual",
]


def _sensed(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Both clouds, seen by a sensor with errors."""
    source, target = map(jnp.asarray, _clouds())
    source = source.at[5].add(x[0] * jnp.array([0.5, -0.3, 0.8]))
    target = target.at[7].add(x[1] * jnp.array([-0.2, 0.9, 0.4]))

    def seen(points: jax.Array) -> jax.Array:
        ray = points - EYE
        length = jnp.linalg.norm(ray, axis=1, keepdims=True)
        points = EYE + ray * (1 + x[2] / length + x[3] * length)
        return points * jnp.array([1.0, 1.0 + x[4], 1.0]) * (1 + x[5])

    return seen(source), seen(target)


def _method(case: jax.Array, x: jax.Array, **settings: Any) -> jr.ICP:
    return jr.ICP(
        _AnyResidual(case[0], x[7]),
        _AnyKernel(case[1]),
        _AnyStep(case[2]),
        width_end=1.0 + x[6],
        tolerance=1e-14,
        max_steps=600,
        **settings,
    )


def _answer(x: jax.Array, method: jr.ICP) -> tuple[jax.Array, jax.Array]:
    sol = jr.register(*_sensed(x), method)
    T = sol.T_target_source
    return jnp.sum(jnp.cos(jnp.arange(16.0)).reshape(4, 4) * T), sol.status


def _derivatives(of: Any, x: jax.Array, along: jax.Array) -> Any:
    """Value, status and gradient; then along a direction: both by forward mode."""
    run = jax.value_and_grad(of, has_aux=True)
    return jax.jvp(lambda x: run(x), (x,), (along,))


def _lanes(along: np.ndarray) -> np.ndarray:
    """Zero, and to both sides of it along every argument and along a direction."""
    sides = np.concatenate([np.eye(len(along)), along[None]])
    return STEP * np.concatenate([0 * sides[:1], sides, -sides])


def test_pose_follows_points_sensors_and_settings_by_any_parts():
    """Every residual with every kernel, and every step; both modes; second order.

    One program, as compiling is what this costs.
    """
    along = np.random.default_rng(1).uniform(0.5, 1, len(CHANGES))
    lanes = jnp.asarray(_lanes(along))

    def run(case):
        def of(x):
            return _answer(x, _method(case, x))

        one = jax.vmap(lambda x: _derivatives(of, x, jnp.asarray(along)))
        return one(lanes)

    cases = [*CASES, *OTHER_STEPS]
    found = jax.device_get(jax.jit(lambda at: lax.map(run, at))(jnp.asarray(cases)))
    same = [cases.index((residual, kernel, 0)) for residual, kernel, _ in OTHER_STEPS]
    slopes, num = found[0][1][:, 0], len(CASES)
    # Steps end where the pulls balance, so those of Gauss-Newton have the same slopes.
    np.testing.assert_allclose(slopes[num:], slopes[same], rtol=1e-4, atol=1e-6)
    found = jax.tree.map(lambda x: x[:num], found)
    ((value, status), slope), ((forward, _), second) = found
    np.testing.assert_array_equal(status, jr.Status.CONVERGED)
    num = len(CHANGES) + 1
    numeric = (value[:, 1 : num + 1] - value[:, num + 1 :]) / (2 * STEP)
    size = np.abs(numeric).max(axis=1, keepdims=True)
    # Points, sensors and the common scale move every answer.
    assert np.all(np.abs(numeric[:, :6]) > 1e-4)
    np.testing.assert_array_less(np.abs(slope[:, 0] - numeric[:, :-1]) / size, 1e-4)
    np.testing.assert_allclose(forward[:, 0], slope[:, 0] @ along, rtol=1e-9, atol=1e-9)
    numeric = (slope[:, num] - slope[:, -1]) / (2 * STEP)
    size = np.abs(numeric).max(axis=1, keepdims=True)
    np.testing.assert_array_less(np.abs(second[:, 0] - numeric) / size, 1e-3)
