"""Which scans hang together: parts that pairs join, from the scans alone upwards.

Each part is told by the lowest number of its scans.

Gradients: none; all is topology, and inputs are cut.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxreg._core import control
from jaxreg.graph.joined import Joined, in_loops_of_three, joined
from jaxreg.graph.trees import components


def confirmed_parts(
    pairs: Int[Array, "e 2"],
    weight: Float[Array, " e"],
    num_scans: int,
    strong: Bool[Array, " e"],
) -> Int[Array, " v"]:
    """Components joined by strong pairs, or by pairs that agree and are confirmed.

    Pairs confirm each other that join the same two parts, or three parts in a loop:
    that wrong ones agree with the poses by chance is far less likely than any one of
    them being wrong. What they join is one part from then on.
    """
    agrees = lax.stop_gradient(weight) > 0

    def merged(state: tuple[Array, Array]) -> tuple[Array, Array]:
        part, _ = state
        present = agrees & _across(pairs, part)
        ends = _ends(pairs, part, present, num_scans)
        join = present & _confirmed(ends, joined(ends), present, num_scans)
        return _joined(part, ends, join)

    core = components(pairs, jnp.where(strong, weight, 0), num_scans)
    return control.while_loop(lambda s: s[1], merged, (core, jnp.asarray(True)))[0]


def likeliest_parts(
    pairs: Int[Array, "e 2"],
    weight: Float[Array, " e"],
    num_scans: int,
    strong: Bool[Array, " e"],
    log_odds: Float[Array, " e"],
) -> Int[Array, " v"]:
    """Those of `confirmed_parts` that all pairs between them speak for together.

    Where rooms are alike, or their walls meet at right angles, several wrong pairs may
    agree. But then scans meet that share no surface, and say so. So two parts join
    where more speaks for it than against it, and about as much as for joining either to
    any other; and so on, with what is joined by then.

    Args:
        pairs: scans i and j.
        weight: above 0 of pairs that agree with the poses.
        num_scans: V.
        strong: pairs that need no others to confirm them.
        log_odds: of every pair that overlaps at the poses, for and against them; 0 of
            the others.
    """
    agrees, log_odds = lax.stop_gradient((weight, log_odds))
    agrees = agrees > 0

    def merged(state: tuple[Array, Array]) -> tuple[Array, Array]:
        part, _ = state
        across = _across(pairs, part)
        present, told = agrees & across, (agrees | (log_odds != 0)) & across
        ends = _ends(pairs, part, told, num_scans)
        same = joined(ends)
        total = _total(jnp.where(told, log_odds, 0), same)
        able = _total(present & strong, same) > 0
        able = told & (able | _confirmed(ends, same, present, num_scans))
        return _joined(part, ends, _best_joins(ends, total, told, able, num_scans))

    alone = jnp.arange(num_scans, dtype=jnp.int32)
    return control.while_loop(lambda s: s[1], merged, (alone, jnp.asarray(True)))[0]


def _best_joins(
    ends: Int[Array, "e 2"],
    total: Float[Array, " e"],
    told: Bool[Array, " e"],
    able: Bool[Array, " e"],
    num_scans: int,
) -> Bool[Array, " e"]:
    """Pairs between parts that are each other's best.

    To take few rounds, also those that are half as good, unless they would bring parts
    together in this round that speak more against each other.
    """
    none, support = jnp.zeros(num_scans, total.dtype), jnp.where(able, total, 0)
    best = none.at[ends].max(support[:, None])[ends]
    mutual = (support > 0) & jnp.all(support[:, None] >= best, axis=1)
    good = (support > 0) & jnp.all(2 * support[:, None] >= best, axis=1)
    would = components(ends, good.astype(jnp.float32), num_scans)[ends]
    meets = told & (would[:, 0] == would[:, 1])
    against = none.at[ends].max(jnp.where(meets, -total, 0)[:, None])[ends]
    return mutual | (good & jnp.all(support[:, None] > against, axis=1))


def _across(pairs: Int[Array, "e 2"], part: Int[Array, " v"]) -> Bool[Array, " e"]:
    """Pairs between two parts."""
    return part[pairs[:, 0]] != part[pairs[:, 1]]


def _ends(
    pairs: Int[Array, "e 2"],
    part: Int[Array, " v"],
    counts: Bool[Array, " e"],
    num_scans: int,
) -> Int[Array, "e 2"]:
    """The two parts of each pair; of one that does not count no two."""
    return jnp.where(counts[:, None], part[pairs], num_scans - 1)


def _total(x: Array, same: Joined) -> Array:
    """The sum over the pairs between the same two parts."""
    x = x.astype(jnp.int32) if x.dtype == bool else x
    return jax.ops.segment_sum(x, same.row, len(x))[same.row]


def _confirmed(
    ends: Int[Array, "e 2"], same: Joined, present: Bool[Array, " e"], num_scans: int
) -> Bool[Array, " e"]:
    """Whether two pairs join the same two parts, or pairs three parts in a loop."""
    num = _total(present, same)
    loop = in_loops_of_three(ends, same.first & (num > 0), num_scans)
    return (num >= 2) | (_total(loop, same) > 0)


def _joined(
    part: Int[Array, " v"], ends: Int[Array, "e 2"], join: Bool[Array, " e"]
) -> tuple[Int[Array, " v"], Bool[Array, ""]]:
    """Parts after some of them were joined, and whether any was."""
    new = components(ends, join.astype(jnp.float32), part.shape[0])[part]
    return new, jnp.any(join)
