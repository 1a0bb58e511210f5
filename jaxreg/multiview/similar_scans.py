"""Which scans look alike before any pose is known: bags of visual words.

Some local features of all scans are the words, and each feature is read as the nearest
of them; scans that see the same surfaces use the same words. It says no more than whom
to try first. Of the two scans most alike to each of 60 views of a room 72 in 100 share
three tenths with it, of all 25; of 100 views of an object all share more than half.

References: Sivic, Zisserman, Video Google, ICCV 2003 (words; theirs are clusters of
features, which told no more than features drawn at random); Arandjelovic, Zisserman,
Three things everyone should know to improve object retrieval, CVPR 2012 (square roots
of counts).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from jaxreg.cloud import Described, PointCloud
from jaxreg.multiview.method import describes
from jaxreg.multiview.prepared_scans import PreparedScans
from jaxreg.multiview.scan_blocks import ScanBlocks, described
from jaxreg.registrar import AbstractRegistrar


# More told a little more, fewer a little less: 128, 256 and 512 were tried.
_WORDS = 512
# Scans, drawn at random, whose features the words are drawn from. Those of all told no
# more, of 600 views of a room and of 900 scans of 30 streets.
_ASKED = 64
# Scans that are compared with all others at once.
_BLOCK = 512


class Words(NamedTuple):
    """How often scans use some words.

    Attributes:
        vocabulary: `(w, f)` the features that are the words.
        used: `(v, w)` unit vectors; zeros of a scan without local features.
    """

    vocabulary: np.ndarray
    used: np.ndarray


def words_of(
    method: AbstractRegistrar, scans: PreparedScans, before: Words | None = None
) -> Words | None:
    """What each scan says; None if no scan that is asked has local features.

    Where no features are held, as of very many scans, they are made here and let go.

    Args:
        method: of registration.
        scans: prepared scans.
        before: of the first of them, whose words are the words of all.
    """
    if scans.feature_spacing is None or not describes(method, scans.mean.shape[1]):
        return None
    num = scans.num_present
    if before is None:
        vocabulary = _drawn(method, scans)
        if vocabulary is None:
            return None
        before = Words(vocabulary, np.zeros((0, len(vocabulary)), np.float32))

    def used(told: Described) -> np.ndarray:
        return _used(told, before.vocabulary)

    more = _of_features(method, scans, slice(len(before.used), num), used)
    return before._replace(used=np.concatenate([before.used, more]))


def _drawn(method: AbstractRegistrar, scans: PreparedScans) -> np.ndarray | None:
    """`(w, f)` some features of some scans; None if there is none."""
    rng = np.random.default_rng(0)
    asked = np.sort(rng.permutation(scans.num_present)[:_ASKED])
    told = _of_features(method, scans, asked, lambda x: (x.even, x.mask))
    features = told[0][told[1]]
    return features[rng.permutation(len(features))[:_WORDS]] if len(features) else None


def _of_features(
    method: AbstractRegistrar,
    scans: PreparedScans,
    rows: np.ndarray | slice,
    run: Callable[[Described], PyTree],
) -> PyTree:
    """What `run` tells of each of these scans by their features, in NumPy."""
    spacing = scans.feature_spacing
    assert spacing is not None
    some = jax.tree.map(lambda x: np.asarray(x)[rows], scans.clouds)
    num = len(some.mask)

    def of_block(clouds: PointCloud) -> PyTree:
        if clouds.as_judged.described is None:
            clouds = described(method, clouds, spacing)
        told = clouds.as_judged.described
        assert told is not None
        return run(told)

    told = ScanBlocks.of(scans.clouds.points)._replace(num=num).each(of_block, some)
    return jax.tree.map(lambda x: x[:num], told)


def _used(told: Described, vocabulary: np.ndarray) -> np.ndarray:
    """`(b, w)` how often each scan of a block uses each word."""
    from scipy.cluster.vq import vq  # at use: a start takes a tenth longer by it

    scan, row = np.nonzero(np.asarray(told.mask))
    counts = np.zeros((len(told.mask), len(vocabulary)), np.float32)
    if len(scan):
        word, _ = vq(np.asarray(told.even)[scan, row], vocabulary)
        np.add.at(counts, (scan, word), 1)
    return np.sqrt(counts / np.maximum(counts.sum(axis=1, keepdims=True), 1))


def most_alike(
    words: np.ndarray,
    num: int,
    part: np.ndarray | None = None,
    rows: np.ndarray | None = None,
) -> np.ndarray:
    """`(r, num)` for each scan the others most like it, the most alike first.

    Args:
        words: `(v, w)` of all scans.
        num: of others, at most v.
        part: `(v,)` those of the same part come last; None if each is its own.
        rows: `(r,)` whose others are wanted; None for all.
    """
    part = np.arange(len(words)) if part is None else part
    rows = np.arange(len(words)) if rows is None else rows
    out = np.empty((len(rows), num), int)
    for start in range(0, len(rows), _BLOCK):
        ids = rows[start : start + _BLOCK]
        alike = words[ids] @ words.T
        alike[part[ids][:, None] == part] = -1
        near = np.argpartition(-alike, num - 1, axis=1)[:, :num]
        order = np.lexsort((near, -np.take_along_axis(alike, near, axis=1)))
        out[start : start + _BLOCK] = np.take_along_axis(near, order, axis=1)
    return out
