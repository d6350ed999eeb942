"""Logs that are cut off, of the wrong type, or lack something: one sentence each, with the file in it."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl.errors import RecordingError, one_line
from equimus_ctrl.recordings import Mapping
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

MAPPING = Mapping.from_dict(
    {"units": {"pos": "deg", "cmd": "deg"}, "names": {"pos": list(JOINTS), "cmd": ["m1", "m2"]}}
)
COLUMNS = {"time": TIMES, "pos.shoulder": TIMES, "pos.elbow": TIMES, "cmd.m1": TIMES, "cmd.m2": TIMES}


def cut(path: Path, share: float = 0.5) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path


def our_mcap(folder: Path) -> Path:
    path = folder / "ours.mcap"
    eq.write_recording(path, eq.Recording("ours", TIMES, goals(TIMES), motion(TIMES), ACTUATORS, JOINTS))
    return path


def raw(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def json_states(folder: Path, message: Callable[[float], Any]) -> Path:
    return write_json_mcap(
        folder / "run.mcap", {"/joints": ("sensor_msgs/JointState", [(t, message(t)) for t in TIMES])}
    )


def npz(folder: Path, **more: Any) -> Path:
    path = folder / "log.npz"
    np.savez(path, **{**COLUMNS, **more})
    return path


def lerobot(folder: Path, change: Callable[[Path], None]) -> Path:
    path = write_lerobot(folder / "set")
    change(path)
    return path


def changed_table(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def work(path: Path) -> None:
        import pyarrow
        import pyarrow.parquet as parquet

        (file,) = path.rglob("file-000.parquet")
        table = parquet.read_table(file)
        columns = {name: table.column(name) for name in table.column_names}
        change(columns)
        parquet.write_table(pyarrow.table(columns), file)

    return work


def changed_info(**more: Any) -> Callable[[Path], None]:
    def work(path: Path) -> None:
        file = path / "meta" / "info.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), **more}))

    return work


def put(name: str, row: int, value: Any) -> Callable[[dict[str, Any]], None]:
    def work(columns: dict[str, Any]) -> None:
        import pyarrow

        values = columns[name].to_pylist()
        values[row] = value
        columns[name] = pyarrow.array(values)

    return work


def foreign_pickle(folder: Path) -> Path:
    """What would run a command where it is unpickled as usual."""
    path = folder / "evil.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", b"cos\nsystem\n(S'false'\ntR.")
    return path


def bag(folder: Path, messages: list[Any]) -> Path:
    return write_bag(folder / "run", messages)


def states(topic: str = "/joint_states") -> list[Any]:
    return [joint_state(topic, t, JOINTS, q) for t, q in zip(TIMES, motion(TIMES), strict=True)]


def sent(topic: str = "/commands") -> list[Any]:
    return [array(topic, t, u) for t, u in zip(TIMES, goals(TIMES), strict=True)]


WRONG: dict[str, tuple[Callable[[Path], Path], str]] = {
    "mcap: cut": (lambda f: cut(our_mcap(f)), "is no MCAP file that can be read|cut off before its summary"),
    "mcap: cut short": (lambda f: cut(our_mcap(f), 0.02), "MCAP file"),
    "mcap: empty": (lambda f: raw(f, "a.mcap", b""), "is no MCAP file; expected one that begins with MCAP0"),
    "mcap: other": (lambda f: raw(f, "a.mcap", b"time,x\n1,2\n"), "is no MCAP file"),
    "mcap: none": (lambda f: f / "nowhere.mcap", "there is no such file"),
    "mcap: no topics": (lambda f: write_json_mcap(f / "a.mcap", {}), "has no topics"),
    "mcap: no commands": (
        lambda f: json_states(f, lambda t: {"name": list(JOINTS), "position": [t, t]}),
        "there is no topic of std_msgs/msg/Float64MultiArray or .* for commands",
    ),
    "mcap: joint": (
        lambda f: json_states(f, lambda t: {"name": ["shoulder", "knee"], "position": [t, t]}),
        "'position' has no element 'elbow'",
    ),
    "mcap: text": (
        lambda f: json_states(f, lambda t: {"name": list(JOINTS), "position": "here"}),
        "there is no column 'position' in /joints",
    ),
    "bag: none": (lambda f: cut(write_bag(f / "run", states()) / "metadata.yaml", 0.3).parent, "is no bag that can be"),
    "bag: cut": (lambda f: cut(next((write_bag(f / "run", states())).glob("*.mcap"))).parent, "is no bag that can be"),
    "bag: two of a kind": (
        lambda f: bag(f, states() + sent("/a") + sent("/b")),
        "/a, /b could be commands; expected a mapping with commands under",
    ),
    "bag: numbers": (
        lambda f: bag(f, states() + [array("/commands", t, [1.0]) for t in TIMES]),
        "/commands has 1 numbers a message, expected 2, one for each of m1, m2",
    ),
    "bag: nan": (
        lambda f: bag(f, [*states()[:-1], joint_state("/joint_states", 2.0, JOINTS, [np.nan, 0.0]), *sent()]),
        "message 100 of /joint_states, column position.shoulder: nan is not finite",
    ),
    "bag: some joints": (
        lambda f: bag(f, [*states(), joint_state("/joint_states", 0.5, ("elbow",), [0.0]), *sent()]),
        "of /joint_states has no position.shoulder; expected all of position.shoulder, position.elbow together",
    ),
    "bag: gap": (
        lambda f: bag(f, [*states(), joint_state("/joint_states", 2e5, JOINTS, [0.0, 0.0]), *sent()]),
        "nothing was recorded for",
    ),
    "bag: late commands": (
        lambda f: bag(f, [*states(), array("/commands", 5.0, [0.0, 0.0])]),
        "no two measurements lie after the first command",
    ),
    "bag: points": (
        lambda f: bag(
            f, [*states(), *(trajectory("/c/joint_trajectory", t, ACTUATORS, [[0, 0], [1, 1]]) for t in TIMES)]
        ),
        "/c/joint_trajectory has trajectories of several points",
    ),
    "npz: cut": (lambda f: cut(npz(f)), "is no .npz file of arrays that can be read"),
    "npz: other": (lambda f: raw(f, "a.npz", b"PK nothing"), "is no .npz file of arrays that can be read"),
    "npz: objects": (lambda f: npz(f, **{"pos.elbow": np.array([{}] * 100)}), "is no .npz file of arrays"),
    "npz: text": (lambda f: npz(f, **{"pos.elbow": np.array(["a"] * 100)}), "column 'pos.elbow' holds text, expected"),
    "npz: nan": (
        lambda f: npz(f, **{"pos.elbow": np.where(TIMES == 0.5, np.nan, 0.0)}),
        "sample 51, column pos.elbow: nan is not finite",
    ),
    "npz: lengths": (lambda f: npz(f, **{"pos.elbow": TIMES[:-1]}), "column 'pos.elbow'|'pos.elbow' is missing"),
    "npz: back": (lambda f: npz(f, time=np.r_[TIMES[:-1], 0.5]), "row 100, column time: 0.5 s goes back from the"),
    "npz: no clock": (
        lambda f: (np.savez(f / "a.npz", **{k: v for k, v in COLUMNS.items() if k != "time"}), f / "a.npz")[1],
        "has no clock; expected a mapping with a column under",
    ),
    "npz: no commands": (
        lambda f: (np.savez(f / "a.npz", time=TIMES, q=motion(TIMES)), f / "a.npz")[1],
        "there is no array des_dof_pos or .* for cmd",
    ),
    "npz: order": (
        lambda f: (np.savez(f / "a.npz", time=TIMES, q=np.zeros((100, 3))), f / "a.npz")[1],
        "'q' has 3 elements, but names.pos of mapping has 2",
    ),
    "pt: cut": (lambda f: cut(write_torch(f / "a.pt", {"time": TIMES})), "is none of the zip files that torch.save"),
    "pt: code": (foreign_pickle, "holds a os.system, expected tensors, numbers and texts alone"),
    "pt: no tensors": (lambda f: write_torch(f / "a.pt", {}), "holds no tensors"),
    "lerobot: no data": (
        lambda f: lerobot(f, lambda p: [own.unlink() for own in p.rglob("*.parquet")] and None),
        "has no parquet files under data/",
    ),
    "lerobot: cut": (lambda f: lerobot(f, lambda p: cut(next(p.rglob("*.parquet"))) and None), "is no parquet file"),
    "lerobot: info": (lambda f: lerobot(f, lambda p: cut(p / "meta" / "info.json") and None), "is no JSON file"),
    "lerobot: version": (lambda f: lerobot(f, changed_info(codebase_version="v1.6")), "codebase_version is 'v1.6'"),
    "lerobot: frames": (lambda f: lerobot(f, changed_info(total_frames=300)), "holds 200 frames, but meta/info.json"),
    "lerobot: column": (
        lambda f: lerobot(f, changed_table(lambda columns: columns.pop("action"))),
        "there is no column 'action', expected those of a LeRobot dataset",
    ),
    "lerobot: null": (
        lambda f: lerobot(f, changed_table(put("observation.state", 3, None))),
        "row 4, column observation.state: there is no value",
    ),
    "lerobot: nan": (
        lambda f: lerobot(f, changed_table(put("observation.state", 3, [float("nan"), 0.0]))),
        r"\(episode_000000\), frame 4, column observation.state.shoulder.pos: nan is not finite",
    ),
    "lerobot: ragged": (
        lambda f: lerobot(f, changed_table(put("action", 3, [1.0, 2.0, 3.0]))),
        "row 4, column action: 3 elements, expected 2 as in row 1",
    ),
    "lerobot: back": (
        lambda f: lerobot(f, changed_table(put("timestamp", 3, 0.0))),
        r"\(episode_000000\), row 4, column time: 0.0 s goes back from",
    ),
    "parquet: cut": (lambda f: raw(f, "a.parquet", b"PAR1 nothing"), "is no parquet file that can be read"),
    "bam: cut": (lambda f: cut(write_bam(f / "a.json")), "is no JSON file that can be read"),
    "bam: other": (lambda f: raw(f, "a.json", b"{}"), 'is no recording that is known; expected "entries"'),
    "bam: none": (lambda f: raw(f, "a.json", b'{"entries": []}'), "has no entries"),
    "bam: time": (lambda f: raw(f, "a.json", b'{"entries": [{"position": 1}]}'), "entry 1 has timestamp None"),
    "bam: off": (lambda f: write_bam(f / "a.json", np.zeros(100)), "torque_enable is never on for two entries"),
    "bam: joints": (lambda f: write_bam(f / "a.json"), "is pos. of shoulder, elbow is not said; expected a mapping"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_log_that_cannot_be_used_is_told_in_a_sentence(name: str, tmp_path: Path) -> None:
    make, said = WRONG[name]
    path = make(tmp_path)
    with pytest.raises(RecordingError, match=said) as caught:
        gather(path, ARM, MAPPING if "lerobot" in name or "order" in name or "no commands" in name else None)
    text = str(caught.value)
    assert text == one_line(text) and str(path.name if path.is_dir() else path) in text
    assert not re.search(r"Traceback|0x[0-9a-f]{8}", text)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
@pytest.mark.parametrize("kind", ["mcap", "npz", "pt", "parquet"])
def test_a_file_that_was_cut_off_anywhere_is_told(kind: str, share: float, tmp_path: Path) -> None:
    """Somebody else's reader may stumble in whatever way."""
    path = tmp_path / f"ours.{kind}"
    if kind == "pt":
        write_torch(path, COLUMNS)
    else:
        eq.write_recording(path, eq.Recording("ours", TIMES, goals(TIMES), motion(TIMES), ACTUATORS, JOINTS))
    with pytest.raises(RecordingError, match=re.escape(str(path))):
        gather(cut(path, share), ARM)


@pytest.mark.parametrize("kind", ["mcap", "npz", "parquet"])
def test_a_bit_that_fell_over_is_told_or_does_no_harm(kind: str, tmp_path: Path) -> None:
    """Checksums see most of it; nothing else than a sentence or numbers comes of the rest."""
    path = tmp_path / f"ours.{kind}"
    eq.write_recording(path, eq.Recording("ours", TIMES, goals(TIMES), motion(TIMES), ACTUATORS, JOINTS))
    whole = path.read_bytes()
    for at in np.random.default_rng(1).integers(0, len(whole), 60).tolist():
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 16]) + whole[at + 1 :])
        try:
            (found,) = gather(path, ARM)
        except eq.EquimusError as error:
            assert str(error) == one_line(str(error))
        else:
            assert np.isfinite(found.position).all()


def test_a_log_of_a_force_driven_robot_takes_no_goals(tmp_path: Path) -> None:
    from mjcf_models import PENDULUM

    with pytest.raises(RecordingError, match="its commands are goals in rad, and those of motor are N·m"):
        gather(write_bam(tmp_path / "a.json"), eq.Model(PENDULUM))
    assert len(gather(write_bam(tmp_path / "b.json"), ONE)) == 1
