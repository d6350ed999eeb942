"""The hardware plant on a wire in memory: what it sends, when it vents, what it records, and what it says."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hardware_rig import DT, LOW, REST, Controller, MemoryWire, driven, plant_on, quick, still

from equimus_ctrl.controllers.open_loop import OpenLoopController
from equimus_ctrl.errors import ConfigError, HardwareFault, NotAvailable, RecordingError
from equimus_ctrl.loop import run
from equimus_ctrl.plants.hardware.settings import Calibration, Channel
from equimus_ctrl.plants.hardware.transport import Sample
from equimus_ctrl.recordings import read
from equimus_ctrl.scenarios.references import HoldReference
from equimus_ctrl.types import Start

pytestmark = pytest.mark.real_time


def test_commands_are_sent_at_the_rate_and_the_end_vents(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    assert driven(wire, LOW, 60) == ""
    times = np.array([at for at, values in wire.sent if values == tuple(LOW)])
    assert len(times) == 60
    assert np.median(np.diff(times)) == pytest.approx(DT, rel=0.05)
    assert wire.closed and np.all(wire.pressures[-3:] == 0)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_the_first_command_may_change_as_much_as_any(wires: Callable[..., MemoryWire], share: float) -> None:
    """However soon after the last one that held the robot it is asked for."""
    wire = wires()
    plant = plant_on(wire, quick(slew=1.2 * LOW.max() / DT))
    plant.reset()
    time.sleep(share * DT)
    plant.step(LOW)
    plant.close()
    gaps = np.diff([at for at, _ in wire.sent])
    assert tuple(LOW) in [values for _, values in wire.sent] and gaps[:-4].min() > 0.5 * DT


def test_time_and_stamps_are_on_one_clock(wires: Callable[..., MemoryWire]) -> None:
    """The device's clock is 1,000 s ahead."""
    wire = wires(lambda k, now: [still(now, stamp=now + 1000.0)])
    plant = plant_on(wire)
    first = plant.reset()
    assert (first.time, first.stamp) == (0.0, 0.0)
    seen = [plant.step(LOW) for _ in range(30)]
    plant.close()
    for k, one in enumerate(seen, start=1):
        assert one.time == pytest.approx(k * DT)
        assert one.time - 0.06 < one.stamp <= one.time
    np.testing.assert_array_equal(seen[-1].position, REST)
    assert plant.counts.misses == 0 and len(plant.counts.latency or ()) == 30


