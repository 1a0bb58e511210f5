"""One colour a scan, the same in every file and figure.

By hand: lists of colours end, and Matplotlib's longest one after twenty.
"""

import colorsys

import numpy as np


def scan_colors(num: int) -> np.ndarray:
    """Colours that differ well between neighbours in the list, `(num, 3)` in [0, 1]."""
    golden = 0.6180339887
    rows = [
        colorsys.hsv_to_rgb((0.58 + k * golden) % 1, (0.75, 0.6)[k % 2], 0.86)
        for k in range(num)
    ]
    return np.array(rows).reshape(num, 3)
