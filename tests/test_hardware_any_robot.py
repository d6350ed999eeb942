"""Real robots of any kind: what settings come to for them, how they begin and how they are stopped."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hardware_rig import MemoryWire
from mjcf_models import refusal
from pendulum_runs import MOTOR, PENDULUM, SERVO

from equimus_ctrl.emulation import emulator as module
from equimus_ctrl.emulation.emulator import Emulator
from equimus_ctrl.errors import HardwareFault
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.hardware.interface import interface_of
from equimus_ctrl.plants.hardware.plant import HardwarePlant
from equimus_ctrl.plants.hardware.settings import Channel, HardwareSettings, Safety
from equimus_ctrl.plants.hardware.transport import Sample
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Start
from equimus_ctrl.workflow import load_hardware, load_model

RATE = 100.0
DT = 1 / RATE
EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"


def robot(drive: str, name: str = "arm") -> MjcfRobot:
    return MjcfRobot(name, PENDULUM.format(drive=drive))


LIMITED = '<motor name="drive" joint="hinge" ctrlrange="-2 3" ctrllimited="true"/>'
GOAL = '<position name="drive" joint="hinge" kp="12" kv="0.4" ctrlrange="-1.5 1.5" ctrllimited="true"/>'
BIASED = (
    '<general name="drive" joint="hinge" gear="2" gainprm="5" biastype="affine" biasprm="1 -3 -0.5" ctrlrange="-4 4" '
    'ctrllimited="true"/>'
)
QUICK = HardwareSettings(rate=RATE, patience=5.0, settle=0.2)


def at(*angles: float) -> Callable[[int, float], Sequence[Sample]]:
    return lambda k, now: [Sample(now, now, ("hinge",), angles)]


@pytest.mark.parametrize(
    ("drive", "topic"),
    [
        (LIMITED, "effort"), (GOAL, "position"), ('<velocity name="drive" joint="hinge" kv="3"/>', "velocity"),
        (BIASED, "position"), (LIMITED + GOAL.replace("drive", "other"), "command"),
    ],
)  # fmt: skip
def test_topics_are_those_of_ros2_control_by_what_commands_are(drive: str, topic: str) -> None:
    settings = HardwareSettings(actuators={"drive": Channel(low=-1, high=1)})
    assert interface_of(settings, robot(drive)).wire.commands == f"/forward_{topic}_controller/commands"


def test_limits_are_the_robots_and_the_files_may_be_narrower() -> None:
    own = interface_of(QUICK, robot(LIMITED))
    assert (own.command_low.tolist(), own.command_high.tolist(), own.stop.tolist()) == ([-2.0], [3.0], [0.0])
    assert own.slew.tolist() == [5.0 / 0.05] and own.stopped == "stopped"
    narrow = replace(QUICK, actuators={"drive": Channel(low=-9.0, high=1.0, slew=4.0)})
    own = interface_of(narrow, robot(LIMITED))
    assert (own.command_low.tolist(), own.command_high.tolist(), own.slew.tolist()) == ([-2.0], [1.0], [4.0])
    goal = interface_of(QUICK, robot(GOAL))
    assert goal.slew.tolist() == [QUICK.safety.speed] and math.isnan(goal.stop[0])
    assert interface_of(QUICK, nominal_model().robot).stopped == "vented"


@pytest.mark.parametrize(
    ("settings", "drive", "said"),
    [
        (QUICK, MOTOR, "commands of drive [N·m] have no limits of their own, expected low and high under [actuators.d"),
        (replace(QUICK, safety=Safety(pressure=2e4)), LIMITED, "pressure is for robots driven by pressures, and arm"),
        (
            replace(QUICK, actuators={"drive": Channel(low=5.0)}),
            LIMITED,
            "lie between 5 and 3, expected low below high",
        ),
        (replace(QUICK, actuators={"drive": Channel(stop=9.0)}), LIMITED, "stop is 9, expected -2 to 3"),
        (replace(QUICK, actuators={"motor": Channel()}), LIMITED, "there is no actuator 'motor'"),
    ],
)
def test_settings_that_do_not_fit_a_robot_are_refused(settings: HardwareSettings, drive: str, said: str) -> None:
    assert said in refusal(lambda: interface_of(settings, robot(drive)))


def test_settings_are_the_robots_own_where_no_file_tells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    finger, arm = load_model(EXAMPLES / "finger.toml"), Model(robot(LIMITED))
    assert interface_of(load_hardware(None, finger), finger.robot).command_high.tolist() == [50e3]
    assert load_hardware(None, arm).rate == pytest.approx(125.0)  # of physics steps of 2 ms
    assert load_hardware(None, nominal_model()).joints.keys() == {"hip", "knee"}
    (tmp_path / "hardware").mkdir()
    (tmp_path / "hardware" / "arm.toml").write_text("[actuators.drive]\nhigh = 1.5\n")
    assert interface_of(load_hardware(None, arm), arm.robot).command_high.tolist() == [1.5]
    pendulum = load_model(EXAMPLES / "pendulum.xml")
    load_hardware(EXAMPLES / "pendulum_hardware.toml", pendulum)
    assert "no limits of their own" in refusal(lambda: load_hardware(None, pendulum))


@pytest.mark.parametrize("drive", [GOAL, BIASED])
def test_a_goal_where_a_robot_is_exerts_nothing(drive: str) -> None:
    own = robot(drive)
    model = own.mujoco_model()
    data = mujoco.MjData(model)
    data.qpos[0] = 0.7
    data.ctrl[:] = own.goals_at(np.array([0.7]))
    mujoco.mj_forward(model, data)
    assert abs(data.ctrl[0]) > 0.1 and data.actuator_force[0] == pytest.approx(0.0, abs=1e-12)
    assert robot(MOTOR).goals_at(np.array([0.7])).tolist() == [0.0]


@pytest.mark.real_time
def test_a_servo_begins_where_it_is_goes_slowly_to_its_start_and_stays_where_it_is_stopped(
    wires: Callable[..., MemoryWire],
) -> None:
    wire = wires(at(0.4))
    plant = HardwarePlant(Model(robot(GOAL)), QUICK, armed=True, transport=wire)
    assert plant.reset(Start(command=np.array([1.0]))).command.tolist() == [1.0]
    for _ in range(5):
        plant.step([0.9])
    plant.close()
    sent = wire.pressures[:, 0]
    assert 0.4 <= sent[0] < 0.45
    assert np.diff(sent[: int(np.argmax(sent))]).max() <= 1.001 * 0.6 / QUICK.settle * DT
    assert np.all(sent[-3:] == 0.9)


@pytest.mark.real_time
@pytest.mark.parametrize("start", [None, Start(command=np.array([1.5]))])
def test_forces_that_nothing_holds_against_wait_for_the_controller(
    start: Start | None, wires: Callable[..., MemoryWire]
) -> None:
    wire = wires(at(0.4))
    plant = HardwarePlant(Model(robot(LIMITED)), QUICK, armed=True, transport=wire)
    assert plant.reset(start).command.tolist() == [0.0]
    asked = [plant.step([9.0]).command[0] for _ in range(6)]
    plant.close()
    assert not wire.pressures[: -6 - 3].any() and max(asked) == 3.0 and np.diff([0.0, *asked]).max() <= 1.0 + 1e-9
    assert np.all(wire.pressures[-3:] == 0.0)


@pytest.mark.real_time
def test_a_robot_beyond_its_range_is_stopped_and_told_in_its_own_unit(wires: Callable[..., MemoryWire]) -> None:
    text = """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <inertial pos="0 0 0" mass="4" diaginertia="1 1 1"/></body></worldbody>
      <actuator><motor name="drive" joint="rail" ctrlrange="-9 9" ctrllimited="true"/></actuator></mujoco>"""
    begun = time.monotonic()

    def slides(k: int, now: float) -> list[Sample]:
        return [Sample(now, now, ("rail",), (0.9 + 0.2 * max(now - begun - 0.6, 0.0),))]

    wire = wires(slides)
    plant = HardwarePlant(Model(MjcfRobot("sled", text)), QUICK, armed=True, transport=wire)
    plant.reset()

    def pushed() -> None:
        for _ in range(300):
            plant.step([2.0])

    with pytest.raises(HardwareFault, match=r"stopped at .* s: rail is at 1.05\d m, expected -1.050 to 1.050 m"):
        pushed()
    plant.close()
    assert np.all(wire.pressures[-3:] == 0.0) and wire.pressures.max() == 2.0


class Clock:
    """Goes on only while somebody sleeps."""

    def __init__(self) -> None:
        self.now = 50.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Device:
    """The robot's end of a wire: what was measured, and who commands."""

    def __init__(self, clock: Clock, commands: Sequence[tuple[float, float]]) -> None:
        self.clock, self.waiting, self.angles = clock, list(commands), []

    angles: list[float]

    def publish(self, stamp: float, names: Sequence[str], position: Sequence[float]) -> None:
        assert list(names) == ["hinge"]
        self.angles.append(position[0])

    def take(self) -> list[tuple[float, ...]]:
        here = [(value,) for at, value in self.waiting if 50.0 + at <= self.clock.now]
        del self.waiting[: len(here)]
        return here

    def close(self) -> None: ...