def test_limits_are_enforced_last(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    plant = plant_on(wire, quick(pressure=20e3, slew=2.4e5))  # 2 kPa a period
    plant.reset()
    clipped = [plant.step([1e9, -1e9]) for _ in range(20)]
    plant.close()
    sent = wire.pressures
    assert sent.max() == 20e3 and sent.min() == 0
    rises = np.diff(sent, axis=0).max(axis=0)
    assert 1.9e3 < rises[0] <= 2e3 * 1.000001 and all(one.clipped.all() for one in clipped)
    assert clipped[-1].command.tolist() == [20e3, 0.0]


def test_units_signs_and_names_are_the_wires(wires: Callable[..., MemoryWire]) -> None:
    wire = wires(lambda k, now: [Sample(now, now, ("x", "k", "h"), (9.0, 60.0, -10.0))])
    settings = replace(
        quick(),
        joints={"hip": Calibration("h", -100.0, math.radians(1)), "knee": Calibration("k", 90.0, -math.radians(1))},
        actuators={"maa": Channel(1, 1e3), "baa": Channel(0, 100.0)},
    )
    plant = plant_on(wire, settings)
    first = plant.reset()
    np.testing.assert_allclose(first.position, np.radians([90.0, 30.0]))
    plant.step(LOW)
    plant.close()
    assert (30.0, 5.0) in [values for _, values in wire.sent]


def test_a_dry_run_sends_nothing(wires: Callable[..., MemoryWire], tmp_path: Path) -> None:
    wire = wires()
    plant = plant_on(wire, armed=False, record=tmp_path / "dry.csv")
    plant.reset()
    seen = [plant.step(LOW) for _ in range(10)]
    plant.close()
    assert wire.sent == [] and seen[-1].command.tolist() == LOW.tolist()
    assert not list(tmp_path.iterdir())


def test_the_starts_command_is_gone_to_and_held_while_the_controller_is_made(
    wires: Callable[..., MemoryWire],
) -> None:
    wire = wires()
    plant = plant_on(wire, quick(slew=6e4))  # 0.5 kPa a period
    plant.reset(Start(command=LOW))
    time.sleep(0.5)  # what a controller compiles
    plant.step(LOW)
    plant.close()
    before = wire.pressures[:-4]
    assert np.diff(before, axis=0).max() <= 500 * 1.001 and before[-1].tolist() == LOW.tolist()
    gaps = np.diff([at for at, _ in wire.sent])
    assert gaps.max() < 0.1, "the device's watchdog would have vented"


def test_a_controller_that_stops_this_process_while_it_is_made_is_waited_for(
    wires: Callable[..., MemoryWire],
) -> None:
    """Such as one that builds symbolic functions: the robot is brought to the start again before the run begins."""
    wire = wires()
    plant = plant_on(wire, quick(slew=6e4))
    plant.reset(Start(command=LOW))
    with plant._lock:  # nothing is sent
        time.sleep(0.4)
    paused = time.monotonic()
    plant.step(LOW)
    plant.close()
    assert plant.counts.fault == ""
    again = [(at, values) for at, values in wire.sent if at >= paused]
    assert again[0][1][0] <= 1000.0, "what the device has vented is ramped to anew"
    begun = next(at for at, values in reversed(again) if values == tuple(LOW))
    assert begun - paused >= 0.29


def test_every_run_is_recorded_as_it_goes(wires: Callable[..., MemoryWire], tmp_path: Path) -> None:
    def moving(k: int, now: float) -> list[Sample]:
        angle = 1.3 + 0.2 * math.sin(4.0 * now)
        return [still(now + 0.003, (angle, 1.04), stamp=now - 50.0)]

    wire = wires(moving)
    plant = plant_on(wire, record=tmp_path / "run.csv")
    plant.reset(Start(command=LOW))
    origin = None
    for k in range(90):
        plant.step(LOW * (1 + (k // 30) / 10))
        origin = origin or plant._origin
        if k == 60:  # a reader does not have to wait for the end
            assert len(read(tmp_path / "run.csv").time) >= 58
    plant.close()
    found = read(tmp_path / "run.csv")
    assert found.before is not None and found.before.tolist() == LOW.tolist()
    sent = found.command.any(axis=1)
    assert sent.sum() == 90 and not sent[-1], "at the end it is vented"
    late = found.time[sent] - np.arange(90) * DT
    assert np.all(late > -1e-6) and np.quantile(late, 0.8) < 3e-3, "a busy machine may be late now and then"
    np.testing.assert_array_equal(found.command[sent], [LOW * (1 + (k // 30) / 10) for k in range(90)])
    # Samples come 3 ms after they were taken, the quickest of which counts as none.
    truth = 1.3 + 0.2 * np.sin(4.0 * (found.time + origin - 0.003))
    assert np.quantile(np.abs(found.position[:, 0] - truth), 0.8) < 3e-3


def test_a_file_that_is_there_is_not_written_over(wires: Callable[..., MemoryWire], tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("mine")
    plant = plant_on(wires(), record=tmp_path / "run.csv")
    plant.reset()
    with closing(plant), pytest.raises(RecordingError, match="the file cannot be made"):
        plant.step(LOW)
    assert (tmp_path / "run.csv").read_text() == "mine"


def test_a_robot_that_nobody_hears_is_not_armed(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    wire.hearing = 0
    plant = plant_on(wire, replace(quick(), patience=0.2))
    with closing(plant), pytest.raises(NotAvailable, match="not armed: nobody listens to /forward_pressure_controller"):
        plant.reset()
    assert wire.sent == []
    wire = wires()
    plant = plant_on(wire)

    def leaves(k: int) -> None:
        wire.hearing = int(k < 20)

    with closing(plant), pytest.raises(HardwareFault, match="nobody listens to"):
        run(plant, Controller(leaves), HoldReference(REST), 2.0)


def test_a_robot_that_another_drives_is_left_alone(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    wire.wrong = "/commands has another publisher, expected this one alone"
    with closing(plant_on(wire)) as plant, pytest.raises(NotAvailable, match="was not armed: /commands has another"):
        plant.reset()
    assert wire.sent == [] and not wire.ready


def test_it_runs_once(wires: Callable[..., MemoryWire]) -> None:
    plant = plant_on(wires())
    plant.reset()
    with pytest.raises(ConfigError, match="a hardware plant runs once"):
        plant.reset()
    plant.close()
    with pytest.raises(HardwareFault, match="let go of"):
        plant.step(LOW)


def test_a_robot_that_does_not_answer_is_not_armed(wires: Callable[..., MemoryWire]) -> None:
    wire = wires(lambda k, now: [])
    plant = plant_on(wire, replace(quick(), patience=0.2))
    with pytest.raises(NotAvailable, match=r"no measurement came on /joint_states, domain \d+, within 0.2 s"):
        plant.reset()
    plant.close()
    wire = wires(lambda k, now: [still(now, (3.3, 0.2))])
    plant = plant_on(wire, replace(quick(), patience=0.2))
    with pytest.raises(
        HardwareFault, match="the robot was not armed: hip is at 3.300 rad, expected 0.374 to 2.768 rad"
    ):
        plant.reset()
    plant.close()
    assert all(values == (0.0, 0.0) for _, values in wire.sent)


def test_starts_that_cannot_be(wires: Callable[..., MemoryWire]) -> None:
    plant = plant_on(wires(), quick(pressure=2e4))
    with pytest.raises(ConfigError, match="start command .* lies outside the limits"):
        plant.reset(Start(command=np.array([3e4, 0.0])))
    with pytest.raises(ConfigError, match="start command .* lies outside the limits"):
        plant.reset(Start(command=np.array([np.nan, 0.0])))
    with pytest.raises(ConfigError, match=r"start command has shape \(1,\)"):
        plant.reset(Start(command=np.array([0.0])))
    plant.close()


def test_open_loop_runs_on_it_as_on_any_plant(wires: Callable[..., MemoryWire]) -> None:
    plant = plant_on(wires())
    done = run(plant, OpenLoopController(), HoldReference(np.array([1.4, 0.6])), 0.25)
    plant.close()
    assert done.position.shape == (30, 2) and done.truth is None
