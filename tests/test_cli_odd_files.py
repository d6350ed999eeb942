"""What a file system can have in the place of a file, and where output can go that takes none: a sentence, exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from equimus_ctrl import presets
from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import LONGEST_WORD, MOST_SAID, ConfigError, one_line
from equimus_ctrl.workflow import listed_scenarios, scenario_names
from equimus_ctrl.workflow.runs import scenario_entry

LONG = "x" * 300
PENDULUM = Path(__file__).resolve().parents[1] / "docs" / "examples" / "pendulum.xml"
HOLD = ("run", "hold", "--model", "pendulum.xml", "--set", "duration=0.1", "--no-figures")


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """The one sentence that a command ends with, in a folder with odd files."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pendulum.xml").write_text(PENDULUM.read_text())
    os.mkfifo("pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "deep.toml").write_text("a = " + "[" * 50_000 + "]" * 50_000)

    def call(*arguments: str) -> str:
        assert main(list(arguments)) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert "Traceback" not in "".join(lines)
        return lines[-1]

    return call


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((*HOLD, "--output", LONG), "File name too long"),
        ((*HOLD, "--record", LONG), "File name too long"),
        (("run", "hold", "--model", f"{LONG}.xml"), "File name too long"),
        (("score", LONG), "File name too long"),
        (("score", "pipe"), "pipe: the file cannot be read (it is a pipe or a device, expected a file)"),
        (("score", "/dev/zero"), "/dev/zero: the file cannot be read (it is a pipe or a device, expected a file)"),
        (("run", "hold", "--model", "pipe"), "pipe: cannot be read (it is a pipe or a device, expected a file)"),
        (("run", "hold", "--model", "/dev/zero"), "/dev/zero: cannot be read (it is a pipe or a device"),
        (("run", "hold", "-c", "pid", "--settings", "/dev/zero"), "/dev/zero: cannot be read (it is a pipe or a device"),
        (("score", "loop"), "ymlink loop"),
        (("run", "hold", "--model", "deep.toml"), "deep.toml: is nested too deeply to be read"),
        ((*HOLD, "--video", "/proc/film.gif"), "/proc: nothing can be written there"),
    ],
)  # fmt: skip
def test_what_is_no_file_is_told(arguments: tuple[str, ...], sentence: str, told: Callable[..., str]) -> None:
    assert sentence in told(*arguments)


def test_a_message_is_one_line_that_somebody_reads() -> None:
    assert one_line(" two\n  lines\tof  words\n") == "two lines of  words"
    assert one_line("a bell \a, a colour \x1b[31m") == "a bell \\x07, a colour \\x1b[31m"
    assert one_line("näher als 1 µm") == "näher als 1 µm"
    long = one_line("begins " + "y" * 6_000_000 + " ends")
    assert len(long) < LONGEST_WORD + 50 and long.startswith("begins ") and long.endswith(" ends")
    assert "… (5999800 characters) …" in long
    words = one_line("begins " + "yes " * 1_000_000 + "ends")
    assert len(words) < MOST_SAID + 50 and words.startswith("begins ") and words.endswith(" ends")
    assert "… (3999011 characters) …" in words


@pytest.mark.slow
def test_output_that_cannot_be_written_is_told(told: Callable[..., str], tmp_path: Path) -> None:
    """Closed, or on a full disk."""
    command = [sys.executable, "-m", "equimus_ctrl", "list", "plants", "--json"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "No space left on device" in done.stderr
    done = subprocess.run(
        f"exec {' '.join(command)} >&-", shell=True, stderr=subprocess.PIPE, text=True, check=False
    )  # fmt: skip
    assert done.returncode == 2 and done.stderr == "equimus-ctrl: standard output is closed; JSON is printed there\n"


def test_scripts_of_a_folder_are_listed_without_being_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenarios").mkdir()
    script = tmp_path / "scenarios" / "anybodys.py"
    script.write_text(
        '"""What it does,\nin two lines.\n\nAnd more."""\nSIZE = -2.5\nopen("ran", "w").close()\n'
        "def build(context, size=SIZE, count: int = 3, name='a', *, twice=2 * SIZE, **joints):\n    pass\n"
    )
    assert main(["list", "scenarios"]) == 0 and "anybodys" in capsys.readouterr().out
    assert "anybodys" in scenario_names()
    (row,) = [row for row in listed_scenarios() if row["name"] == "anybodys"]
    assert row["summary"] == "What it does, in two lines."
    assert row["options"] == {
        "size": -2.5, "count": 3, "name": "a", "twice": "2 * SIZE", "JOINT": "as in the keyframe",
    }  # fmt: skip
    assert not (tmp_path / "ran").exists()
    script.write_text("def build(context:\n")
    with pytest.raises(ConfigError, match=r"scenarios/anybodys.py: is no Python file"):
        listed_scenarios()
    script.write_text('"""From elsewhere."""\nfrom common import build\n')
    assert {"name": "anybodys", "summary": "From elsewhere.", "options": {}} in listed_scenarios()
    script.write_text("SIZE: float = 2.0\ndef build(context=None, size=SIZE, /, odd={(1,): [2]}):\n    pass\n")
    (row,) = [row for row in listed_scenarios() if row["name"] == "anybodys"]
    assert row["options"] == {"size": 2.0, "odd": {(1,): [2]}}


def test_scripts_are_listed_as_they_are_when_they_are_run() -> None:
    rows = {row["name"]: row for row in listed_scenarios()}
    assert len(rows) > 8
    for name in presets.names("scenarios", ".py"):
        entry = scenario_entry(name)
        assert (rows[name]["summary"], rows[name]["options"]) == (entry.summary, entry.options)
