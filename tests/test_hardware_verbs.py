"""Checking a robot, measuring how late it is, and reading what ROS 2 recorded of it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hardware_rig import DOMAIN, LOOPBACK, emulator, seen_by

pytest.importorskip("cyclonedds.core", reason="Cyclone DDS is not installed: pip install 'equimus-ctrl[hardware]'")
pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed: pip install 'equimus-ctrl[hardware]'")
os.environ["CYCLONEDDS_URI"] = LOOPBACK

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import RecordingError
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.hardware.bag import read_bag
from equimus_ctrl.plants.hardware.settings import Calibration, Channel, HardwareSettings
from equimus_ctrl.recordings import read
from equimus_ctrl.workflow import load_model

MODEL = nominal_model()
STORE = get_typestore(Stores.ROS2_HUMBLE)
KINDS: dict[str, Any] = dict(STORE.types)
STATES, COMMANDS = "/joint_states", "/forward_pressure_controller/commands"


def own_settings(tmp_path: Path) -> str:
    path = tmp_path / "quick.toml"
    path.write_text(f"settle = 0.3\npatience = 8.0\n[wire]\ndomain = {DOMAIN}\n")
    return str(path)


@pytest.mark.slow
@pytest.mark.real_time
def test_a_robot_is_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["hardware", "check", "--hardware", own_settings(tmp_path), "--seconds", "1", "--json"]
    with emulator(tmp_path / "log.json", "--noise", "0.001"):
        assert main(options) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["problems"] == [] and found["listeners"] == 1 and "reactions" not in found
        assert found["rate_hz"] == pytest.approx(120, rel=0.02) and found["joints"] == ["hip", "knee"]
        assert main([*options, "--arm"]) == 0
        found = json.loads(capsys.readouterr().out)
    assert all(moved["reacts"] and moved["moved_rad"] > 0.02 for moved in found["reactions"].values())
    assert 4e3 < max(seen_by(tmp_path / "log.json")["highest"]) <= 5e3


@pytest.mark.slow
@pytest.mark.real_time
def test_a_robot_that_does_not_react_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["hardware", "check", "--hardware", own_settings(tmp_path), "--seconds", "0.5", "--arm"]
    with emulator(tmp_path / "log.json", "--noise", "0.001", "--fault", "deaf:0"):
        assert main(options) == 3
    said = capsys.readouterr().err
    assert "no joint reacted to 5 kPa in maa: the most was" in said and "in baa" in said


@pytest.mark.slow
@pytest.mark.real_time
def test_whoever_stops_a_sweep_is_told_that_the_robot_is_vented(tmp_path: Path) -> None:
    code = "import signal as s; s.signal(s.SIGINT, s.default_int_handler); from equimus_ctrl.cli.main import entry; entry()"
    words = ["hardware", "delay", "--arm", "--hardware", own_settings(tmp_path), "--record", str(tmp_path / "runs")]
    with emulator(tmp_path / "log.json"):
        process = subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.PIPE, text=True)
        until = time.monotonic() + 60
        while not list(tmp_path.glob("runs/*.csv")) and time.monotonic() < until:
            time.sleep(0.05)
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        out = process.communicate(timeout=20)[1]
    assert process.returncode == 130 and "the robot is vented" in out and "delay.csv" in out, out
    assert max(seen_by(tmp_path / "log.json")["highest"]) > 0
    assert read(tmp_path / "runs" / "delay.csv").command[-1].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("arm", "said"), [(True, "was commanded is vented"), (False, "was only listened to")])
def test_whoever_stops_a_check_is_told_what_became_of_the_robot(
    arm: bool, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("equimus_ctrl.workflow.check_hardware", stopped)
    assert main(["hardware", "check", *(["--arm"] if arm else [])]) == 130
    assert said in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
@pytest.mark.real_time
def test_a_robot_that_is_too_slow_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with emulator(tmp_path / "log.json", "--rate", "40"):
        assert main(["hardware", "check", "--hardware", own_settings(tmp_path), "--seconds", "0.5"]) == 3
    said = re.search(r"comes at ([0-9.]+) Hz, expected at least half of the 120 Hz", capsys.readouterr().err)
    assert said is not None and float(said[1]) == pytest.approx(40.0, abs=2.0)


@pytest.mark.slow
@pytest.mark.real_time
def test_delays_and_lags_are_found_and_handed_to_controllers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = {"maa": (0.06, 0.05), "baa": (0.1, 0.08)}
    effects = []
    for name, (late, lag) in truth.items():
        effects += ["--effect", f"transport_delay:{name}:delay={late}"]
        effects += ["--effect", f"first_order_lag:{name}:time_constant={lag}"]
    known = tmp_path / "known.toml"
    options = ["--hardware", own_settings(tmp_path), "--arm", "--set", "duration=12", "--record", str(tmp_path)]
    with emulator(tmp_path / "log.json", "--noise", "0.001", *effects):
        assert main(["hardware", "delay", *options, "--write-model", str(known), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["actuators"]
    for name, (late, lag) in truth.items():
        assert abs(found[name]["delay_s"]["value"] - late) < 0.01
        assert abs(found[name]["lag_s"]["value"] - lag) < 0.01
    effect_names = [effect.name for effect in load_model(known).effects]
    assert effect_names.count("transport_delay") == effect_names.count("first_order_lag") == 2
    assert len(read(tmp_path / "delay.csv").time) > 1400


@pytest.mark.real_time
def test_a_delay_needs_an_armed_robot(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hardware", "delay"]) == 2
    assert "give --arm" in capsys.readouterr().err


def message(kind: str, **values: Any) -> bytes:
    return bytes(STORE.serialize_cdr(KINDS[kind](**values), kind))


def state(stamp: float, names: list[str], position: list[float]) -> bytes:
    nanoseconds = round(stamp * 1e9)
    header = KINDS["std_msgs/msg/Header"](
        stamp=KINDS["builtin_interfaces/msg/Time"](sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9), frame_id=""
    )
    nothing = np.array([])
    return message(
        "sensor_msgs/msg/JointState", header=header, name=names, position=np.array(position), velocity=nothing,
        effort=nothing,
    )  # fmt: skip


def commanded(values: list[float]) -> bytes:
    layout = KINDS["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return message("std_msgs/msg/Float64MultiArray", layout=layout, data=np.array(values))


def bag(
    path: Path, messages: list[tuple[str, str, float, bytes]], plugin: StoragePlugin = StoragePlugin.SQLITE3
) -> Path:
    """A bag of (topic, type, time, bytes)."""
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, kind, at, raw in sorted(messages, key=lambda m: m[2]):
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic, kind], round((100.0 + at) * 1e9), raw)
    return path


def motion(at: float) -> list[float]:
    return [1.4 + 0.1 * np.sin(3 * at), 0.6 + 0.2 * np.cos(2 * at)]


def whole_bag(names: tuple[str, str] = ("hip", "knee"), scale: float = 1.0) -> list[tuple[str, str, float, bytes]]:
    """Two seconds: the device's clock is 7 s ahead, messages take 2 to 5 ms; commands every 50 ms."""
    rng = np.random.default_rng(0)
    found = []
    for k in range(240):
        at = 0.3 + k / 120
        late = 0.002 + 0.003 * rng.random()
        raw = state(at + 107.0, [names[1], names[0]], [value / scale for value in motion(at)[::-1]])
        found.append((STATES, "sensor_msgs/msg/JointState", at + late, raw))
    for k in range(40):
        raw = commanded([100.0 * k, 5e3])
        found.append((COMMANDS, "std_msgs/msg/Float64MultiArray", 0.05 * k, raw))
    return found


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_bag_is_a_recording(plugin: StoragePlugin, tmp_path: Path) -> None:
    found = read_bag(bag(tmp_path / "run", whole_bag(), plugin), MODEL)
    assert found.joints == ("hip", "knee") and found.actuators == ("maa", "baa") and found.before is not None
    # The first row is the first measurement; six commands had come before.
    first = 0.302
    np.testing.assert_allclose(found.position, [motion(at + 0.3) for at in found.time], atol=3e-3)
    assert found.before.tolist() == [600.0, 5e3]
    for at, command in zip(found.time, found.command, strict=True):
        assert command[1] == 5e3 and abs(command[0] / 100.0 - min((at + first) / 0.05, 39.0)) < 1.1
    changes = np.flatnonzero(np.diff(found.command[:, 0]))
    np.testing.assert_allclose(np.diff(found.time[changes + 1]), 0.05, atol=1e-6)


