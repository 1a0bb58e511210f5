"""Each check tells a promise that is broken, in a sentence."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from pairs import Centroids

import jaxreg as jr
from jaxreg import robust
from jaxreg.averaging.base import solution
from jaxreg.local import turn_and_shift
from jaxreg.neighbours import BruteForce
from jaxreg.particle import AbstractHardResampler, UniformPrior
from jaxreg.robust import by_lower_third
from jaxreg.testing import (
    check_averager,
    check_dynamics,
    check_energy,
    check_index,
    check_kernel,
    check_prior,
    check_registrar,
    check_resampler,
    check_residual,
    check_step,
)


class Kernel(jr.AbstractKernel):
    """Least squares, or what `twist` makes of it."""

    twist: str = ""
    number: jax.Array | float = eqx.field(default=1.0, converter=jnp.asarray)

    def rho(self, sq_residual, width):
        if self.twist == "starts at one":
            return 1 + sq_residual / 2
        if self.twist == "falls":
            return -sq_residual / 2
        if self.twist == "not its derivative":
            return sq_residual
        return sq_residual / 2

    def weight(self, sq_residual, width):
        if self.twist == "falls":
            return -jnp.ones_like(sq_residual)
        if self.twist == "not finite":
            return jnp.where(width > 0, 1.0, jnp.nan) * jnp.ones_like(sq_residual)
        if self.twist == "promotes":
            return jnp.ones(sq_residual.shape, float)
        return jnp.ones_like(sq_residual)

    def width_of(self, sq_residual, mask):
        if self.twist == "squared width":
            return by_lower_third(self, sq_residual, mask) ** 2
        if self.twist == "masked width":
            return by_lower_third(self, sq_residual, jnp.ones_like(mask))
        return by_lower_third(self, sq_residual, mask)


@pytest.mark.parametrize(
    ("twist", "sentence"),
    [
        ("starts at one", r"rho\(0\) is 1"),
        ("falls", "rho falls"),
        ("not its derivative", "weight is not the derivative"),
        ("not finite", "a weight is not finite"),
        ("promotes", "data of float32 give float64"),
        ("squared width", "width_of is not a length"),
        ("masked width", "masked residuals change width_of"),
    ],
)
def test_kernels(twist, sentence):
    check_kernel(Kernel())
    with pytest.raises(AssertionError, match=f"Kernel.*{sentence}"):
        check_kernel(Kernel(twist))


def test_a_python_float_would_compile_again():
    class Fixed(jr.AbstractKernel):
        number: float = 1.0
        rho = robust.L2.rho
        weight = robust.L2.weight
        width_of = by_lower_third

    with pytest.raises(AssertionError, match=r"Fixed\.number is a Python float"):
        check_kernel(Fixed())


class Residual(jr.AbstractResidual):
    """Point to point, its equations times factors."""

    uses_normals = False
    H: int = eqx.field(default=1, static=True)
    b: int = eqx.field(default=1, static=True)
    descent: int = eqx.field(default=1, static=True)
    offset: int = eqx.field(default=0, static=True)

    def normal_equations(self, match, weight):
        H, b = jr.PointToPoint().normal_equations(match, weight)
        return self.H * H, self.b * b

    def descents(self, match):
        return self.descent * jr.PointToPoint().descents(match)

    def energy(self, match, weight):
        return self.offset + jr.PointToPoint().energy(match, weight)


@pytest.mark.parametrize(
    ("factors", "sentence"),
    [
        ({"offset": 1}, "the energy is 1 at the identity"),
        ({"H": 2}, "H is not the second differences"),
        ({"b": -1, "descent": -1}, "b is not minus the differences"),
        ({"descent": 2}, "descents do not add up to b"),
    ],
)
def test_residuals(factors, sentence):
    with pytest.raises(AssertionError, match=f"Residual.*{sentence}"):
        check_residual(Residual(**factors))


class Index(jr.AbstractIndex):
    """Comparison of all pairs, or what `twist` makes of it."""

    points: jax.Array
    mask: jax.Array
    twist: str = eqx.field(default="", static=True)

    @classmethod
    def build(cls, points, mask=None, twist=""):
        brute = BruteForce.build(points, mask)
        mask = jnp.ones_like(brute.mask) if twist == "masked" else brute.mask
        return cls(points, mask, twist)

    @property
    def reach(self):
        return jnp.asarray(jnp.inf, self.points.dtype)

    def lookup(self, columns, num=None, coarse=None):
        rows = BruteForce(self.points, self.mask).lookup(columns)
        if self.twist == "another":
            return jnp.where(jnp.arange(len(rows)) % 7 > 0, rows, jnp.argmax(self.mask))
        return rows

    def lookup_nearest(self, columns, k):
        rows = self.lookup(columns)[None]
        return rows if self.twist == "surplus" else jnp.where(self.mask.any(), rows, -1)


@pytest.mark.parametrize(
    ("twist", "sentence"),
    [
        ("masked", "a masked target is found"),
        ("another", r"0\.\d+ of the answers are the nearest; wanted 1"),
        ("surplus", "something is found where no target is valid"),
    ],
)
def test_indexes(twist, sentence):
    def build(points, mask=None):
        return Index.build(points, mask, twist)

    with pytest.raises(AssertionError, match=f"Index.*{sentence}"):
        check_index(build)


class Resampler(AbstractHardResampler):
    """The heaviest particle alone."""

    threshold: jax.Array | float = eqx.field(default=0.5, converter=jnp.asarray)

    def draw(self, key, weight, num):
        return jnp.full(weight.shape, jnp.argmax(weight), jnp.int32)


def test_resamplers():
    with pytest.raises(AssertionError, match="copies are not as many as their share"):
        check_resampler(Resampler())


class Step(jr.AbstractStep):
    """Gauss-Newton's, or what `twist` makes of it."""

    twist: str = eqx.field(default="", static=True)

    def __call__(self, T_target_source, match, weight, residual):
        T = jr.GaussNewton()(T_target_source, match, weight, residual)
        d = len(T) - 1
        if self.twist == "back":
            return T_target_source @ jnp.linalg.inv(T) @ T_target_source
        if self.twist == "drifts":
            return T.at[0, d].add(0.01)
        if self.twist == "stretches":
            return T.at[:d, :d].multiply(1.01)
        if self.twist == "all points":
            ones = jnp.ones_like(weight) * (jnp.max(weight) > 0)
            return jr.GaussNewton()(T_target_source, match, ones, residual)
        if self.twist == "in lengths":
            shift = (T - T_target_source)[:d, d]
            return T.at[:d, d].add(-shift * (1 - 1 / (1 + jnp.sum(shift**2))))
        if self.twist == "along one axis":
            return T.at[1, d].set(T_target_source[1, d])
        return T


