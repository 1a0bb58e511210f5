"""Scans of one surface, of which later ones join a map of the first."""

import numpy as np

from jaxreg.testing.problems import motion, surface


T_WORLD = [motion(3, 0.02 * k, 0.02, k) for k in range(8)]


def _views(num: int) -> list[np.ndarray]:
    """Views of one surface, each a little turned and a little smaller."""
    whole = surface(200 * num, 3, 0)
    views = [(whole[k::num] - x[:3, 3]) @ x[:3, :3] for k, x in enumerate(T_WORLD)]
    # Those of few points that are left are the innermost.
    inside = [np.argsort(np.linalg.norm(x, axis=1)) for x in views]
    some = [
        x[rows[: 200 - 8 * k]]
        for k, (x, rows) in enumerate(zip(views, inside, strict=True))
    ]
    return [x.astype(np.float32) for x in some]


SCANS = _views(8)
