"""Logs of other programs are read as what they hold: names, units, signs, clocks, every bit."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import ConfigError, NotAvailable, RecordingError
from equimus_ctrl.recordings import Mapping, RecordingWarning, read_mapping, write_recording
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow import gather

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'equimus-ctrl[logs]'")
pytest.importorskip("mcap", reason="mcap is not installed: pip install 'equimus-ctrl[logs]'")
pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'equimus-ctrl[logs]'")

from foreign_logs import (
    ACTUATORS,
    ARM,
    JOINTS,
    ONE,
    TIMES,
    XML,
    array,
    goals,
    joint_state,
    motion,
    trajectory,
    write_bag,
    write_bam,
    write_json_mcap,
    write_lerobot,
    write_torch,
)

DEGREES = Mapping.from_dict({"units": {"pos": "deg", "cmd": "deg"}})
ORDER = Mapping.from_dict({"names": {"pos": ["elbow", "shoulder"], "cmd": ["m1", "m2"]}})


def same(found: Recording, times: Any = TIMES, exact: bool = True) -> None:
    """What the arm did."""
    assert found.joints == JOINTS and found.actuators == ACTUATORS
    check = np.testing.assert_array_equal if exact else np.testing.assert_allclose
    check(found.position, motion(times)) if exact else check(found.position, motion(times), atol=1e-7)
    check(found.command, goals(times)) if exact else check(found.command, goals(times), atol=1e-7)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet", ".mcap"])
def test_every_bit_comes_back(suffix: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    written = Recording(
        "trial", np.cumsum(rng.uniform(0.005, 0.015, 50)) + 1e-3 / 3, rng.normal(size=(50, 2)),
        rng.normal(size=(50, 2)), ACTUATORS, JOINTS, velocity=rng.normal(size=(50, 2)),
        measured=np.column_stack([rng.normal(size=50), np.full(50, np.nan)]), before=rng.normal(size=2),
        sites={"tip.x": rng.normal(size=50)}, notes={"source": "°", "settled": "no"},
    )  # fmt: skip
    path = tmp_path / f"trial{suffix}"
    eq.write_recording(path, written)
    for model in (None, ARM):
        found = eq.read_recording(path, model)
        assert found.name == "trial" and dict(found.notes) == dict(written.notes)
        for key in ("time", "command", "position", "velocity", "measured", "before"):
            np.testing.assert_array_equal(getattr(found, key), getattr(written, key))
        np.testing.assert_array_equal(found.sites["tip.x"], written.sites["tip.x"])


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("kind", ["array", "joint_state", "trajectory"])
def test_a_bags_topics_are_found_by_kind_and_name(kind: str, plugin: str, tmp_path: Path) -> None:
    messages = [
        joint_state("/joint_states", t, JOINTS[::-1], q[::-1]) for t, q in zip(TIMES, motion(TIMES), strict=True)
    ]
    for t, u in zip(TIMES, goals(TIMES), strict=True):
        messages.append(
            {
                "array": lambda t, u: array("/forward_position_controller/commands", t, u),
                "joint_state": lambda t, u: joint_state("/joint_commands", t, ("elbow", "shoulder"), u[::-1]),
                "trajectory": lambda t, u: trajectory("/controller/joint_trajectory", t, ("elbow", "m1"), [u[::-1]]),
            }[kind](t, u)
        )
    messages.append(joint_state("/gripper/joint_states", 0.5, ("finger",), [0.1]))
    found = eq.read_recording(write_bag(tmp_path / "run", messages, plugin), ARM)
    same(found)
    np.testing.assert_allclose(found.time, TIMES, atol=1e-6)


def two_clocks() -> list[tuple[str, str, float, dict[str, Any]]]:
    messages = [joint_state("/joint_states", t, JOINTS, q) for t, q in zip(TIMES, motion(TIMES), strict=True)]
    return messages + [array("/commands", 0.05 * k + 0.0012, [0.01 * k, 1.0]) for k in range(20)]


def test_commands_between_measurements_count_from_the_nearest_and_nothing_is_made_up(tmp_path: Path) -> None:
    found = eq.read_recording(write_bag(tmp_path / "run", two_clocks()), ARM)
    first = int(np.searchsorted(TIMES, 0.0012))  # nothing is known of commands before the first
    np.testing.assert_array_equal(found.position, motion(TIMES[first:]))
    np.testing.assert_allclose(found.time, TIMES[first:] - TIMES[first], atol=1e-6)
    expected = np.floor((TIMES[first:] + 1e-6) / 0.05) * 0.01
    np.testing.assert_allclose(found.command[:, 0], expected)
    assert found.notes["commands"].startswith("each counts from the measurement nearest to it, at most 0.0012")


def test_all_rows_keep_the_instants_of_commands(tmp_path: Path) -> None:
    every = Mapping.from_dict({"clock": {"rows": "all"}})
    found = eq.read_recording(write_bag(tmp_path / "run", two_clocks()), ARM, every)
    changes = np.flatnonzero(np.diff(found.command[:, 0])) + 1
    np.testing.assert_allclose(np.diff(found.time[changes]), 0.05, atol=1e-6)
    assert len(found.time) > len(TIMES) and "commands" not in found.notes


def test_commands_that_are_lost_are_told(tmp_path: Path) -> None:
    messages = [joint_state("/joint_states", t, JOINTS, q) for t, q in zip(TIMES, motion(TIMES), strict=True)]
    messages += [array("/commands", 0.002 * k, [0.01 * k, 1.0]) for k in range(480)]
    path = write_bag(tmp_path / "run", messages)
    with pytest.warns(RecordingWarning, match="commands were followed by another before the next measurement"):
        eq.read_recording(path, ARM)


def test_stamps_of_another_clock_are_brought_onto_the_bags(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    late = 0.001 + 0.004 * rng.random(len(TIMES))
    messages = [
        joint_state("/joint_states", t + own, JOINTS, q, stamp=t + 50.0)
        for t, own, q in zip(TIMES, late, motion(TIMES), strict=True)
    ]
    messages += [array("/commands", t, u) for t, u in zip(TIMES, goals(TIMES), strict=True)]
    found = eq.read_recording(write_bag(tmp_path / "run", messages), ARM)
    np.testing.assert_allclose(np.diff(found.time), 0.01, atol=1e-6)


def test_json_of_an_mcap_file(tmp_path: Path) -> None:
    states = [(t, {"name": list(JOINTS), "position": list(q)}) for t, q in zip(TIMES, motion(TIMES), strict=True)]
    sent = [(t, {"left": {"goal": u[0]}, "right": {"goal": u[1]}}) for t, u in zip(TIMES, goals(TIMES), strict=True)]
    path = write_json_mcap(
        tmp_path / "run.mcap", {"/joints": ("sensor_msgs/JointState", states), "/goal": ("mine", sent)}
    )
    mapping = Mapping.from_dict(
        {"columns": {"cmd.m1": {"topic": "/goal", "column": "left.goal"}, "cmd": {"m2": "right.goal"}}}
    )
    same(eq.read_recording(path, ARM, mapping))


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
@pytest.mark.parametrize("names", [("shoulder.pos", "elbow.pos"), {"motors": ["m1", "m2"]}, None])
def test_episodes_of_lerobot_are_trials(version: str, names: Any, tmp_path: Path) -> None:
    path = write_lerobot(tmp_path / "set", version, names)
    mapping = DEGREES
    if not isinstance(names, tuple):
        mapping = Mapping.from_dict({"units": {"pos": "deg", "cmd": "deg"}, "names": {"pos": list(JOINTS)}})
    if names is None:
        mapping = replace(mapping, names={"pos": JOINTS, "cmd": ACTUATORS})
    if isinstance(names, dict):  # motors, whose positions are not the joints' by name
        mapping = replace(
            mapping,
            columns=Mapping.from_dict(
                {"columns": {f"pos.{j}": f"observation.state.{m}" for j, m in zip(JOINTS, ACTUATORS, strict=True)}}
            ).columns,
        )
    found = gather(path, ARM, mapping)
    assert [trial.name for trial in found] == ["episode_000000", "episode_000001"]
    for episode, trial in enumerate(found):
        same(trial, TIMES + episode, exact=False)
        np.testing.assert_array_equal(trial.time, TIMES.astype(np.float32).astype(float))


def test_the_unit_of_lerobots_numbers_is_never_guessed(tmp_path: Path) -> None:
    path = write_lerobot(tmp_path / "silent")
    with pytest.raises(RecordingError, match=r"what observation\.state measures is not in the dataset"):
        gather(path, ARM)
    same(gather(write_lerobot(tmp_path / "told", unit="deg"), ARM)[0], exact=False)


@pytest.mark.parametrize("suffix", [".npz", ".pt"])
def test_arrays_without_names_need_their_order(suffix: str, tmp_path: Path) -> None:
    """PACE's ``chirp_data.pt``, and the same as npz."""
    path = tmp_path / f"chirp_data{suffix}"
    data = {"time": TIMES, "dof_pos": motion(TIMES)[:, ::-1], "des_dof_pos": goals(TIMES)}
    if suffix == ".npz":
        np.savez(path, **data)  # type: ignore[arg-type]
    else:
        write_torch(path, data)
    with pytest.raises(RecordingError, match="the 2 elements of 'dof_pos' have no names; expected pos under"):
        eq.read_recording(path, ARM)
    same(eq.read_recording(path, ARM, ORDER), exact=suffix == ".npz")