@pytest.mark.parametrize(
    ("twist", "sentence"),
    [
        ("back", "the energy does not fall"),
        ("drifts", "weights of zero move the pose"),
        ("stretches", "a pose of the problem 'plain' is not rigid"),
        ("all points", "a point of weight zero counts"),
        ("in lengths", "another unit of length changes the answer"),
        ("along one axis", "it does not turn with the clouds"),
    ],
)
def test_steps(twist, sentence):
    check_step(Step())
    with pytest.raises(AssertionError, match=f"Step in 2D: {sentence}"):
        check_step(Step(twist))


class Dynamics(jr.AbstractDynamics):
    """Half of the motion error again, or what `twist` makes of it."""

    twist: str = eqx.field(default="", static=True)

    @property
    def needs_path(self):
        return False

    def __call__(self, key, particles, time):
        T, error = particles.T_target_source, particles.motion_error
        if self.twist == "jitters":
            error = error + 0.1 * jax.random.normal(key, error.shape)
        if self.twist == "mean":
            error = jnp.broadcast_to(jnp.mean(error, axis=0), error.shape)
        if self.twist == "promotes":
            T = T.astype(float)
        moved = jax.vmap(turn_and_shift)(T, error / 2)
        return 2 * moved if self.twist == "stretches" else moved


@pytest.mark.parametrize(
    ("twist", "sentence"),
    [
        ("jitters", "particles without motion errors move"),
        ("mean", "a row without weight counts"),
        ("promotes", "data of float32 give float64"),
        ("stretches", "a pose of the problem 'plain' is not rigid"),
    ],
)
def test_dynamics(twist, sentence):
    check_dynamics(Dynamics())
    with pytest.raises(AssertionError, match=f"Dynamics in 2D: {sentence}"):
        check_dynamics(Dynamics(twist))


