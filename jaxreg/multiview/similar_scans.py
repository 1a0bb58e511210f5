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

import numpy as np

from jaxreg.multiview.prepared_scans import PreparedScans


# More told a little more, fewer a little less: 128, 256 and 512 were tried.
_WORDS = 512


def words_of(scans: PreparedScans) -> np.ndarray | None:
    """`(v, w)` how often each scan uses each word, as unit vectors; None if unknown.

    Of a scan without local features zeros, None if no scan has any.

    Args:
        scans: prepared scans.
    """
    described = scans.clouds.as_judged.described
    if described is None:
        return None
    num = scans.num_present
    scan, row = np.nonzero(np.asarray(described.mask)[:num])
    if not len(scan):
        return None
    from scipy.cluster.vq import vq  # at use: a start takes a tenth longer by it

    features = np.asarray(described.even)[scan, row]
    drawn = np.random.default_rng(0).permutation(len(scan))[:_WORDS]
    word, _ = vq(features, features[drawn])
    counts = np.zeros((num, len(drawn)))
    np.add.at(counts, (scan, word), 1)
    return np.sqrt(counts / np.maximum(counts.sum(axis=1, keepdims=True), 1))


def most_alike(words: np.ndarray, num: int) -> np.ndarray:
    """`(v, num)` for each scan the others most like it, the most alike first."""
    from scipy.spatial import KDTree  # likewise

    near = np.asarray(KDTree(words).query(words, num + 1)[1])
    own = near == np.arange(len(words))[:, None]
    # Of scans that are equal others may come first, and this one not at all.
    own[~own.any(axis=1), -1] = True
    return near[~own].reshape(len(words), num)
