"""One colour a scan, the same in every file and figure.

The first ten differ for the colour-blind, too (Petroff 2021, Accessible Color Sequences
for Data Visualization). Such lists end; those behind differ by turns of the hue.
"""

import colorsys

import numpy as np

from jaxreg.io.extras import require


def scan_colors(num: int) -> np.ndarray:
    """Colours that differ well between neighbours in the list, `(num, 3)` in [0, 1].

    Raises:
        MissingExtraError: if matplotlib is not installed.
    """
    matplotlib = require("matplotlib", "A colour for each scan", "app")
    to_rgb = require("matplotlib.colors", "A colour for each scan", "app").to_rgb
    golden = 0.6180339887
    first = [to_rgb(name) for name in matplotlib.color_sequences["petroff10"]]
    rows = [
        colorsys.hsv_to_rgb((0.58 + k * golden) % 1, (0.75, 0.6)[k % 2], 0.86)
        for k in range(len(first), num)
    ]
    return np.array([*first[:num], *rows]).reshape(num, 3)
