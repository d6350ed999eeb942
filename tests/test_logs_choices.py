"""What of a log is the robot's is said by the log, a mapping or nobody: topics, orders, units, notes, limits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import ConfigError, RecordingError
from equimus_ctrl.recordings import Mapping, arrays
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow import gather

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'equimus-ctrl[logs]'")
pytest.importorskip("mcap", reason="mcap is not installed: pip install 'equimus-ctrl[logs]'")
pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'equimus-ctrl[logs]'")

from foreign_logs import (
    ACTUATORS,
    ARM,
    JOINTS,
    TIMES,
    XML,
    array,
    goals,
    joint_state,
    motion,
    trajectory,
    write_bag,
    write_json_mcap,
    write_lerobot,
    write_torch,
)


def states(topic: str = "/joint_states", values: Any = motion) -> list[Any]:
    return [joint_state(topic, t, JOINTS, q) for t, q in zip(TIMES, values(TIMES), strict=True)]


def sent(label: str = "m1,m2") -> list[Any]:
    return [array("/commands", t, u, label) for t, u in zip(TIMES, goals(TIMES), strict=True)]


def trial(**more: Any) -> Recording:
    return Recording("trial", TIMES, goals(TIMES), motion(TIMES), ACTUATORS, JOINTS, **more)


@pytest.mark.parametrize("topic", ["/joint_states_raw", "/filtered", "/left/joint_states"])
def test_a_second_joint_state_is_no_command_unless_its_topic_says_so(topic: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run", [*states(), *states(topic, goals)])
    mapping = Mapping.from_dict({"topics": {"states": "/joint_states"}})
    with pytest.raises(RecordingError, match=rf"{topic} could be commands; expected a mapping with commands under"):
        eq.read_recording(path, ARM, mapping)
    chosen = Mapping.from_dict({"topics": {"states": "/joint_states", "commands": topic}})
    np.testing.assert_array_equal(eq.read_recording(path, ARM, chosen).command, goals(TIMES))


@pytest.mark.parametrize("topic", ["/joint_commands", "/arm/goal_states", "/cmd"])
def test_a_recording_says_which_topics_it_is_of(topic: str, tmp_path: Path) -> None:
    found = eq.read_recording(write_bag(tmp_path / "run", [*states(), *states(topic, goals)]), ARM)
    np.testing.assert_array_equal(found.command, goals(TIMES))
    assert (found.notes["topic.states"], found.notes["topic.commands"]) == ("/joint_states", topic)


def test_the_order_of_an_arrays_numbers_is_never_guessed(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "silent", [*states(), *sent("")])
    with pytest.raises(RecordingError, match="the 2 elements of 'data' have no names; expected cmd under"):
        eq.read_recording(path, ARM)
    with pytest.raises(RecordingError, match="the 2 elements of 'data' have no names; expected cmd under"):
        eq.read_recording(write_bag(tmp_path / "other", [*states(), *sent("left,right")]), ARM)
    mapping = Mapping.from_dict({"names": {"cmd": ["m2", "m1"]}})
    np.testing.assert_array_equal(eq.read_recording(path, ARM, mapping).command, goals(TIMES)[:, ::-1])
    labelled = write_bag(tmp_path / "labelled", [*states(), *sent("elbow, shoulder")])
    np.testing.assert_array_equal(eq.read_recording(labelled, ARM).command, goals(TIMES)[:, ::-1])


def test_a_bag_that_we_wrote_says_its_order(tmp_path: Path) -> None:
    (path,) = eq.export_recordings([trial()], tmp_path / "bags", ARM, ros2=True)
    np.testing.assert_array_equal(eq.read_recording(path, ARM).command, goals(TIMES))


def test_topics_that_nobody_asks_for_are_not_read(tmp_path: Path) -> None:
    """Messages that cannot be read, on a topic of their own."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    path = tmp_path / "run"
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        secret = writer.add_connection("/a", "geometry_msgs/msg/Twist", typestore=store)
        for topic, kind, values in (("/joint_states", states, 0), ("/joint_commands", states, 1)):
            known = writer.add_connection(topic, "sensor_msgs/msg/JointState", typestore=store)
            for _, name, at, fields in kind(topic, (motion, goals)[values]):
                message = store.types[name](**fields)
                writer.write(known, round((1000 + at) * 1e9), bytes(store.serialize_cdr(message, name)))
        writer.write(secret, round(1000e9), b"nothing")
    np.testing.assert_array_equal(eq.read_recording(path, ARM).command, goals(TIMES))
    columns = {f"pos.{j}": f"position.{j}" for j in JOINTS} | {
        f"cmd.{a}": f"position.{j}" for a, j in zip(ACTUATORS, JOINTS, strict=True)
    }
    named = Mapping.from_dict(
        {
            "columns": {
                t: {"topic": "/joint_states" if t[0] == "p" else "/joint_commands", "column": c}
                for t, c in columns.items()
            }
        }
    )
    np.testing.assert_array_equal(eq.read_recording(path, ARM, named).command, goals(TIMES))
    with pytest.raises(RecordingError, match="is no bag that can be read"):
        eq.read_recording(path, ARM, Mapping.from_dict({"columns": {"vel.elbow": {"topic": "/a", "column": "rate"}}}))