def test_a_log_of_bam_is_cut_where_torque_is_off(tmp_path: Path) -> None:
    found = eq.read_recording(write_bam(tmp_path / "whole.json"), ONE)
    np.testing.assert_array_equal(found.position[:, 0], motion(TIMES)[:, 0])
    assert found.notes["bam.kp"] == "32"
    torque = np.ones(len(TIMES), dtype=bool)
    torque[40:60] = False
    parts = gather(write_bam(tmp_path / "parts.json", torque), ONE)
    assert [(own.name, len(own.time)) for own in parts] == [("parts_1", 40), ("parts_2", 40)]
    np.testing.assert_array_equal(parts[1].command[:, 0], goals(TIMES)[60:, 0])


def test_a_mapping_of_a_csv_file_says_units_signs_offsets_and_clock(tmp_path: Path) -> None:
    path, file = tmp_path / "log.csv", tmp_path / "map.toml"
    q, u = motion(TIMES), goals(TIMES)
    rows = zip(TIMES, 90.0 - np.degrees(q[:, 0]), q[:, 1] * 4096 / (2 * np.pi), u[:, 0], u[:, 1], strict=True)
    text = (
        "".join(f"{int(t * 1e6 + 0.5)},on,{a!r},{b!r},{c!r},{d!r}\n" for t, a, b, c, d in rows)
        .replace("np.float64(", "")
        .replace(")", "")
    )
    path.write_text("stamp,state,shoulder_deg,elbow_ticks,u1,u2\n" + text)
    file.write_text(
        f"""format = "equimus-ctrl/mapping/1"
[clock]
column = "stamp"
unit = "us"
[columns]
"pos.shoulder" = {{ column = "shoulder_deg", unit = "deg", sign = -1, offset = 90 }}
pos.elbow = {{ column = "elbow_ticks", scale = {2 * np.pi / 4096!r} }}
cmd.m1 = "u1"
cmd.m2 = "u2"
"""
    )
    for given in (file, read_mapping(file)):
        found = eq.read_recording(path, ARM, given)
        np.testing.assert_allclose(found.position, q, atol=1e-12)
        np.testing.assert_allclose(found.time, TIMES, atol=1e-12)
        np.testing.assert_array_equal(found.command, u)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"colums": {}}, r"there is no key 'colums'; did you mean 'columns'\?"),
        ({"format": "equimus-ctrl/mapping/2"}, "format is 'equimus-ctrl/mapping/2', expected 'equimus-ctrl/mapping/1'"),
        ({"columns": {"position.elbow": "q"}}, "'position.elbow' is no column of a recording; did you mean 'pos"),
        ({"columns": {"pos.elbow": {"column": "q", "units": "deg"}}}, "there is no key 'units'; did you mean 'unit'"),
        ({"columns": {"pos.elbow": {"column": "q", "unit": "degrees"}}}, "there is no unit 'degrees'; did you mean 'deg"),
        ({"columns": {"pos.elbow": {"column": "q", "unit": "kPa"}}}, "unit is 'kPa', which measures Pa; expected rad"),
        ({"columns": {"pos.elbow": {"column": "q", "sign": 2}}}, "sign is 2, expected 1 or -1"),
        ({"columns": {"pos.elbow": {"column": "q", "scale": 1.0, "unit": "deg"}}}, "expected one of the two"),
        ({"columns": {"pos.elbow": {"unit": "deg"}}}, "column is missing"),
        ({"columns": {"pos.elbw": "q"}}, "there is no joint 'elbw'; did you mean 'elbow'"),
        ({"clock": {"unit": "min"}}, "there is no unit of time 'min'"),
        ({"clock": {"rows": "both"}}, "there is no choice of rows 'both'"),
        ({"units": {"position": "deg"}}, "there is no prefix 'position'"),
        ({"names": {"pos": ["a", "a"]}}, "expected each name once"),
        ({"topics": {"state": "/x"}}, "there is no key 'state'; did you mean 'states'"),
    ],
)  # fmt: skip
def test_a_mapping_that_cannot_be_is_told(data: dict[str, Any], said: str, tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    columns = {"q": TIMES, "time": TIMES, "cmd.m1": TIMES, "cmd.m2": TIMES, "pos.shoulder": TIMES}
    np.savez(path, **columns)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=said):
        eq.read_recording(path, ARM, Mapping.from_dict(data))


