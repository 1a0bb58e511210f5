"""Registers pairs of scans round by round, each chosen by what the last ones say."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._core.platforms import platform_of
from jaxreg._core.typing import Key, Progress, Scalar
from jaxreg.averaging import AbstractAverager
from jaxreg.batching.padding import rounded_up
from jaxreg.batching.threads import map_in_threads
from jaxreg.geometry import lie
from jaxreg.multiview.choose_pairs import (
    SAFE,
    Order,
    first_pairs,
    most_pairs,
    next_pairs,
)
from jaxreg.multiview.follow_sequence import (
    SURE,
    descended,
    descended_in_input_frames,
)
from jaxreg.multiview.hold_poses import Held
from jaxreg.multiview.likely_overlap import LikelyOverlap, NearPairs
from jaxreg.multiview.method import min_log_evidence, num_kept
from jaxreg.multiview.place import Placement, place
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.relative_motions import RelativeMotions, relative_motions
from jaxreg.multiview.which_join import joins, likely, strictly
from jaxreg.multiview.workers import Workers
from jaxreg.registrar import AbstractRegistrar


# What a run keeps: motions of pairs as they are found, in the input's frames.
OnPairs = Callable[[RelativeMotions], None]

# Pairs of a batch: few, so that none waits for long, but an accelerator wants more.
_ON_CPU, _ON_ACCELERATOR = 4, 32
_THREADS = 2
# Scans from which on pairs that cannot count are left out of a round's average: it
# takes longer by then than the programs of more sizes take to compile.
_LARGE = 4_000


class Rounds:
    """The pairs that were registered so far, and how to register more.

    Args:
        method, averaging: as in `reconstruct`.
        scans: prepared scans.
        key: of the pairs, and of those drawn at random.
        known: motions that need not be found again, in the scans' centred frames.
        on_pairs: told of every batch, or None.
        report: told of progress.
        workers: who registers pairs; None for threads of this process.
        hold: old frames that stay, or None.
    """

    def __init__(
        self,
        method: AbstractRegistrar,
        averaging: AbstractAverager | None,
        scans: PreparedScans,
        key: Key,
        known: RelativeMotions | None,
        on_pairs: OnPairs | None,
        report: Progress,
        workers: Workers | None = None,
        hold: Held | None = None,
    ) -> None:
        self.workers = workers
        self.method, self.averaging, self.scans = method, averaging, scans
        self.key, self.on_pairs, self.report = key, on_pairs, report
        self.known, self.row = known, {}
        if known is not None:
            self.known = known.with_modes(num_kept(method))
            ids = map(tuple, np.asarray(known.pairs).tolist())
            self.row = {pair: row for row, pair in enumerate(ids)}
        self.hold = hold
        held = None if hold is None else np.asarray(hold.held)
        self.overlaps = LikelyOverlap(scans, held)
        self.found: list[RelativeMotions] = []
        self.sure: dict[tuple[int, int], RelativeMotions] = {}
        self.rivals: dict[tuple[int, int], RelativeMotions] = {}
        self.num, self.most = scans.num_present, most_pairs(scans.num_present)
        here = platform_of(scans) == "cpu"
        self.batch = _ON_CPU if here else _ON_ACCELERATOR

    def run(
        self, order: Order, pairs: np.ndarray | None, words: np.ndarray | None
    ) -> RelativeMotions:
        """All rounds; the motions, in ascending order of the scans.

        Args:
            order: of the scans, see `first_pairs`.
            pairs: of the first round, or None.
            words: which scans look alike, or None (`words_of`).
        """
        bits = np.asarray(jax.random.key_data(self.key)).ravel()
        rng = np.random.default_rng(bits)
        if pairs is None:
            pairs = first_pairs(self.num, order, rng, words)
            if order == "sequential":
                self._follow()
        self.most = max(self.most, len(pairs))
        while len(pairs):
            self._register(pairs)
            if self.num_tried >= self.most:
                break
            placement, tried, trusted, near = self._evidence()
            part = np.asarray(placement.part)[: self.num]
            ids, overlap = np.asarray(near.pairs), np.asarray(near.overlap)
            pairs = next_pairs(tried, trusted, ids, overlap, part, rng, words)
            pairs = pairs[: self.most - self.num_tried]
            if order == "sequential":
                held = np.bincount(tried[trusted].ravel(), minlength=len(part)) >= SAFE
                self._close_loops(pairs, placement, held)
        return RelativeMotions.joined(self.found)

    @property
    def num_rows(self) -> int:
        """For the pairs of all rounds, and one of few numbers."""
        return max(most_pairs(self.scans.num_scans), rounded_up(self.most))

    @property
    def num_tried(self) -> int:
        """Pairs registered or known."""
        return sum(len(x.overlap) for x in self.found)

    def _register(self, pairs: np.ndarray) -> None:
        """The pairs in batches of one compiled size, two batches at a time."""
        total = self.num_tried + len(pairs)
        ids = list(map(tuple, pairs.tolist()))
        have = [self.row[pair] for pair in ids if pair in self.row]
        if self.known is not None and have:
            self.found.append(self.known.on_host(have))
        self.found += [self.sure[pair] for pair in ids if pair in self.sure]
        pairs = pairs[[not self._is_known(pair) for pair in ids]]
        done = total - len(pairs)
        self.report("registering pairs", done, total)
        found: dict[int, RelativeMotions] = {}
        for number, batch in self._searched(pairs):
            start = number * self.batch
            out = batch.on_host(slice(len(pairs) - start))
            rivals = [self.rivals.get(tuple(pair)) for pair in out.pairs.tolist()]
            found[number] = out.or_better(rivals)
            self._tell(found[number])
            done += len(out.overlap)
            self.report("registering pairs", done, total)
        self.found += [found[number] for number in sorted(found)]

    def _searched(self, pairs: np.ndarray) -> Iterator[tuple[int, RelativeMotions]]:
        """Batches of pairs and their numbers as they come; the last is filled up."""
        rows = np.arange(0, len(pairs), self.batch)[:, None] + np.arange(self.batch)
        batches = list(pairs[np.minimum(rows, len(pairs) - 1)])
        if self.workers is not None:
            yield from self.workers.registered(batches)
        elif batches:

            def run(batch: np.ndarray) -> RelativeMotions:
                some, rows = self.scans.of_pairs(batch)
                found = relative_motions(self.method, some, rows, self.key)
                return jax.block_until_ready(found)

            yield from enumerate(map_in_threads(run, batches, _THREADS))

    def _tell(self, found: RelativeMotions) -> None:
        if self.on_pairs is not None:
            self.on_pairs(found.told(self.scans))

    def _follow(self) -> None:
        """Neighbours of a sequence, by descents from the motions before.

        What is sure is known from here on; the rest competes with the search.
        """
        scans, step = self.scans, np.eye(self.scans.mean.shape[1] + 1)
        sure: dict[tuple[int, int], np.ndarray] = {}
        gaps = [(k, k + gap) for gap in (1, 2) for k in range(self.num - gap)]
        for done, (i, j) in enumerate(gaps):
            self.report("following the sequence", done, len(gaps))
            guess = step if j == i + 1 else None
            if guess is None and (i, i + 1) in sure and (i + 1, j) in sure:
                guess = sure[i, i + 1] @ sure[i + 1, j]
            if guess is None:
                continue
            one = descended_in_input_frames(self.method, scans, (i, j), guess)
            # Known pairs are followed, too: a run taken up again goes the same way.
            if self._keep(one, SURE):
                step = sure[i, j] = np.asarray(one.in_input_frames(scans).T_i_j[0, 0])
        self.report("following the sequence", len(gaps), len(gaps))

    def _close_loops(
        self, pairs: np.ndarray, placement: Placement, held: np.ndarray
    ) -> None:
        """Pairs of a sequence by descents from the present poses.

        Where these poses are wrong, what they bring together is no surface twice. A
        descent is one try, where a search has hundreds: of scans that others hold it is
        believed as an answer is. Scans that hang by few pairs need the best there is.
        """
        part = np.asarray(placement.part)
        least = float(min_log_evidence(self.method))
        T = placement.T_world_i
        for done, (i, j) in enumerate(pairs.tolist()):
            if part[i] != part[j] or self._is_known((i, j)):
                continue
            self.report("closing loops", done, len(pairs))
            some, rows = self.scans.of_pairs(np.array([(i, j)], np.int32))
            T_i_j = lie.between(T[i], T[j])
            one = descended(self.method, some, rows, T_i_j[None])
            self._keep(one, least if held[i] and held[j] else SURE)

    def _is_known(self, pair: tuple[int, int]) -> bool:
        return pair in self.row or pair in self.sure

    def _keep(self, one: RelativeMotions, least: float) -> bool:
        """Whether a motion is sure enough to be kept; if not it rivals the search's."""
        i, j = one.pairs[0].tolist()
        if float(one.log_evidence[0, 0]) < least:
            self.rivals[i, j] = one
            return False
        if not self._is_known((i, j)):
            self._tell(one)
            self.sure[i, j] = one.with_modes(num_kept(self.method))
        return True

    def _evidence(self) -> tuple[Placement, np.ndarray, np.ndarray, NearPairs]:
        """Present poses, the pairs tried, those trusted, and those that may overlap."""
        found = RelativeMotions.joined(self.found)
        least = jnp.asarray(min_log_evidence(self.method), self.scans.radius.dtype)
        if self.hold is None:
            placement, trusted = self._placed(found, least)
        else:
            told = found.padded(self.num_rows), self.averaging, least, strictly(least)
            placement = self.hold.place(self.scans, *told)
            trusted = np.asarray(joins(placement.edge_weight))[: len(found.overlap)]
        near = self.overlaps.of(placement, seed=len(trusted))
        return placement, np.asarray(found.pairs), trusted, near

    def _placed(
        self, found: RelativeMotions, least: Scalar
    ) -> tuple[Placement, np.ndarray]:
        """Present poses, and which pairs are trusted."""
        size, rows = self.num_rows, np.arange(len(found.overlap))
        if self.num > _LARGE:
            rows = np.flatnonzero(np.asarray(likely(found, least)).any(axis=1))
            size = rounded_up(len(rows), an_octave=1)
        motions = found.on_host(rows).padded(size)
        told = self.averaging, least, self.scans.count, None, strictly(least)
        placement = place(motions, self.scans.num_scans, *told)
        trusted = np.zeros(len(found.overlap), bool)
        trusted[rows] = np.asarray(joins(placement.edge_weight))[: len(rows)]
        return placement, trusted
