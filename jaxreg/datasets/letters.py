"""Words drawn as points, for the letter search of the PF paper (section 5.1.1).

A letter is a few strokes on a box that is one unit high, each a polyline or an arc of
an ellipse. Points lie on the strokes at an even spacing, several rows wide, as on
letters drawn with a pen. Everything is NumPy on the host and holds no random numbers:
the same letter gives the same points wherever it stands.
"""

import numpy as np


# A stroke is ("line", (x, y), (x, y), ...) or ("arc", centre x, centre y, radius x,
# radius y, first angle, last angle) in degrees, counter-clockwise from the right.
_Stroke = tuple
_S: tuple[_Stroke, ...] = (
    ("arc", 0.30, 0.74, 0.28, 0.26, 30, 270),
    ("arc", 0.30, 0.24, 0.30, 0.24, 90, -150),
)
# Width of the letter and its strokes.
_FONT: dict[str, tuple[float, tuple[_Stroke, ...]]] = {
    "A": (
        0.72,
        (("line", (0, 0), (0.36, 1), (0.72, 0)), ("line", (0.13, 0.36), (0.59, 0.36))),
    ),
    "C": (0.70, (("arc", 0.42, 0.5, 0.42, 0.5, 48, 312),)),
    "E": (
        0.54,
        (
            ("line", (0.54, 1), (0, 1), (0, 0), (0.54, 0)),
            ("line", (0, 0.53), (0.44, 0.53)),
        ),
    ),
    "I": (0.0, (("line", (0, 0), (0, 1)),)),
    "K": (
        0.62,
        (
            ("line", (0, 0), (0, 1)),
            ("line", (0.60, 1), (0, 0.38)),
            ("line", (0.20, 0.59), (0.62, 0)),
        ),
    ),
    "L": (0.52, (("line", (0, 1), (0, 0), (0.52, 0)),)),
    "P": (
        0.58,
        (
            ("line", (0.32, 0.44), (0, 0.44), (0, 1), (0.32, 1)),
            ("line", (0, 0.44), (0, 0)),
            ("arc", 0.32, 0.72, 0.26, 0.28, 90, -90),
        ),
    ),
    "R": (
        0.62,
        (
            ("line", (0.32, 0.46), (0, 0.46), (0, 1), (0.32, 1)),
            ("line", (0, 0.46), (0, 0)),
            ("arc", 0.32, 0.73, 0.26, 0.27, 90, -90),
            ("line", (0.30, 0.46), (0.62, 0)),
        ),
    ),
    "S": (0.60, _S),
    "T": (0.66, (("line", (0, 1), (0.66, 1)), ("line", (0.33, 1), (0.33, 0)))),
    "V": (0.72, (("line", (0, 1), (0.36, 0), (0.72, 1)),)),
}
_HEIGHT = 20.0
_GAP = 0.26  # between letters, in heights
_SPACE = 0.55  # a blank
_LINE = 1.5  # from one base line to the next
_PEN = 0.10  # width of a stroke
_SPACING = 0.05


def word_points(
    text: str, *, height: float = _HEIGHT, spacing: float | None = None
) -> np.ndarray:
    """Points on the strokes of a text, evenly spaced.

    The text starts at the origin, with the base line of its first line along x and y
    up. Points on the edges of strokes lie up to a twentieth of the height outside.

    Args:
        text: letters among A C E I K L P R S T V, blanks, and line feeds.
        height: of a letter, which is the unit of the result.
        spacing: between points along and across the strokes, in the same unit; a
            twentieth of the height by default.

    Returns:
        `(n, 2)` float64 points, letter by letter.

    Raises:
        ValueError: for another character, a text without letters, or a spacing that is
            not between zero and the height.
    """
    spacing = _SPACING * height if spacing is None else spacing
    if not 0 < spacing <= height:
        raise ValueError(
            f"spacing: wanted more than 0, at most the height {height}, found "
            f"{spacing}."
        )
    letters = _places(text)
    drawn = [
        _letter(char, spacing / height) + place
        for char, place in zip(text, letters, strict=True)
        if char in _FONT
    ]
    if not drawn:
        raise ValueError(f"text: wanted at least one letter, found {text!r}.")
    return height * np.concatenate(drawn)


def letter_offset(text: str, index: int, *, height: float = _HEIGHT) -> np.ndarray:
    """Where a letter of a text stands: what to add to the letter drawn alone.

    Args:
        text: as in `word_points`.
        index: of the letter in the text; `text.index("S")`, for instance.
        height: as in `word_points`.

    Returns:
        `(2,)`, such that `word_points(text[index]) + offset` are points of
        `word_points(text)`.
    """
    return height * _places(text)[index]


def _places(text: str) -> np.ndarray:
    """The lower left corner of each character, in heights, `(len(text), 2)`."""
    places, x, y = [], 0.0, 0.0
    for char in text:
        places.append((x, y))
        if char == "\n":
            x, y = 0.0, y - _LINE
        elif char == " ":
            x += _SPACE
        elif char in _FONT:
            x += _FONT[char][0] + _GAP
        else:
            raise ValueError(
                f"text: wanted letters among {' '.join(_FONT)}, blanks and line feeds, "
                f"found {char!r}."
            )
    return np.array(places).reshape(-1, 2)


def _letter(char: str, spacing: float) -> np.ndarray:
    """Points of one letter at the origin, in heights."""
    points = [_pen(_path(stroke), spacing) for stroke in _FONT[char][1]]
    # Where strokes meet, points of the later ones too near to an earlier one go.
    kept = points[0]
    for stroke in points[1:]:
        gap = np.linalg.norm(stroke[:, None] - kept, axis=2).min(axis=1)
        kept = np.concatenate([kept, stroke[gap > 0.7 * spacing]])
    return kept


def _path(stroke: _Stroke) -> np.ndarray:
    """A dense polyline, `(p, 2)`."""
    if stroke[0] == "line":
        return np.array(stroke[1:], dtype=float)
    x, y, radius_x, radius_y, first, last = stroke[1:]
    angle = np.deg2rad(np.linspace(first, last, 181))
    return np.stack([x + radius_x * np.cos(angle), y + radius_y * np.sin(angle)], 1)


def _pen(path: np.ndarray, spacing: float) -> np.ndarray:
    """Rows of points side by side along a path."""
    step = np.diff(path, axis=0)
    length = np.linalg.norm(step, axis=1)
    at = np.concatenate([[0.0], np.cumsum(length)])
    num = max(int(round(at[-1] / spacing)), 1)
    along = np.linspace(0.0, at[-1], num + 1)
    middle = np.stack([np.interp(along, at, path[:, k]) for k in (0, 1)], axis=1)
    piece = np.clip(np.searchsorted(at, along, side="right") - 1, 0, len(length) - 1)
    direction = step[piece] / length[piece, None]
    left = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    rows = max(int(round(_PEN / spacing)), 0)
    across = np.linspace(-_PEN / 2, _PEN / 2, rows + 1) if rows else np.zeros(1)
    return (middle[:, None] + across[None, :, None] * left[:, None]).reshape(-1, 2)
