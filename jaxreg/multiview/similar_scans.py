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

from typing import NamedTuple

import numpy as np

from jaxreg.multiview.prepared_scans import PreparedScans


# More told a little more, fewer a little less: 128, 256 and 512 were tried.
_WORDS = 512


class Words(NamedTuple):
    """How often scans use some words.

    Attributes:
        vocabulary: `(w, f)` the features that are the words.
        used: `(v, w)` unit vectors; zeros of a scan without local features.
    """

    vocabulary: np.ndarray
    used: np.ndarray


def words_of(scans: PreparedScans, before: Words | None = None) -> Words | None:
    """What each scan says; None if no scan has local features.

    Args:
        scans: prepared scans.
        before: of the first of them, whose words are the words of all.
    """
    described = scans.clouds.as_judged.described
    if described is None:
        return None
    first = 0 if before is None else len(before.used)
    num = scans.num_present - first
    scan, row = np.nonzero(np.asarray(described.mask)[first : first + num])
    features = np.asarray(described.even)[first + scan, row]
    if before is not None:
        more = _used(features, scan, num, before.vocabulary)
        return Words(before.vocabulary, np.concatenate([before.used, more]))
    if not len(scan):
        return None
    drawn = np.random.default_rng(0).permutation(len(scan))[:_WORDS]
    return Words(features[drawn], _used(features, scan, num, features[drawn]))


def _used(
    features: np.ndarray, scan: np.ndarray, num: int, vocabulary: np.ndarray
) -> np.ndarray:
    """How often each of so many scans, whose features these are, uses each word."""
    counts = np.zeros((num, len(vocabulary)))
    if len(scan):
        from scipy.cluster.vq import vq  # at use: a start takes a tenth longer by it

        np.add.at(counts, (scan, vq(features, vocabulary)[0]), 1)
    return np.sqrt(counts / np.maximum(counts.sum(axis=1, keepdims=True), 1))


def most_alike(words: np.ndarray, num: int) -> np.ndarray:
    """`(v, num)` for each scan the others most like it, the most alike first."""
    from scipy.spatial import KDTree  # likewise

    near = np.asarray(KDTree(words).query(words, num + 1)[1])
    own = near == np.arange(len(words))[:, None]
    # Of scans that are equal others may come first, and this one not at all.
    own[~own.any(axis=1), -1] = True
    return near[~own].reshape(len(words), num)