def test_a_bags_name_may_have_dots_in_it(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "run_2024.01.05", [*states(), *sent()])
    assert eq.read_recording(path, ARM).name == "run_2024.01.05"


@pytest.mark.parametrize(
    "view",
    [(-1, (100,), (1,)), (0, (100,), (-1,)), (0, (101,), (1,)), (0, (10, 100), (0, 1)), (200, (0,), (1,)), (0, (-1,), (1,))],
)  # fmt: skip
def test_tensors_outside_of_their_storage_are_refused(view: Any, tmp_path: Path) -> None:
    path = write_torch(tmp_path / "a.pt", {"time": TIMES}, {"time": view})
    with pytest.raises(RecordingError, match="lies outside its 100 numbers"):
        arrays.read_torch(path)


def test_views_of_a_storage_are_read(tmp_path: Path) -> None:
    data = {"time": TIMES, "dof_pos": np.arange(200.0)}
    (log,) = arrays.read_torch(write_torch(tmp_path / "a.pt", data, {"dof_pos": (0, (100, 2), (1, 100))}))
    np.testing.assert_array_equal(log.tables[0].columns["dof_pos[1]"], np.arange(100.0, 200.0))


def test_a_pickle_changes_nothing_of_the_reader(tmp_path: Path) -> None:
    """BUILD sets attributes of whatever it is handed, for all files to come."""
    import zipfile

    path = tmp_path / "a.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "a/data.pkl", b"ctorch._utils\n_rebuild_tensor_v2\nN(dS'__defaults__'\n(I1\nI2\nI3\nI4\nts\x86b."
        )
    before = arrays._rebuild.__defaults__
    with pytest.raises(RecordingError):
        arrays.read_torch(path)
    assert arrays._rebuild.__defaults__ == before


@pytest.mark.parametrize("header", ["time,cmd.m1,cmd.m2,pos.shoulder,pos.elbow", "time,cmd.m1,cmd.m2,a,b"])
def test_a_mapping_leaves_the_notes_of_a_csv_file_what_they_are(header: str, tmp_path: Path) -> None:
    path = tmp_path / "trial.csv"
    eq.write_recording(path, trial(before=np.array([0.5, 0.25]), notes={"interpolation": "linear", "made": "here"}))
    path.write_text("# a word\n" + path.read_text().replace("time,cmd.m1,cmd.m2,pos.shoulder,pos.elbow", header))
    columns = {} if "pos" in header else {"columns": {"pos.shoulder": "a", "pos.elbow": "b"}}
    found = eq.read_recording(path, ARM, Mapping.from_dict(columns))
    assert found.before is not None and found.before.tolist() == [0.5, 0.25]
    kept = {key: found.notes[key] for key in ("interpolation", "made", "comment")}
    assert kept == {"interpolation": "linear", "made": "here", "comment": "a word"}
    path.write_text("# made = there\n" + path.read_text())
    with pytest.raises(RecordingError, match="row 4: note 'made' is there more than once"):
        eq.read_recording(path, ARM, Mapping.from_dict(columns))


MAPPED = {f"pos.{j}": f"observation.state.{j}.pos" for j in JOINTS} | {
    f"cmd.{a}": f"action.{j}.pos" for a, j in zip(ACTUATORS, JOINTS, strict=True)
}


def test_the_unit_of_a_dataset_holds_for_columns_that_are_mapped(tmp_path: Path) -> None:
    mapping = Mapping.from_dict({"columns": MAPPED})
    (found, _) = gather(write_lerobot(tmp_path / "told", unit="deg"), ARM, mapping)
    np.testing.assert_allclose(found.position, motion(TIMES), atol=1e-7)
    np.testing.assert_allclose(found.command, goals(TIMES), atol=1e-7)
    silent = write_lerobot(tmp_path / "silent")
    said = (
        r"what observation\.state\.shoulder\.pos measures is not in the file; expected a unit or a scale of pos\.shou"
    )
    with pytest.raises(RecordingError, match=said):
        gather(silent, ARM, mapping)
    scaled = {target: {"column": column, "scale": np.pi / 180} for target, column in MAPPED.items()}
    np.testing.assert_allclose(
        gather(silent, ARM, Mapping.from_dict({"columns": scaled}))[0].position, motion(TIMES), atol=1e-7
    )


def test_notes_of_an_mcap_file_may_be_called_anything(tmp_path: Path) -> None:
    path, notes = tmp_path / "a.mcap", {"trial": "7", "notes": "{}", "columns": "x"}
    eq.write_recording(path, trial(notes=notes))
    found = eq.read_recording(path, ARM)
    assert found.name == "trial" and dict(found.notes) == notes


def test_what_is_imported_is_what_was_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A joint whose motion a model prescribes is a column like any other."""
    robot, path = tmp_path / "arm.xml", tmp_path / "run.npz"
    robot.write_text(XML)
    eq.write_recording(path, Recording("run", TIMES, goals(TIMES)[:, 1:], motion(TIMES), ("m2",), JOINTS))
    given = ["--model", str(robot), "--prescribe", "shoulder", "--ignore", "m1"]
    assert main(["recordings", "import", str(path), *given, "-o", str(tmp_path / "trials"), "--json"]) == 0
    (file,) = json.loads(capsys.readouterr().out)["files"]
    assert Path(file).read_text().splitlines()[-101].split(",") == ["time", "cmd.m2", "pos.elbow", "pos.shoulder"]
    model = eq.load_model(robot, prescribe=["shoulder"], ignore=["m1"])
    found = eq.read_recording(path, model)
    np.testing.assert_array_equal(found.position, motion(TIMES)[:, ::-1])
    eq.write_recording(tmp_path / "again.csv", found)
    (modelled,) = gather(tmp_path / "again.csv", model)
    assert modelled.joints == ("elbow",) and modelled.prescribed is not None
    assert main(["score", file, *given]) == 0


def test_limits_of_pressures_hold_with_a_mapping_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    leg = Recording(
        "leg", TIMES, 6e4 + 0 * TIMES[:, None] + [0, 0], 1.0 + motion(TIMES), ("maa", "baa"), ("hip", "knee")
    )
    path, file = tmp_path / "leg.npz", tmp_path / "map.toml"
    eq.write_recording(path, leg)
    file.write_text('[units]\npos = "rad"\n')
    import_ = ["recordings", "import", str(path), "--map", str(file), "-o", str(tmp_path / "trials")]
    assert main(import_) == 2
    assert "60000" in capsys.readouterr().err
    assert main([*import_, "--command-high", "100000"]) == 0
    robot = tmp_path / "arm.xml"
    robot.write_text(XML)
    eq.write_recording(tmp_path / "arm.npz", trial())
    for verb in (["import", "-o", str(tmp_path / "arms")], ["check"]):
        call = ["recordings", verb[0], str(tmp_path / "arm.npz"), *verb[1:], "--model", str(robot)]
        assert main([*call, "--command-low", "0"]) == 2
        assert "--command-low and --command-high bound pressures in Pa" in capsys.readouterr().err


def test_a_folder_of_bags_is_there_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from equimus_ctrl.recordings import bags
    from equimus_ctrl.workflow import logs

    two = [trial(), Recording("other", TIMES, goals(TIMES), motion(TIMES), ACTUATORS, JOINTS)]
    written: list[Path] = []

    def fail_at_the_second(path: Path, own: Any) -> None:
        if written:
            raise RecordingError("the disk is full")
        written.append(path)
        bags.write_bag(path, own)

    with monkeypatch.context() as patch:
        patch.setattr(logs, "write_bag", fail_at_the_second)
        with pytest.raises(RecordingError, match="the disk is full"):
            eq.export_recordings(two, tmp_path / "bags", ARM, ros2=True)
    assert written and not list(tmp_path.iterdir())
    files = eq.export_recordings(two, tmp_path / "bags", ARM, ros2=True, force=True)
    assert [file.relative_to(tmp_path) for file in files] == [Path("bags/trial"), Path("bags/other")]
    assert {own.name for own in (tmp_path / "bags").iterdir()} == {"trial", "other"}
    with pytest.raises(ConfigError, match="is there already, and --force replaces no folder of bags"):
        eq.export_recordings(two, tmp_path / "bags", ARM, ros2=True, force=True)


def test_trajectories_say_that_they_are_commands(tmp_path: Path) -> None:
    messages = [trajectory("/arm/points", t, JOINTS, [u]) for t, u in zip(TIMES, goals(TIMES), strict=True)]
    found = eq.read_recording(write_bag(tmp_path / "run", [*states(), *messages]), ARM)
    np.testing.assert_array_equal(found.command, goals(TIMES))


def test_json_topics_are_searched_for_names_of_a_recording(tmp_path: Path) -> None:
    rows = [
        (t, {"pos": dict(zip(JOINTS, q, strict=True)), "cmd": dict(zip(ACTUATORS, u, strict=True))})
        for t, q, u in zip(TIMES, motion(TIMES).tolist(), goals(TIMES).tolist(), strict=True)
    ]
    found = eq.read_recording(write_json_mcap(tmp_path / "run.mcap", {"/log": ("mine", rows)}), ARM)
    np.testing.assert_array_equal(found.command, goals(TIMES))
