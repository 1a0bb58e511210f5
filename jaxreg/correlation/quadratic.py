"""The kernel correlation around a pose, to second order in the tangent (v, w).

The pose moves by R -> exp(w) R, t -> t + v (the source is centred). The energy is
that of a multiply-linked ICP: every source point is tied to every target point by
Welsch's kernel, rho(r) = s^2 (1 - exp(-r^2 / (2 s^2))) with s the bandwidth, which is
r^2 / 2 for close pairs and s^2 for far ones. Its sum is s^2 times the number of pairs
less the kernel correlation.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxreg._core.typing import Motion
from jaxreg.cloud import PointCloud
from jaxreg.correlation.pairs import PairSums, pair_sums
from jaxreg.geometry import lie
from jaxreg.matching.residuals.gram import wrench


class Quadratic(eqx.Module):
    """Value and derivatives at a pose.

    Attributes:
        correlation: the kernel correlation, a sum over all pairs.
        H: `(k, k)` exact Hessian of the energy; indefinite far from a minimum.
        b: `(k,)` its descent direction, zero where the correlation is stationary.
        stiffness: `(k,)` diagonal of the matrix that ICP with these links would use:
            positive wherever any pair is close.
        links: `(k, k)` that matrix.
        by_source: `(k, n)` what every source point adds to b.
    """

    correlation: Float[Array, ""]
    H: Float[Array, "k k"]
    b: Float[Array, " k"]
    stiffness: Float[Array, " k"]
    links: Float[Array, "k k"]
    by_source: Float[Array, "k n"]

    @classmethod
    def at(
        cls,
        T_target_source: Motion,
        source: PointCloud,
        target: PointCloud,
        bandwidth: Float[Array, ""],
    ) -> "Quadratic":
        """One pass over all pairs."""
        d = source.points.shape[1]
        moved = lie.act(T_target_source, source.points).T
        lever = moved - lie.translation(T_target_source)[:, None]
        sums = pair_sums(moved, source.mask, target.points, target.mask, bandwidth)
        by_source = wrench(sums.pull, lever)

        eye = jnp.eye(d, dtype=lever.dtype)
        values = eye[:, :, None] * sums.value[None, None]
        # Rows e_i . d(R p + t) / d(v, w), `(d, k, n)`.
        J = jnp.stack([wrench(_constant(row, lever), lever) for row in eye])
        pairs_H = values - sums.spread / bandwidth**2
        H = _quadratic_form(J, pairs_H) + _bending(lever, sums)
        stiffness = jnp.sum(jnp.sum(J * J, axis=0) * sums.value[None], axis=1)
        links = _quadratic_form(J, values)
        return cls(
            correlation=jnp.sum(sums.value),
            H=H,
            b=jnp.sum(by_source, axis=1),
            stiffness=stiffness,
            links=links,
            by_source=by_source,
        )


def pull_on_target(
    T_target_source: Motion,
    source: PointCloud,
    target: PointCloud,
    bandwidth: Float[Array, ""],
) -> Float[Array, "k m"]:
    """What every target point adds to b: one more pass, with the roles swapped."""
    moved = lie.act(T_target_source, source.points)
    at = target.points.T
    sums = pair_sums(at, target.mask, moved, source.mask, bandwidth)
    return wrench(-sums.pull, at - lie.translation(T_target_source)[:, None])


def _constant(vector: Float[Array, " d"], like: Array) -> Array:
    return jnp.broadcast_to(vector[:, None], like.shape)


def _quadratic_form(
    J: Float[Array, "d k n"], M: Float[Array, "d d n"]
) -> Float[Array, "k k"]:
    """The sum of J^T M J over points."""
    d, k, n = J.shape
    MJ = jnp.stack([sum(M[i, j][None] * J[j] for j in range(d)) for i in range(d)])
    rows = jnp.swapaxes(J, 0, 1).reshape(k, d * n)
    others = jnp.swapaxes(MJ, 0, 1).reshape(k, d * n)
    return jnp.matmul(rows, others.T, precision=lax.Precision.HIGHEST)


def _bending(lever: Float[Array, "d n"], sums: PairSums) -> Float[Array, "k k"]:
    """The part of H that comes from the curvature of exp(w) lever in w."""
    d = lever.shape[0]
    outer = jnp.matmul(sums.pull, lever.T, precision=lax.Precision.HIGHEST)
    trace = jnp.trace(outer)
    if d == 2:
        turn = trace[None, None]
    else:
        turn = trace * jnp.eye(3, dtype=outer.dtype) - (outer + outer.T) / 2
    return jnp.pad(turn, ((d, 0), (d, 0)))
