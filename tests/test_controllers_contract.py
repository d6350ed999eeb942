"""What every controller known by name owes its users, and the example with them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from mjcf_models import pendulum

import equimus_ctrl as eq
from equimus_ctrl import presets, workflow
from equimus_ctrl.controllers.registry import CONTROLLERS, make_controller
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.scenario import CommandProfile

EXAMPLE = presets.find("controllers", "example_custom.py")
NAMES = [*CONTROLLERS, f"{EXAMPLE}:Spring", f"{EXAMPLE}:spring"]
DURATION = 0.25


def moving(time: float) -> list[float]:
    return [1.4 + 0.1 * np.sin(3 * time), 0.5 + 0.2 * np.sin(2 * time)]


@pytest.fixture(scope="module")
def scenario() -> eq.Scenario:
    return eq.Scenario(
        "contract", "for these tests", DURATION, eq.FunctionReference(moving), start=eq.Start(command=[14e3, 6e3])
    )


@pytest.fixture(scope="module", params=NAMES, ids=lambda name: name.rpartition("/")[2])
def controller(request: pytest.FixtureRequest, scenario: eq.Scenario) -> Any:
    if request.param in ("nmpc", "sampling"):  # in machine code it does the same, see test_predictive
        return make_controller(request.param, {"compiled": False})
    return workflow.load_controller(request.param, scenario)


@pytest.fixture(scope="module")
def plant() -> eq.MujocoPlant:
    return eq.MujocoPlant(eq.nominal_model(), noise=1e-3)


def drive(plant: eq.Plant, controller: Any, scenario: eq.Scenario, seed: int = 0) -> eq.Run:
    return eq.run(plant, controller, scenario.reference, scenario.duration, start=scenario.start, seed=seed)


def test_the_registry_is_complete() -> None:
    for name, entry in CONTROLLERS.items():
        assert name.isidentifier() and entry.summary and "\n" not in entry.summary
        if entry.settings is not None:
            path = presets.find("controllers", entry.settings)
            assert path is not None, f"controllers/{entry.settings} is missing"
            make_controller(name, presets.read_toml(path), None, str(path))


def test_it_has_the_two_functions_of_the_protocol(controller: Any) -> None:
    assert callable(controller.init) and callable(controller.step)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_on_a_plant_used_before(
    controller: Any, plant: eq.MujocoPlant, scenario: eq.Scenario
) -> None:
    """Everything that evolves is in the state; commands are finite and applied within the range."""
    other = drive(plant, controller, scenario, 6)
    one = drive(plant, controller, scenario, 5)
    two = drive(eq.MujocoPlant(eq.nominal_model(), noise=1e-3), controller, scenario, 5)
    assert np.array_equal(one.command, two.command) and np.array_equal(one.position, two.position)
    assert not np.array_equal(one.position, other.position)
    assert one.asked.shape == one.command.shape == (round(DURATION * 120), 2)
    assert np.isfinite(one.asked).all()
    assert np.all(one.command >= one.spec.command_low) and np.all(one.command <= one.spec.command_high)
    np.testing.assert_array_equal(one.clipped, one.asked != one.command)


def test_a_step_is_a_function_of_its_arguments(controller: Any, plant: eq.MujocoPlant, scenario: eq.Scenario) -> None:
    """Steps asked again from an old state answer the same, so a planner may branch."""
    observation = plant.reset(scenario.start, 1)
    state = controller.init(plant.spec, observation)
    trail = []
    for _ in range(5):
        command, after = controller.step(observation, scenario.reference, state)
        trail.append((observation, state, np.array(command)))
        state, observation = after, plant.step(command)
    for observation, state, command in reversed(trail):
        again, _ = controller.step(observation, scenario.reference, state)
        np.testing.assert_array_equal(again, command)


def test_it_runs_at_other_rates(controller: Any, scenario: eq.Scenario) -> None:
    rates = eq.PlantRates(control=60.0, sensor=240.0, physics=480.0)
    run = drive(eq.MujocoPlant(eq.nominal_model(), rates=rates), controller, scenario)
    assert len(run.time) == round(DURATION * 60) and np.isfinite(run.asked).all()


def test_it_runs_beside_a_recording(controller: Any, scenario: eq.Scenario) -> None:
    time = np.arange(60) / 100
    position = np.array([moving(t) for t in time])
    recording = eq.Recording("made", time, np.full((60, 2), 9e3), position, ("maa", "baa"), ("hip", "knee"))
    run = drive(eq.ReplayPlant(recording, eq.nominal_leg()), controller, scenario)
    assert np.isfinite(run.asked).all() and np.array_equal(run.position[0], position[0])


def test_open_loop_plays_what_it_is_given(plant: eq.MujocoPlant, scenario: eq.Scenario) -> None:
    profile = CommandProfile([0.0, 0.1], [[10e3, 5e3], [12e3, 7e3]])
    run = drive(plant, make_controller("open_loop", commands=profile.at), scenario)
    expected = np.where(run.time[:, None] < 0.1 - 1e-9, [10e3, 5e3], [12e3, 7e3])
    np.testing.assert_array_equal(run.command, expected)


def test_open_loop_falls_back_on_the_static_pressures(plant: eq.MujocoPlant, scenario: eq.Scenario) -> None:
    run = drive(plant, eq.OpenLoopController(), scenario)
    kinematics = eq.Kinematics(eq.nominal_leg())
    expected = [np.clip(kinematics.static_pressure(moving(t)), 0.0, 50e3) for t in run.time]
    np.testing.assert_allclose(run.command, expected, atol=1e-6)


def test_open_loop_needs_something_to_play() -> None:
    spec = eq.PlantSpec(("hip",), ("maa",), np.zeros(1), np.ones(1), 0.01, np.zeros(1), np.ones(1))
    first = eq.Observation(0.0, np.zeros(1), 0.0, np.zeros(1), np.zeros(1, dtype=bool))
    with pytest.raises(eq.ControllerError, match="open loop needs commands to play, or a plant with a nominal model"):
        eq.OpenLoopController().init(spec, first)


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(eq.ControllerError) as caught:
        make_controller("pidd")
    known = ", ".join(sorted(CONTROLLERS))
    assert str(caught.value) == f"there is no controller 'pidd'; did you mean 'pid'? (known: {known})"


def test_a_pid_without_settings_places_its_gains() -> None:
    made = make_controller("pid", None, None, "pid")
    assert isinstance(made, eq.PidController) and made.settings is None


def test_the_pid_holds_a_pose_better_than_open_loop() -> None:
    """On a leg that is not the nominal one, feedback must be worth something."""
    other = eq.nominal_leg().with_parameters({"baa.area": 0.00036, "maa.stiffness": 240.0})
    held = eq.Scenario("hold", "", 3.0, eq.HoldReference([1.4, 0.5]), start=eq.Start(command=[14e3, 6e3]))
    errors = {}
    for name in ("open_loop", "pid"):
        plant = eq.MujocoPlant(eq.Model(other), nominal=eq.nominal_leg())
        run = drive(plant, workflow.load_controller(name, held), held)
        errors[name] = np.abs(run.position[-60:] - [1.4, 0.5]).max()
    assert errors["pid"] < 0.25 * errors["open_loop"]


def test_the_lqr_needs_no_settings_and_holds_a_pose_of_a_leg_it_does_not_know() -> None:
    other = eq.nominal_leg().with_parameters({"baa.area": 0.00036, "maa.stiffness": 240.0})
    held = eq.Scenario("hold", "", 5.0, eq.HoldReference([1.4, 0.5]), start=eq.Start(command=[14e3, 6e3]))
    plant = eq.MujocoPlant(eq.Model(other), nominal=eq.nominal_leg())
    run = drive(plant, make_controller("lqr"), held)
    assert np.abs(run.position[-60:] - [1.4, 0.5]).max() < 5e-3
    assert eq.LqrSettings.from_dict(presets_table("lqr.toml")) == eq.LqrSettings()


@pytest.mark.parametrize(("name", "own", "table", "sentence"), [
    ("lqr", "arm", {"rate": 0.5, "observer": {"torque": 1e-3}},
     "rate, observer.torque are for commands that are pressures, and would change nothing of arm; what can be set there "
     "is angle, bandwidth, integral, disturbance, estimate_valves, spacing, start_time, observer.noise, "
     "observer.patience"),
    ("nmpc", "arm", {"pressure_rate": 1e5}, "pressure_rate is for commands that are pressures"),
    ("lqr", "leg", {"bandwidth": 2.0}, "bandwidth is for commands that are no pressures"),
])  # fmt: skip
def test_a_setting_that_would_change_nothing_is_refused(
    name: str, own: str, table: dict[str, object], sentence: str
) -> None:
    robot = MjcfRobot("arm", pendulum()) if own == "arm" else eq.nominal_leg()
    with pytest.raises(eq.ConfigError) as caught:
        make_controller(name, table, where="own.toml", robot=robot, chosen=True)
    assert str(caught.value).startswith(f"own.toml: {name}: {sentence}")
    # Of a file that all robots share it is left aside, and said; what has an effect stays.
    shared: Any = make_controller(name, {**table, "angle": 0.02}, where="lqr.toml", robot=robot)
    plant = eq.MujocoPlant(eq.Model(robot))
    names = re.split(" is for| are for", sentence)[0]
    assert shared.init(plant.spec, plant.reset(seed=0)).note.startswith(f"lqr.toml: {names} left aside, for ")
    kind = type(shared.settings)
    assert shared.settings == kind(angle=0.02)
    # And a program is told when the robot is known.
    given = type(shared)(kind.from_dict(table))
    with pytest.raises(eq.ConfigError, match=f"^{name}: {names} "):
        given.init(plant.spec, plant.reset(seed=0))


def presets_table(name: str) -> dict[str, object]:
    path = presets.find("controllers", name)
    assert path is not None
    return dict(presets.read_toml(path))
