"""Every way of giving the command something wrong ends in one sentence, the right exit code, and nothing written."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl import presets, recordings
from equimus_ctrl.cli.main import main

Ran = tuple[int, str, str]


CONTROLLERS = """\
import numpy as np

class Fine:
    def init(self, spec, observation):
        return None
    def step(self, observation, reference, state):
        return np.array([1e4, 1e4]), state

class GivesNaN(Fine):
    def step(self, observation, reference, state):
        return np.array([np.nan, 0.0]), state

class WrongShape(Fine):
    def step(self, observation, reference, state):
        return np.zeros(3), state

class Alone(Fine):
    def step(self, observation, reference, state):
        return np.zeros(2)

class Words(Fine):
    def step(self, observation, reference, state):
        return "a lot", state

class NeedsGain(Fine):
    def __init__(self, gain):
        self.gain = gain

class Raises(Fine):
    def step(self, observation, reference, state):
        raise ValueError("boom")

class RaisesAtOnce(Fine):
    def init(self, spec, observation):
        raise ValueError("boom")

class OldStyle(Fine):
    def init(self, spec):
        return None

class Idle:
    pass

def one(observation):
    return np.zeros(2)

number = 3
"""

STUDY: dict[str, Any] = {
    "candidates": 2,
    "objectives": [{"scenario": "hold", "duration": 2.5}],
    "ensemble": {"members": 2, "unseen": 0},
    "search": {
        "kp": {"low": 5.0, "high": 3000.0, "start": 150.0},
        "ki": {"low": 5.0, "high": 5000.0, "start": 200.0},
        "kd": {"low": 0.2, "high": 200.0, "start": 5.0},
        "derivative_time": {"low": 0.005, "high": 0.1, "start": 0.02},
    },
}


def study(**changes: Any) -> str:
    """The small study with some tables changed, a table's keys one by one."""
    data = {
        key: {**STUDY[key], **value} if isinstance(STUDY.get(key), dict) and isinstance(value, dict) else value
        for key, value in {**STUDY, **changes}.items()
    }
    return presets.toml_text(data)


