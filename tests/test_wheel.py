"""The wheel, ready to publish: built and installed in an environment of its own."""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from collections.abc import Iterator
from email import message_from_bytes
from email.message import Message
from pathlib import Path

import pytest

import jaxreg


ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxreg"


def _run(*words: str | Path, **more: str) -> str:
    """What a command says; it sees nothing of this working tree."""
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(
        words, capture_output=True, text=True, cwd=sys.prefix, env=env | more
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("dist")
    words = "-m pip wheel -q --no-index --no-deps --no-build-isolation -w".split()
    home = {"GITHUB_REPOSITORY": "somebody/jaxreg"}
    _run(sys.executable, *words, folder, ROOT, **home)
    (found,) = folder.iterdir()
    assert found.name == f"jaxreg-{jaxreg.__version__}-py3-none-any.whl"
    return found


@pytest.fixture(scope="module")
def files(wheel: Path) -> Iterator[zipfile.ZipFile]:
    with zipfile.ZipFile(wheel) as archive:
        yield archive


def _metadata(files: zipfile.ZipFile) -> Message:
    (name,) = (x for x in files.namelist() if x.endswith(".dist-info/METADATA"))
    return message_from_bytes(files.read(name))


def test_it_holds_the_package_whole_and_nothing_else(files: zipfile.ZipFile):
    wanted = {
        path.relative_to(ROOT).as_posix()
        for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    found = {name for name in files.namelist() if ".dist-info/" not in name}
    assert found == wanted
    assert any(name.endswith("/licenses/LICENSE") for name in files.namelist())


def test_its_metadata_lead_to_where_it_was_built(files: zipfile.ZipFile):
    told = _metadata(files)
    urls = dict(x.split(", ", 1) for x in told.get_all("Project-URL", []))
    home = "https://github.com/somebody/jaxreg"
    assert urls["Homepage"] == home
    assert urls["Issues"] == f"{home}/issues"
    extras = set(told.get_all("Provides-Extra", []))
    assert {"app", "formats"} <= extras
    # No link of the page that an index makes of the README leads nowhere.
    text = str(told.get_payload())
    assert f"]({home}/raw/HEAD/notebooks/demo.png)" in text
    assert f"]({home}/blob/HEAD/docs/pages/choosing.md)" in text
    assert "](docs/" not in text


def test_it_runs_in_an_environment_of_its_own(wheel: Path, tmp_path: Path):
    builder = venv.EnvBuilder(symlinks=True)
    builder.create(tmp_path)
    context = builder.ensure_directories(tmp_path)
    python = context.env_exe
    pip = sys.executable, "-m", "pip", "--python", python
    _run(*pip, "install", "-q", "--no-index", "--no-deps", wheel)
    # Its dependencies are those of this environment, without what is editable in it.
    site = next(tmp_path.rglob("site-packages"))
    (site / "others.pth").write_text(sysconfig.get_path("purelib"))
    place = _run(python, "-c", "import jaxreg; print(jaxreg.__file__)").strip()
    assert Path(place).resolve().is_relative_to(tmp_path.resolve())
    terminal = Path(context.bin_path) / "jaxreg"
    assert _run(terminal, "--version").strip() == f"jaxreg {jaxreg.__version__}"
    scan = tmp_path / "scan.xyz"
    scan.write_text("0 0 0\n1 0 0\n0 1 0\n0 0 1\n")
    assert "4 points" in _run(terminal, "info", scan)
