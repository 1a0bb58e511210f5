"""Runs the notebooks: `python .ci/notebooks.py [--write] [NAME ...]`.

As it stands each runs in this process, with the small sizes that its metadata names
under `jaxreg_quick`, which shows that it runs. With `--write` each runs in a fresh
kernel at its full size, and its outputs are kept; that needs the extra `notebooks`.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any


FOLDER = Path(__file__).parents[1] / "notebooks"


def run_quickly(path: Path) -> None:
    """Runs the code of a notebook, its parameters replaced by the small ones."""
    import matplotlib
    import matplotlib.pyplot as plt

    matplotlib.use("agg")
    plt.show = lambda: plt.close("all")
    document = json.loads(path.read_text(encoding="utf-8"))
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(document["cells"]):
        if cell["cell_type"] != "code":
            continue
        exec(compile("".join(cell["source"]), f"{path.name}[{number}]", "exec"), names)
        if "parameters" in cell["metadata"].get("tags", []):
            exec(document["metadata"].get("jaxreg_quick", ""), names)
        plt.close("all")


def write(path: Path) -> None:
    """Runs a notebook in full and keeps its outputs, but no times or versions."""
    import nbformat
    from nbclient import NotebookClient

    document = nbformat.read(path, as_version=4)
    NotebookClient(document, timeout=600, record_timing=False).execute()
    document["metadata"]["language_info"] = {"name": "python"}
    nbformat.write(document, path)


def main() -> None:
    """Runs those named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="such as 03_averaging")
    parser.add_argument("--write", action="store_true", help="keep the outputs")
    options = parser.parse_args()
    for path in sorted(FOLDER.glob("*.ipynb")):
        if options.names and path.stem not in options.names:
            continue
        begin = time.perf_counter()
        (write if options.write else run_quickly)(path)
        sys.stdout.write(f"{path.name}: {time.perf_counter() - begin:.1f} s\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
