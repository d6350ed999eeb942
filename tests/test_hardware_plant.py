"""The hardware plant on a wire in memory: what it sends, when it vents, what it records, and what it says."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hardware_rig import REST, MemoryWire, quick, still

from equimus_ctrl.controllers.open_loop import OpenLoopController
from equimus_ctrl.errors import ConfigError, ControllerError, HardwareFault, NotAvailable, RecordingError
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.hardware.clock import WINDOW, ClockMap
from equimus_ctrl.plants.hardware.plant import HardwarePlant
from equimus_ctrl.plants.hardware.settings import Calibration, Channel, HardwareSettings
from equimus_ctrl.plants.hardware.transport import Sample
from equimus_ctrl.recordings import read
from equimus_ctrl.scenarios.references import HoldReference
from equimus_ctrl.simulate import run
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, Start

pytestmark = pytest.mark.real_time
MODEL, DT = nominal_model(), 1 / 120
LOW = np.array([5e3, 3e3])


@pytest.fixture
def wires() -> Iterator[Callable[..., MemoryWire]]:
    made: list[MemoryWire] = []

    def make(measure: Callable[[int, float], Sequence[Sample]] | None = None) -> MemoryWire:
        made.append(MemoryWire(measure))
        return made[-1]

    yield make
    for wire in made:
        wire.close()


def plant_on(wire: MemoryWire, settings: HardwareSettings | None = None, **given: object) -> HardwarePlant:
    return HardwarePlant(MODEL, settings or quick(), **{"armed": True, "transport": wire, **given})  # type: ignore[arg-type]


def driven(wire: MemoryWire, command: Array, steps: int, settings: HardwareSettings | None = None) -> str:
    """Steps until it faults; why."""
    plant = plant_on(wire, settings)
    try:
        plant.reset()
        for _ in range(steps):
            plant.step(command)
    except HardwareFault as fault:
        return str(fault)
    finally:
        plant.close()
    return ""


def after(wire: MemoryWire, fault_at: float) -> Array:
    """Commands sent from a time on."""
    return np.array([values for at, values in wire.sent if at >= fault_at])


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


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("silent", r"the latest measurement is 0\.1\d* s old, expected one at least every 0.1 s"),
        ("nan", "hip was measured as nan, expected a number"),
        ("jump", r"knee jumped from 1.040 to 1.540 rad in .* ms, expected at most 30 rad/s"),
        ("range", r"knee is at -0.260 rad, expected -0.185 to 2.150 rad"),
        ("clock", "a sample's stamp is 2 s ahead of its arrival, expected at most 0.5 s"),
        ("other", "measurements come from another publisher than before"),
        ("names", "a sample names hip, expected hip, knee"),
        ("short", "a sample names 2 joints, but has 1 positions"),
    ],
)
def test_what_is_wrong_with_measurements_vents_within_a_period(
    wires: Callable[..., MemoryWire], name: str, message: str
) -> None:
    fell: list[float] = []

    def measure(k: int, now: float) -> list[Sample]:
        if k < 80:
            return [still(now)]
        fell.append(now)
        slowly = (REST[0], max(REST[1] - (k - 80) * 0.1, -0.3))
        return {
            "silent": [], "nan": [still(now, (math.nan, 1.04))], "jump": [still(now, (REST[0], REST[1] + 0.5))],
            "range": [still(now, slowly)], "clock": [still(now, stamp=now + 2.0)], "other": [still(now, source=7)],
            "names": [Sample(now, now, ("hip",), (1.3,))], "short": [Sample(now, now, ("hip", "knee"), (1.3,))],
        }[name]  # fmt: skip

    wire = wires(measure)
    why = driven(wire, LOW, 400)
    assert why.startswith("vented at ")
    assert re.search(message, why), why
    vented = next(at for at, values in wire.sent if at > fell[0] and values == (0.0, 0.0))
    allowed = {"silent": 0.1, "range": 0.12}.get(name, 0.0) + 2.5 * DT
    assert vented - fell[0] < allowed + 0.02
    assert np.all(after(wire, vented) == 0)


def test_duplicates_and_what_comes_out_of_order_are_ignored(wires: Callable[..., MemoryWire]) -> None:
    def measure(k: int, now: float) -> list[Sample]:
        return [still(now), still(now), still(now, (2.4, 0.1), stamp=now - 0.02)]

    wire = wires(measure)
    plant = plant_on(wire)
    plant.reset()
    seen = [plant.step(LOW) for _ in range(30)]
    plant.close()
    assert all(one.position.tolist() == list(REST) for one in seen)
    assert plant.counts.ignored > plant.counts.samples


class Controller:
    """Holds, and once does something else."""

    def __init__(self, act: Callable[[int], object]) -> None:
        self._act = act

    def init(self, spec: PlantSpec, observation: Observation) -> int:
        return 0

    def step(self, observation: Observation, reference: Reference, state: int) -> tuple[object, int]:
        found = self._act(state)
        return LOW if found is None else found, state + 1


def fails(k: int) -> None:
    if k == 20:
        raise ZeroDivisionError("oops")


def hangs(k: int) -> None:
    if k == 20:
        time.sleep(0.4)


def slow(k: int) -> None:
    if k >= 20:
        time.sleep(1.4 * DT)


@pytest.mark.parametrize(
    ("act", "error", "message"),
    [
        (fails, ControllerError, "failed at .*ZeroDivisionError: oops"),
        (lambda k: [math.nan, 0.0] if k == 20 else None, ControllerError, "expected finite pressures"),
        (hangs, HardwareFault, "the controller has not answered for 0.0.* s, expected a command every 8.33 ms"),
        (slow, HardwareFault, "the controller missed 6 deadlines of 8.33 ms in a row, expected at most 5"),
    ],
)
def test_what_is_wrong_with_the_controller_vents(
    wires: Callable[..., MemoryWire], act: Callable[[int], None], error: type[Exception], message: str
) -> None:
    wire = wires()
    plant = plant_on(wire)
    with closing(plant), pytest.raises(error, match=message):
        run(plant, Controller(act), HoldReference(REST), 3.0)
    sent = wire.pressures
    assert np.all(sent[-3:] == 0)
    if act is hangs:
        # Not when it came back at last.
        held = [at for at, values in wire.sent if values == tuple(LOW)]
        vented = next(at for at, values in wire.sent if at > held[-1] and values == (0.0, 0.0))
        assert vented - held[-1] < 8 * DT


def test_a_deadline_missed_now_and_then_is_counted(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    plant = plant_on(wire)

    def dawdles(k: int) -> None:
        if k % 10 == 5:
            time.sleep(1.5 * DT)

    done = run(plant, Controller(dawdles), HoldReference(REST), 0.5)
    plant.close()
    assert plant.counts.misses >= 6 and plant.counts.fault == ""
    assert np.all(np.diff(done.time) > 0.9 * DT) and np.diff(done.time).max() > 1.9 * DT


def test_another_sender_of_commands_vents(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    plant = plant_on(wire)

    def intrudes(k: int) -> None:
        if k == 20:
            wire.wrong = "/commands has another publisher, expected this one alone"

    with closing(plant), pytest.raises(HardwareFault, match="/commands has another publisher"):
        run(plant, Controller(intrudes), HoldReference(REST), 2.0)
    assert np.all(wire.pressures[-3:] == 0)


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


def test_a_watch_that_fails_vents(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    plant = plant_on(wire)

    def breaks(k: int) -> None:
        if k == 20:
            wire.trouble = lambda: 1 / 0  # type: ignore[assignment, method-assign, return-value]

    with closing(plant), pytest.raises(HardwareFault, match="the watch over the robot failed .ZeroDivisionError"):
        run(plant, Controller(breaks), HoldReference(REST), 2.0)
    assert np.all(wire.pressures[-3:] == 0)


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


def test_a_recording_that_cannot_go_on_vents_and_stays_readable(
    wires: Callable[..., MemoryWire], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full in the middle of a row."""
    whole, written = os.write, []

    def full(file: int, data: bytes) -> int:
        written.append(len(data))
        if len(written) == 41:
            return whole(file, data[:12])
        if len(written) > 41:
            raise OSError(28, "No space left on device")
        return whole(file, data)

    wire = wires()
    plant = plant_on(wire, record=tmp_path / "run.csv")
    plant.reset()
    monkeypatch.setattr("equimus_ctrl.recordings.stream.os.write", full)

    def steps() -> None:
        for _ in range(100):
            plant.step(LOW)

    with closing(plant), pytest.raises(HardwareFault, match="vented at .*run.csv: cannot be written .No space left"):
        steps()
    assert np.all(wire.pressures[-3:] == 0) and len(read(tmp_path / "run.csv").time) == 39


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


