"""The closed loop: who sees what and when, what is recorded, and what a controller may not return."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl.effects import FirstOrderLag, TransportDelay
from equimus_ctrl.errors import ConfigError, ControllerError, SimulationDiverged, unknown_name
from equimus_ctrl.loop import checked_command, run
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, make_spec
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.scenarios.references import FunctionReference, HoldReference
from equimus_ctrl.types import Array, Observation, PlantSpec, Recording, Reference, Start, frozen_array

SPEC = make_spec(nominal_leg(), 0.1, None)
HOLD = HoldReference(np.array([1.5, 0.2]))


@dataclass
class Scripted:
    """A plant of whole numbers that writes down what is done to it: the position is (step, last first command)."""

    spec: PlantSpec = SPEC
    calls: list[tuple[Any, ...]] = field(default_factory=list)
    count: int = 0

    def reset(self, start: Start | None = None, seed: int | None = None) -> Observation:
        self.calls.append(("reset", start, seed))
        self.count = 0
        return self.seen(np.array([7.0, 8.0]), np.zeros(2, dtype=bool))

    def step(self, command: Any) -> Observation:
        command = np.asarray(command, dtype=float)
        self.calls.append(("step", tuple(command)))
        self.count += 1
        applied = np.clip(command, self.spec.command_low, self.spec.command_high)
        return self.seen(applied, applied != command)

    def close(self) -> None:
        self.calls.append(("close",))

    def seen(self, command: Array, clipped: Any) -> Observation:
        time = self.count * self.spec.control_dt
        return Observation(time, frozen_array([self.count, command[0]]), time, frozen_array(command), clipped)


@dataclass(frozen=True)
class Echo:
    """Counts its steps in its state and commands what a function makes of the count; writes down what it saw."""

    command: Callable[[int], Any]
    log: list[Any] = field(default_factory=list)
    name: str = "echo"

    def init(self, spec: PlantSpec, observation: Observation) -> int:
        self.log.append(("init", spec, observation))
        return 0

    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[Any, int]:
        self.log.append((observation, reference, state))
        return self.command(state), state + 1


@pytest.mark.parametrize(("duration", "n"), [(0.1, 1), (1.0, 10), (0.96, 10), (1.04, 10), (0.06, 1)])
def test_the_loop_runs_the_nearest_number_of_periods(duration: float, n: int) -> None:
    plant = Scripted()
    done = run(plant, Echo(lambda k: [k, 0]), HOLD, duration)
    assert [call[0] for call in plant.calls] == ["reset", *["step"] * n]
    np.testing.assert_allclose(done.time, 0.1 * np.arange(n))
    for array in (done.position, done.reference, done.command, done.asked, done.clipped):
        assert array.shape == (n, 2)
    assert done.solve_time.shape == (n,)
    assert np.all(done.solve_time >= 0)
    assert done.spec is SPEC


def test_the_controller_sees_what_the_plant_last_showed() -> None:
    """First the reset's observation, twice: to make its state and to act on; then each step's."""
    controller = Echo(lambda k: [1e3 * (k + 1), 60e3])
    plant = Scripted()
    done = run(plant, controller, HOLD, 0.3, start=Start(command=np.array([1.0, 2.0])), seed=5)
    assert plant.calls[0][2] == 5
    np.testing.assert_array_equal(plant.calls[0][1].command, [1.0, 2.0])
    (kind, spec, first), *steps = controller.log
    assert kind == "init"
    assert spec is SPEC
    assert steps[0][0] is first
    assert [state for _, _, state in steps] == [0, 1, 2]
    assert all(reference is HOLD for _, reference, _ in steps)
    np.testing.assert_array_equal([o.position for o, _, _ in steps], [[0, 7], [1, 1e3], [2, 2e3]])
    np.testing.assert_array_equal([o.command for o, _, _ in steps], [[7, 8], [1e3, 50e3], [2e3, 50e3]])
    np.testing.assert_array_equal([o.clipped for o, _, _ in steps], [[False, False], [False, True], [False, True]])
    np.testing.assert_array_equal(done.position, [o.position for o, _, _ in steps])
    np.testing.assert_array_equal(done.before, [7, 8])


def test_what_was_asked_for_and_what_was_applied_are_both_recorded() -> None:
    done = run(Scripted(), Echo(lambda k: [-1e3 if k == 1 else 5e3, 60e3 if k == 0 else 50e3]), HOLD, 0.3)
    np.testing.assert_array_equal(done.asked, [[5e3, 60e3], [-1e3, 50e3], [5e3, 50e3]])
    np.testing.assert_array_equal(done.command, [[5e3, 50e3], [0, 50e3], [5e3, 50e3]])
    np.testing.assert_array_equal(done.clipped, [[False, True], [True, False], [False, False]])


def test_the_reference_is_recorded_at_the_control_instants() -> None:
    reference = FunctionReference(lambda t: [t, 2 * t])
    done = run(Scripted(), Echo(lambda k: [0, 0]), reference, 0.5)
    np.testing.assert_allclose(done.reference, np.outer(done.time, [1, 2]))


def test_progress_goes_to_one() -> None:
    shares: list[float] = []
    run(Scripted(), Echo(lambda k: [0, 0]), HOLD, 0.4, progress=shares.append)
    np.testing.assert_allclose(shares, [0.25, 0.5, 0.75, 1.0])


def test_a_controllers_own_array_may_be_used_again_and_again() -> None:
    own = np.zeros(2)

    def command(k: int) -> Array:
        own[:] = 1e3 * k
        return own

    done = run(Scripted(), Echo(command), HOLD, 0.3)
    np.testing.assert_array_equal(done.asked[:, 0], [0, 1e3, 2e3])


def test_a_run_is_a_recording_too() -> None:
    done = run(Scripted(), Echo(lambda k: [1e3 * k, 60e3]), HOLD, 0.3)
    recording = done.recording("trial", {"controller": "echo"})
    np.testing.assert_array_equal(recording.time, done.time)
    np.testing.assert_array_equal(recording.command, done.command)
    np.testing.assert_array_equal(recording.position, done.position)
    np.testing.assert_array_equal(recording.command_before, [7, 8])
    assert (recording.name, recording.joints, recording.actuators) == ("trial", SPEC.joints, SPEC.actuators)
    assert recording.notes == {"controller": "echo"}


@pytest.mark.parametrize("duration", [0.0, 0.04, -1.0])
def test_a_duration_under_one_period_is_refused(duration: float) -> None:
    with pytest.raises(ConfigError) as caught:
        run(Scripted(), Echo(lambda k: [0, 0]), HOLD, duration)
    expected = f"duration is {duration:g} s, expected at least one control period of 0.1 s"
    assert str(caught.value) == expected


@pytest.mark.parametrize("duration", [math.nan, math.inf])
def test_a_duration_that_is_no_number_is_refused(duration: float) -> None:
    with pytest.raises(ConfigError, match="duration"):
        run(Scripted(), Echo(lambda k: [0, 0]), HOLD, duration)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ([1.0], "echo returned a command of shape (1,) at 0.100 s, expected one pressure in Pa for each of maa, baa"),
        (
            [1, 2, 3],
            "echo returned a command of shape (3,) at 0.100 s, expected one pressure in Pa for each of maa, baa",
        ),
        ([[1, 2]], "echo returned a command of shape (1, 2) at 0.100 s, expected one pressure in Pa for each of"),
        (5.0, "echo returned a command of shape () at 0.100 s, expected one pressure in Pa for each of maa, baa"),
        ([math.nan, 0], "echo returned [nan  0.] at 0.100 s, expected finite pressures in Pa"),
        ([0, math.inf], "echo returned [ 0. inf] at 0.100 s, expected finite pressures in Pa"),
        ("full", "echo returned 'full' at 0.100 s, expected pressures in Pa"),
        ([1, [2]], "echo returned [1, [2]] at 0.100 s, expected pressures in Pa"),
        ({"maa": 1}, "echo returned {'maa': 1} at 0.100 s, expected pressures in Pa"),
        (None, "echo returned "),
    ],
)
def test_a_command_that_is_none_is_refused_with_its_time_and_controller(command: Any, message: str) -> None:
    plant = Scripted()
    with pytest.raises(ControllerError) as caught:
        run(plant, Echo(lambda k: command if k == 1 else [0, 0]), HOLD, 1.0)
    assert str(caught.value).startswith(message)
    assert "at 0.100 s" in str(caught.value)
    assert [call[0] for call in plant.calls] == ["reset", "step"]


@pytest.mark.parametrize("result", [None, [1.0, 2.0], np.zeros(2), (1.0, 2.0, 3.0), 5.0])
def test_a_step_that_returns_no_pair_is_refused(result: Any) -> None:
    class Broken:
        def init(self, spec: PlantSpec, observation: Observation) -> None:
            return None

        def step(self, observation: Observation, reference: Reference, state: None) -> Any:
            return result

    with pytest.raises(ControllerError) as caught:
        run(Scripted(), Broken(), HOLD, 1.0)
    assert str(caught.value) == f"Broken.step returned {result!r}, expected (command, state)"


@pytest.mark.parametrize(("method", "at"), [("init", "0.000"), ("step", "0.200")])
def test_a_controller_that_fails_is_named_with_the_time_and_the_reason(method: str, at: str) -> None:
    class Fragile(Echo):
        def init(self, spec: PlantSpec, observation: Observation) -> int:
            return 1 // 0 if method == "init" else 0

        def step(self, observation: Observation, reference: Reference, state: int) -> tuple[Any, int]:
            return ([1 // (2 - state), 0], state + 1)

    with pytest.raises(ControllerError) as caught:
        run(Scripted(), Fragile(lambda k: [0, 0], name="fragile"), HOLD, 1.0)
    assert str(caught.value).startswith(f"fragile.{method} failed at {at} s: ZeroDivisionError: ")
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_a_controller_that_would_end_the_program_is_one_that_fails() -> None:
    def leave(k: int) -> Any:
        sys.exit(0)

    with pytest.raises(ControllerError, match=r"^leaving.step failed at 0.000 s: SystemExit: 0$"):
        run(Scripted(), Echo(leave, name="leaving"), HOLD, 1.0)


def test_a_reference_that_fails_is_told_with_the_time() -> None:
    reference = FunctionReference(lambda time: np.array([1.0, 1 / (0.2 - time)]) if time < 0.15 else sys.exit(1))
    with pytest.raises(ConfigError, match=r"^the reference fails at 0.200 s: SystemExit: 1$"):
        run(Scripted(), Echo(lambda k: [0, 0]), reference, 1.0)


def test_a_controllers_own_sentence_comes_through() -> None:
    def refuse(k: int) -> Any:
        raise ConfigError("the gains of this controller are missing")

    with pytest.raises(ConfigError, match=r"^the gains of this controller are missing$"):
        run(Scripted(), Echo(refuse), HOLD, 1.0)


def test_whole_numbers_and_tuples_are_commands() -> None:
    for command in ([1, 2], (1, 2), np.array([1, 2]), np.array([1, 2], dtype=np.float32)):
        array = checked_command(command, SPEC, 0.0, "x")
        assert array.dtype == np.float64
        np.testing.assert_array_equal(array, [1, 2])


@pytest.mark.parametrize("pose", [[1.5], [1.5, 0.2, 0.1], [math.nan, 0.2]])
def test_a_reference_that_does_not_fit_the_robot_is_refused(pose: list[float]) -> None:
    with pytest.raises(ConfigError, match="reference"):
        run(Scripted(), Echo(lambda k: [0, 0]), HoldReference(np.array(pose)), 0.2)


def test_the_arrays_of_a_run_are_read_only() -> None:
    done = run(Scripted(), Echo(lambda k: [0, 0]), HOLD, 0.2)
    for array in (done.time, done.position, done.reference, done.command, done.asked, done.clipped, done.before):
        assert not array.flags.writeable


class Feedback:
    """A controller with memory: a leaky integrator of the error it sees."""

    def init(self, spec: PlantSpec, observation: Observation) -> Array:
        return np.zeros(2)

    def step(self, observation: Observation, reference: Reference, state: Array) -> tuple[Array, Array]:
        error = reference.position(observation.time) - observation.position
        state = 0.9 * state + error
        return 1e4 + 3e3 * state, state


def test_a_run_repeats_bit_for_bit() -> None:
    effects = (TransportDelay("maa", 0.02), FirstOrderLag("baa", 0.1))
    reference = FunctionReference(lambda t: [1.5 + 0.1 * math.sin(5 * t), 0.3])

    def once(plant: MujocoPlant, seed: int) -> bytes:
        done = run(plant, Feedback(), reference, 0.5, seed=seed)
        return b"".join(a.tobytes() for a in (done.time, done.position, done.reference, done.command, done.asked))

    one, two = (MujocoPlant(Model(nominal_leg(), effects), noise=1e-3) for _ in range(2))
    first = once(one, 1)
    assert once(one, 2) != first
    assert once(one, 1) == first
    assert once(two, 1) == first


def test_the_plants_divergence_comes_through() -> None:
    plant = MujocoPlant(Model(nominal_leg().with_parameters({"maa.stiffness": 1e8})))
    with pytest.raises(SimulationDiverged):
        run(plant, Feedback(), HOLD, 1.0, start=Start(position=np.array([1.3, 0.5])))


# --- the vocabulary the loop is written in ----------------------------------------------------------------------


def recording(**changes: Any) -> Recording:
    values: dict[str, Any] = {
        "time": [0.0, 0.1, 0.2],
        "command": np.zeros((3, 2)),
        "position": np.ones((3, 1)),
        "actuators": ("maa", "baa"),
        "joints": ("hip",),
    }
    return Recording("trial", **{**values, **changes})


def test_a_recording_copies_what_it_is_given_and_cannot_be_changed() -> None:
    time, notes = np.array([0.0, 0.1, 0.2]), {"source": "bench"}
    made = recording(time=time, notes=notes, before=[1.0, 2.0], velocity=np.zeros((3, 1)), measured=np.zeros((3, 2)))
    time[0], notes["source"] = 9.0, "elsewhere"
    assert made.time[0] == 0.0
    assert made.notes == {"source": "bench"}
    for array in (made.time, made.command, made.position, made.velocity, made.measured, made.before):
        assert array is not None
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 1


def test_the_command_before_is_the_first_rows_unless_told() -> None:
    command = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    np.testing.assert_array_equal(recording(command=command).command_before, [1, 2])
    np.testing.assert_array_equal(recording(command=command, before=[7, 8]).command_before, [7, 8])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"command": np.zeros((2, 2))}, "trial: command has shape (2, 2), expected (3, 2)"),
        ({"command": np.zeros((3, 1))}, "trial: command has shape (3, 1), expected (3, 2)"),
        ({"position": np.zeros((3, 2))}, "trial: position has shape (3, 2), expected (3, 1)"),
        ({"position": np.zeros(3)}, "trial: position: expected 2 dimension(s), got an array of shape (3,)"),
        ({"time": np.zeros((3, 1))}, "trial: time: expected 1 dimension(s), got an array of shape (3, 1)"),
        ({"velocity": np.zeros((2, 1))}, "trial: velocity has shape (2, 1), expected (3, 1)"),
        ({"measured": np.zeros((3, 1))}, "trial: measured has shape (3, 1), expected (3, 2)"),
        ({"before": np.zeros(3)}, "trial: before has shape (3,), expected (2,)"),
    ],
)
def test_a_recording_of_uneven_shapes_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        recording(**changes)
    assert str(caught.value) == message


def test_a_start_is_flat_read_only_and_a_copy() -> None:
    own = np.array([1.0, 2.0])
    start = Start(command=own)
    own[0] = 9.0
    assert start.command is not None
    np.testing.assert_array_equal(start.command, [1, 2])
    assert not start.command.flags.writeable
    with pytest.raises(ConfigError, match="start position: expected 1 dimension"):
        Start(position=np.zeros((1, 2)))


def test_an_unknown_name_lists_what_there_is() -> None:
    assert unknown_name("link", "tigh", ["thigh", "calf"], "leg") == (
        "leg: there is no link 'tigh'; did you mean 'thigh'? (known: calf, thigh)"
    )
    assert unknown_name("link", "x", []) == "there is no link 'x' (known: none)"


def test_what_the_package_offers_is_no_module_of_it() -> None:
    """Importing a submodule binds its name in the package, in the place of what the package offers by that name."""
    folder = Path(eq.__file__).parent
    modules = {path.stem for path in folder.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert modules & set(eq.__all__) == {"testing"}


def test_the_package_runs_as_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "equimus_ctrl", "--version"], capture_output=True, text=True)
    assert done.stdout == f"equimus-ctrl {eq.__version__}\n", done.stderr
