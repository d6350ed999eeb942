"""The README's and the docs' commands and code, run as they stand; what takes long a little shorter."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from equimus_ctrl.cli.main import main

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
INSTALLS = "python3 -m venv"
SHORTER = {
    "autotune-pid": "--candidates 30",
    "run chirp": "--set duration=10",
    "compare": "--set duration=6",
}
"""Verb → options that say the same in less time; the last of an option given twice counts."""


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def commands(text: str) -> list[str]:
    lines = [line for block in blocks(text, "sh") for line in block.splitlines() if line.strip()]
    return [line for line in lines if line.startswith("equimus-ctrl ")]


def arguments(command: str) -> list[str]:
    """What a command of the README is called with."""
    words, said = shlex.split(command)[1:], command.partition(" ")[2]
    more = [options for verb, options in SHORTER.items() if said.startswith(verb) and "duration=" not in said]
    return [*words, *" ".join(more).split()]


def prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in with what a checkout has."""
    for folder in ("controllers", "hardware", "scenarios", "tuning", "docs"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("results", "images"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return prepared(tmp_path, monkeypatch)


def tour() -> tuple[list[str], list[str]]:
    """The README's commands: those before something runs beside them, and the rest, which keep up with a robot's clock."""
    found = commands(README)
    beside = next(k for k, command in enumerate(found) if command.endswith("&"))
    return found[:beside], found[beside:]


@pytest.mark.slow
def test_readme_commands_run_one_after_the_other(workspace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = tour()[0]
    assert len(found) >= 15
    for command in found:
        assert main(arguments(command)) == 0, command
    assert (workspace / "my_pid.toml").is_file()
    assert (workspace / "my_recordings" / "chirp.csv").is_file()
    said = capsys.readouterr().err
    assert "dead zone" in said and "kPa" in said
    assert_the_dead_zone_is_found(workspace / "report")
    # The corrected model reproduces what was recorded, the nominal one does not.
    errors = []
    for model in ([], ["--model", "corrected.toml"]):
        assert main(["score", "concealed", "--json", *model]) == 0
        errors.append(json.loads(capsys.readouterr().out)["rmse_rad"]["knee"])
    nominal, corrected = errors
    assert corrected < 0.0025 < 5 * corrected < nominal


def assert_the_dead_zone_is_found(report: Path) -> None:
    """In the record and on the page of the README's diagnosis."""
    record = json.loads((report / "record.json").read_text())
    assert record["verdict"] == "explained"
    (finding,) = record["findings"]
    assert (finding["effect"], finding["locations"]) == ("dead_zone", ["baa"])
    threshold = finding["parameters"]["threshold"]
    assert threshold["low"] < threshold["value"] < threshold["high"]
    assert threshold["value"] == pytest.approx(4000, rel=0.03)
    page = (report / "report.html").read_text()
    assert page.lower().startswith("<!doctype html>")
    assert "http://" not in page.replace("http://www.w3.org", "") and "dead zone" in page


def test_every_command_is_shortened_that_is_to_be() -> None:
    found = commands(README)
    assert all(any(command.startswith(f"equimus-ctrl {verb}") for command in found) for verb in SHORTER)


def test_format_commands_run(workspace: Path) -> None:
    assert main(shlex.split("equimus-ctrl run chirp --set duration=2 --record my_recordings --no-figures")[1:]) == 0
    for command in commands((ROOT / "docs" / "formats.md").read_text(encoding="utf-8")):
        assert main(shlex.split(command)[1:]) == 0, command


@pytest.mark.slow
def test_commands_for_any_mujoco_model_run(workspace: Path) -> None:
    for command in commands((ROOT / "docs" / "machines.md").read_text(encoding="utf-8")):
        assert main(shlex.split(command)[1:]) == 0, command
    assert (workspace / "corrected.xml").is_file() and (workspace / "free.toml").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("code", blocks(README, "python"))
def test_readme_code_runs(code: str, workspace: Path) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=workspace)
    assert done.returncode == 0, done.stderr


def test_readme_shows_the_example_controller_as_it_is() -> None:
    shown = next(block for block in blocks(README, "python") if "class Spring" in block)
    body = shown[shown.index("class Spring") : shown.index("done =")]
    example = (ROOT / "controllers" / "example_custom.py").read_text(encoding="utf-8")
    for line in body.splitlines():
        assert line in example.splitlines() or not line.strip(), line


def test_ci_calls_the_test_command_of_the_readme() -> None:
    installs = [line for block in blocks(README, "sh") for line in block.splitlines() if line.startswith(INSTALLS)]
    assert len(installs) == 2
    assert installs[0].endswith("equimus-ctrl autotune-pid")
    assert installs[1] in (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()


def test_recording_example_reads(tmp_path: Path) -> None:
    from equimus_ctrl import recordings

    text = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    example = next(block for block in blocks(text, "") if "cmd.maa" in block)
    path = tmp_path / "example.csv"
    path.write_text(example)
    recording = recordings.read(path)
    assert recording.joints == ("hip", "knee")
    assert recording.notes["source"] == "made up"
    assert recording.command_before.tolist() == [0.0, 0.0]


def test_links_of_the_documents_lead_somewhere() -> None:
    for document in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8")):
            assert (document.parent / target).exists(), f"{document.name}: {target}"


def test_constraints_hold_names_and_versions_only() -> None:
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        assert re.fullmatch(r"[A-Za-z0-9_.-]+==[0-9][0-9A-Za-z.+-]*", line), line