class Energy(jr.AbstractEnergy):
    """The mean squared residual, or what `twist` makes of it."""

    twist: str = eqx.field(default="", static=True)
    resolution = 0.0

    def __call__(self, found, width):
        sq = jnp.where(found.mask, found.sq_residual, 0)
        mean = jnp.sum(sq) / jnp.maximum(jnp.sum(found.mask), 1)
        if self.twist == "sum":
            return jnp.sum(sq)
        if self.twist == "everyone":
            return jnp.mean(found.sq_residual)
        if self.twist == "likelihood":
            return -mean
        if self.twist == "of nobody":
            return jnp.sum(sq) / jnp.sum(found.mask)
        if self.twist == "height":
            return mean + found.residual[0, 0] ** 2
        return mean


@pytest.mark.parametrize(
    ("twist", "sentence"),
    [
        ("sum", "it is no mean"),
        ("everyone", "masked points count"),
        ("likelihood", r"it is not less at the true pose than 0\.05 rad from it"),
        ("of nobody", "it is not finite"),
        ("height", "it changes when both clouds turn"),
    ],
)
def test_energies(twist, sentence):
    check_energy(Energy())
    with pytest.raises(AssertionError, match=f"Energy in 2D: {sentence}"):
        check_energy(Energy(twist))


class Prior(jr.AbstractPrior):
    """The guess alone, or what `twist` makes of it."""

    twist: str = eqx.field(default="", static=True)

    def draw(self, key, num, d, init, dtype):
        T = jnp.eye(d + 1) if init is None else init
        num = num - 1 if self.twist == "one less" else num
        T = jnp.tile(T, (num, 1, 1))
        if self.twist == "reflects":
            T = T.at[:, 0].multiply(-1)
        return T if self.twist == "promotes" else T.astype(dtype)

    def in_frames(self, frames) -> Any:
        if self.twist == "forgets":
            return UniformPrior()
        return None if self.twist == "no frames" else self

    def log_density(self, T_target_source):
        t = T_target_source[:-1, -1]
        if self.twist == "in favour":
            return jnp.ones((), t.dtype)
        return -jnp.sum(t**2) if self.twist == "nearsighted" else 0 * t[0]


@pytest.mark.parametrize(
    ("twist", "sentence"),
    [
        ("one less", r"wanted poses \(64, 4, 4\), found \(63, 4, 4\)"),
        ("reflects", "with a guess' is not rigid"),
        ("promotes", "data of float32 give float64"),
        ("forgets", "frames of the input change its poses"),
        ("no frames", "in_frames gives no prior"),
        ("in favour", "log_density speaks for a pose"),
        ("nearsighted", "frames change its log_density"),
    ],
)
def test_priors(twist, sentence):
    check_prior(Prior())
    with pytest.raises(AssertionError, match=f"Prior.*{sentence}"):
        check_prior(Prior(twist))


class Nothing(jr.AbstractRegistrar):
    """Leaves the guess, or what `twist` makes of it."""

    twist: str = ""

    def in_frames(self, frames):
        return self

    def prepare(self, points, mask):
        return Centroids().prepare(points, mask)

    def solve(self, source, target, init, key):
        found = Centroids().solve(source, target, init)
        assert init is not None
        eye = jnp.eye(len(init), dtype=init.dtype)
        T = {"stretched": 2 * init, "fixed": eye}[self.twist]
        return eqx.tree_at(lambda s: s.T_target_source, found, T)


@pytest.mark.parametrize(
    ("twist", "sentence"),
    [
        ("stretched", "a pose of the problem 'plain' is not rigid"),
        ("fixed", "the pose does not follow the clouds"),
    ],
)
def test_registrars(twist, sentence):
    with pytest.raises(AssertionError, match=f"Nothing.*{sentence}"):
        check_registrar(Nothing(twist), d=2)


class Still(jr.AbstractAverager):
    """All poses at the identity."""

    trust: int = eqx.field(default=1, static=True)

    def solve(self, graph, init, key):
        eye = jnp.eye(graph.dim + 1, dtype=graph.T_i_j.dtype)
        trust = jnp.full_like(graph.weight, self.trust)
        T = jnp.tile(eye, (graph.num_poses, 1, 1))
        return solution(graph, T, edge_weight=trust)


@pytest.mark.parametrize(
    ("trust", "sentence"),
    [
        (1, "exact motions do not give the true poses"),
        (2, r"an edge_weight is not in \[0, 1\]"),
    ],
)
def test_averagers(trust, sentence):
    with pytest.raises(AssertionError, match=f"Still.*{sentence}"):
        check_averager(Still(trust), d=2)
