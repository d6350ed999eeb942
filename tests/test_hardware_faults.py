"""The hardware plant on a wire in memory that misbehaves: what vents, how soon, and what is said."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hardware_rig import DT, LOW, REST, Controller, MemoryWire, after, driven, plant_on, still

from equimus_ctrl.errors import ControllerError, HardwareFault
from equimus_ctrl.loop import run
from equimus_ctrl.plants.hardware.transport import Sample
from equimus_ctrl.recordings import read
from equimus_ctrl.scenarios.references import HoldReference

pytestmark = pytest.mark.real_time


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


def test_a_watch_that_fails_vents(wires: Callable[..., MemoryWire]) -> None:
    wire = wires()
    plant = plant_on(wire)

    def breaks(k: int) -> None:
        if k == 20:
            wire.trouble = lambda: 1 / 0  # type: ignore[assignment, method-assign, return-value]

    with closing(plant), pytest.raises(HardwareFault, match="the watch over the robot failed .ZeroDivisionError"):
        run(plant, Controller(breaks), HoldReference(REST), 2.0)
    assert np.all(wire.pressures[-3:] == 0)


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


@pytest.mark.slow
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
