"""Clouds far from their origins, such as map coordinates in float64.

Cast to float32 they would be rounded to half a metre. They are moved to their middles
before, in float64 on the host, and the poses that are found are moved back there.
"""

import contextlib
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxreg._core.checks import as_host_array, as_host_numbers
from jaxreg._core.typing import ArrayLike
from jaxreg.batching.padding import is_list_of_clouds
from jaxreg.particle import AbstractSearch, GivenParticles, PartialPose
from jaxreg.registrar import AbstractRegistrar, RegistrationSolution


# A cloud so many radii from the origin loses two of the seven digits of float32.
_FAR = 100.0
# Rotations of float32 are orthonormal within this.
_ROUNDING = 1e-5


class Moved(NamedTuple):
    """A cloud, a batch or a list of them, and the `(..., d)` origins they are about.

    The origins are None where nothing was moved: of clouds near their origins, of what
    JAX holds already, and where JAX computes in float64.
    """

    points: object
    origin: np.ndarray | None

    def at(self, i: int) -> "Moved":
        """One of a list."""
        return Moved(None, None if self.origin is None else self.origin[i])


def near_origin(points: object, mask: object, name: str) -> Moved:
    """Clouds moved to their middles where they are far from their origins."""
    if isinstance(points, jax.Array) or jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        return Moved(points, None)
    if isinstance(points, list | tuple) and is_list_of_clouds(points):
        masks = mask if isinstance(mask, list | tuple) else [None] * len(points)
        each = [
            near_origin(x, m, f"{name}[{i}]")
            for i, (x, m) in enumerate(zip(points, masks, strict=False))
        ]
        far = [x.origin for x in each if x.origin is not None]
        if len(each) < len(points) or not far:
            return Moved(points, None)
        zero = np.zeros_like(far[0])
        origins = [zero if x.origin is None else x.origin for x in each]
        return Moved([x.points for x in each], np.stack(origins))
    found = as_host_array(points, name)
    exact = found.dtype == np.float64 or found.dtype.kind in "iu"
    if not exact or found.ndim < 2:
        return Moved(points, None)
    valid = np.ones(found.shape[:-1], bool)
    if mask is not None:
        with contextlib.suppress(ValueError, TypeError):
            valid = as_host_array(mask, f"{name}_mask").astype(bool)
    # One that does not fit is refused where both clouds are checked.
    if valid.shape != found.shape[:-1]:
        return Moved(points, None)
    origin = _middles(found, valid)
    if not np.any(origin):
        return Moved(points, None)
    return Moved(found - origin[..., None, :], origin)


def _middles(points: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """`(..., d)` means of the valid finite rows; zero of clouds that are near."""
    valid = (valid & np.all(np.isfinite(points), axis=-1))[..., None]
    num = np.maximum(np.sum(valid, axis=-2), 1)
    mean = np.sum(points, axis=-2, where=valid, dtype=np.float64) / num
    offset = points - mean[..., None, :]
    sq = np.sum(offset**2, axis=(-2, -1), where=valid) / num[..., 0]
    far = (sq > 0) & (np.sum(mean**2, axis=-1) > _FAR**2 * sq)
    return np.where(far[..., None], mean, 0)


def check_prior_fits(method: AbstractRegistrar, source: Moved, target: Moved) -> None:
    """Requires that a prior holds no poses between frames that were moved."""
    if source.origin is None and target.origin is None:
        return
    prior = method.prior if isinstance(method, AbstractSearch) else None
    if isinstance(prior, GivenParticles) or (
        isinstance(prior, PartialPose) and prior.position is not None
    ):
        raise ValueError(
            f"{type(prior).__name__}: source and target are far from their origins and "
            "are moved; subtract their middles, and give poses between what is left."
        )


def moved_guess(
    init: ArrayLike | None, source: Moved, target: Moved
) -> ArrayLike | None:
    """A guess between the frames of the input as one between those of the search."""
    if init is None or (source.origin is None and target.origin is None):
        return init
    T = as_host_numbers(init, "init")
    one = source.origin if source.origin is not None else target.origin
    assert one is not None
    d = one.shape[-1]
    # What does not fit is refused by who looks for motions.
    if T.shape[-2:] != (d + 1, d + 1) or T.shape[:-2] not in ((), one.shape[:-1]):
        return init
    return pose_moved(T, *_origins(source, target, d))


def moved_back(
    solution: RegistrationSolution, source: Moved, target: Moved
) -> RegistrationSolution:
    """A solution with poses between the frames of the input, in float64 on the host."""
    if source.origin is None and target.origin is None:
        return solution
    d = solution.T_target_source.shape[-1] - 1
    here, there = _origins(source, target, d)
    T = pose_back(solution.T_target_source, here, there)
    modes = solution.modes.T_target_source
    modes = pose_back(modes, here[..., None, :], there[..., None, :])
    # Not by the constructor: JAX without x64 has no such arrays.
    return eqx.tree_at(
        lambda s: (s.T_target_source, s.modes.T_target_source), solution, (T, modes)
    )


def pose_moved(T: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """As one between clouds moved to their origins, the source's and the target's."""
    T = np.asarray(T, np.float64)
    return _with_translation(T, T[..., :-1, -1] + _turned(T, here) - there)


def pose_back(T: ArrayLike, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The other way; the rotation is made orthonormal to the last digit before."""
    T = _orthonormal(np.asarray(T, np.float64))
    return _with_translation(T, T[..., :-1, -1] + there - _turned(T, here))


def _origins(source: Moved, target: Moved, d: int) -> tuple[np.ndarray, np.ndarray]:
    here, there = (
        np.zeros(d) if x.origin is None else x.origin for x in (source, target)
    )
    return here, there


def _turned(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.einsum("...ij,...j->...i", T[..., :-1, :-1], points)


def _with_translation(T: np.ndarray, t: np.ndarray) -> np.ndarray:
    shape = np.broadcast_shapes(T.shape[:-2], t.shape[:-1])
    out = np.broadcast_to(T, (*shape, *T.shape[-2:])).copy()
    out[..., :-1, -1] = t
    return out


def _orthonormal(T: np.ndarray) -> np.ndarray:
    """To the last digit: seven of a rotation are a metre at a million metres.

    A scale that was looked for stays, and so does what is not finite.
    """
    T = np.where(np.isfinite(T).all(axis=(-2, -1), keepdims=True), T, np.nan)
    known = ~np.isnan(T)
    U, size, Vt = np.linalg.svd(np.where(known, T, np.eye(T.shape[-1]))[..., :-1, :-1])
    scale = np.mean(size, axis=-1)
    scale = np.where(np.abs(scale - 1) < _ROUNDING, 1, scale)
    out = T.copy()
    out[..., :-1, :-1] = scale[..., None, None] * (U @ Vt)
    return np.where(known, out, np.nan)