def test_a_library_that_is_missing_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    trial = Recording("trial", TIMES, goals(TIMES), motion(TIMES), ACTUATORS, JOINTS)
    for module, suffix, extra in (
        ("mcap", ".mcap", "logs"),
        ("pyarrow", ".parquet", "logs"),
        ("rerun", ".rrd", "rerun"),
    ):
        monkeypatch.setitem(__import__("sys").modules, module, None)
        with pytest.raises(
            NotAvailable, match=rf"is not installed; get it with: pip install 'equimus-ctrl\[{extra}\]'"
        ):
            write_recording(tmp_path / f"trial{suffix}", trial)


def test_verbs_take_logs_with_a_mapping(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot, file = tmp_path / "arm.xml", tmp_path / "map.toml"
    robot.write_text(XML)
    file.write_text('[units]\npos = "deg"\ncmd = "deg"\n')
    path = write_lerobot(tmp_path / "set")
    given = [str(path), "--model", str(robot), "--map", str(file), "--json"]
    assert main(["score", *given]) == 0
    scored = json.loads(capsys.readouterr().out)
    assert main(["recordings", "import", *given, "-o", str(tmp_path / "trials")]) == 0
    assert [Path(name).name for name in json.loads(capsys.readouterr().out)["files"]] == [
        "episode_000000.csv",
        "episode_000001.csv",
    ]
    assert main(["score", str(tmp_path / "trials"), "--model", str(robot), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["trials"] == scored["trials"]
    assert main(["recordings", "check", *given]) == 0
    assert main(["score", *given[:3]]) == 2
    assert "what observation.state measures is not in the dataset" in capsys.readouterr().err


def test_the_mapping_of_the_page_is_one() -> None:
    page = (Path(__file__).resolve().parents[1] / "docs" / "logs.md").read_text()
    (block,) = (own.partition("```")[0] for own in page.split("```toml\n")[1:])
    mapping = Mapping.from_dict(tomllib.loads(block))
    assert mapping.columns["pos.elbow"].offset == 90 and mapping.columns["vel.elbow"].column == "elbow_rate"
    assert mapping.clock.unit == "us" and mapping.names["pos"] == ("shoulder", "elbow")


def test_a_folder_of_logs_is_a_set(tmp_path: Path) -> None:
    for name in ("b", "a"):
        write_bam(tmp_path / f"{name}.json")
    (tmp_path / "notes.json").write_text("{}")
    assert [trial.name for trial in gather(tmp_path, ONE)] == ["a", "b"]
