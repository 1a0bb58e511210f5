"""Parts that pairs join, against plain loops over pairs of parts."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxreg.multiview.join_parts import confirmed_parts, likeliest_parts


NUM, NUM_PAIRS = 9, 20
_CONFIRMED = jax.jit(confirmed_parts, static_argnums=2)
_LIKELIEST = jax.jit(likeliest_parts, static_argnums=2)
_PAIR = st.tuples(
    st.sampled_from(list(combinations(range(NUM), 2))),
    st.booleans(),  # agrees with the poses
    st.sampled_from([False, False, True]),  # needs no other
    st.integers(-6, 6),  # log odds
)
_PAIRS = st.lists(_PAIR, min_size=NUM_PAIRS, max_size=NUM_PAIRS)


def _arrays(told: list) -> tuple:
    pairs, agrees, strong, odds = map(np.array, zip(*told, strict=True))
    weight = agrees.astype(np.float32)
    return pairs.astype(np.int32), weight, NUM, strong, odds.astype(np.float32)


def _between(told: list, part: list[int]) -> dict[tuple[int, int], list]:
    """What is told between each two parts."""
    out: dict = {}
    for (i, j), *rest in told:
        low, high = sorted((part[i], part[j]))
        if low != high:
            out.setdefault((low, high), []).append(rest)
    return out


def _able(between: dict) -> set[tuple[int, int]]:
    """Two parts that a strong pair, two pairs, or a loop of three parts joins."""
    present = {k for k, rest in between.items() if any(x[0] for x in rest)}
    beside = {k: {a + b - k for a, b in present if k in (a, b)} for k in range(NUM)}
    return {
        (a, b)
        for a, b in present
        if sum(x[0] for x in between[a, b]) >= 2
        or any(x[0] and x[1] for x in between[a, b])
        or beside[a] & beside[b]
    }


def _merged(part: list[int], joins: list[tuple[int, int]]) -> list[int]:
    for _ in range(NUM):
        for a, b in joins:
            low = min(part[a], part[b])
            part = [low if x in (part[a], part[b]) else x for x in part]
    return part


@settings(max_examples=100, deadline=None)
@given(told=_PAIRS)
def test_pairs_that_confirm_each_other_join(told: list):
    part = list(range(NUM))
    while joins := list(_able(_between(told, part))):
        part = _merged(part, joins)
    np.testing.assert_array_equal(_CONFIRMED(*_arrays(told)[:4]), part)


def _best_joins(total: dict, able: set) -> list[tuple[int, int]]:
    """Each other's best, and those half as good that bring nothing worse along."""
    support = {k: total[k] for k in able if total[k] > 0}
    best = [max([x for k, x in support.items() if p in k] + [0]) for p in range(NUM)]
    mutual = [k for k, x in support.items() if x == best[k[0]] == best[k[1]]]
    good = [k for k, x in support.items() if 2 * x >= max(best[k[0]], best[k[1]])]
    would = _merged(list(range(NUM)), good)
    meets = {k: -x for k, x in total.items() if would[k[0]] == would[k[1]]}
    against = [max([x for k, x in meets.items() if p in k] + [0]) for p in range(NUM)]
    quiet = [k for k in good if support[k] > max(against[k[0]], against[k[1]])]
    return sorted({*mutual, *quiet})


@settings(max_examples=200, deadline=None)
@given(told=_PAIRS)
def test_parts_join_where_most_speaks_for_it_of_either(told: list):
    part = list(range(NUM))
    while True:
        between = _between(told, part)
        total = {k: sum(x[2] for x in rest) for k, rest in between.items()}
        joins = _best_joins(total, _able(between))
        if not joins:
            break
        part = _merged(part, joins)
    np.testing.assert_array_equal(_LIKELIEST(*_arrays(told)), part)


@given(_PAIRS)
@settings(deadline=None)
def test_where_every_pair_speaks_for_joining_what_is_confirmed_is_joined(told):
    *arrays, odds = _arrays(told)
    every = _LIKELIEST(*arrays, np.ones_like(odds))
    np.testing.assert_array_equal(every, _CONFIRMED(*arrays))


def test_pairs_that_agree_join_no_parts_of_which_others_say_they_meet_nowhere():
    """Two parts of three scans, and two pairs between them."""
    within = [(i, j) for i, j in combinations(range(6), 2) if (i < 3) == (j < 3)]
    across = [(0, 3), (1, 4), (0, 4), (1, 3), (2, 5)]
    pairs = np.array(within + across, np.int32)
    agrees = np.arange(len(pairs)) < len(within) + 2
    for against, parts in ((0.0, [0] * 6), (-2.0, [0, 0, 0, 3, 3, 3])):
        odds = np.r_[np.full(len(within), 5.0), [2.0, 2.0], np.full(3, against)]
        weight, odds = (jnp.asarray(x, jnp.float32) for x in (agrees, odds))
        strong = np.arange(len(pairs)) < len(within)
        found = likeliest_parts(
            jnp.asarray(pairs), weight, 6, jnp.asarray(strong), odds
        )
        np.testing.assert_array_equal(found, parts)
