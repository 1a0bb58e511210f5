"""The contract of steps, and the tangent space that they work in."""

import abc
from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxreg._core.arrays import full_matmul
from jaxreg._core.brief import BriefModule
from jaxreg._core.typing import Motion
from jaxreg.geometry import lie
from jaxreg.matching.problem import Match
from jaxreg.matching.residuals import AbstractResidual


class AbstractStep(BriefModule):
    """One update of the pose with correspondences and weights held."""

    described: ClassVar[str] = "a step such as GaussNewton()"

    @abc.abstractmethod
    def __call__(
        self,
        T_target_source: Motion,
        match: Match,
        weight: Float[Array, " n"],
        residual: AbstractResidual,
    ) -> Motion:
        """The updated pose; the pose itself where the weights are all zero."""


def turn_and_shift(T_target_source: Motion, tangent: Float[Array, " k"]) -> Motion:
    """Applies (v, w) about the origin of the source: R -> exp(w) R, t -> t + v."""
    d = T_target_source.shape[-1] - 1
    turn = lie.rotation_exp(tangent[d:])
    return lie.compose(
        full_matmul(turn, lie.rotation(T_target_source)),
        lie.translation(T_target_source) + tangent[:d],
    )


def tangent_slopes(tangent: Float[Array, " k"]) -> Float[Array, "k k"]:
    """How `turn_and_shift` by a tangent follows it, as a tangent from where it ends."""
    d = 2 if len(tangent) == 3 else 3
    w = tangent[d:]
    R, dR = lie.rotation_exp(w), jax.jacfwd(lie.rotation_exp)(w)
    spin = jnp.sum(dR[:, None] * R[None, :, :, None], axis=2)
    rows = [spin[1, 0]] if d == 2 else [spin[2, 1], spin[0, 2], spin[1, 0]]
    return jnp.eye(len(tangent), dtype=w.dtype).at[d:, d:].set(jnp.stack(rows))


def decoupled_error(
    T_after: Float[Array, "D D"], T_before: Float[Array, "D D"]
) -> Float[Array, " k"]:
    """(v, w) with `turn_and_shift(T_before, (v, w)) = T_after` (PF paper, Eq. 6)."""
    turn = full_matmul(lie.rotation(T_after), lie.rotation(T_before).T)
    w = lie.rotation_log(turn)
    v = lie.translation(T_after) - lie.translation(T_before)
    return jnp.concatenate([v, w])
