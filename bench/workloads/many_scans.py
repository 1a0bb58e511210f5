"""From a hundred scans to ten thousand: all but the search, which is replayed.

Scans are small, and what the search says of a pair is drawn from the truth: right with
its noise where scans overlap enough, wrong elsewhere, and believed once in a while.
Everything else is what `reconstruct` does with any scans.
"""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from bench.case import Case, Judged, Method, Options
from bench.records import Metric, error
from bench.workloads.averaging_data import motions
from jaxreg import ParticleFilter, reconstruct
from jaxreg.cloud import centroid, rms_radius
from jaxreg.matching import NO_EVIDENCE
from jaxreg.metrics import rotation_errors, translation_errors
from jaxreg.multiview import RelativeMotions
from jaxreg.multiview.method import num_kept
from jaxreg.multiview.prepare import common_radius


SIZES = (100, 1_000, 10_000)
#: Scans of which a call takes many minutes.
_MANY = 10_000
#: Points of a scan, and how far its scanner sees: along a street in steps, of an object
#: of radius 1 in radians.
_POINTS, _REACH, _SIGHT = 400, 6.0, 0.9
# Noise of a motion of the search in radians and radii; pairs that share less than this
# are not found, and of those not found so many are believed in some other pose.
_NOISE, _FOUND, _FALSE = 0.01, 0.3, 0.001
# Modes of a pair that are kept.
_MODES = num_kept(ParticleFilter())


def cases(options: Options) -> Iterator[Case]:
    """A case per scene and size."""
    del options
    for scene, make in (("street", street), ("object", view_of_object)):
        for num in SIZES:
            scans, T_world_i, place = make(num)
            own = Method(
                "jaxreg",
                "jaxreg",
                "reconstruct, pairs replayed",
                partial(_solved, scans, T_world_i, place, SHARES[scene]),
            )
            yield Case(
                name=f"{scene}, {num} scans",
                data=f"generated {scene}, scans of {_POINTS} points",
                methods=[own],
                trials=[(seed,) for seed in range(1 if num >= _MANY else 3)],
                judge=partial(_judged, T_world_i),
                long=True,
                once=num >= _MANY,
                x=float(num),
                x_label=f"scans of a {scene}",
            )


def street(num: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scans, poses and places of a scanner along a street that winds to and fro."""
    rng = np.random.default_rng(num)
    block = max(int(math.sqrt(num)), 10)
    lane, along = np.divmod(np.arange(num), block)
    along = np.where(lane % 2, block - 1 - along, along)
    place = np.column_stack([along, 2.5 * lane])
    place = place + rng.normal(0, 0.1, place.shape)
    r = _REACH / 2 * np.sqrt(rng.random((num, _POINTS)))
    angle = rng.uniform(0, 2 * np.pi, r.shape)
    x, y = place[:, :1] + r * np.cos(angle), place[:, 1:] + r * np.sin(angle)
    points = np.stack([x, y, _ground(x, y)], axis=-1)
    points += rng.normal(0, 0.01, points.shape)
    return *_in_own_frames(points, rng), place


def _ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A surface without symmetry or period."""
    rng = np.random.default_rng(0)
    out = np.zeros_like(x)
    for _ in range(12):
        a, b = rng.normal(0, 1.0, 2)
        out += 0.25 * np.sin(a * x + b * y + rng.uniform(0, 6))
    return out


def view_of_object(num: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Views of a bumpy ball from directions that spiral over it."""
    rng = np.random.default_rng(num)
    k = np.arange(num) + 0.5
    polar, turn = np.arccos(1 - 2 * k / num), np.pi * (1 + 5**0.5) * k
    axis = np.stack(
        [np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], -1
    )
    cosine = 1 - (1 - math.cos(_SIGHT)) * rng.random((num, _POINTS))
    side = rng.normal(size=(num, _POINTS, 3))
    side -= np.sum(side * axis[:, None], -1, keepdims=True) * axis[:, None]
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    ray = cosine[..., None] * axis[:, None] + np.sqrt(1 - cosine**2)[..., None] * side
    waves = np.random.default_rng(0).normal(0, 4, (16, 3))
    radius = 1 + 0.03 * np.sum(np.sin(ray @ waves.T), axis=-1)
    points = ray * radius[..., None] + rng.normal(0, 0.002, ray.shape)
    return *_in_own_frames(points, rng), axis


def _in_own_frames(
    points: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Scans in frames turned at random about their middles, and `T_world_i`."""
    R = Rotation.random(len(points), rng=rng).as_matrix()
    middle = points.mean(axis=1)
    own = np.einsum("nba,nmb->nma", R, points - middle[:, None])
    return own.astype(np.float32), motions(R, middle)


def _share_on_street(distance: np.ndarray) -> np.ndarray:
    """Of two discs."""
    x = np.clip(distance / _REACH, 0, 1)
    return 2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x**2))


