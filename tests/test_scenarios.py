"""One contract over every script in ``scenarios/``, what each of the leg's own must do, and their options."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl import presets, workflow
from equimus_ctrl.scenarios.scenario import build_scenario, option_defaults

NAMES = sorted(presets.names("scenarios", ".py"))
PLAYED = "time,cmd.maa,cmd.baa\n0,0,0\n0.5,9000,3000\n1,9000,3000\n"
"""What the scenario that plays a file is given."""
OWN = ("chirp", "hold", "step_release", "triangle")


@pytest.fixture(scope="module")
def leg() -> eq.Morphology:
    return eq.nominal_leg()


@pytest.fixture(scope="module")
def plant() -> eq.MujocoPlant:
    return eq.MujocoPlant(eq.nominal_model())


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("no_recordings")


@pytest.fixture(scope="module")
def built(leg: eq.Morphology, empty: Path) -> Callable[..., eq.Scenario]:
    """Scenarios by name and folder of recordings, each built once: the references take a moment."""
    done: dict[tuple[str, Path | None], eq.Scenario] = {}

    def get(name: str, recordings: Path | None = None) -> eq.Scenario:
        if (name, recordings) not in done:
            (empty / "played.csv").write_text(PLAYED)
            options = {"file": str(empty / "played.csv")} if name == "commands" else {}
            done[name, recordings] = workflow.load_scenario(name, leg, options=options, recordings=recordings or empty)
        return done[name, recordings]

    return get


@pytest.fixture(params=[False, True], ids=["alone", "with recordings"])
def folder(request: pytest.FixtureRequest) -> Path | None:
    return request.getfixturevalue("leg_dir") if request.param else None


def test_the_scenarios_of_the_leg_are_there() -> None:
    assert set(OWN) <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_contract(name: str, folder: Path | None, built: Callable[..., eq.Scenario], leg: eq.Morphology) -> None:
    scenario = built(name, folder)
    assert scenario.name == name and scenario.summary and "\n" not in scenario.summary
    assert 0 < scenario.duration < math.inf
    for time in (0.0, 1e-9, 0.1, 0.3 * scenario.duration, 0.9 * scenario.duration, scenario.duration, 1e4):
        pose = scenario.reference.position(time)
        assert pose.shape == (2,) and np.isfinite(pose).all(), f"reference at {time} s"
        assert np.all(np.abs(pose) < math.pi)
        if scenario.commands is not None:
            command = scenario.commands.at(time)
            assert command.shape == (2,)
            assert np.all((command >= leg.command_low) & (command <= leg.command_high)), f"command at {time} s"
    assert scenario.controller in ("pid", "open_loop", "sampling")
    if scenario.score_window is not None:
        assert 0 <= scenario.score_window[0] < scenario.score_window[1]
    if scenario.recorded is not None:
        assert scenario.recorded.joints == leg.joint_names and scenario.recorded.actuators == leg.actuator_names
        assert scenario.missing is None
    for key in scenario.published or {}:
        assert key in leg.joint_names


@pytest.mark.parametrize(
    "name",
    [
        *OWN[:3],
        pytest.param("triangle"),
    ],
)
def test_commands_begin_at_zero_or_before(name: str, leg_dir: Path, built: Callable[..., eq.Scenario]) -> None:
    """As ``CommandProfile`` promises; before its first time a profile has nothing to say."""
    commands = built(name, leg_dir).commands
    assert commands is None or commands.times[0] <= 0


@pytest.mark.parametrize("name", NAMES)
def test_the_start_is_valid(
    name: str, folder: Path | None, built: Callable[..., eq.Scenario], plant: eq.MujocoPlant
) -> None:
    scenario = built(name, folder)
    first = plant.reset(scenario.start, 0)
    assert np.isfinite(first.position).all()
    command = np.zeros(2) if scenario.start.command is None else scenario.start.command
    np.testing.assert_array_equal(first.command, command)
    if scenario.start.position is None:
        for _ in range(12):
            later = plant.step(command)
        np.testing.assert_allclose(later.position, first.position, atol=1e-6)


@pytest.mark.parametrize("controller", [None, "pid"], ids=["own controller", "pid"])
@pytest.mark.parametrize("name", NAMES)
def test_it_runs(
    name: str, controller: str | None, folder: Path | None, built: Callable[..., eq.Scenario], plant: eq.MujocoPlant
) -> None:
    scenario = built(name, folder)
    driven = workflow.load_controller(controller or scenario.controller, scenario)
    run = eq.run(plant, driven, scenario.reference, 0.5, start=scenario.start)
    assert run.position.shape == (60, 2) and np.isfinite(run.position).all() and np.isfinite(run.asked).all()


@pytest.mark.parametrize("name", NAMES)
def test_it_is_documented(name: str) -> None:
    build, where = presets.load_scenario(name)
    module = presets.load_script(Path(where))
    assert module.__doc__ and build.__doc__
    assert next(iter(inspect.signature(build).parameters)) == "context"
    defaults = option_defaults(build)
    assert "duration" in defaults
    for key, value in defaults.items():
        assert isinstance(value, bool | int | float | str), f"option {key} has no plain default"


# The leg's own.


def test_the_triangle_open_loop_predicts_the_real_leg(leg_dir: Path) -> None:
    """The published simulation is at 0.0915 and 0.1748 rad of the same recording."""
    done = eq.run_scenario("triangle", recordings=leg_dir)
    assert done.controller == "open_loop" and done.scenario.missing is None
    assert done.score.recorded is not None
    hip, knee = done.score.recorded.rmse
    assert hip == pytest.approx(0.07, abs=0.03) and knee == pytest.approx(0.14, abs=0.03)
    assert hip < 0.0915 and knee < 0.1748
    assert done.scenario.published == {"hip": 0.0915, "knee": 0.1748}
    assert done.score.window[0] == 0.0 and done.score.window[1] == pytest.approx(40.0, abs=0.02)


def test_the_triangle_is_one(built: Callable[..., eq.Scenario]) -> None:
    """The foot's path, worked out on paper, lies on straight lines through the poses the corners' pressures hold."""
    scenario = built("triangle")
    kinematics = eq.Kinematics(eq.nominal_leg())
    pressures = [(6.154, 2.728), (3.757, 7.261), (19.801, 8.520)]
    poses = [kinematics.equilibrium(np.array(p) * 1e3) for p in pressures]

    def foot(q: Any) -> np.ndarray:
        return 0.25 * np.array([math.cos(q[0]) + math.cos(q[0] + q[1]), math.sin(q[0]) + math.sin(q[0] + q[1])])

    corners = [foot(q) for q in poses]
    for time in np.linspace(0.0, 13.0, 131):
        k = int(time // 2.0)
        a, b = corners[k % 3], corners[(k + 1) % 3]
        along = (b - a) / np.linalg.norm(b - a)
        offset = foot(scenario.reference.position(time)) - a
        across = offset - (offset @ along) * along
        assert np.linalg.norm(across) < 2e-5
        assert -1e-6 <= offset @ along <= np.linalg.norm(b - a) + 1e-6
    for k in range(6):
        np.testing.assert_allclose(scenario.reference.position(2.0 * k), poses[k % 3], atol=1e-5)


def test_the_triangle_without_recordings_plays_the_corners_in_the_recorded_order(
    built: Callable[..., eq.Scenario], leg_dir: Path
) -> None:
    alone, recorded = built("triangle"), built("triangle", leg_dir)
    assert alone.commands is not None and recorded.commands is not None
    for time in np.arange(1.0, 39.0, 2.0):
        np.testing.assert_allclose(alone.commands.at(time), recorded.commands.at(time), atol=1.0)
    assert alone.missing is not None and "equimus-ctrl recordings fetch" in alone.missing
    assert "--recordings DIR" in alone.missing and "EQUIMUS_RECORDINGS" in alone.missing


def test_hold_is_the_pose_asked_for(leg: eq.Morphology) -> None:
    scenario = workflow.load_scenario("hold", leg, options={"hip": "80", "knee": "20", "duration": "3"})
    np.testing.assert_allclose(scenario.reference.position(1.0), np.radians([80, 20]))
    assert scenario.step_like and scenario.duration == 3.0 and scenario.controller == "pid"
    assert scenario.start.command is None and scenario.start.position is None


def test_step_release_finds_its_group(leg: eq.Morphology, leg_dir: Path) -> None:
    options = {"maa": "20", "baa": "10"}
    scenario = workflow.load_scenario("step_release", leg, options=options, recordings=leg_dir)
    assert scenario.recorded is not None and scenario.commands is not None
    np.testing.assert_allclose(scenario.recorded.command.max(axis=0), [20e3, 10e3])
    np.testing.assert_allclose(scenario.commands.at(2.0), [20e3, 10e3])
    np.testing.assert_allclose(scenario.commands.at(9.0), 0.0)
    other = workflow.load_scenario("step_release", leg, options={"maa": "21"}, recordings=leg_dir)
    assert other.recorded is None and other.missing is not None
    assert other.missing.startswith("no group of 21/30 kPa was recorded (recorded: ") and "20/10" in other.missing


def test_step_release_steps_and_releases(leg: eq.Morphology, empty: Path) -> None:
    options = {"maa": "12", "baa": "8", "hold": "2", "duration": "4"}
    scenario = workflow.load_scenario("step_release", leg, options=options, recordings=empty)
    assert scenario.commands is not None
    for time, expected in ((0.0, [12e3, 8e3]), (1.99, [12e3, 8e3]), (2.0, [0, 0]), (3.5, [0, 0])):
        np.testing.assert_allclose(scenario.commands.at(time), expected)
    kinematics = eq.Kinematics(leg)
    np.testing.assert_allclose(scenario.reference.position(1.0), kinematics.equilibrium([12e3, 8e3]), atol=1e-8)
    np.testing.assert_allclose(scenario.reference.position(3.0), kinematics.equilibrium([0.0, 0.0]), atol=1e-8)


def test_chirp_sweeps(leg: eq.Morphology, built: Callable[..., eq.Scenario]) -> None:
    """The phase crosses mean upwards once a period; periods go from 1/low down to 1/high."""
    scenario = built("chirp")
    assert scenario.commands is not None
    t, p = scenario.commands.times, scenario.commands.values / 1e3
    assert p.min() >= 3.0 - 1e-9 and p.max() <= 27.0 + 1e-9 and p[:, 0].max() > 26.9 and p[:, 0].min() < 3.1
    rising = t[1:][(p[:-1, 0] < 15.0) & (p[1:, 0] >= 15.0)]
    expected = 0.05 * 20 / math.log(40) * (40 - 1)  # cycles: ∫ 0.05·40^(t/20) dt
    assert abs(len(rising) - expected) <= 1
    assert 1 / (rising[-1] - rising[-2]) == pytest.approx(2.0, rel=0.15)
    start = scenario.reference.position(0.0)
    np.testing.assert_allclose(start, eq.Kinematics(leg).equilibrium([15e3, 15e3]), atol=1e-8)


# Options and robots.


@pytest.mark.parametrize(
    ("name", "options", "sentence"),
    [
        ("hold", {"hpi": "3"}, "there is no option 'hpi'; did you mean 'hip'? (known: duration, hip, keyframe, knee)"),
        ("hold", {"hip": "three"}, "option hip is 'three', expected "),
        ("hold", {"duration": "0"}, "duration is 0 s, expected more than 0, up to 86400"),
        ("hold", {"duration": "-2"}, "duration is -2 s, expected more than 0, up to 86400"),
        ("hold", {"duration": "nan"}, "option duration is 'nan', expected a number"),
        ("hold", {"duration": "inf"}, "duration is inf s, expected more than 0, up to 86400"),
        ("chirp", {"mean": "45"}, "kPa lies outside the range of nominal_leg, 0 to 50 kPa"),
        ("chirp", {"amplitude": "20"}, "kPa lies outside the range of nominal_leg, 0 to 50 kPa"),
        ("step_release", {"maa": "50.1"}, "kPa lies outside the range of nominal_leg, 0 to 50 kPa"),
        ("step_release", {"baa": "-1"}, "kPa lies outside the range of nominal_leg, 0 to 50 kPa"),
    ],
)
def test_a_wrong_option_is_a_sentence(
    name: str, options: dict[str, str], sentence: str, leg: eq.Morphology, empty: Path
) -> None:
    with pytest.raises(eq.ConfigError) as caught:
        workflow.load_scenario(name, leg, options=options, recordings=empty)
    assert sentence in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("triangle", "duration", "nan"),
        ("triangle", "duration", "0"),
        ("triangle", "duration", "-1"),
        ("chirp", "duration", "nan"),
        ("chirp", "duration", "0"),
        ("chirp", "duration", "-1"),
        ("chirp", "low", "0"),
        ("chirp", "low", "-1"),
        ("chirp", "high", "0"),
        ("chirp", "amplitude", "nan"),
        ("chirp", "high", "0.05"),
        ("step_release", "maa", "nan"),
        ("step_release", "hold", "0"),
        ("step_release", "hold", "-1"),
        ("hold", "hip", "nan"),
        ("hold", "knee", "1000"),
    ],
)
def test_an_impossible_option_is_a_sentence(name: str, key: str, value: str, leg: eq.Morphology, empty: Path) -> None:
    with pytest.raises(eq.ConfigError) as caught:
        workflow.load_scenario(name, leg, options={key: value}, recordings=empty)
    assert key in str(caught.value) and value in str(caught.value)


@pytest.mark.parametrize("name", ["foot_circle", "triangle"])
def test_a_foreign_robot_is_refused(name: str, leg: eq.Morphology, empty: Path) -> None:
    foreign = eq.Morphology("arm", leg.links, leg.joints, leg.actuators[:1], leg.foot)
    with pytest.raises(eq.ConfigError) as caught:
        workflow.load_scenario(name, foreign, recordings=empty)
    assert str(caught.value).endswith(
        f": scenario {name} is for a robot with joints hip, knee and actuators maa, baa; arm has hip, knee and maa"
    )


def test_step_release_refuses_a_foreign_robot(leg: eq.Morphology, empty: Path) -> None:
    foreign = eq.Morphology("arm", leg.links, leg.joints, leg.actuators[:1], leg.foot)
    with pytest.raises(eq.ConfigError, match="scenario step_release is for a robot"):
        workflow.load_scenario("step_release", foreign, recordings=empty)


@pytest.fixture
def context(leg: eq.Morphology) -> eq.ScenarioContext:
    return eq.ScenarioContext(leg)


def test_options_are_read_as_the_type_of_their_default(context: eq.ScenarioContext) -> None:
    seen: dict[str, Any] = {}

    def build(context: eq.ScenarioContext, n: int = 3, x: float = 1.0, s: str = "a", b: bool = False) -> eq.Scenario:
        seen.update(n=n, x=x, s=s, b=b)
        return eq.Scenario("s", "", 1.0, eq.HoldReference([1.0, 0.0]))

    assert option_defaults(build) == {"n": 3, "x": 1.0, "s": "a", "b": False}
    build_scenario(build, context, {"n": "5", "x": "2e-3", "s": "7", "b": "Yes"})
    assert seen == {"n": 5, "x": 2e-3, "s": "7", "b": True}
    build_scenario(build, context, {"b": "no"})
    assert seen == {"n": 3, "x": 1.0, "s": "a", "b": False}
    with pytest.raises(eq.ConfigError, match=r"f.py: option n is '2.5', expected int"):
        build_scenario(build, context, {"n": "2.5"}, "f.py")


def _option_of_bool(context: eq.ScenarioContext, b: bool = False) -> eq.Scenario:
    return eq.Scenario("s", "", 1.0, eq.HoldReference([1.0, 0.0]))


def _raises(context: eq.ScenarioContext) -> eq.Scenario:
    raise ValueError("boom")


def _returns_nothing(context: eq.ScenarioContext) -> Any:
    return None


def _asks_for_more(context: eq.ScenarioContext, x: Any) -> eq.Scenario:
    return eq.Scenario("s", "", 1.0, eq.HoldReference([1.0, 0.0]))


def _wrong_size(context: eq.ScenarioContext) -> eq.Scenario:
    return eq.Scenario("s", "", 1.0, eq.HoldReference([1.0]))


@pytest.mark.parametrize(
    ("build", "options"),
    [(_option_of_bool, {"b": "maybe"}), (_raises, {}), (_returns_nothing, {}), (_asks_for_more, {}), (_wrong_size, {})],
)
def test_a_script_at_fault_is_a_sentence(
    build: Callable[..., Any], options: dict[str, str], context: eq.ScenarioContext
) -> None:
    with pytest.raises(eq.EquimusError, match=r"mine\.py"):
        build_scenario(build, context, options, "mine.py")


def test_profiles_are_checked(context: eq.ScenarioContext) -> None:
    profile = context.profile([0.0, 1.0], [[1e3, 2e3], [3e3, 4e3]])
    assert profile.at(-1.0).tolist() == [1e3, 2e3] and profile.at(0.5).tolist() == [1e3, 2e3]
    assert profile.at(1.0).tolist() == profile.at(99.0).tolist() == [3e3, 4e3]
    assert not profile.values.flags.writeable
    with pytest.raises(eq.ConfigError, match="needs 2 commands in each row"):
        context.profile([0.0], [[1e3]])
    with pytest.raises(eq.ConfigError, match=r"baa: a command of 60 kPa lies outside .*, 0 to 50 kPa"):
        context.profile([0.0, 1.0], [[2e3, 3e3], [1e3, 60e3]])
    for times in ([0.0, 0.0], [1.0, 0.0], [0.0], []):
        with pytest.raises(eq.ConfigError):
            context.profile(times, [[1e3, 1e3], [1e3, 1e3]])


@pytest.mark.parametrize(("times", "values"), [([0.0], [[math.nan, 0.0]]), ([0.0, math.nan], [[0.0, 0.0]] * 2)])
def test_profiles_must_be_numbers(context: eq.ScenarioContext, times: list[float], values: list[list[float]]) -> None:
    with pytest.raises(eq.ConfigError):
        context.profile(times, values)


def test_recordings_can_be_asked_for_by_kind(leg_dir: Path, empty: Path) -> None:
    find = workflow.recordings_of(leg_dir)
    assert len(find("triangle")) == 1 and len(find("step_release")) > 10
    assert workflow.recordings_of(empty)("triangle") == ()
