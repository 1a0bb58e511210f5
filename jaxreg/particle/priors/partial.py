"""What is known of the pose beforehand: which way is up, about where the scan was."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxreg._core.arrays import cast_floats, traced
from jaxreg._core.checks import as_float_array, check_flag, check_positive, is_concrete
from jaxreg._core.typing import Key, Motion, Scalar
from jaxreg.geometry import lie
from jaxreg.particle.priors.base import AbstractPrior
from jaxreg.registrar import Frames


def _vector(name: str) -> Callable[[object], Array | None]:
    def converted(x: object) -> Array | None:
        return None if x is None else as_float_array(x, f"PartialPose: {name}")

    return converted


class PartialPose(AbstractPrior):
    """x_0 of levelled scanners and of scanners that knew about where they were.

        levelled = jr.PartialPose(up=(0, 0, 1))
        sol = jr.register(source, target, jr.ParticleFilter(prior=levelled), key=key)

    Poses are drawn as it says, and judged by it: what it contradicts is held against a
    pose's `log_evidence`, so that of several that fit equally well the likely one is
    believed. That a pose agrees is no evidence: it was looked for there.

    Attributes:
        up: `(3,)` the direction against gravity, the same in both scans' own frames; of
            any length. None where the rotation is unknown, and in 2D.
        tilt: deviation of that direction about each of the two horizontal axes, in
            radians.
        position: `(d,)` where the source's scanner stood as seen from the target's, in
            the unit of the input; None where it is unknown.
        deviation: of each coordinate of `position`, in that unit.
        oriented: whether `position` has the axes of the target's frame. If not, as of
            the difference of two satellite fixes, only its length is known; with `up`,
            whose direction they share, its height and its horizontal length.
        source_scanner: `(d,)` where the scanner, or its antenna, is in the source's
            frame; the origin by default.
        target_scanner: `(d,)` likewise in the target's.
        translation_spread: as in `UniformPrior`, where `position` is unknown.
        frames: those of the search; set by `in_frames`.

    `init`, if given, is the first of the poses.

    Raises: ValueError for deviations that are not above zero, where neither `up` nor
        `position` is given, for shapes that do not fit, and for an `up` of no length.
    """

    up: Float[Array, "3"] | None = eqx.field(default=None, converter=_vector("up"))
    tilt: Array | float = traced(0.035)
    position: Float[Array, " d"] | None = eqx.field(
        default=None, converter=_vector("position")
    )
    deviation: Array | float = traced(1.0)
    oriented: bool = eqx.field(default=True, static=True)
    source_scanner: Float[Array, " d"] | None = eqx.field(
        default=None, converter=_vector("source_scanner")
    )
    target_scanner: Float[Array, " d"] | None = eqx.field(
        default=None, converter=_vector("target_scanner")
    )
    translation_spread: Array | float = traced(0.5)
    frames: Frames | None = None

    def __check_init__(self) -> None:
        """Refuses what says nothing, or nothing that can be."""
        check_positive(self, "tilt", "deviation", "translation_spread")
        check_flag(self.oriented, "PartialPose: oriented")
        if self.up is None and self.position is None:
            raise ValueError("PartialPose: wanted up, position or both, found neither.")
        for name, found in self._vectors():
            if is_concrete(found) and not np.all(np.isfinite(found)):
                raise ValueError(f"PartialPose: {name}: wanted finite numbers.")
        if self.up is not None and is_concrete(self.up) and not np.any(self.up):
            raise ValueError("PartialPose: up: wanted a direction, found zero.")

    def in_frames(self, frames: Frames) -> "PartialPose":
        """With the frames of the search, in which it draws and judges."""
        for name, found in self._vectors():
            if found.shape != (frames.d,):
                raise ValueError(
                    f"PartialPose: {name}: wanted shape ({frames.d},) for points of "
                    f"dimension {frames.d}, found {found.shape}."
                )
        if self.up is not None and frames.d != 3:
            raise ValueError("PartialPose: up: of 3D points only.")
        return dataclasses.replace(self, frames=frames)

    def draw(
        self, key: Key, num: int, d: int, init: Motion | None, dtype: Any
    ) -> Float[Array, "p D D"]:
        """`(num, d+1, d+1)` poses."""
        self = cast_floats(self, dtype)
        key_R, key_t, key_turn = jax.random.split(key, 3)
        R = self._rotations(key_R, num, d, dtype)
        noise = jax.random.normal(key_t, (num, d), dtype)
        if self.position is None:
            T = lie.compose(R, self.translation_spread * noise)
        else:
            place = jnp.broadcast_to(self.position, (num, d))
            if not self.oriented:
                turn = self._rotations(key_turn, num, d, dtype)
                place = jnp.einsum("pij,pj->pi", turn, place)
            place = place + self.deviation * noise
            if self.target_scanner is not None:
                place = place + self.target_scanner[None]
            if self.source_scanner is not None:
                place = place - R @ self.source_scanner
            T = lie.compose(R, place)
            if self.frames is not None:
                T = jax.vmap(self.frames.enter)(T)
        return T if init is None else T.at[0].set(init.astype(dtype))

    def log_density(self, T_target_source: Motion) -> Scalar:
        """(E[z^2] - z^2) / 2 of the deviations z from what is known, zero at most."""
        T = T_target_source
        self = cast_floats(self, T.dtype)
        excess = jnp.zeros((), T.dtype)
        if self.up is not None:
            angle = _angle(lie.rotation(T), _unit(self.up))
            excess = excess + (angle / self.tilt) ** 2 - 2
        if self.position is not None:
            T = T if self.frames is None else self.frames.leave(T)
            place = lie.translation(T)
            if self.source_scanner is not None:
                place = place + lie.rotation(T) @ self.source_scanner
            if self.target_scanner is not None:
                place = place - self.target_scanner
            z = self._deviations(place, self.position)
            excess = excess + jnp.sum(z**2) - z.size
        return jnp.minimum(-excess / 2, 0)

    def _vectors(self) -> list[tuple[str, Array]]:
        """Names and values of those that are given."""
        names = "up", "position", "source_scanner", "target_scanner"
        pairs = ((name, getattr(self, name)) for name in names)
        return [(name, found) for name, found in pairs if found is not None]

    def _rotations(
        self, key: Key, num: int, d: int, dtype: Any
    ) -> Float[Array, "p d d"]:
        """Anyhow; with `up` about it by any angle, and nearly upright."""
        if self.up is None:
            return lie.random_rotations(key, num, d, dtype)
        key_turn, key_tilt = jax.random.split(key)
        up = _unit(self.up)
        angle = jax.random.uniform(key_turn, (num, 1), dtype, -jnp.pi, jnp.pi)
        tilt = self.tilt * jax.random.normal(key_tilt, (num, 3), dtype)
        tilt = tilt - (tilt @ up)[:, None] * up[None]
        return lie.rotation_exp(tilt) @ lie.rotation_exp(angle * up[None])

    def _deviations(
        self, place: Float[Array, " d"], known: Float[Array, " d"]
    ) -> Float[Array, " n"]:
        """From the known position, of what is known of it, in its deviations."""
        deviation = self.deviation
        if self.oriented:
            return (place - known) / deviation
        if self.up is None:
            return jnp.stack([_norm(place) - _norm(known)]) / deviation
        up = _unit(self.up)
        heights = place @ up, known @ up
        flat, flat_known = (
            _norm(x - height * up)
            for x, height in zip((place, known), heights, strict=True)
        )
        # Far away a scanner that is tilted sees the other at another height.
        leaning = jnp.sqrt(deviation**2 + (self.tilt * flat_known) ** 2)
        return jnp.stack(
            [(flat - flat_known) / deviation, (heights[0] - heights[1]) / leaning]
        )


def _unit(x: Float[Array, " d"]) -> Float[Array, " d"]:
    return x / _norm(x)


def _norm(x: Float[Array, " d"]) -> Scalar:
    return jnp.sqrt(jnp.sum(x**2))


def _angle(R: Float[Array, "3 3"], up: Float[Array, "3"]) -> Scalar:
    """Between a direction and its image."""
    # Half the chord is the sine of half the angle, also of small ones.
    return 2 * jnp.arcsin(jnp.minimum(_norm(R @ up - up) / 2, 1))
