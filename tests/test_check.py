"""What recordings could show of a model, beside what small fits find; the command, and where a diagnosis stops."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded
from rich.console import Console

import equimus_ctrl as eq
from equimus_ctrl import recordings as files
from equimus_ctrl import workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.diagnosis.budget import Budget
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.diagnose import with_default_engine
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.scoring import Scoring
from equimus_ctrl.diagnosis.screening import screen
from equimus_ctrl.effects import CoulombFriction, Effect, TransportDelay
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.preflight.information import EffectInformation
from equimus_ctrl.report.check_text import effect_rows, headline, print_check
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.checks import Check
from equimus_ctrl.workflow.prepared import prepared, read_given

ROBOT = MjcfRobot("arm", PENDULUM.format(drive=MOTOR))
MODEL = Model(ROBOT)
EXAMPLE = Path(__file__).resolve().parents[1] / "docs" / "examples"


@lru_cache(maxsize=1)
def runs() -> tuple[Recording, ...]:
    return tuple(recorded(MODEL, seed=3))


@lru_cache(maxsize=1)
def checked() -> Check:
    return workflow.check(runs(), MODEL)


def asked(trials: Any, **options: Any) -> tuple[Data, Any]:
    given = read_given(trials, MODEL, eq.DiagnoseOptions(**options), Budget())
    free, parts, settings = prepared(given, eq.DiagnoseOptions(**options), Budget(), None)
    return with_default_engine(free, parts, settings), settings


def smallest(effect: str, place: str) -> EffectInformation:
    (own,) = [
        e
        for e in checked().information.effects
        if e.smallest.named.effect == effect and e.smallest.named.locations == (place,)
    ]
    return own


def gained(effect: Effect) -> tuple[float, float]:
    """By how much a fit gains with an effect that the recordings have, and what it has to gain."""
    data, _ = asked(recorded(Model(ROBOT, (effect,)), seed=3))
    pool = candidates(MODEL, data.segments)
    (own,) = [c for c in pool if c.effect is type(effect) and c.locations == (effect.location,) and not c.each]
    base = data.base()
    (screened,) = screen(data, base, [own])
    begins = [(theta, base.fit.starts) for theta in screened.begins(data, base, True)]
    found = data.converge(data.coarse_fit(screened.hypothesis, begins, base.noise, 10))
    threshold = Scoring(data, pool, data.policy.applied(SearchSettings())).threshold(own.n_parameters)
    return base.deviance - found.deviance, threshold


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "place", "make"),
    [
        ("coulomb_friction", "hinge", lambda size: CoulombFriction("hinge", size)),
        ("transport_delay", "drive", lambda size: TransportDelay("drive", size)),
    ],
)
def test_an_effect_of_the_smallest_detectable_size_gains_about_what_it_has_to(
    effect: str, place: str, make: Any
) -> None:
    own = smallest(effect, place)
    assert own.possible and own.share < 0.05
    at, threshold = gained(make(own.smallest.size))
    assert 0.5 * threshold < at < 2.0 * threshold
    far_below, _ = gained(make(0.3 * own.smallest.size))
    assert far_below < 0.7 * threshold
    above, _ = gained(make(3.0 * own.smallest.size))
    assert above > 2.0 * threshold


@pytest.mark.slow
def test_what_free_parameters_can_do_shows_at_no_size() -> None:
    """A payload is mass and inertia, which are free."""
    own = smallest("payload_mass", "tip")
    assert not own.possible and own.confounded
    assert "acts like free parameters at tip" in dict(effect_rows(checked().information))["payload mass (mass)"]
    fixed = workflow.check(runs(), MODEL, free=["arm.mass"], budget=20.0)
    shown = [e for e in fixed.information.effects if e.smallest.named.effect == "payload_mass"]
    assert any(e.possible for e in shown), "with the inertia known it shows"


@pytest.mark.slow
def test_least_standard_deviations_are_those_of_fits() -> None:
    """Over recordings that differ by their noise alone."""
    deviations = {own.name: own.deviation for own in checked().information.parameters}
    quiet = [replace(r, position=r.position) for r in recorded(MODEL, seed=3, noise=0.0)]
    found: dict[str, list[float]] = {name: [] for name in deviations}
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        trials = [replace(r, position=r.position + rng.normal(0, 5e-4, r.position.shape)) for r in quiet]
        data, _ = asked(trials)
        fitted = data.base().fit
        for name, value in zip(data.free.names, fitted.theta, strict=True):
            found[name].append(float(value))
    for name, values in found.items():
        assert 0.5 < np.std(values, ddof=1) / deviations[name] < 1.8, name


def test_the_result_tells_itself_in_json_text_and_a_figure() -> None:
    found = checked()
    assert not found.stops
    assert repr(found).startswith("<Check of 3 recordings with arm: 0 stops")
    data = json.loads(json.dumps(found.as_json(), allow_nan=False))
    assert data["schema"] == "equimus-ctrl/check/1" and len(data["recordings"]) == 3
    assert {own["name"] for own in data["parameters"]} == {"arm.mass", "arm.inertia"}
    assert data["intervals"]["share"] == 1.0 and data["not_done"] == []
    assert len(found.figure().axes) == 3
    assert found.information.far < 1.5, "the model is the one that made them"


def test_a_budget_ends_it_and_what_was_not_looked_at_is_told() -> None:
    found = workflow.check(runs(), MODEL, budget=0.05)
    assert found.information.not_done and found.information.parameters
    text = told(found)
    assert "Not looked at in the time (--budget):" in text


def told(found: Any, width: int = 80) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    print_check(console, found)
    return console.export_text()


def widest(text: str) -> int:
    return max(len(line.rstrip()) for line in text.splitlines())


def test_six_joints_fit_into_eighty_columns() -> None:
    links, tails = "", ""
    for k in range(6):
        links += f"""<body pos="0 0 -0.2"><joint name="shoulder_pan_{k}" axis="0 1 0" range="-90 90" damping="0.5"/>
          <inertial mass="0.4" pos="0 0 -0.1" diaginertia="0.01 0.01 0.01"/>"""
        tails += "</body>"
    motors = "".join(f'<motor name="motor_of_{k}" joint="shoulder_pan_{k}"/>' for k in range(6))
    xml = f"<mujoco><worldbody>{links}{tails}</worldbody><actuator>{motors}</actuator></mujoco>"
    robot = MjcfRobot("six", xml)
    t = np.arange(0, 6, 0.01)
    rng = np.random.default_rng(0)
    q = np.column_stack([0.4 * np.sin((1 + 0.3 * k) * t) for k in range(6)]) + rng.normal(0, 1e-3, (len(t), 6))
    u = rng.normal(0, 123.456, (len(t), 6))
    trial = Recording("a_recording_with_a_long_name", t, u, q, robot.actuator_names, robot.joint_names)
    found = workflow.check([trial], Model(robot), quick=True)
    text = told(found)
    assert widest(text) <= 80 and "…\n" not in text
    for name in (*robot.joint_names, *robot.actuator_names):
        assert name in text


def spoilt(name: str) -> list[Recording]:
    step = 2.0 * max(float(r.position.std()) for r in runs())
    change = {
        "noise alone": lambda r: np.random.default_rng(1).normal(0, 1e-3, r.position.shape),
        "coarse": lambda r: np.round(r.position / step) * step,
        "still": lambda r: 0 * r.position,
    }[name]
    return [replace(r, position=change(r)) for r in runs()]


@pytest.mark.parametrize(("name", "said"), [("noise alone", "noise"), ("coarse", "steps"), ("still", "never moves")])
def test_a_diagnosis_stops_where_an_answer_would_mean_nothing(name: str, said: str) -> None:
    with pytest.raises(ConfigError, match=f"{said}.*--anyway goes on all the same"):
        eq.diagnose(spoilt(name), MODEL)
    found = workflow.check(spoilt(name), MODEL, quick=True)
    assert found.stops and found.findings[0].severity == "stop"
    assert "a diagnosis would mean nothing" in headline(found)


def test_negated_commands_stop_and_anyway_goes_on_with_a_note() -> None:
    wrong = [replace(r, command=-r.command) for r in runs()]
    with pytest.raises(ConfigError, match=r"look negated.*--anyway"):
        read_given(wrong, MODEL, eq.DiagnoseOptions(), Budget())
    _, settings = asked(wrong, anyway=True)
    (note,) = [text for text in settings.notes if "--anyway" in text]
    assert note.startswith("Gone on with all the same") and "look negated" in note


def broken(name: str) -> Recording:
    good = runs()[0]
    change: dict[str, Any] = {
        "a position": {"position": np.where(np.arange(400)[:, None] == 7, np.nan, good.position)},
        "a time": {"time": np.where(np.arange(400) == 7, np.nan, good.time)},
        "a command": {"command": np.where(np.arange(400)[:, None] == 7, np.inf, good.command)},
        "all times": {"time": np.full(400, 3.0)},
        "a repeated time": {"time": np.where(np.arange(400) == 7, good.time[6], good.time)},
        "descending times": {"time": good.time[::-1]},
    }
    rows = {"no row": 0, "one row": 1, "two rows": 2, "short": 50}
    if name in rows:
        count = rows[name]
        return replace(good, time=good.time[:count], command=good.command[:count], position=good.position[:count])
    return replace(good, **change[name])


@pytest.mark.parametrize("quick", [True, False])
@pytest.mark.parametrize(
    ("name", "said"),
    [
        *((f"a {what}", "not finite") for what in ("position", "time", "command")),
        ("all times", r"row 2 is stamped 3\.0 s after 3\.0 s .*399 such rows.*must ascend"),
        ("a repeated time", r"row 8 .*1 such row\).*must ascend"),
        ("descending times", "must ascend"),
        *((what, "too short to diagnose") for what in ("no row", "one row", "two rows", "short")),
    ],
)
def test_what_is_no_recording_is_refused_in_a_sentence(name: str, said: str, quick: bool) -> None:
    """Whether or not it is to go on all the same."""
    with pytest.raises(ConfigError, match=said):
        workflow.check([broken(name)], MODEL, quick=quick)
    with pytest.raises(ConfigError, match=said):
        read_given([broken(name)], MODEL, eq.DiagnoseOptions(anyway=True), Budget())


def test_what_does_not_count_does_not_decide_whether_an_answer_means_something() -> None:
    """Commands that are negated before 2 s and behind, and noise alone within 2 s and outside."""
    half = [(r, r.time[:, None] < 2) for r in runs()]
    wrong = [replace(r, command=np.where(early, -1.0, 1.0) * r.command) for r, early in half]
    noise = [replace(r, position=np.where(early, 0.5, r.position)) for r, early in half]
    noise = [
        replace(r, position=r.position + np.random.default_rng(2).normal(0, 1e-3, r.position.shape)) for r in noise
    ]
    for trials, said in ((wrong, "look negated"), (noise, "noise")):
        for window, stops in (((0.0, 1.99), True), ((2.0, 4.0), False)):
            asked = eq.DiagnoseOptions(window=window)
            assert workflow.check(trials, MODEL, window=window, quick=True).stops is stops
            if not stops:
                read_given(trials, MODEL, asked, Budget())
                continue
            with pytest.raises(ConfigError, match=said):
                read_given(trials, MODEL, asked, Budget())


@pytest.mark.parametrize("rows", [1, 2, 9, 59])
def test_too_few_rows_that_count_are_refused(rows: int) -> None:
    window = (1.0, 1.0 + 0.01 * (rows - 0.5))
    with pytest.raises(ConfigError, match=f"has {rows} rows between .* too few to diagnose"):
        workflow.check(runs(), MODEL, window=window, quick=True)
    with pytest.raises(ConfigError, match=f"has {rows} rows between .* too few to diagnose"):
        read_given(runs(), MODEL, eq.DiagnoseOptions(window=window), Budget())


def test_good_recordings_have_no_note_of_it() -> None:
    data, settings = asked(runs())
    assert settings.notes == () and data.free.names == ("arm.mass", "arm.inertia")


def test_fewer_changes_than_parameters_stop() -> None:
    few = [replace(r, position=np.where(r.time[:, None] < 2, 0.0, 0.4)) for r in runs()[:1]]
    given = read_given(few, MODEL, eq.DiagnoseOptions(anyway=True), Budget())
    with pytest.raises(ConfigError, match="change 1 times"):
        prepared(given, eq.DiagnoseOptions(), Budget(), None)


def test_the_command_prints_json_draws_and_ends_with_two_where_it_stops(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = ["--model", str(EXAMPLE / "pendulum.xml")]
    picture = tmp_path / "shows.png"
    good = ["check", str(EXAMPLE / "pendulum"), *model, "--quick", "--json", "--figure", str(picture)]
    assert main(good) == 0
    shown = capsys.readouterr()
    data = json.loads(shown.out)
    assert data["stops"] is False and data["files"] == [str(picture)] and picture.stat().st_size > 10_000
    assert "nothing keeps a diagnosis from meaning something" in " ".join(shown.err.split())
    assert main(good) == 2 and "is there already" in capsys.readouterr().err
    trial = files.read(EXAMPLE / "pendulum" / "run_1.csv", limits=files.Limits.of_mjcf(["hinge"], ["motor"]))
    for k in range(2):
        noise = np.random.default_rng(k).normal(0, 1e-3, trial.position.shape)
        files.write(tmp_path / f"still_{k}.csv", replace(trial, name=f"still_{k}", position=noise))
    still = [str(tmp_path / f"still_{k}.csv") for k in range(2)]
    assert main(["check", *still, *model, "--quick"]) == 2
    assert "a diagnosis would mean nothing" in " ".join(capsys.readouterr().err.split())
    assert main(["diagnose", *still, *model]) == 2
    said = capsys.readouterr().err
    assert "--anyway goes on all the same" in said and "Traceback" not in said


def test_the_command_lists_the_thresholds(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "thresholds", "--json"]) == 0
    names = [row["name"] for row in json.loads(capsys.readouterr().out)["thresholds"]]
    assert "check.coarse" in names and "significance" in names


@pytest.mark.parametrize("folder", ["concealed/open_1", "concealed/open_2", "concealed/open_3", "concealed/open_4"])
def test_recordings_of_legs_are_not_stopped(folder: str, recordings_dir: Path) -> None:
    found = workflow.check(recordings_dir / folder, quick=True)
    assert not found.stops and not found.of("warning")


def test_recordings_of_the_real_leg_are_not_stopped_and_the_cameras_clock_is_told(recordings_dir: Path) -> None:
    folder = recordings_dir / "equimus_leg"
    found = workflow.check([folder / "step_release.csv", folder / "triangle.csv"], quick=True)
    assert not found.stops
    assert {(own.about, own.channel) for own in found.of("warning")} == {("clock", "pos.hip"), ("clock", "pos.knee")}
    # Of most steps both valves open at the same row: whose the motion is nobody knows.
    maa, baa = found.latencies
    assert maa.steps == 5 and 0.015 < maa.low < maa.high < 0.1
    assert baa.steps == 3 and baa.low == 0 and baa.high < 0.12


@pytest.mark.parametrize("folder", ["open_1", "open_2", "open_3", "open_4"])
def test_recordings_of_arms_are_not_stopped(folder: str, recordings_dir: Path) -> None:
    place = recordings_dir / "concealed_robots"
    robot = (place / folder / "ROBOT").read_text(encoding="utf-8").strip()
    model = workflow.load_model(place / "robots" / f"{robot}.xml")
    found = workflow.check(place / folder, model, quick=True)
    assert not found.stops and not found.of("warning")
    assert widest(told(found)) <= 80


def test_options_that_cannot_be_are_refused() -> None:
    with pytest.raises(ConfigError, match="there is no effect"):
        workflow.check(runs(), MODEL, exclude=["cogging"])
    for quick in (True, False):
        for budget in (-1.0, 0.0, float("nan")):
            with pytest.raises(ConfigError, match="expected a time above 0"):
                workflow.check(runs(), MODEL, budget=budget, quick=quick)
    with pytest.raises(ConfigError, match="rows between"):
        workflow.check(runs(), MODEL, window=(90.0, 91.0), quick=True)