def _share_on_object(chord: np.ndarray) -> np.ndarray:
    """Of two caps, as of flat discs."""
    angle = 2 * np.arcsin(np.clip(chord / 2, 0, 1))
    x = np.clip(angle / (2 * _SIGHT), 0, 1)
    return 2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x**2))


SHARES = {"street": _share_on_street, "object": _share_on_object}


class Replayed(Executor):
    """In place of the search: what it would say of a pair, drawn from the truth.

    Args:
        T_world_i: poses of the centred scans, in radii (`in_radii`).
        place: `(v, k)` whose distances tell the share that two scans have in common.
        share: by the distance.
    """

    def __init__(
        self,
        T_world_i: np.ndarray,
        place: np.ndarray,
        share: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        self._T, self._place, self._share = T_world_i, place, share

    @classmethod
    def of(
        cls,
        scans: np.ndarray,
        T_world_i: np.ndarray,
        place: np.ndarray,
        share: Callable[[np.ndarray], np.ndarray],
    ) -> "Replayed":
        """Of scans `(v, n, 3)` and their poses."""
        points = jnp.asarray(scans)
        mask = jnp.ones(points.shape[:2], bool)
        radius = float(common_radius(jax.vmap(rms_radius)(points, mask)))
        mean = np.asarray(jax.vmap(centroid)(points, mask))
        return cls(in_radii(T_world_i, mean, radius), place, share)

    def submit(self, fn: object, /, *args: Any, **kwargs: Any) -> Future:
        """The motions of the pairs of a task."""
        out: Future = Future()
        out.set_result(self._told(np.asarray(args[0].pairs)))
        return out

    def _told(self, pairs: np.ndarray) -> RelativeMotions:
        i, j = pairs.T
        rng = np.random.default_rng(pairs.ravel())
        share = self._share(np.linalg.norm(self._place[i] - self._place[j], axis=1))
        e = rng.normal(0, _NOISE, (len(i), 6))
        T = np.linalg.inv(self._T[i]) @ self._T[j]
        found = share >= _FOUND
        e[~found] = rng.normal(0, 1, e[~found].shape)
        T = T @ motions(Rotation.from_rotvec(e[:, 3:]).as_matrix(), e[:, :3])
        told = np.where(found, 6.0, -3.0) + rng.normal(0, 0.5, len(i))
        told[~found & (rng.random(len(i)) < _FALSE)] = 4.0
        arrays = (
            pairs.astype(np.int32),
            _with_others(T.astype(np.float32), np.eye(4, dtype=np.float32)),
            _with_others(share.astype(np.float32), 0),
            _with_others(told.astype(np.float32), NO_EVIDENCE),
            _with_others(np.full(len(i), 0.01, np.float32), 0),
        )
        return RelativeMotions.kept(*arrays)


def _with_others(x: np.ndarray, fill: Any) -> np.ndarray:
    """With as many modes as the search keeps, of which one is there."""
    others = np.broadcast_to(np.asarray(fill, x.dtype), x.shape)
    return np.stack([x, *[others] * (_MODES - 1)], axis=1)


def _solved(
    scans: np.ndarray,
    T_world_i: np.ndarray,
    place: np.ndarray,
    share: Callable[[np.ndarray], np.ndarray],
    seed: int,
) -> tuple[np.ndarray, np.ndarray, int]:
    with Replayed.of(scans, T_world_i, place, share) as executor:
        found = reconstruct(scans, key=jax.random.key(seed), executor=executor)
    return (
        np.asarray(found.T_world_i),
        np.asarray(found.placed),
        len(np.asarray(found.overlap)),
    )


def in_radii(T_world_i: np.ndarray, mean: np.ndarray, radius: float) -> np.ndarray:
    """Poses of scans less their means, in a unit of so much."""
    T = T_world_i.copy()
    T[:, :3, 3] += np.einsum("nab,nb->na", T[:, :3, :3], mean.astype(np.float64))
    T[:, :3, 3] /= radius
    return T


def _judged(T_true: np.ndarray, answers: list[Any]) -> Judged:
    """Of the worst seed; errors in the best common frame."""
    degrees, shift = [], []
    for T, placed, _ in answers:
        told = jnp.asarray(T[placed]), jnp.asarray(T_true[placed], jnp.float32)
        degrees.append(float(np.rad2deg(rotation_errors(*told, "best")).mean()))
        shift.append(float(translation_errors(*told, "best").mean()))
    most = max(pairs / len(placed) for _, placed, pairs in answers)
    metrics = [
        error("e_rot", max(degrees), "deg", 0.01),
        error("e_trans", max(shift), "", 0.01),
        Metric("placed", min(float(x.mean()) for _, x, _ in answers), "", "up"),
        Metric("pairs a scan", most, "", "down"),
    ]
    return Judged(metrics)
