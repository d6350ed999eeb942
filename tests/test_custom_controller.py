"""A user's own controller: in ten lines, as a class, an instance or a function, and what is said when it is wrong."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl import presets, workflow
from equimus_ctrl.controllers.custom import FunctionController, as_controller
from equimus_ctrl.loop import checked_command

POSE = [1.4, 0.5]


class Constant:
    """The same pressures always, counting its steps in the state."""

    command: Any = (14e3, 6e3)

    def init(self, spec: eq.PlantSpec, observation: eq.Observation) -> int:
        return 0

    def step(self, observation: eq.Observation, reference: eq.Reference, state: int) -> tuple[Any, int]:
        return self.command, state + 1


def of_two(observation: eq.Observation, reference: eq.Reference) -> list[float]:
    return [14e3, 6e3]


def of_three(observation: eq.Observation, reference: eq.Reference, spec: eq.PlantSpec) -> Any:
    return (spec.command_low + spec.command_high) / 4


@pytest.fixture(scope="module")
def held() -> eq.Scenario:
    return eq.Scenario("held", "for these tests", 0.2, eq.HoldReference(POSE), start=eq.Start(command=[14e3, 6e3]))


@pytest.fixture(scope="module")
def plant() -> eq.MujocoPlant:
    return eq.MujocoPlant(eq.nominal_model())


@pytest.mark.parametrize("thing", [Constant, Constant(), of_two, lambda observation, reference: (14e3, 6e3)])
def test_a_class_an_instance_and_a_function_do_the_same(thing: Any, held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    done = eq.run_scenario(held, thing, plant=plant)
    np.testing.assert_array_equal(done.run.command, np.tile([14e3, 6e3], (24, 1)))
    np.testing.assert_allclose(done.run.position, np.tile(done.run.position[0], (24, 1)), atol=1e-6)


def test_a_function_of_three_is_given_the_spec(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    done = eq.run_scenario(held, of_three, plant=plant)
    np.testing.assert_array_equal(done.run.command, np.full((24, 2), 12.5e3))


def test_commands_beyond_the_range_are_clipped_and_reported(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    done = eq.run_scenario(held, lambda observation, reference: (1e9, -1e9), plant=plant)
    np.testing.assert_array_equal(done.run.command, np.tile([50e3, 0.0], (24, 1)))
    assert done.run.clipped.all() and done.score.saturated == 1.0
    np.testing.assert_array_equal(done.run.asked, np.tile([1e9, -1e9], (24, 1)))


def test_it_is_told_of_the_clipping(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    told = []

    def greedy(observation: eq.Observation, reference: eq.Reference) -> list[float]:
        told.append((observation.clipped.tolist(), observation.command.tolist()))
        return [1e9, 6e3]

    eq.run_scenario(held, greedy, plant=plant)
    assert told[0] == ([False, False], [14e3, 6e3]) and told[1] == ([True, False], [50e3, 6e3])


def test_what_it_sees_cannot_be_written_to(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    def meddler(observation: eq.Observation, reference: eq.Reference, spec: eq.PlantSpec) -> list[float]:
        for array in (
            observation.position,
            observation.command,
            observation.clipped,
            spec.command_high,
            reference.position(observation.time),
        ):
            with pytest.raises(ValueError):
                array[0] = 1.0
        return [14e3, 6e3]

    eq.run_scenario(held, meddler, plant=plant)


def test_labels(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    class Named(Constant):
        name = "my own"

    assert eq.run_scenario(held, Constant, plant=plant).controller == "Constant"
    assert eq.run_scenario(held, Constant(), plant=plant).controller == "Constant"
    assert eq.run_scenario(held, of_two, plant=plant).controller == "of_two"
    assert eq.run_scenario(held, Named(), plant=plant).controller == "my own"


TEN_LINES = """\
import numpy as np
import equimus_ctrl as eq
class Mine:
    def init(self, spec, observation):
        return np.zeros(2), eq.Kinematics(spec.model)
    def step(self, observation, reference, state):
        total, kinematics = state
        total = total + reference.position(observation.time) - observation.position
        hold = kinematics.static_pressure(reference.position(observation.time))
        return hold + 3e3 * np.array([-1.0, -1.0]) * total / 120, (total, kinematics)
