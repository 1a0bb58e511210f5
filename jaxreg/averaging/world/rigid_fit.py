"""The place of one rigid body that brings it to surveyed points, almost half wrong.

With a direction that points up, two points suffice.
"""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg.averaging.world.levels import upright
from jaxreg.geometry import lie
from jaxreg.geometry.kabsch import kabsch


#: Choices of points to fit: where half are wrong one of eight choices of three is
#: right, and none of 256 with a chance of 1e-15.
CHOICES = 256
#: Deviations of right points that are tried, as shares of their extent.
_LADDER = tuple(0.3 / 2 ** (n / 2) for n in range(32))
# Points lie on a line if they are wide by less than a thousandth of its length: they
# would tell the turn about it a thousand times less than the others.
_LINE = 1e-6
#: The middle length of a vector of k normal numbers, and that which a hundredth of them
#: exceed: roots of quantiles of chi-square.
MEDIAN = {2: 1.177, 3: 1.538, 6: 2.313}
FARTHEST = {2: 3.035, 3: 3.368, 6: 4.1}


def likeliest_place(
    seen: Float[Array, "c d"],
    in_world: Float[Array, "c d"],
    usable: Bool[Array, " c"],
    also: Float[Array, "n D D"] | None = None,
    up: Float[Array, "3"] | None = None,
) -> tuple[Float[Array, "D D"], Bool[Array, " c"], Bool[Array, ""]]:
    """`T_world_body`, the likeliest over the choices, then by all that agree with it.

    Also which agree in the end, and whether `up` was believed.

    Args:
        seen: points of the body.
        in_world: where they lie in the world.
        usable: those that count.
        also: more places to try beside those of some points.
        up: of the body what points up in the world, 0 if that is not known.
    """
    num, d = seen.shape
    rows = _choices(usable, min(d, num))
    present = usable.astype(seen.dtype)
    whole = jnp.all(usable[rows], axis=1)
    tried = jax.vmap(lambda r: kabsch(seen[r], in_world[r], present[r]))(rows)
    level = jnp.zeros(len(rows), bool)
    if up is not None:
        stood = jax.vmap(lambda r: _stood(seen[r], in_world[r], present[r], up))(rows)
        tried = jnp.concatenate([stood, tried])
        level = jnp.concatenate([~level, level])
        whole = jnp.concatenate([whole & jnp.any(up != 0), whole])
    if also is not None:
        tried = jnp.concatenate([tried, also])
        level = jnp.concatenate([level, jnp.zeros(len(also), bool)])
        whole = jnp.concatenate([whole, jnp.ones(len(also), bool)])
    free = jnp.where(level, d + 1, lie.tangent_dim(d)) / d

    def squares(T: Array) -> Array:
        return jnp.sum((lie.act(T, seen) - in_world) ** 2, axis=-1)

    extent = jnp.max(jnp.linalg.norm(in_world - in_world[:1], axis=-1))
    extent = jnp.where(extent > 0, extent, 1)
    # One after the other: of thousands of points memory would not hold all.
    scores, sizes = jax.lax.map(
        lambda x: _log_evidence(squares(x[0]), present, extent, d, x[1]),
        (tried, free.astype(seen.dtype)),
    )
    first = jnp.argmax(jnp.where(whole, scores, -jnp.inf))
    size = sizes[first]

    def closer(_: Array, T: Array) -> Array:
        w = jnp.exp(-squares(T) / (FARTHEST[d] * size) ** 2 / 2)
        free = kabsch(seen, in_world, present * w)
        if up is None:
            return free
        return jnp.where(level[first], _stood(seen, in_world, present * w, up), free)

    T = control.fori_loop(0, 5, closer, tried[first])
    agrees = usable & (squares(T) < (FARTHEST[d] * size) ** 2)
    return T, agrees, level[first]


