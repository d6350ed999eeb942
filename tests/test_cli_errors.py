"""Every way of giving the command something wrong ends in one sentence, the right exit code, and nothing written."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from wrong_input import RUN, SCORE, Ran, sentence, snapshot, study

CASES: list[tuple[Sequence[object], str]] = [
    # run: scenarios and their options
    (("run", "hodl"), "there is no scenario 'hodl'; did you mean 'hold'? (known: chirp, commands, foot_circle, hold"),
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
    (("run", "hold", "--set", "duration=-1"), "scenarios/hold.py: duration is -1 s, expected more than 0"),
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
    (
        (*RUN, "--plant", "mojoco"),
        "there is no plant 'mojoco'; did you mean 'mujoco'? (known: hardware, mujoco, replay)",
    ),
    ((*RUN, "--plant", "replay"), "the replay plant plays the scenario's recording, and there is none"),
    ((*RUN, "--noise", "-0.1"), "noise is -0.1 rad or m, expected 0 to 1"),
    ((*RUN, "--noise", "nan"), "noise is nan rad or m, expected 0 to 1"),
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
    (
        ("run", "hold", "--recordings", "nowhere"),
        "--recordings: nowhere does not exist; a folder of recordings belongs",
    ),
    ((*RUN, "--model", "empty.toml"), "empty.toml: is empty; a model file has a morphology, parameters or effects, or"),
    # score
    (("score", "nowhere.csv"), "nowhere.csv: there is no such file"),
    (
        ("score", "nothing"),
        "nothing: there are no recordings in this folder; expected CSV files, one a trial, or files of other formats",
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
    (("autotune-pid", "--candidates", "0"), "study: candidates is 0, expected 1 to 1e+06"),
    (("autotune-pid", "--candidates", "-3"), "study: candidates is -3, expected 1 to 1e+06"),
    (("autotune-pid", "--seed", "-1"), "study: seed is -1, expected at least 0"),
    (
        ("autotune-pid", "--scenario", "hodl"),
        "there is no scenario 'hodl'; did you mean 'hold'? (known: chirp, commands, foot_circle, hold",
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
def test_one_sentence_says_what_is_wrong(arguments: Sequence[object], said: str, run_there: Callable[..., Ran]) -> None:
    found = sentence(run_there(arguments), 2)
    assert said in found


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
def test_wrong_usage_is_one_sentence_and_tells_where_help_is(
    arguments: Sequence[str], said: str, run_there: Callable[..., Ran]
) -> None:
    found = sentence(run_there(arguments), 2)
    assert said in found and found.endswith("--help") and "Value error" not in found


# Exit code 3.


def test_a_diverged_run(run_there: Callable[..., Ran], tmp_path: Path) -> None:
    """Nothing but what it was goes to its folder."""
    found = sentence(run_there((*RUN, "--model", "fast.toml", "--output", tmp_path)), 3)
    assert "the simulation diverged at 0.0" in found and "kPa" in found
    assert [p.name for p in tmp_path.iterdir()] == ["score.json"]


def test_a_diverged_score(run_there: Callable[..., Ran]) -> None:
    assert "good: the simulation of nominal_leg diverged at 0" in sentence(
        run_there((*SCORE, "--model", "fast.toml", "--engine", "mujoco")), 3
    )


def test_nothing_feasible(run_there: Callable[..., Ran], wrong_folder: Path, tmp_path: Path) -> None:
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
    found = sentence(run_there(arguments, {"s.toml": text}), 3)
    assert found.startswith("none of 2 sets of gains is stable and within the limits on every leg; the nearest ")
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["journal.jsonl"]


# Nothing but the sentence, and nothing left behind.


@pytest.mark.parametrize("arguments", [("run", "hodl"), ("score", "nowhere.csv"), ("autotune-pid", "--seed", "-1")])
def test_nothing_but_the_sentence_is_on_standard_error(arguments: Sequence[str], run_there: Callable[..., Ran]) -> None:
    _, _, err = run_there(arguments)
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
def test_these_are_sentences_too(arguments: Sequence[str], said: str, run_there: Callable[..., Ran]) -> None:
    assert said in sentence(run_there(arguments), 2)


def test_a_video_of_no_known_kind_is_refused_before_the_run(run_there: Callable[..., Ran]) -> None:
    found = sentence(run_there(("run", "hold", "--set", "duration=0.2", "--video", "film.avi")), 2)
    assert "film.avi: a video can be written as .mp4 or .gif, not as .avi" in found


IN_TIME: list[tuple[Sequence[object], str]] = [
    (("run", "hodl", "--record", "new"), "there is no scenario 'hodl'"),
    ((*RUN, "-c", "pdi", "--settings", "bad.toml"), "there is no controller 'pdi'; did you mean 'pid'?"),
    ((*RUN, "--video", "plain_file/film.gif"), "plain_file"),
    ((*SCORE, "--rate", "1e12"), "rate"),
    (("autotune-pid", "--study", "s.toml", "--results", "plain_file"), "plain_file"),
    (
        ("autotune-pid", "--study", "s.toml", "--results", "new", "--output", "plain_file/pid.toml"),
        "plain_file/pid.toml",
    ),
]


@pytest.mark.parametrize(("arguments", "said"), IN_TIME, ids=[" ".join(map(str, a)) for a, _ in IN_TIME])
def test_these_are_sentences_in_time(arguments: Sequence[object], said: str, run_there: Callable[..., Ran]) -> None:
    assert said in sentence(run_there(arguments, {"s.toml": study(limits={"overshoot": 9.0, "modulus": 0.99999})}), 2)


# Real processes.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("run", "hodl"), 2, "there is no scenario 'hodl'"),
        (("score", "good.csv", "--model", "fast.toml", "--engine", "mujoco"), 3, "diverged"),
    ],
)
def test_processes_end_with_the_code(arguments: Sequence[str], code: int, said: str, wrong_folder: Path) -> None:
    before = snapshot(wrong_folder)
    entry = "from equimus_ctrl.cli.main import entry; entry()"
    environment = {**os.environ, "EQUIMUS_RECORDINGS": str(wrong_folder / "nothing")}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", entry, *arguments],
        cwd=wrong_folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code and done.stdout == ""
    assert said in done.stderr and "Traceback" not in done.stderr
    assert sum(line.startswith("equimus-ctrl: ") for line in done.stderr.splitlines()) == 1
    assert snapshot(wrong_folder) == before
