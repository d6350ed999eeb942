"""The command line where all goes well: what it prints where, what it writes, and that its help can be followed."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from rich.console import Console

import equimus_ctrl as eq
from equimus_ctrl import effects, presets, recordings
from equimus_ctrl.cli import autotune
from equimus_ctrl.cli.main import app, main
from equimus_ctrl.controllers.registry import CONTROLLERS
from equimus_ctrl.plants.registry import PLANTS
from equimus_ctrl.workflow.plugins import known


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder of our own, without recordings."""
    (tmp_path / "none").mkdir()
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("EQUIMUS_RECORDINGS", str(tmp_path / "none"))
    monkeypatch.setenv("COLUMNS", "120")
    return tmp_path / "work"


@pytest.fixture
def ran(here: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run the command: (exit code, stdout, stderr)."""

    def call(*arguments: object) -> tuple[int, str, str]:
        code = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return call


def files(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


# Help.


def verbs(command: Any = None, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every verb and every verb under one, with its command."""
    command = command or typer.main.get_command(app)
    for name, inner in getattr(command, "commands", {}).items():
        yield from verbs(inner, (*path, name))
    if not hasattr(command, "commands"):
        yield path, command


VERBS = dict(verbs())
EXAMPLES = [
    (path, line.strip())
    for path, command in VERBS.items()
    for line in (command.help or "").splitlines()
    if line.strip().startswith("equimus-ctrl")
]


def test_the_verbs_are_there() -> None:
    assert {("autotune-pid",), ("run",), ("score",), ("list",), ("recordings", "import")} <= set(VERBS)


@pytest.mark.parametrize("path", VERBS, ids=" ".join)
@pytest.mark.parametrize("option", ["--help", "-h"])
def test_every_verb_has_help_with_examples(path: tuple[str, ...], option: str, ran: Any) -> None:
    code, out, err = ran(*path, option)
    assert code == 0 and err == ""
    assert f"equimus-ctrl {' '.join(path)}" in out and "Examples" in out
    assert "[bold]" not in out and "\x08" not in out
    for paragraph in (VERBS[path].help or "").split("\n\n"):
        assert "\n" not in paragraph or paragraph.lstrip().startswith("\b"), "lines end where the source's do"
    for parameter in VERBS[path].params:
        names = [name for name in getattr(parameter, "opts", []) if name.startswith("--")]
        assert all(name in out for name in names)
        if names:
            assert parameter.help, f"{names} says nothing of itself"


@pytest.mark.parametrize(("path", "line"), EXAMPLES, ids=[line for _, line in EXAMPLES])
def test_every_example_can_be_followed(path: tuple[str, ...], line: str) -> None:
    """Its options exist, and so does what it names that comes with the package."""
    words = shlex.split(line)[1:]
    assert tuple(words[: len(path)]) == path, "the example is of another verb"
    found = VERBS[path].make_context(" ".join(path), words[len(path) :]).params
    scenarios = presets.names("scenarios", ".py")
    for name in [found.get("scenario")] if isinstance(found.get("scenario"), str) else found.get("scenario") or ():
        assert name in scenarios
    before = [(registry, dict(registry)) for registry in known()]
    try:
        eq.load_plugins([Path(__file__).resolve().parents[1] / file for file in found.get("plugins") or ()])
        given = found.get("controller") or ()
        for controller in [given] if isinstance(given, str) else given:
            assert controller in CONTROLLERS or callable(presets.load_object(_from_checkout(controller)))
        assert found.get("plant") is None or found["plant"] in PLANTS
        for text in found.get("effect") or ():
            assert isinstance(effects.parse(text), eq.Effect)
    finally:
        for registry, held in before:
            registry.clear()
            registry.update(held)


def _from_checkout(controller: str) -> str:
    file, _, name = controller.rpartition(":")
    path = presets.find(Path(file).parent.name, Path(file).name)
    assert path is not None, f"{file} is not there"
    return f"{path}:{name}"


def test_every_verb_has_an_example() -> None:
    assert {path for path, _ in EXAMPLES} == set(VERBS)


def test_the_command_alone_shows_its_verbs(ran: Any) -> None:
    _, bare, _ = ran()
    code, out, _ = ran("--help")
    assert code == 0
    for text in (bare, out):
        for path in VERBS:
            assert path[0] in text
    assert "Exit codes" in out and "130" in out


def test_the_version(ran: Any) -> None:
    assert ran("--version") == (0, f"equimus-ctrl {eq.__version__}\n", "")


def test_help_is_quick_because_it_imports_nothing_heavy() -> None:
    heavy = "{'mujoco', 'casadi', 'numba', 'numpy', 'scipy', 'matplotlib', 'control'}"
    code = (
        "import sys; from equimus_ctrl.cli.main import main\n"
        f"for path in {[(), *VERBS]!r}: assert main([*path, '--help']) == 0\n"
        f"print(sorted({heavy} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "[]\n" and done.stdout.count("Usage") == len(VERBS) + 1


# Lists.


def test_lists_for_machines(ran: Any) -> None:
    found = {}
    for kind in ("scenarios", "controllers", "plants", "effects", "models", "thresholds"):
        code, out, err = ran("list", kind, "--json")
        assert code == 0 and err == ""
        (key,) = data = json.loads(out)
        assert key == kind
        found[kind] = {row["name"]: row for row in data[kind]}
        assert all(row["summary"] for row in data[kind])
    assert set(found["controllers"]) == {*CONTROLLERS, "path/to/file.py:Name"}
    assert set(found["plants"]) == set(PLANTS)
    assert set(found["effects"]) == set(effects.REGISTRY)
    assert {"nominal_leg", "ideal_leg"} <= set(found["models"])
    assert found["scenarios"]["hold"]["options"] == {
        "duration": 6.0, "keyframe": "", "JOINT": "as in the keyframe",
    }  # fmt: skip
    assert found["effects"]["transport_delay"]["sits_at"] == ["actuator"]


@pytest.mark.parametrize("kind", ["scenarios", "controllers", "plants", "effects", "models", "thresholds"])
def test_lists_for_people(kind: str, ran: Any) -> None:
    code, out, err = ran("list", kind)
    assert code == 0 and err == ""
    rows = json.loads(ran("list", kind, "--json")[1])[kind]
    for row in rows:
        assert row["name"] in out
    if kind == "effects":
        assert "delay [s] 0 to 2: " in out


def test_a_scenario_of_ones_own_is_listed_and_run(ran: Any, here: Path) -> None:
    (here / "scenarios").mkdir()
    (here / "scenarios" / "mine.py").write_text(
        '"""My own."""\nimport equimus_ctrl as eq\n'
        "def build(context, hip: float = 1.4):\n"
        '    """Angle in rad."""\n'
        '    return eq.Scenario("mine", "my own", 0.2, eq.HoldReference([hip, 0.5]))\n'
    )
    rows = {row["name"]: row for row in json.loads(ran("list", "scenarios", "--json")[1])["scenarios"]}
    assert rows["mine"] == {"name": "mine", "summary": "My own.", "options": {"hip": 1.4}}
    code, out, _ = ran("run", "mine", "--set", "hip=1.5", "--no-figures", "--json")
    assert code == 0 and json.loads(out)["scenario"] == "mine"


# Run.


def test_run_json(ran: Any, here: Path) -> None:
    code, out, err = ran("run", "hold", "--set", "duration=0.3", "--no-figures", "--json", "--seed", "7")
    assert code == 0
    found = json.loads(out)
    assert (found["scenario"], found["controller"], found["recorded"]) == ("hold", "pid", None)
    assert set(found["rmse_rad"]) == {"hip", "knee"} and all(v > 0 for v in found["rmse_rad"].values())
    assert (found["plant"], found["model"], found["seed"], found["files"]) == ("mujoco", "nominal_leg", 7, [])
    assert files(here) == ["results/run/hold-pid/score.json"]
    assert json.loads((here / "results/run/hold-pid/score.json").read_text()) == found
    assert "hold, pid" in err and "RMSE" in err


def test_run_without_json_keeps_standard_output_clean(ran: Any) -> None:
    code, out, err = ran("run", "hold", "--set", "duration=0.2", "--no-figures")
    assert code == 0 and out == "" and "RMSE" in err


def test_without_recordings_the_score_is_missing_and_it_says_how_to_get_them(ran: Any) -> None:
    code, out, err = ran("run", "triangle", "--set", "duration=0.3", "--no-figures", "--json")
    assert code == 0
    found = json.loads(out)
    assert found["recorded"] is None and found["rmse_rad"]["hip"] > 0
    text = " ".join(err.split())
    for part in ("the recordings of the real leg are not here", "equimus-ctrl recordings fetch", "--recordings DIR"):
        assert part in text and part in found["missing"]


def test_what_is_missing_is_said_once(ran: Any) -> None:
    _, _, err = ran("run", "triangle", "--set", "duration=0.3", "--no-figures")
    assert " ".join(err.split()).count("equimus-ctrl recordings fetch") == 1


def test_with_recordings_the_real_leg_is_scored(ran: Any, leg_dir: Path) -> None:
    code, out, err = ran("run", "triangle", "--set", "duration=1.5", "--recordings", leg_dir, "--no-figures", "--json")
    assert code == 0
    found = json.loads(out)
    assert set(found["recorded"]["rmse_rad"]) == {"hip", "knee"} and found["missing"] is None
    assert found["published"] == {"rmse_rad": {"hip": 0.0915, "knee": 0.1748}, "controller": "open_loop"}
    assert found["window_s"] == pytest.approx([0.0, 1.49], abs=0.011)
    assert "0.0915" in err and "0.1748" in err and "recordings fetch" not in err


def test_the_environment_names_recordings_too(ran: Any, leg_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EQUIMUS_RECORDINGS", str(leg_dir))
    _, out, _ = ran("run", "step_release", "--set", "duration=0.3", "--no-figures", "--json")
    assert json.loads(out)["recorded"]["name"].startswith("step_release")


def test_run_draws_and_says_where(ran: Any, here: Path) -> None:
    code, out, err = ran("run", "chirp", "--set", "duration=0.4", "--json", "--output", "out/here")
    assert code == 0
    found = json.loads(out)
    assert found["files"] and all(Path(file).is_file() for file in found["files"])
    assert set(files(here)) == {"out/here/score.json", *found["files"]}
    for file in found["files"]:
        begins = b"time,cmd.maa,cmd.baa,pos.hip" if file.endswith("series.csv") else b"\x89PNG"
        assert Path(file).read_bytes().startswith(begins) and f"wrote {file}" in err


def test_a_run_can_be_recorded_and_scored(ran: Any, here: Path) -> None:
    """The loop closes: what a model with an effect recorded, that model explains and the bare one does not."""
    effect = "transport_delay:baa:delay=0.1"
    options = ["--set", "duration=1.2", "--no-figures", "--effect", effect]
    assert ran("run", "chirp", *options, "--record", "mine/recordings")[0] == 0
    trial = recordings.read(here / "mine" / "recordings" / "chirp.csv")
    assert trial.notes["scenario"] == "chirp" and len(trial.time) == 144
    (here / "late.toml").write_text('[[effects]]\neffect = "transport_delay"\nlocation = "baa"\ndelay = 0.1\n')
    own, bare = (
        json.loads(ran("score", "mine/recordings", "--json", *model)[1])["rmse_rad"]
        for model in (["--model", "late.toml"], [])
    )
    assert max(own.values()) < 3e-5 < 1e-3 < bare["knee"]


def test_a_long_path_stays_on_its_line(ran: Any) -> None:
    folder = "a_rather_long_name_of_a_folder/" * 5 + "out"
    _, _, err = ran("run", "hold", "--set", "duration=0.2", "--no-figures", "--record", folder)
    assert f"wrote {folder}/hold.csv" in err


def test_options_of_run_reach_what_they_name(ran: Any, here: Path) -> None:
    (here / "stiff.toml").write_text('name = "stiff"\n[parameters]\n"maa.stiffness" = 290.0\n')
    (here / "weak.toml").write_text("[gains.maa]\nkp = 1.0\n[gains.baa]\nkp = 1.0\n")
    base = ["run", "hold", "--set", "duration=0.5", "--set", "knee=30", "--no-figures", "--json"]
    figures = [
        json.loads(ran(*base, *more)[1])["rmse_rad"]["knee"]
        for more in (
            [],
            ["--model", "stiff.toml"],
            ["--settings", "weak.toml"],
            ["--noise", "0.003"],
            ["--controller", "open_loop"],
            ["-c", f"{presets.find('controllers', 'example_custom.py')}:Spring"],
            ["--effect", "first_order_lag:maa:time_constant=0.1", "--effect", "transport_delay:baa:delay=0.02"],
        )
    ]
    assert len(set(figures)) == len(figures)


def test_results_of_a_users_controller_have_a_plain_name(ran: Any, here: Path) -> None:
    example = presets.find("controllers", "example_custom.py")
    assert ran("run", "hold", "--set", "duration=0.2", "--no-figures", "-c", f"{example}:Spring")[0] == 0
    assert files(here) == ["results/run/hold-Spring/score.json"]


# Score.


def test_score_json(ran: Any, recordings_dir: Path, here: Path) -> None:
    folder = recordings_dir / "concealed" / "open_1"
    if not folder.is_dir():
        pytest.skip("no concealed recordings here")
    code, out, err = ran("score", folder, "--json")
    assert code == 0
    found = json.loads(out)
    assert set(found["rmse_rad"]) == {"hip", "knee"} and all(v <= 0.0020 for v in found["rmse_rad"].values())
    assert [trial["name"] for trial in found["trials"]] == [f"trial_{k:02d}" for k in range(8)]
    for trial in found["trials"]:
        assert set(trial) >= {"name", "rmse_rad"} and set(trial["rmse_rad"]) == {"hip", "knee"}
    assert "trial_07" in err and files(here) == []


def test_score_for_people_is_on_the_other_output(ran: Any, here: Path) -> None:
    write_trial(here / "a.csv")
    code, out, err = ran("score", "a.csv", "--window", "0.1", "0.3", "--rate", "50", "--engine", "mujoco")
    assert code == 0 and out == "" and "nominal_leg" in err and "hip" in err


def write_trial(path: Path) -> None:
    time = np.arange(60) / 120
    pose = eq.Kinematics(eq.nominal_leg()).equilibrium([12e3, 6e3])
    trial = eq.Recording(
        path.stem, time, np.tile([12e3, 6e3], (60, 1)), np.tile(pose, (60, 1)), ("maa", "baa"), ("hip", "knee")
    )
    recordings.write(path, trial)


# Tuning.


STUDY = {
    "seed": 5,
    "candidates": 3,
    "objectives": [{"scenario": "hold", "duration": 2.5}],
    "limits": {"overshoot": 0.6},
    "ensemble": {"members": 2, "unseen": 1, "delay": [0.0, 0.02], "lag": [0.02, 0.04]},
    "search": {
        "kp": {"low": 5.0, "high": 3000.0, "start": 150.0},
        "ki": {"low": 5.0, "high": 5000.0, "start": 200.0},
        "kd": {"low": 0.2, "high": 200.0, "start": 5.0},
        "derivative_time": {"low": 0.005, "high": 0.1, "start": 0.02},
    },
}


def test_autotune(ran: Any, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    presets.write_text(here / "small.toml", presets.toml_text(STUDY))
    code, out, err = ran("autotune-pid", "--study", "small.toml", "--json")
    assert code == 0, err
    found = json.loads(out)
    assert found["schema"] == "equimus-ctrl/tuning-record/1" and found["reused"] == 0 and "evaluations" not in found
    written = files(here)
    assert {"controllers/pid.toml", "tuning/results/small/record.json", "tuning/results/small/journal.jsonl"} <= set(
        written
    )
    figures = [file for file in written if file.endswith(".png")]
    assert len(figures) >= 3 and all(file.startswith("tuning/results/small/") for file in figures)
    assert {Path(file).resolve() for file in found["files"]} == {
        (here / file).resolve()
        for file in written
        if not file.endswith(("journal.jsonl", "small.toml", "small/pid.toml"))
    }
    for part in ("Gains", "cost", "stable on 1 unseen robots", "Margins", "on the MuJoCo plant"):
        assert part in err
    assert err.count("wrote ") == len(found["files"]) and "left" not in err
    monkeypatch.setattr(autotune, "people", lambda: Console(stderr=True, force_terminal=True, width=120))
    code, out, err = ran("autotune-pid", "--study", "small.toml", "--no-figures", "--json")
    assert code == 0 and json.loads(out)["reused"] == 3
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", err)
    assert "3 evaluations were taken over" in shown
    for part in ("3/3", f"best {found['best']['cost']:.4f}", "left"):
        assert part in shown, "a terminal gets a bar with the best so far and the time left"
    assert json.loads(out)["settings"] == found["settings"]
    code, out, _ = ran("run", "hold", "--set", "duration=0.2", "--no-figures", "--json")
    assert code == 0, "the settings just tuned are those that run takes"


def test_autotune_options(ran: Any, here: Path) -> None:
    presets.write_text(here / "small.toml", presets.toml_text(STUDY))
    code, out, err = ran(
        *("autotune-pid", "--study", "small.toml", "--candidates", 2, "--seed", 8, "--scenario", "hold"),
        *("--output", "mine.toml", "--results", "kept", "--workers", 1, "--no-figures", "--fresh", "--json"),
    )
    assert code == 0, err
    found = json.loads(out)
    assert found["seed"] == 8 and found["evaluated"] == 2
    assert files(here) == ["kept/journal.jsonl", "kept/pid.toml", "kept/record.json", "mine.toml", "small.toml"]
    assert (here / "kept" / "pid.toml").read_text() == (here / "mine.toml").read_text()


CORRECTED = """
morphology = "nominal_leg"

[[effects]]
effect = "dead_zone"
location = "baa"
threshold = 800.0

[[effects]]
effect = "coulomb_friction"
location = "knee"
friction = 0.01

[[effects]]
effect = "sensor_delay"
location = "hip"
delay = 0.02

[[effects]]
effect = "quadratic_drag"
location = "knee"
coefficient = 0.02
"""


def test_autotune_on_a_model_with_effects(ran: Any, here: Path) -> None:
    """Of every side, and one of a user's own."""
    presets.write_text(here / "small.toml", presets.toml_text({**STUDY, "limits": {"overshoot": 0.9}}))
    (here / "corrected.toml").write_text(CORRECTED)
    drag = Path(__file__).resolve().parents[1] / "docs" / "examples" / "drag.py"
    tune = ("autotune-pid", "--study", "small.toml", "--model", "corrected.toml", "--no-figures", "--json")
    code, _, err = ran(*tune)
    assert code == 2 and "there is no effect 'quadratic_drag'" in err
    code, out, err = ran(*tune, "--effects", drag)
    assert code == 0, err
    found = json.loads(out)
    assert [effect["effect"] for effect in found["model"]["effects"]] == re.findall(r'effect = "(\w+)"', CORRECTED)
    assert 0 < found["mujoco"][0]["largest_difference_rad"] < 1e-3
    assert found["settings"]["gains"].keys() == {"maa", "baa"}


# Real processes.


@pytest.mark.slow
def test_the_console_script_prints_json_alone(here: Path) -> None:
    write_trial(here / "a.csv")
    code = "from equimus_ctrl.cli.main import entry; entry()"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, "score", "a.csv", "--json"],
        capture_output=True,
        text=True,
        env={**os.environ, "EQUIMUS_RECORDINGS": ""},
        check=True,
    )
    found = json.loads(done.stdout)
    assert set(found["rmse_rad"]) == {"hip", "knee"} and "nominal_leg" in done.stderr