def emulated(drive: str, monkeypatch: pytest.MonkeyPatch) -> tuple[Emulator, Device]:
    """A robot that hangs and is told 0.5 for half a second, every 20 ms; 1.5 s of it."""
    clock = Clock()
    monkeypatch.setattr(module, "clock", clock)
    device = Device(clock, [(0.02 * k, 0.5) for k in range(25)])
    emulator = Emulator(Model(robot(drive)), QUICK, device=device)
    emulator.run(1.5)
    return emulator, device


@pytest.mark.slow
def test_an_emulated_motor_lets_go_where_commands_end(monkeypatch: pytest.MonkeyPatch) -> None:
    emulator, device = emulated(MOTOR, monkeypatch)
    assert emulator.rate == 125.0 and (emulator.seen.highest, emulator.seen.watchdog) == ([0.5], 1)
    assert emulator.seen.vented == pytest.approx(0.58, abs=0.01)
    # With and without 0.5 N·m it swings about sin q = 0.5 / (m g l), and then about 0.
    pulled, left = np.array(device.angles[:70]), np.array(device.angles[80:])
    assert pulled.max() > 0.2 and pulled.min() > -1e-3 and left.min() < -0.1


def test_an_emulated_servo_stays_where_commands_end(monkeypatch: pytest.MonkeyPatch) -> None:
    emulator, device = emulated(SERVO, monkeypatch)
    assert emulator.seen.watchdog == 1 and device.angles[0] == pytest.approx(0.0, abs=0.01)
    # 12 (0.5 − q) = m g l sin q at rest.
    rest = device.angles[-1]
    assert 12 * (0.5 - rest) == pytest.approx(0.6 * 9.81 * 0.4 * math.sin(rest), abs=0.1)