def _stood(
    seen: Float[Array, "c 3"],
    in_world: Float[Array, "c 3"],
    weight: Float[Array, " c"],
    up: Float[Array, "3"],
) -> Float[Array, "4 4"]:
    """The place that fits the points best of those that have `up` point up."""
    A = upright(up)
    turned = jnp.sum(A * seen[:, None, :], axis=-1)
    flat = kabsch(turned[:, :2], in_world[:, :2], weight)
    total = jnp.sum(weight)
    rise = jnp.sum(weight * (in_world - turned)[:, 2]) / jnp.where(total > 0, total, 1)
    about = jnp.eye(3, dtype=A.dtype).at[:2, :2].set(lie.rotation(flat))
    return lie.compose(about @ A, jnp.append(lie.translation(flat), rise))


def _log_evidence(
    sq: Float[Array, " c"], present: Array, extent: Array, d: int, free: Array
) -> tuple[Array, Array]:
    """The likeliest deviation of right points, and how likely.

    A point is right or wrong with even odds, and lies anywhere in the extent if wrong.
    A motion of k free components fits k / d points whatever they are, which are taken
    off as `free`.
    """
    deviation = extent * jnp.asarray(_LADDER, sq.dtype)
    gain = d * jnp.log(extent / deviation)
    each = jax.nn.softplus(gain[:, None] - sq / (2 * deviation[:, None] ** 2))
    total = jnp.sum(present * each, axis=1) - free * gain
    best = jnp.argmax(total)
    return total[best], deviation[best]


def _choices(usable: Bool[Array, " c"], size: int) -> Int[Array, "n s"]:
    """Rows of points to fit, all choices if they are few; no key is needed.

    Else some of those that are usable, as far as these are enough.
    """
    num = len(usable)
    if math.comb(num, size) <= CHOICES:
        return jnp.asarray(list(itertools.combinations(range(num), size)), jnp.int32)
    shares, count = np.random.default_rng(0).random((size, CHOICES)), jnp.sum(usable)
    picks: list[Array] = []
    for share in shares:
        left = jnp.maximum(count - len(picks), 1)
        pick = jnp.floor(jnp.asarray(share, jnp.float32) * left).astype(jnp.int32)
        pick = jnp.minimum(pick, left - 1)
        # The number of one of those that are left, among all.
        for taken in jnp.sort(jnp.stack(picks), axis=0) if picks else ():
            pick = pick + (pick >= taken)
        picks.append(pick)
    usable_first = jnp.argsort(~usable, stable=True).astype(jnp.int32)
    return usable_first[jnp.stack(picks, axis=-1)]


def spans(in_world: Float[Array, "c d"], trust: Float[Array, " c"]) -> Bool[Array, ""]:
    """Whether the trusted points hold every turn: they lie on no line, in 2D apart."""
    spread = _spread(in_world, trust)
    whole = jnp.trace(spread)
    if in_world.shape[-1] == 2:
        return whole > 0
    # The sum of the minors: the products of two of the squared widths.
    minors = (whole**2 - jnp.sum(spread**2)) / 2
    return minors > _LINE * whole**2


def spans_upright(
    in_world: Float[Array, "c 3"], trust: Float[Array, " c"]
) -> Bool[Array, ""]:
    """Whether they hold the turn that levels leave: they lie on no plumb line."""
    sq = jnp.diagonal(_spread(in_world, trust))
    return sq[0] + sq[1] > _LINE * sq[2]


def _spread(
    in_world: Float[Array, "c d"], trust: Float[Array, " c"]
) -> Float[Array, "d d"]:
    """About the mean of the trusted points."""
    w = jnp.where(trust > 0.5, 1.0, 0.0).astype(in_world.dtype)
    mean = jnp.sum(w[:, None] * in_world, axis=0) / jnp.maximum(jnp.sum(w), 1)
    off = (in_world - mean) * w[:, None]
    return jnp.sum(off[:, :, None] * off[:, None, :], axis=0)