FILES = {
    "mine.py": CONTROLLERS,
    "broken.py": "import no_such_module\n",
    "syntax.py": "def (:\n",
    "no_build.py": "x = 1\n",
    "bad.toml": "a = [\n",
    "latin.toml": b'a = "\xe9"\n',
    "fast.toml": '[parameters]\n"thigh.mass" = 1e-9\n"maa.stiffness" = 1e9\n',
    "header.csv": "a,b\n1,2\n",
    "empty.csv": "",
    "gap.csv": "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n0,0,0,1.5,0\n0.1,0,0,nan,0\n",
    "back.csv": "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n0,0,0,1.5,0\n-0.1,0,0,1.5,0\n",
    "degrees.csv": "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n0,0,0,90,0\n0.1,0,0,90,0\n",
    "high.csv": "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n0,0,60000,1.5,0\n0.1,0,0,1.5,0\n",
    "lame.csv": "time,cmd.maa,cmd.baa,pos.hip\n0,0,0,1.5\n0.1,0,0,1.5\n",
    "recordings/triangle.csv": "a,b\n1,2\n",
    "plain_file": "",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with something wrong of every kind; whoever writes into it is found out."""
    folder = tmp_path_factory.mktemp("errors")
    for name, content in FILES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (folder / "nothing").mkdir()
    pose = eq.Kinematics(eq.nominal_leg()).equilibrium([12e3, 6e3])
    trial = eq.Recording(
        "good",
        np.arange(30) / 60,
        np.tile([12e3, 6e3], (30, 1)),
        np.tile(pose, (30, 1)),
        ("maa", "baa"),
        ("hip", "knee"),
    )
    recordings.write(folder / "good.csv", trial)
    return folder


def snapshot(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b""
        for path in folder.rglob("*")
        if "__pycache__" not in path.parts
    }


@pytest.fixture
def ran(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    """Run the command in that folder; fail where it wrote, printed to standard output or showed a trace."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("EQUIMUS_RECORDINGS", str(folder / "nothing"))
    monkeypatch.setenv("COLUMNS", "100")

    def call(arguments: Sequence[object], texts: dict[str, str] | None = None) -> Ran:
        for name, text in (texts or {}).items():
            (folder / name).write_text(text)
        before = snapshot(folder)
        try:
            code = main([str(argument) for argument in arguments])
            out, err = capsys.readouterr()
            assert snapshot(folder) == before, "something was written"
        finally:
            for path in folder.rglob("*"):
                if path.is_file() and str(path.relative_to(folder)) not in before:
                    path.unlink()
            for name in texts or {}:
                (folder / name).unlink()
        assert out == "" and "Traceback" not in err
        return code, out, err

    return call


def sentence(ran: Ran, code: int) -> str:
    """The one line that says what is wrong; a progress bar may stand before it."""
    assert ran[0] == code, ran[2]
    said = [line for line in ran[2].splitlines() if line.startswith("equimus-ctrl: ")]
    assert len(said) == 1, ran[2]
    rest = [line for line in ran[2].splitlines() if line.strip() and line != said[0] and "left" not in line]
    assert rest == [], "there is more on standard error than the sentence"
    assert ran[2].rstrip("\n").endswith(said[0])
    return said[0].removeprefix("equimus-ctrl: ")


SHORT = ("--no-figures", "--set", "duration=0.2")
RUN = ("run", "hold", *SHORT)
SCORE = ("score", "good.csv")

CASES: list[tuple[Sequence[object], str]] = [
    # run: scenarios and their options
    (("run", "hodl"), "there is no scenario 'hodl'; did you mean 'hold'? (known: chirp, hold, step_release, triangle)"),
    (("run", "hodl", "--output", "new", "--video", "new/film.gif"), "there is no scenario 'hodl'"),
    (("run", "nowhere.py"), "nowhere.py: there is no such file"),
    (("run", "broken.py"), "broken.py: fails when it is loaded: ModuleNotFoundError: No module named 'no_such_module'"),
    (("run", "syntax.py"), "syntax.py: fails when it is loaded: SyntaxError: "),
    (("run", "no_build.py"), "no_build.py: has no function build(context, …) that returns a Scenario"),
    (
        ("run", "hold", "--set", "hpi=3"),
        "hold.py: there is no option 'hpi'; did you mean 'hip'? (known: duration, hip,",
    ),
    (("run", "hold", "--set", "hip=three"), "hold.py: option hip is 'three', expected "),
    (("run", "hold", "--set", "hip"), "--set 'hip': expected key=value, such as duration=10"),
    (("run", "hold", "--set", "=3"), "--set '=3': expected key=value, such as duration=10"),
    (("run", "hold", "--set", "duration=-1"), "scenario hold: duration is -1 s, expected more than 0"),
    (("run", "hold", "--set", "duration=0.001"), "duration is 0.001 s, expected at least one control period of 0.0083"),
    (("run", "chirp", "--set", "mean=45"), "kPa lies outside the range of nominal_leg, 0 to 50 kPa"),
    # run: controllers
    ((*RUN, "-c", "pdi"), "there is no controller 'pdi'; did you mean 'pid'? (known: "),
    ((*RUN, "-c", ""), "there is no controller '' (known: "),
    ((*RUN, "-c", "nowhere.py:X"), "nowhere.py: there is no such file"),
    ((*RUN, "-c", "broken.py:X"), "broken.py: fails when it is loaded: ModuleNotFoundError: No module named 'no_such_"),
    ((*RUN, "-c", "mine.py"), "'mine.py' is neither a known controller nor path/to/file.py:Name"),
    ((*RUN, "-c", "mine.py:Finne"), "mine.py: there is no name 'Finne'; did you mean 'Fine'? (known: Alone, Fine, "),
    ((*RUN, "-c", "mine.py:number"), "mine.py:number: int is neither a class with init and step nor a function"),
    ((*RUN, "-c", "mine.py:Idle"), "mine.py:Idle: Idle is neither a class with init and step nor a function"),
    ((*RUN, "-c", "mine.py:one"), "mine.py:one: a controller function takes (observation, reference) or (observation"),
    ((*RUN, "-c", "mine.py:NeedsGain"), "mine.py:NeedsGain: the class cannot be made without arguments (missing"),
    ((*RUN, "-c", "mine.py:GivesNaN"), "GivesNaN returned [nan  0.] at 0.000 s, expected finite pressures in Pa"),
    ((*RUN, "-c", "mine.py:WrongShape"), "WrongShape returned a command of shape (3,) at 0.000 s, expected one press"),
    ((*RUN, "-c", "mine.py:Alone"), "Alone.step returned array([0., 0.]), expected (command, state)"),
    ((*RUN, "-c", "mine.py:Words"), "Words returned 'a lot' at 0.000 s, expected pressures in Pa"),
    # run: settings
    ((*RUN, "--settings", "nowhere.toml"), "nowhere.toml: there is no such file"),
    ((*RUN, "--settings", "bad.toml"), "bad.toml: is not valid TOML: "),
    ((*RUN, "--settings", "latin.toml"), "latin.toml: cannot be read ("),
    ((*RUN, "--settings", "nothing"), "nothing: cannot be read ("),
    # run: plants, noise, effects, recordings
    ((*RUN, "--plant", "mojoco"), "there is no plant 'mojoco'; did you mean 'mujoco'? (known: mujoco, replay)"),
    ((*RUN, "--plant", "replay"), "the replay plant plays the scenario's recording, and there is none"),
    ((*RUN, "--noise", "-0.1"), "noise is -0.1 rad, expected 0 or more"),
    ((*RUN, "--noise", "nan"), "noise is nan rad, expected 0 or more"),
    ((*RUN, "--effect", "transport_dely:baa:delay=0.1"), "there is no effect 'transport_dely'; did you mean 'transpo"),
    ((*RUN, "--effect", "transport_delay:hip:delay=0.1"), "effect transport_delay: there is no actuator 'hip' (known"),
    ((*RUN, "--effect", "transport_delay:baa"), "effect 'transport_delay:baa': expected name:location:parameter=valu"),
    ((*RUN, "--effect", "transport_delay:baa:delay=x"), "'delay=x' is not parameter=number; expected name:location:p"),
    ((*RUN, "--effect", "transport_delay:baa:delay"), "'delay' is not parameter=number; expected name:location:para"),
    ((*RUN, "--effect", "transport_delay:baa:dely=1"), "effect transport_delay: there is no parameter 'dely'; did yo"),
    ((*RUN, "--effect", "transport_delay:baa:"), "effect transport_delay at 'baa' lacks 'delay' [s]"),
    ((*RUN, "--effect", "transport_delay:baa:delay=-1"), "effect transport_delay at 'baa': delay is -1 s, expected 0"),
    ((*RUN, "--effect", "transport_delay:baa:delay=nan"), "effect transport_delay at 'baa': delay is nan s, expected"),
    (
        ("run", "triangle", "--recordings", "nowhere"),
        "--recordings: nowhere does not exist; a folder of recordings bel",
    ),
    (
        ("run", "triangle", "--recordings", "plain_file"),
        "--recordings: plain_file is not a folder; a folder of recordi",
    ),
    (("run", "triangle", "--recordings", "recordings"), "recordings/triangle.csv, row 1: there is no column 'a' (know"),
    # score
    (("score", "nowhere.csv"), "nowhere.csv: there is no such file"),
    (
        ("score", "nothing"),
        "nothing: there are no CSV files in this folder; recordings, one CSV file a trial, belong in",
    ),
    (("score", "good.csv", "good.csv"), "good.csv: this file is given twice"),
    (("score", "empty.csv"), "empty.csv: the file is empty; a header and rows of numbers belong in it"),
    (("score", "header.csv"), "header.csv, row 1: there is no column 'a' (known: time, cmd.<actuator>, pos.<joint>, "),
    (("score", "gap.csv"), "gap.csv, row 3, column pos.hip: 'nan' is not finite; a finite number belongs there"),
    (
        ("score", "back.csv"),
        "back.csv, row 3, column time: -0.1 s goes back from the 0.0 s of row 2; times must ascend",
    ),
    (("score", "degrees.csv"), "degrees.csv, row 2, column pos.hip: 90 is beyond ±6.9115 rad; this looks like degrees"),
    (("score", "high.csv"), "high.csv, row 2, column cmd.baa: command 60000 Pa is above the range 0..50000 Pa"),
    (
        ("score", "lame.csv"),
        "lame.csv, row 1: column 'pos.knee' is missing, though 'pos.hip' is there; hip and knee be",
    ),
    ((*SCORE, "--engine", "mujoko"), "there is no engine 'mujoko'; did you mean 'mujoco'? (known: mujoco, reduced)"),
    ((*SCORE, "--window", "5", "6"), "good: has no samples between 5 and 6 s; it lasts from 0 to 0.483333 s"),
    ((*SCORE, "--window", "0.4", "0.1"), "good: has no samples between 0.4 and 0.1 s; it lasts from 0 to 0.483333 s"),
    ((*SCORE, "--model", "nowhere.toml"), "nowhere.toml: there is no such file"),
    # autotune-pid
    (("autotune-pid", "--study", "nowhere.toml"), "nowhere.toml: there is no such file"),
    (("autotune-pid", "--study", "bad.toml"), "bad.toml: is not valid TOML: "),
    (("autotune-pid", "--candidates", "0"), "study: candidates is 0, expected at least 1"),
    (("autotune-pid", "--candidates", "-3"), "study: candidates is -3, expected at least 1"),
    (("autotune-pid", "--seed", "-1"), "study: seed is -1, expected at least 0"),
    (
        ("autotune-pid", "--scenario", "hodl"),
        "there is no scenario 'hodl'; did you mean 'hold'? (known: chirp, hold, s",
    ),
    (("autotune-pid", "--model", "nowhere.toml"), "nowhere.toml: there is no such file"),
    # recordings
    (("recordings", "check", "nowhere.csv"), "nowhere.csv: there is no such file"),
    (
        ("recordings", "check", "gap.csv"),
        "gap.csv, row 3, column pos.hip: 'nan' is not finite; a finite number belongs",
    ),
    (
        ("recordings", "import", "back.csv", "-o", "new"),
        "back.csv, row 3, column time: -0.1 s goes back from the 0.0 s",
    ),
    (("recordings", "import", "good.csv", "degrees.csv", "-o", "new"), "degrees.csv, row 2, column pos.hip: 90 is bey"),
    (
        ("recordings", "check", "good.csv", "--command-low", "9", "--command-high", "5"),
        "the lowest command (9 Pa) must",
    ),
]


@pytest.mark.parametrize(("arguments", "said"), CASES, ids=[" ".join(map(str, a)) for a, _ in CASES])
def test_one_sentence_says_what_is_wrong(arguments: Sequence[object], said: str, ran: Callable[..., Ran]) -> None:
    found = sentence(ran(arguments), 2)
    assert said in found


MODELS = {
    'morphology = "nominal_lag"': "there is no morphology 'nominal_lag'; did you mean 'nominal_leg'? (known: ideal",
    "parametres = 3": "there is no key 'parametres'; did you mean 'parameters'? (known: effects, format, m",
    'format = "x/2"': "format is 'x/2', expected 'equimus-ctrl/model/1'",
    "name = 3": "name is 3, expected a text",
    'phase = "swin"': "there is no phase 'swin'; did you mean 'swing'? (known: stance, swing)",
    "morphology = 3": "morphology is 3, expected a name or a table",
    '[morphology]\nname = "x"': "morphology: 'links' is missing",
    "parameters = 3": "parameters: 3 is not a table of numbers",
    "[parameters]\nmaa.stiffness = 3": "parameters: 'maa' is a table; put a dotted name in quotes, such as \"maa.",
    '[parameters]\n"maa.stifness" = 3': "there is no parameter 'maa.stifness'; did you mean 'maa.stiffness'? (known: ",
    '[parameters]\n"maa.stiffness" = -3': "actuator 'maa': stiffness is -3, expected at least 0",
    '[parameters]\n"maa.stiffness" = nan': "actuator 'maa': stiffness is nan, expected a finite number",
    '[parameters]\n"maa.stiffness" = "a"': "parameters: maa.stiffness is 'a', expected a number",
    '[parameters]\n"maa.area" = 0': "actuator 'maa': area is 0, expected more than 0",
    "effects = 3": "effects is 3, expected [[effects]] tables",
    '[[effects]]\nlocation = "baa"': "an [[effects]] table lacks 'effect'",
    '[[effects]]\neffect = "delay"\nlocation = "baa"': "there is no effect 'delay'",
    '[[effects]]\neffect = "transport_delay"\nlocation = "baa"': "effect transport_delay at 'baa' lacks 'delay' [s]",
    '[[effects]]\neffect = "transport_delay"\nlocation = "baa"\ndelay = "a"': "transport_delay: delay is 'a', expected",
    '[[effects]]\neffect = "transport_delay"\nlocation = "baa"\ndelay = 9': "delay is 9 s, expected 0 to 2 s",
    '[[effects]]\neffect = "transport_delay"\nlocation = "hip"\ndelay = 0.1': "there is no actuator 'hip' (known: ",
}


@pytest.mark.parametrize("text", MODELS, ids=lambda text: text.replace("\n", "; "))
@pytest.mark.parametrize("verb", [SCORE, ("run", "hold"), ("autotune-pid",)], ids=lambda verb: verb[0])
def test_a_wrong_model_file(verb: tuple[str, ...], text: str, ran: Callable[..., Ran]) -> None:
    found = sentence(ran((*verb, "--model", "leg.toml"), {"leg.toml": text + "\n"}), 2)
    assert MODELS[text] in found


GAINS = "[gains.maa]\nkp = 1.0\n[gains.baa]\nkp = 1.0\n"
SETTINGS = {
    'format = "x/2"\n' + GAINS: "format is 'x/2', expected 'equimus-ctrl/pid/1'",
    "kp = 3\n" + GAINS: "there is no key 'kp' (known: derivative_time, ",
    "": "there is no [gains.<channel>] table",
    'space = "lenght"\n' + GAINS: "there is no PID space 'lenght'; did you mean 'length'? (known: joint, length)",
    "derivative_time = -1\n" + GAINS: "derivative_time is -1, expected a finite number of at least 0",
    'derivative_time = "a"\n' + GAINS: "derivative_time is 'a', expected a number",
    "feedforward = 1\n" + GAINS: "feedforward is 1, expected true or false",
    GAINS.replace("1.0", "-1", 1): "gains.maa: kp is -1, expected a finite number of at least 0",
    GAINS.replace("kp", "kpp", 1): "gains.maa: there is no key 'kpp'; did you mean 'kp'? (known: kd, ki, kp)",
    GAINS.replace("kp", "ki", 1): "gains.maa: 'kp' is missing",
    GAINS.replace("baa", "bba"): "there is no length channel 'bba'; did you mean 'baa'? (known: baa, maa)",
    GAINS.split("[gains.baa]")[0]: "channel 'baa' has none (given: maa)",
    'space = "joint"\n' + GAINS: "there is no joint channel 'maa' (known: hip, knee)",
}


@pytest.mark.parametrize("text", SETTINGS, ids=lambda text: text.replace("\n", "; "))
def test_a_wrong_settings_file(text: str, ran: Callable[..., Ran]) -> None:
    assert SETTINGS[text] in sentence(ran((*RUN, "--settings", "pid.toml"), {"pid.toml": text}), 2)


STUDIES: list[tuple[dict[str, Any], str]] = [
    ({"format": "x/2"}, "format is 'x/2', expected 'equimus-ctrl/tuning/1'"),
    ({"candidtes": 2}, "study: there is no key 'candidtes'; did you mean 'candidates'? (known: "),
    ({"candidates": 2.5}, "study: candidates is 2.5, expected a whole number"),
    ({"polish": 2}, "study: polish is 2, expected 0 to 0.9"),
    ({"objectives": []}, "a study needs at least one [[objectives]] table"),
    ({"objectives": [{"scenario": "hodl"}]}, "there is no scenario 'hodl'; did you mean 'hold'?"),
    ({"objectives": [{"scenario": "hold", "weight": -1}]}, "objective hold: weight is -1, expected at least 0"),
    ({"ensemble": {"delay": [-0.1, 0.1]}}, "ensemble: delay is -0.1, expected 0 to 2"),
    ({"ensemble": {"delay": [0.2, 0.1]}}, "ensemble: delay is 0.1, expected 0.2 to 2"),
    ({"ensemble": {"stiffness": -0.1}}, "ensemble: stiffness is -0.1, expected 0 to 0.95"),
    ({"ensemble": {"members": 0}}, "ensemble: members is 0, expected at least 1"),
    ({"ensemble": {"noise": -1}}, "ensemble: noise is -1, expected 0 to 0.1"),
    ({"weights": {"error": -1}}, "weights: error is -1, expected at least 0"),
    ({"limits": {"modulus": 2}}, "limits: modulus is 2, expected 0 to 1"),
    (
        {"search": {"kp": {"low": -1, "high": 2, "start": 1}}},
        "search.kp: low -1, start 1, high 2; expected 0 < low ≤ st",
    ),
    ({"search": {"kq": {"low": 1, "high": 2, "start": 1}}}, "search: there is no gain 'kq' (known: derivative_time, k"),
]


@pytest.mark.parametrize(("changes", "said"), STUDIES, ids=[str(changes) for changes, _ in STUDIES])
def test_a_wrong_study(changes: dict[str, Any], said: str, ran: Callable[..., Ran]) -> None:
    assert said in sentence(ran(("autotune-pid", "--study", "s.toml"), {"s.toml": study(**changes)}), 2)


USAGE: list[tuple[Sequence[str], str]] = [
    (("lst",), "Did you mean 'list'?"),
    (("run",), "Missing argument"),
    (("run", "hold", "--contoller", "pid"), "--contoller"),
    (("run", "hold", "--noise", "much"), "--noise"),
    (("run", "hold", "--seed", "1.5"), "--seed"),
    (("score",), "Missing argument"),
    (("score", "good.csv", "--window", "5"), "--window"),
    (("score", "good.csv", "--rate", "x"), "--rate"),
    (("list", "scenarois"), "'scenarios', 'controllers', 'plants'"),
    (("list",), "Missing argument"),
    (("autotune-pid", "--candidates", "many"), "--candidates"),
    (("recordings", "import", "good.csv"), "--output"),
]


@pytest.mark.parametrize(("arguments", "said"), USAGE, ids=[" ".join(arguments) for arguments, _ in USAGE])
def test_wrong_usage_has_its_own_box(arguments: Sequence[str], said: str, ran: Callable[..., Ran]) -> None:
    code, _, err = ran(arguments)
    assert code == 2 and "Error" in err and said in " ".join(err.replace("│", " ").split())


# Exit code 3.


def test_a_diverged_run(ran: Callable[..., Ran]) -> None:
    found = sentence(ran((*RUN, "--model", "fast.toml")), 3)
    assert "the simulation diverged at 0.0" in found and "kPa" in found


def test_a_diverged_score(ran: Callable[..., Ran]) -> None:
    assert "good: the simulation of nominal_leg diverged at 0" in sentence(
        ran((*SCORE, "--model", "fast.toml", "--engine", "mujoco")), 3
    )


def test_nothing_feasible(ran: Callable[..., Ran], folder: Path, tmp_path: Path) -> None:
    """The journal stays, so that a wider search goes on; nothing else is written."""
    text = study(limits={"overshoot": 0.0, "modulus": 0.1})
    arguments = (
        "autotune-pid",
        "--study",
        "s.toml",
        "--results",
        tmp_path / "results",
        "--output",
        tmp_path / "p.toml",
    )
    found = sentence(ran(arguments, {"s.toml": text}), 3)
    assert found.startswith("none of 2 sets of gains is stable and within the limits on every leg; the nearest ")
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["journal.jsonl"]


# Nothing but the sentence, and nothing left behind.


@pytest.mark.parametrize("arguments", [("run", "hodl"), ("score", "nowhere.csv"), ("autotune-pid", "--seed", "-1")])
def test_nothing_but_the_sentence_is_on_standard_error(arguments: Sequence[str], ran: Callable[..., Ran]) -> None:
    _, _, err = ran(arguments)
    assert err.startswith("equimus-ctrl: ") and err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((*RUN, "-c", "mine.py:Raises"), "boom"),
        ((*RUN, "-c", "mine.py:RaisesAtOnce"), "boom"),
        ((*RUN, "-c", "mine.py:OldStyle"), "OldStyle"),
        ((*RUN, "--seed", "-1"), "seed"),
        ((*RUN, "--output", "plain_file"), "plain_file"),
        ((*RUN, "--record", "plain_file"), "plain_file"),
        (("run", "triangle", "--set", "duration=nan"), "duration"),
        (("run", "chirp", "--set", "low=0"), "low"),
        (("run", "step_release", "--set", "maa=nan"), "maa"),
        ((*SCORE, "--rate", "nan"), "rate"),
        ((*SCORE, "--rate", "0"), "rate"),
        ((*SCORE, "--rate", "-5"), "rate"),
        (("autotune-pid", "--workers", "-1"), "workers"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_these_are_sentences_too(arguments: Sequence[str], said: str, ran: Callable[..., Ran]) -> None:
    assert said in sentence(ran(arguments), 2)


def test_a_video_of_no_known_kind_is_refused_before_the_run(ran: Callable[..., Ran]) -> None:
    found = sentence(ran(("run", "hold", "--set", "duration=0.2", "--video", "film.avi")), 2)
    assert "film.avi: a video can be written as .mp4 or .gif, not as .avi" in found


@pytest.mark.parametrize(
    "changes", [{"space": "lenght"}, {"objectives": [{"scenario": "hold", "duration": 0.001}]}], ids=str
)
def test_a_wrong_study_leaves_no_journal(changes: dict[str, Any], ran: Callable[..., Ran]) -> None:
    sentence(ran(("autotune-pid", "--study", "s.toml"), {"s.toml": study(**changes)}), 2)


def test_gains_for_other_channels_name_their_file(ran: Callable[..., Ran]) -> None:
    text = GAINS.replace("baa", "bba")
    assert "pid.toml" in sentence(ran((*RUN, "--settings", "pid.toml"), {"pid.toml": text}), 2)


@pytest.mark.parametrize("more", ['location = "baa"\ndelay = 9', 'location = "hip"\ndelay = 0.1'])
def test_an_effect_of_a_model_file_names_the_file(more: str, ran: Callable[..., Ran]) -> None:
    text = f'[[effects]]\neffect = "transport_delay"\n{more}\n'
    assert "leg.toml" in sentence(ran((*SCORE, "--model", "leg.toml"), {"leg.toml": text}), 2)


OPEN: list[tuple[Sequence[object], str, str]] = [
    (
        ("run", "hodl", "--record", "new"),
        "there is no scenario 'hodl'",
        "the folder is made before the scenario is found",
    ),
    (
        (*RUN, "-c", "pdi", "--settings", "bad.toml"),
        "there is no controller 'pdi'; did you mean 'pid'?",
        "the unknown name is said to take no settings",
    ),
    ((*RUN, "--video", "plain_file/film.gif"), "plain_file", "mkdir's error is handed on bare"),
    ((*SCORE, "--rate", "1e12"), "rate", "numpy's error about memory is handed on bare"),
    (("autotune-pid", "--study", "s.toml", "--results", "plain_file"), "plain_file", "mkdir's error is handed on bare"),
    (
        ("autotune-pid", "--study", "s.toml", "--results", "new", "--output", "plain_file/pid.toml"),
        "plain_file/pid.toml",
        "found out after the search, when the record is written already",
    ),
]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [pytest.param(arguments, said, id=" ".join(map(str, arguments))) for arguments, said, why in OPEN],
)
def test_these_are_sentences_in_time(arguments: Sequence[object], said: str, ran: Callable[..., Ran]) -> None:
    assert said in sentence(ran(arguments, {"s.toml": study(limits={"overshoot": 9.0, "modulus": 0.99999})}), 2)


# Real processes.


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("run", "hodl"), 2, "there is no scenario 'hodl'"),
        (("score", "good.csv", "--model", "fast.toml", "--engine", "mujoco"), 3, "diverged"),
        (("score", "gap.csv"), 2, "gap.csv, row 3, column pos.hip"),
    ],
)
def test_processes_end_with_the_code(arguments: Sequence[str], code: int, said: str, folder: Path) -> None:
    before = snapshot(folder)
    entry = "from equimus_ctrl.cli.main import entry; entry()"
    environment = {**os.environ, "EQUIMUS_RECORDINGS": str(folder / "nothing")}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", entry, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code and done.stdout == ""
    assert said in done.stderr and "Traceback" not in done.stderr
    assert sum(line.startswith("equimus-ctrl: ") for line in done.stderr.splitlines()) == 1
    assert snapshot(folder) == before
