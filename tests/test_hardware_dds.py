"""Over ROS 2's wire: an emulator as a process of its own, controllers that track, faults, and the bytes that are sent.

All of it on loopback, in a domain of this process.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_rig import DOMAIN, LOOPBACK, PATIENT, SHARED, emulator, patient, quick, seen_by, within_limits

pytest.importorskip("cyclonedds.core", reason="Cyclone DDS is not installed: pip install 'equimus-ctrl[hardware]'")
os.environ["CYCLONEDDS_URI"] = LOOPBACK

from equimus_ctrl.cli.main import main
from equimus_ctrl.effects.valves import TransportDelay
from equimus_ctrl.emulation.emulator import TICK
from equimus_ctrl.errors import ConfigError, HardwareFault, NotAvailable
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.hardware import messages
from equimus_ctrl.plants.hardware.dds import DdsDevice, DdsHost
from equimus_ctrl.plants.hardware.plant import HardwarePlant
from equimus_ctrl.plants.hardware.settings import HardwareSettings, Wire
from equimus_ctrl.plants.hardware.transports import transport_entry
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.recordings import read
from equimus_ctrl.scenarios.references import FunctionReference
from equimus_ctrl.types import Array
from equimus_ctrl.workflow import load_controller, load_scenario

pytestmark = pytest.mark.real_time
MODEL = nominal_model()
SLEW = 1e6
LOW = np.array([5e3, 3e3])
COMMANDS = "/forward_pressure_controller/commands"


def until(condition: Any, seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return False


def swaying(time: float) -> Array:
    return np.array([1.45, 0.6]) + np.array([0.07, 0.12]) * np.sin([2.0 * time, 3.0 * time])


def rmse(time: Array, position: Array) -> Array:
    settled = (time > 1.5) & (time < 5.9)
    error = position[settled] - [swaying(t) for t in time[settled].tolist()]
    return np.asarray(np.sqrt((error**2).mean(axis=0)))


@pytest.fixture(scope="module")
def leg(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """An emulator without faults; its log."""
    log = tmp_path_factory.mktemp("emulator") / "log.json"
    with emulator(log, "--noise", "0.0005", *PATIENT, domain=SHARED):
        yield log
    assert within_limits(seen_by(log), SLEW / 120)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pid", "nmpc"])
def test_controllers_track_over_the_wire_as_in_simulation(leg: Path, name: str, tmp_path: Path) -> None:
    scenario = load_scenario("hold", MODEL.morphology, search=False)
    own = load_controller(name, scenario, None, MODEL.morphology)
    reference, record = FunctionReference(swaying), tmp_path / "run.csv"
    with closing(HardwarePlant(MODEL, patient(SHARED), armed=True, record=record)) as plant:
        run(plant, own, reference, 6.0)
    assert plant.counts.fault == ""
    # What the loop says it was late by, which is this machine's; commands wait for the emulator's next tick.
    late = plant.counts.to_dict()["latency_p50_s"] + 0.5 / TICK
    delays = tuple(TransportDelay(location=name, delay=late) for name in MODEL.morphology.actuator_names)
    leg_and_loop = MujocoPlant(replace(MODEL, effects=delays), nominal=MODEL, noise=5e-4)
    simulated = run(leg_and_loop, own, reference, 6.0, seed=0)
    # What a controller sees is up to a period old: the recording has the angles at the instants of its rows.
    real = read(record)
    assert np.all(rmse(real.time, real.position) <= 1.2 * rmse(simulated.time, simulated.position))


@pytest.mark.slow
def test_instants_begin_soon_after_a_measurement_and_stamps_are_even(tmp_path: Path) -> None:
    with (
        emulator(tmp_path / "log.json", *PATIENT),
        closing(HardwarePlant(MODEL, patient(), armed=True)) as plant,
    ):
        ages = []
        observation = plant.reset()
        for _ in range(240):
            observation = plant.step(LOW)
            ages.append(observation.time - observation.stamp)
    assert plant.counts.fault == ""
    # Of 8.3 ms that a measurement may be old: what is later than its instant is this machine's.
    assert np.median(ages) < 3e-3


# What else the emulator can do is in test_emulator, what a robot's host does about it in test_hardware_faults.
FAULTS = {
    "stall": ("stall:{t}:0.2", "the latest measurement is"),
    "nan": ("nan:{t}:0.05", "was measured as nan"),
    "second_publisher": ("second_publisher:{t}:1", "/joint_states has 2 publishers|from another publisher"),
    "crash": ("crash:{t}", "the latest measurement is"),
}


def driven(
    log: Path, tmp_path: Path, *options: str, seconds: float = 4.0, settings: HardwareSettings | None = None
) -> tuple[str, HardwarePlant]:
    """Swaying by open loop until it faults; why."""
    settings, record = settings or quick(), tmp_path / "run.csv"
    with emulator(log, *options), closing(HardwarePlant(MODEL, settings, armed=True, record=record)) as plant:
        try:
            plant.reset()
            for k in range(round(120 * seconds)):
                plant.step(LOW * (1 + 0.3 * np.sin(k / 30)))
        except HardwareFault as fault:
            why = str(fault)
        else:
            why = ""
        plant.close()
        time.sleep(0.15)  # for the last command to be received
    return why, plant


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_faults_vent_and_are_told_and_what_came_before_is_recorded(name: str, tmp_path: Path) -> None:
    log, (fault, message) = tmp_path / "log.json", FAULTS[name]
    why, plant = driven(log, tmp_path, "--fault", fault.format(t=3.5))
    assert why.startswith("vented at ") and plant.counts.fault == why
    assert re.search(message, why), why
    found = read(tmp_path / "run.csv")
    assert len(found.time) > 10 and np.all(found.command <= 50e3)
    if name != "crash":  # it did not live to tell
        seen = seen_by(log)
        assert within_limits(seen, SLEW / 120)
        # By the host, not by the watchdog, and soon.
        assert seen["watchdog"] == 0 and 3.5 <= seen["vented"] < 4.0


@pytest.mark.slow
def test_losses_are_borne(tmp_path: Path) -> None:
    log = tmp_path / "log.json"
    why, plant = driven(log, tmp_path, "--loss", "0.3", "--jitter", "0.002", "--seed", "3", seconds=3.0)
    assert why == "" and plant.counts.misses <= 3
    seen = seen_by(log)
    # What is lost in between makes a step of several.
    assert within_limits(seen) and seen["watchdog"] <= 1
    found = read(tmp_path / "run.csv")
    assert len(found.time) > 350 and np.all(np.diff(found.time) > 0)


@pytest.mark.slow
def test_a_controller_that_is_killed_is_vented_by_the_device(tmp_path: Path) -> None:
    code = f"""
    import sys
    sys.path.insert(0, {os.path.dirname(__file__)!r})
    from pathlib import Path
    from hardware_rig import quick
    from equimus_ctrl.models.model import nominal_model
    from equimus_ctrl.plants.hardware.plant import HardwarePlant
    plant = HardwarePlant(nominal_model(), quick({DOMAIN}), armed=True, record=Path({str(tmp_path / "run.csv")!r}))
    plant.reset()
    while True:
        plant.step([5e3, 3e3])
    """
    log = tmp_path / "log.json"
    with emulator(log) as robot:
        process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)])
        assert until(lambda: (tmp_path / "run.csv").exists() and log.exists(), 20)
        time.sleep(1.0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        time.sleep(0.5)
        robot.send_signal(signal.SIGTERM)
        robot.wait(20)
    seen = seen_by(log)
    assert seen["watchdog"] == 1 and seen["vented"] is not None and seen["time"] - seen["vented"] > 0.2
    assert max(seen["highest"]) == 5e3
    found = read(tmp_path / "run.csv")
    assert len(found.time) > 80 and np.all(found.command[2:] == [5e3, 3e3])  # the first are within the slew limit


@pytest.mark.slow
def test_someone_else_who_sends_commands_is_noticed(leg: Path) -> None:
    with (
        closing(DdsHost(Wire(domain=SHARED, commands=COMMANDS))) as second_publisher,
        closing(HardwarePlant(MODEL, quick(SHARED), armed=True)) as plant,
    ):
        assert not plant._wire.trouble()  # who only listens is no publisher
        second_publisher.prepare()
        assert until(plant._wire.trouble)
        with pytest.raises(NotAvailable, match="has another publisher, expected this one alone"):
            plant.reset()


def test_a_wrong_type_on_the_topic_is_named() -> None:
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    wire = Wire(domain=DOMAIN, states="/wrong", commands="/commands")
    participant = DomainParticipant(DOMAIN)
    writer = DataWriter(participant, Topic(participant, "rt/wrong", messages.Float64MultiArray))
    host = DdsHost(wire)
    assert until(host.trouble)
    assert host.trouble() == (
        "/wrong is published as std_msgs::msg::dds_::Float64MultiArray_, expected sensor_msgs::msg::dds_::JointState_"
    )
    host.close()
    del writer


def test_the_bytes_are_those_of_ros_2() -> None:
    """As rosbags, which knows ROS 2's definitions, serialises them."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    kinds = store.types
    state = kinds["sensor_msgs/msg/JointState"](
        header=kinds["std_msgs/msg/Header"](
            stamp=kinds["builtin_interfaces/msg/Time"](sec=12, nanosec=500_000_000), frame_id=""
        ),
        name=["hip", "knee"],
        position=np.array([1.25, -0.5]),
        velocity=np.array([]),
        effort=np.array([]),
    )
    wanted = bytes(store.serialize_cdr(state, "sensor_msgs/msg/JointState"))
    assert messages.joint_state(12.5, ["hip", "knee"], [1.25, -0.5]).serialize() == wanted
    array = kinds["std_msgs/msg/Float64MultiArray"](
        layout=kinds["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0), data=np.array([1e4, 2.5e4])
    )
    wanted = bytes(store.serialize_cdr(array, "std_msgs/msg/Float64MultiArray"))
    assert messages.multi_array([1e4, 2.5e4]).serialize() == wanted


@pytest.mark.slow
def test_a_device_obeys_finite_commands_of_the_right_size_alone(tmp_path: Path) -> None:
    log = tmp_path / "log.json"
    host = DdsHost(Wire(domain=DOMAIN, commands=COMMANDS))
    with emulator(log) as robot:
        assert until(host.take, 20)
        for values in ([1e3], [1e3, float("nan")], [1e3, 2e3, 3e3], [9e9, -5.0], [1e3, 2e3]):
            host.send(values)
            time.sleep(0.02)
        robot.send_signal(signal.SIGTERM)
        robot.wait(20)
    host.close()
    seen = seen_by(log)
    assert (seen["commands"], seen["refused"]) == (5, 3)
    assert seen["highest"] == [9e9, 2e3] and seen["lowest"] == [0.0, -5.0]


def test_an_extra_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cyclonedds.core", None)
    with pytest.raises(NotAvailable, match=r"pip install 'equimus-ctrl\[hardware\]'"):
        transport_entry("dds").host(Wire())
    with pytest.raises(ConfigError, match="there is no transport 'seriell'"):
        transport_entry("seriell")


@pytest.mark.slow
def test_a_domain_that_cannot_be_joined_is_told(tmp_path: Path) -> None:
    code = "from equimus_ctrl.cli.main import entry; entry()"
    uri = '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="nosuch0"/></Interfaces></General></Domain></CycloneDDS>'
    done = subprocess.run(
        [sys.executable, "-c", code, "emulate", "--duration", "1", "--domain", str(DOMAIN)],
        capture_output=True, text=True, env={**os.environ, "CYCLONEDDS_URI": uri}, cwd=tmp_path, timeout=60,
    )  # fmt: skip
    assert done.returncode == 2
    assert f"equimus-ctrl: DDS domain {DOMAIN} cannot be joined" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_the_commands_run_and_diagnose_can_read_what_was_recorded(leg: Path, tmp_path: Path) -> None:
    own = tmp_path / "quick.toml"
    own.write_text(f"settle = 0.3\n[wire]\ndomain = {SHARED}\n")
    options = ["--plant", "hardware", "--hardware", str(own), "--set", "duration=2", "--no-figures"]
    out = ["--output", str(tmp_path / "out"), "--record", str(tmp_path / "rec")]
    assert main(["run", "chirp", *options, *out]) == 0  # a dry run
    assert not (tmp_path / "rec").exists()
    for name in ("chirp.csv", "chirp-2.csv"):
        assert main(["run", "chirp", *options, *out, "--arm", "--json"]) == 2, "the results before are there"
        assert main(["run", "chirp", *options, *out, "--arm", "--json", "--force"]) == 0
        assert len(read(tmp_path / "rec" / name).time) > 230
    assert main(["run", "chirp", "--arm"]) == 2
    assert main(["run", "chirp", *options, "--effect", "dead_zone:baa:threshold=4000"]) == 2
    assert main(["run", "push", *options]) == 2
    assert main(["run", "chirp", *options, "--noise", "0.001"]) == 2


def test_a_device_and_a_host_leave_the_domain_when_closed() -> None:
    wire = Wire(domain=DOMAIN, states="/elsewhere", commands="/nowhere")
    device, host = DdsDevice(wire), DdsHost(wire)
    assert until(host.listeners)
    host.prepare()
    assert until(lambda: len(host._end.publishers()) >= 2)
    device.publish(1.0, ["hip"], [0.5])
    assert until(host.take)
    device.close()
    assert until(lambda: not any(topic == "rt/elsewhere" for topic, _, _ in host._end.publishers()))
    host.close()