def test_a_process_that_is_told_to_end_vents_first(tmp_path: Path) -> None:
    code = """
    import sys, time
    sys.path.insert(0, {tests!r})
    from hardware_rig import MemoryWire, quick
    from equimus_ctrl.models.model import nominal_model
    from equimus_ctrl.plants.hardware.plant import HardwarePlant
    wire = MemoryWire()
    plant = HardwarePlant(nominal_model(), quick(), armed=True, transport=wire)
    plant.reset()
    try:
        print("ready", flush=True)
        while True:
            plant.step([5e3, 3e3])
    except BaseException as error:
        print(type(error).__name__, error)
    finally:
        plant.close()
        print(wire.sent[-1][1], next(sent for _, sent in reversed(wire.sent) if any(sent)))
    """
    for number, said in ((signal.SIGTERM, "HardwareFault vented at"), (signal.SIGINT, "KeyboardInterrupt")):
        process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(code.format(tests=os.path.dirname(__file__)))],
            stdout=subprocess.PIPE, text=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )  # fmt: skip
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        time.sleep(0.3)
        process.send_signal(number)
        out = process.communicate(timeout=20)[0]
        assert said in out and "(0.0, 0.0) (5000.0, 3000.0)" in out, out


def test_clocks_are_as_far_apart_as_the_quickest_sample_says() -> None:
    rng = np.random.default_rng(0)
    clock = ClockMap.of(0.0, 100.0 + 0.01)
    for k in range(1, 600):
        stamp = k / 120
        clock = clock.seen(stamp, 100.0 + stamp + 0.002 + abs(rng.normal(0, 0.003)))
    assert clock.local(5.0) == pytest.approx(105.002, abs=2e-4)
    assert clock.late(5.0, 105.012) == pytest.approx(0.01, abs=2e-4)
    # A clock that loses 1e-4 is followed within the window.
    for k in range(600, 600 + int(4 * WINDOW * 120)):
        stamp = k / 120
        clock = clock.seen(stamp, 100.0 + stamp * 1.0001 + 0.002)
    assert clock.late(stamp, 100.0 + stamp * 1.0001 + 0.002) < 2.1 * WINDOW * 1e-4


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"rate": 0.0}, "rate is 0, expected more than 0"),
        ({"wire": {"domain": 300}}, "domain is 300, expected 0 to 232"),
        ({"wire": {"states": "joint_states"}}, "states is 'joint_states', expected a topic such as /joint_states"),
        ({"wire": {"topic": "x"}}, "own.toml: wire: there is no key 'topic'"),
        ({"safety": {"slew": -1.0}}, "safety: slew is -1, expected more than 0"),
        ({"safety": {"misses": -1}}, "safety: misses is -1, expected at least 0"),
        ({"safety": {"stale": 0.02}}, "safety: stale is 0.02 s, expected at least 3 periods of 0.008333 s"),
        ({"joints": {"hip": {"scale": 0.0}}}, "joints.hip: scale is 0, expected a finite number other than 0"),
        ({"joints": {"ankle": {}}}, "there is no joint 'ankle'"),
        ({"joints": {"hip": 3}}, "joints.hip is 3, expected a table"),
        ({"joints": {"hip": {"name": "knee"}}}, "joints are called knee, knee on the wire"),
        ({"actuators": {"maa": {"index": 1}}}, "actuators have the indices 1, 1, expected 0 to 1, each once"),
        ({"actuators": {"maa": {"unit": 0.0}}}, "actuators.maa: unit is 0 Pa, expected more than 0"),
        ({"format": "equimus-ctrl/hardware/9"}, "expected 'equimus-ctrl/hardware/1'"),
    ],
)
def test_settings_that_make_no_sense(data: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        HardwareSettings.from_dict(data, "own.toml").for_robot(("hip", "knee"), ("maa", "baa"), "own.toml")
    assert message in str(raised.value) and "own.toml" in str(raised.value)


def test_settings_are_what_their_table_says() -> None:
    from equimus_ctrl import presets

    path = presets.find("hardware", "equimus_leg.toml")
    assert path is not None
    own = HardwareSettings.from_dict(presets.read_toml(path), str(path))
    assert HardwareSettings.from_dict(own.to_dict()) == own
    assert replace(own, joints={}, actuators={}) == HardwareSettings()


def test_open_loop_runs_on_it_as_on_any_plant(wires: Callable[..., MemoryWire]) -> None:
    plant = plant_on(wires())
    done = run(plant, OpenLoopController(), HoldReference(np.array([1.4, 0.6])), 0.25)
    plant.close()
    assert done.position.shape == (30, 2) and done.truth is None