"""


def test_ten_lines_are_enough(tmp_path: Path, held: eq.Scenario) -> None:
    assert len(TEN_LINES.splitlines()) == 10
    (tmp_path / "mine.py").write_text(TEN_LINES)
    done = eq.run_scenario(held, f"{tmp_path}/mine.py:Mine")
    assert done.controller.endswith("mine.py:Mine") and np.isfinite(done.score.tracking.rmse).all()


@pytest.mark.parametrize("name", ["Spring", "spring"])
def test_the_example_pulls_towards_the_reference(name: str) -> None:
    example = presets.find("controllers", "example_custom.py")
    scenario = workflow.load_scenario("hold", eq.nominal_leg(), options={"duration": "1.5", "knee": "30"})
    done = eq.run_scenario(scenario, f"{example}:{name}")
    start, end = np.abs(done.run.position - done.run.reference)[[0, -1]]
    assert np.all(end < 0.5 * start)


def test_both_forms_of_the_example_are_the_same(held: eq.Scenario) -> None:
    example = presets.find("controllers", "example_custom.py")
    one, two = (eq.run_scenario(held, f"{example}:{name}").run for name in ("Spring", "spring"))
    np.testing.assert_array_equal(one.command, two.command)


def test_the_example_runs_as_a_script(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(presets.find("controllers", "example_custom.py")), run_name="__main__")
    assert capsys.readouterr().out.startswith("RMSE [rad]: [0.")


class NeedsArguments(Constant):
    def __init__(self, gain: float) -> None:
        self.gain = gain


class HalfDone:
    def init(self, spec: eq.PlantSpec, observation: eq.Observation) -> None: ...


@pytest.mark.parametrize(
    ("thing", "sentence"),
    [
        (NeedsArguments, "x: the class cannot be made without arguments (missing a required argument: 'gain')"),
        (HalfDone, "x: HalfDone is neither a class with init and step nor a function"),
        (3.5, "x: float is neither a class with init and step nor a function"),
        (None, "x: NoneType is neither a class with init and step nor a function"),
        (np, "x: module is neither a class with init and step nor a function"),
        (
            lambda observation: 0,
            "x: a controller function takes (observation, reference) or (observation, reference, sp",
        ),
        (lambda a, b, c, d: 0, "spec), this one takes 4 parameters"),
    ],
)
def test_what_is_no_controller_is_refused(thing: Any, sentence: str) -> None:
    with pytest.raises(eq.ControllerError) as caught:
        as_controller(thing, "x")
    assert sentence in str(caught.value)


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ((np.nan, 1.0), "Constant returned [nan  1.] at 0.000 s, expected finite pressures in Pa"),
        ((1.0, np.inf), "Constant returned [ 1. inf] at 0.000 s, expected finite pressures in Pa"),
        (
            (1.0,),
            "Constant returned a command of shape (1,) at 0.000 s, expected one pressure in Pa for each of maa, b",
        ),
        (5.0, "Constant returned a command of shape () at 0.000 s, expected one pressure in Pa for each of maa, baa"),
        (None, "Constant returned a command of shape () at 0.000 s, expected one"),
        (np.zeros((1, 2)), "Constant returned a command of shape (1, 2) at 0.000 s"),
        ("much", "Constant returned 'much' at 0.000 s, expected pressures in Pa"),
        ([[1.0], [1.0, 2.0]], "Constant returned [[1.0], [1.0, 2.0]] at 0.000 s, expected pressures in Pa"),
    ],
)
def test_what_is_no_command_is_refused(command: Any, sentence: str, held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    controller = Constant()
    controller.command = command
    with pytest.raises(eq.ControllerError) as caught:
        eq.run_scenario(held, controller, plant=plant)
    assert str(caught.value).startswith(sentence)


def test_the_time_of_a_bad_command_is_told(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    def late(observation: eq.Observation, reference: eq.Reference) -> list[float]:
        return [14e3, 6e3 if observation.time < 0.1 else np.nan]

    with pytest.raises(eq.ControllerError, match=r"late returned \[14000\.\s+nan\] at 0.1\d\d s"):
        eq.run_scenario(held, late, plant=plant)


@pytest.mark.parametrize("result", [[1.0, 2.0], (1.0, 2.0, 3.0), np.zeros(2), None])
def test_a_step_must_return_a_pair(result: Any, held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    class Alone(Constant):
        def step(self, observation: eq.Observation, reference: eq.Reference, state: int) -> Any:
            return result

    with pytest.raises(eq.ControllerError, match=r"Alone.step returned .*, expected \(command, state\)"):
        eq.run_scenario(held, Alone, plant=plant)


def test_checked_command_takes_what_numpy_takes(plant: eq.MujocoPlant) -> None:
    for command in ([1, 2], (1.0, 2.0), np.array([1, 2], dtype=np.int32)):
        array = checked_command(command, plant.spec, 0.0, "x")
        assert array.dtype == np.float64 and array.tolist() == [1.0, 2.0]


def test_a_run_needs_one_control_period(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    with pytest.raises(eq.ConfigError, match=r"duration is 0.001 s, expected at least one control period of 0.008333"):
        eq.run(plant, Constant(), held.reference, 0.001)


def test_progress_goes_to_one(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    shares: list[float] = []
    run = eq.run(plant, Constant(), held.reference, 0.1, progress=shares.append)
    assert shares == [(k + 1) / 12 for k in range(12)]
    np.testing.assert_allclose(run.time, np.arange(12) / 120, atol=1e-12)
    assert np.all(run.solve_time >= 0) and len(run.solve_time) == 12


# What goes wrong inside a user's code should end in a sentence that says where, as everything else does.


class Boom(Constant):
    def step(self, observation: eq.Observation, reference: eq.Reference, state: int) -> Any:
        raise ValueError("boom")


class BoomAtOnce(Constant):
    def init(self, spec: eq.PlantSpec, observation: eq.Observation) -> int:
        raise KeyError("boom")


class BoomWhenMade(Constant):
    def __init__(self) -> None:
        raise OSError("boom")


def boom(observation: eq.Observation, reference: eq.Reference) -> Any:
    raise RuntimeError("boom")


@pytest.mark.parametrize("thing", [Boom, BoomAtOnce, BoomWhenMade, boom])
def test_an_exception_in_a_controller_is_a_sentence(thing: Any, held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    with pytest.raises(eq.ControllerError, match="boom"):
        eq.run_scenario(held, thing, plant=plant)


def test_a_type_error_in_a_constructor_is_not_missing_arguments() -> None:
    class Odd(Constant):
        def __init__(self) -> None:
            len(3)  # type: ignore[arg-type]

    with pytest.raises(eq.ControllerError) as caught:
        as_controller(Odd, "x")
    assert "arguments" not in str(caught.value)


def test_a_default_is_left_alone(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    def tuned(observation: eq.Observation, reference: eq.Reference, level: float = 9e3) -> list[float]:
        assert level == 9e3
        return [level, level]

    eq.run_scenario(held, tuned, plant=plant)


def test_star_arguments_are_welcome(held: eq.Scenario, plant: eq.MujocoPlant) -> None:
    eq.run_scenario(held, lambda *given: [14e3, 6e3], plant=plant)


def test_function_controllers_keep_their_name() -> None:
    controller = as_controller(of_two, "path.py:of_two")
    assert isinstance(controller, FunctionController) and controller.name == "path.py:of_two"
