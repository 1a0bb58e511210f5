"""What commands print: help, version, completion, JSON, and what is missing."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import jaxreg
from jaxreg import app
from jaxreg.app.cli.main import main
from jaxreg.app.cli.options import SearchOptions
from jaxreg.app.result import RESULT_FORMAT
from jaxreg.io import MissingExtraError
from tests.app.cli.stand_ins import (
    CLOUD,
    FILES,
    GRAPH,
    POSES,
    fake_reconstruct,
    register_s1_onto_s0,
    save_scans,
    seen_from,
)


SCHEMA = jsonschema.Draft202012Validator(
    json.loads(Path(app.__file__).with_name("result.schema.json").read_text())
)


@pytest.mark.parametrize(
    "command", ["demo", "register", "multiview", "average", "info"]
)
def test_help_tells_the_default_of_every_option(
    capsys: pytest.CaptureFixture[str], command: str
):
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    options = re.findall(r" (--[a-z-]+)(?= )(?:(?! --[a-z]).)*", text.split("exit")[1])
    assert "--json" in options
    assert len(options) == text.split("exit")[1].count("(default: ")


def test_without_a_command_the_help_is_shown(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as caught:
        main([])
    assert caught.value.code == 0
    assert "multiview" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("word", "said"), [("regster", "Did you mean register?"), ("xy", "Commands: demo")]
)
def test_a_command_that_is_none(
    capsys: pytest.CaptureFixture[str], word: str, said: str
):
    assert main([word, "a.ply", "b.ply"]) == 2
    assert said in capsys.readouterr().err


def test_version(capsys: pytest.CaptureFixture[str]):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("jaxreg ")


def test_python_m_jaxreg_is_the_command(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-m", "jaxreg", "multiview", str(tmp_path / "none.ply")],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        timeout=120,
    )
    assert done.returncode == 2
    assert "none.ply: no such file" in done.stderr
    assert "Traceback" not in done.stderr


COMPLETE = """\
source ./completion
function=$(complete -p jaxreg | sed 's/.*-F \\([^ ]*\\).*/\\1/')
try() {
  COMP_WORDS=(jaxreg "$@") COMP_CWORD=$# COMPREPLY=()
  $function jaxreg "${@: -1}" ""
  echo "${COMPREPLY[@]}"
}
try multiv; try average --meth; try average --method c; try multiview a.ply b
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_commands_options_choices_and_files(tmp_path: Path):
    command = [sys.executable, "-m", "jaxreg", "--tyro-print-completion", "bash"]
    script = subprocess.run(
        command, capture_output=True, text=True, cwd=Path(__file__).parents[2]
    )
    assert (script.returncode, script.stderr) == (0, "")
    (tmp_path / "completion").write_text(script.stdout)
    (tmp_path / "bunny.ply").touch()
    done = subprocess.run(
        ["bash", "-c", COMPLETE], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stdout.splitlines() == [
        "multiview",
        "--method",
        "correntropy",
        "bunny.ply",
    ]


def test_quiet_prints_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    assert main(["multiview", *scans, "--quiet"]) == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


@pytest.mark.parametrize("command", ["multiview", "register", "average", "demo"])
def test_json_is_all_that_goes_to_standard_output(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
):
    scans = save_scans(folder)
    (folder / "g.g2o").write_text(GRAPH)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    monkeypatch.setattr(jaxreg, "register", register_s1_onto_s0)
    monkeypatch.setattr(
        "jaxreg.app.cli.demo.sculpture_scans",
        lambda num, seed: ([seen_from(T) for T in POSES], POSES),
    )
    given = {"multiview": scans, "register": scans[1::-1], "average": ["g.g2o"]}
    assert main([command, *given.get(command, []), "--json"]) == 0
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["status"] == "CONVERGED"
    SCHEMA.validate(found)
    assert found == json.loads(Path("jaxreg-out/result.json").read_text())
    assert captured.err == ""


def test_json_of_a_failure_is_still_the_result(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scans = save_scans(folder)[:2]
    fake_reconstruct(monkeypatch, POSES, [True, False])
    assert main(["multiview", *scans, "--json"]) == 3
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["T_world_i"][1] is None
    SCHEMA.validate(found)
    assert "no two scans could be joined" in captured.err


def test_a_missing_extra_is_said_in_two_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(
        "jaxreg.app.cli.main.find_spec", lambda name: None if name == "rich" else name
    )
    assert main(["demo"]) == 2
    message = capsys.readouterr().err
    assert "rich" in message
    assert "pip install 'jaxreg[app]'" in message


def test_without_plotly_the_other_files_are_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def missing() -> str:
        raise MissingExtraError("plotly", "The page report.html")

    scans = save_scans(folder)
    fake_reconstruct(monkeypatch, POSES, [True] * 3)
    monkeypatch.setattr("jaxreg.app.plot.report_page._plotly", missing)
    assert main(["multiview", *scans]) == 0
    assert sorted(os.listdir("jaxreg-out")) == [f for f in FILES if f != "report.html"]
    said = capsys.readouterr().out
    assert "needs the package plotly" in said
    assert "report.html" not in said.split("Written to")[1]


def test_help_and_facts_of_files_load_no_jax(folder: Path):
    np.save(folder / "scan.npy", CLOUD)
    (folder / "a.g2o").write_text(GRAPH)
    facts = ["info", "scan.npy"], ["info", "a.g2o"]
    for words in (["--help"], ["register", "--help"], *facts):
        code = (
            "import contextlib, sys\n"
            "from jaxreg.app.cli.main import main\n"
            f"with contextlib.suppress(SystemExit): main({words})\n"
            "assert not {'jax', 'scipy', 'matplotlib'} & set(sys.modules)"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True
        )
        assert (done.returncode, done.stderr) == (0, ""), words
        assert done.stdout


def test_the_budget_that_help_tells_is_that_of_the_search():
    assert SearchOptions().budget == jaxreg.ParticleFilter().num_prior


def test_the_schema_knows_every_status_and_no_other_format():
    told: Any = SCHEMA.schema
    assert told["$defs"]["status"]["enum"] == [s.name for s in jaxreg.Status]
    assert told["properties"]["format"] == {"const": RESULT_FORMAT}
    assert not SCHEMA.is_valid({"status": "CONVERGED"})


def test_names_of_files_do_not_steer_the_terminal(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    name = "s\x1b[2J\x9b1A.npy"
    np.save(folder / name, seen_from(POSES[0]))
    np.save(folder / "s1.npy", seen_from(POSES[1]))
    monkeypatch.setattr(jaxreg, "register", register_s1_onto_s0)
    assert main(["register", "s1.npy", name]) == 0
    assert main(["info", name]) == 0
    assert main(["multiview", name]) == 2
    told = capsys.readouterr()
    assert not set("\x1b\x9b") & set(told.out + told.err)
    assert "s\\x1b[2J\\x9b1A" in told.out
    assert "s\\x1b[2J\\x9b1A.npy: this is one scan alone" in told.err
