"""What the metadata of a wheel says of the place where the project is at home.

Neither the package nor its README names that place. A build on GitHub is told it by the
environment; then the metadata have its addresses, and relative links of the README
lead there, as on the page of a package index. Elsewhere both are left out.
"""

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


_PLACES = {
    "Homepage": "",
    "Documentation": "/tree/HEAD/docs/pages",
    "Source": "",
    "Changelog": "/blob/HEAD/CHANGELOG.md",
    "Issues": "/issues",
}
_RELATIVE = re.compile(r"(!?\[[^\]]*\]\()(?![a-z]+:|#)([^)]+)\)")


class Home(MetadataHookInterface):
    """Fills `urls` and `readme`."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Of the project table, in place."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        repository = os.environ.get("GITHUB_REPOSITORY")
        metadata["urls"] = {}
        if repository:
            server = os.environ.get("GITHUB_SERVER_URL", "https://github.com")
            home = f"{server}/{repository}"
            metadata["urls"] = {name: home + path for name, path in _PLACES.items()}
            text = _RELATIVE.sub(
                lambda link: f"{link[1]}{home}/{_view(link[1])}/HEAD/{link[2]})", text
            )
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def _view(start: str) -> str:
    """Of a picture its file, of all else the page about it."""
    return "raw" if start.startswith("!") else "blob"
