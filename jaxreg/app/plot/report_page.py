"""The file: one HTML page that holds its style, its programs and its data."""

import base64
import gzip
import html
import json
from importlib import resources
from pathlib import Path
from typing import Any

from jaxreg.app.result import without_nan
from jaxreg.io.atomic import atomic_write
from jaxreg.io.errors import MissingExtraError


_SCRIPTS = (
    "unpack.js",
    "base.js",
    "view.js",
    "ellipsoids.js",
    "control.js",
    "priors.js",
    "section.js",
    "pairs.js",
    "graph.js",
    "residuals.js",
    "curves.js",
    "tables.js",
)


def write_page(path: str | Path, title: str, data: dict[str, Any]) -> None:
    """Writes the page; it opens from disk and asks the network for nothing.

    Args:
        path: the HTML file; it appears whole or not at all.
        title: of the page, plain text.
        data: what the programs of the page show; numbers that are not finite become
            null.

    Raises:
        InputError: if the file cannot be written.
        MissingExtraError: if plotly is not installed.
    """
    folder = resources.files("jaxreg.app.plot") / "page"
    parts = {
        "TITLE": html.escape(title),
        "STYLE": (folder / "report.css").read_text("utf-8"),
        "PLOTLY": _packed(_plotly()),
        "DATA": _packed(_in_json(data)),
        "PROGRAM": "\n".join((folder / s).read_text("utf-8") for s in _SCRIPTS),
    }
    # Split, not replaced one after another: what is put in is never searched.
    pieces = (folder / "report.html").read_text("utf-8").split("@@")
    text = "".join(parts[p] if k % 2 else p for k, p in enumerate(pieces))
    with atomic_write(path) as file:
        file.write(text)


def _plotly() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ModuleNotFoundError as err:
        raise MissingExtraError("plotly", "The page report.html") from err
    return get_plotlyjs()


def _in_json(data: dict[str, Any]) -> str:
    return json.dumps(without_nan(data), allow_nan=False, separators=(",", ":"))


def _packed(text: str) -> str:
    """Text as gzip in base64: in a page it takes two fifths of the room.

    Nothing in it can end its element; a file may be named `</script>`.
    """
    # Of all levels: a hundredth larger than the best, in half of its time.
    packed = gzip.compress(text.encode(), compresslevel=5, mtime=0)
    return base64.b64encode(packed).decode("ascii")