def test_names_units_and_signs_of_a_bag_are_the_wires(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", whole_bag(("a", "b"), np.radians(1)))
    settings = HardwareSettings(
        joints={"hip": Calibration("a", 0.0, np.radians(1)), "knee": Calibration("b", 0.0, np.radians(1))},
        actuators={"maa": Channel(1, 1.0), "baa": Channel(0, 10.0)},
    )
    found = read_bag(path, MODEL, settings)
    np.testing.assert_allclose(found.position, [motion(at + 0.3) for at in found.time], atol=3e-3)
    assert np.all(found.command[:, 0] == 5e3) and found.command[0, 1] == 6e3


def test_the_verb_writes_what_can_be_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = bag(tmp_path / "run", whole_bag())
    assert main(["recordings", "import-bag", str(path), "-o", str(tmp_path / "trials"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["files"] == [str(tmp_path / "trials" / "run.csv")]
    assert len(read(tmp_path / "trials" / "run.csv").time) > 240
    assert main(["recordings", "import-bag", str(path), "-o", str(tmp_path / "trials")]) == 2
    assert "run.csv: is there already; --force replaces it" in capsys.readouterr().err
    assert main(["recordings", "import-bag", str(path), "-o", str(tmp_path / "trials"), "--force"]) == 0


def without(topic: str) -> list[tuple[str, str, float, bytes]]:
    return [m for m in whole_bag() if m[0] != topic]


WRONG: dict[str, tuple[list[tuple[str, str, float, bytes]], str]] = {
    "no states": (without(STATES), r"there is no topic /joint_states \(known: /forward_pressure_controller/commands\)"),
    "no commands": (without(COMMANDS), "there is no topic /forward_pressure_controller/commands"),
    "type": (
        [*without(STATES), (STATES, "std_msgs/msg/Float64MultiArray", 0.0, commanded([1.0]))],
        "/joint_states holds std_msgs/msg/Float64MultiArray, expected sensor_msgs/msg/JointState",
    ),
    "joints": (
        [(STATES, "sensor_msgs/msg/JointState", 0.5, state(1.0, ["hip"], [1.0])), *without(STATES)],
        "there is no column 'position.knee' in /joint_states; did you mean 'position.hip'",
    ),
    "size": (
        [*whole_bag(), (COMMANDS, "std_msgs/msg/Float64MultiArray", 0.6, commanded([1.0]))],
        "message 13 of /forward_pressure_controller/commands has no data.1.; expected all of data.0., data.1. together",
    ),
    "nan": (
        [*whole_bag(), (STATES, "sensor_msgs/msg/JointState", 0.6, state(200.0, ["hip", "knee"], [np.nan, 0.0]))],
        "message 37 of /joint_states, column position.hip: nan is not finite",
    ),
    "few": (
        [(STATES, "sensor_msgs/msg/JointState", 0.5, state(1.0, ["hip", "knee"], [1.0, 0.5])), *without(STATES)],
        "holds 1 measurements and 40 commands, expected at least 2 and 1",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_bags_that_cannot_be_used(name: str, tmp_path: Path) -> None:
    messages, said = WRONG[name]
    with pytest.raises(RecordingError, match=said):
        read_bag(bag(tmp_path / "run", messages), MODEL)


def test_what_is_no_bag_is_told(tmp_path: Path) -> None:
    (tmp_path / "file.db3").write_text("nothing")
    for path in (tmp_path / "nowhere", tmp_path / "file.db3", tmp_path):
        with pytest.raises(RecordingError, match="is no bag that can be read|there is no such file"):
            read_bag(path, MODEL)
