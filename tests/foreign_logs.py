"""Logs as other programs write them: rosbags' bags, mcap's files, pyarrow's in LeRobot's layouts, torch's and BAM's."""

from __future__ import annotations

import json
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

XML = """<mujoco model="arm"><compiler angle="radian"/><option timestep="0.001"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" armature="0.02"/>
  <inertial mass="1" pos="0 0 -0.2" diaginertia="0.01 0.01 0.01"/>
  <body name="lower" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" armature="0.02"/>
  <inertial mass="0.5" pos="0 0 -0.2" diaginertia="0.01 0.01 0.01"/></body></body></worldbody>
  <actuator><position name="m1" joint="shoulder" kp="20" kv="1"/><position name="m2" joint="elbow" kp="20" kv="1"/>
  </actuator></mujoco>"""
ARM = Model(MjcfRobot("arm", XML, source="arm.xml"))
ONE = Model(
    MjcfRobot("one", XML[: XML.index('<body name="lower"')] + '</body></worldbody><actuator><position name="m1" '
              'joint="shoulder" kp="20" kv="1"/></actuator></mujoco>', source="one.xml")
)  # fmt: skip
JOINTS, ACTUATORS = ("shoulder", "elbow"), ("m1", "m2")


def motion(times: Array) -> Array:
    """(n, 2) positions [rad]."""
    return np.column_stack([0.3 * np.sin(3 * times), 0.2 * np.cos(2 * times)])


def goals(times: Array) -> Array:
    """(n, 2) commands [rad]."""
    return np.column_stack([0.31 * np.sin(3 * times + 0.1), 0.22 * np.cos(2 * times + 0.1)])


TIMES = np.arange(100) * 0.01


def write_bag(path: Path, messages: list[tuple[str, str, float, dict[str, Any]]], plugin: str = "MCAP") -> Path:
    """A bag by rosbags, of (topic, type, time, fields)."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types

    def made(kind: str, fields: dict[str, Any]) -> Any:
        return kinds[kind](**fields)

    with Writer(path, version=9, storage_plugin=getattr(StoragePlugin, plugin)) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, at, fields in sorted(messages, key=lambda own: own[2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            raw = store.serialize_cdr(made(kind, fields), kind)
            writer.write(connections[topic], round((1000.0 + at) * 1e9), bytes(raw))
    return path


def _kinds() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE).types


def header(at: float = 0.0) -> Any:
    """A message's header; without a stamp at 0."""
    kinds = _kinds()
    nanoseconds = round(at * 1e9)
    stamp = kinds["builtin_interfaces/msg/Time"](nanoseconds // 10**9, nanoseconds % 10**9)
    return kinds["std_msgs/msg/Header"](stamp, "")


def joint_state(
    topic: str, at: float, names: tuple[str, ...], position: Any, effort: Any = (), stamp: float = 0.0
) -> tuple[str, str, float, dict[str, Any]]:
    """sensor_msgs/JointState."""
    fields = {
        "header": header(stamp), "name": list(names), "position": np.array(position, dtype=float, order="C"),
        "velocity": np.empty(0), "effort": np.asarray(effort, dtype=float),
    }  # fmt: skip
    return topic, "sensor_msgs/msg/JointState", at, fields


def array(topic: str, at: float, values: Any, label: str = "m1,m2") -> tuple[str, str, float, dict[str, Any]]:
    """std_msgs/Float64MultiArray; without a label as most write it."""
    kinds = _kinds()
    dim = [kinds["std_msgs/msg/MultiArrayDimension"](label, len(values), len(values))] if label else []
    layout = kinds["std_msgs/msg/MultiArrayLayout"](dim=dim, data_offset=0)
    return (
        topic,
        "std_msgs/msg/Float64MultiArray",
        at,
        {"layout": layout, "data": np.array(values, dtype=float, order="C")},
    )


def trajectory(
    topic: str, at: float, names: tuple[str, ...], points: list[Any]
) -> tuple[str, str, float, dict[str, Any]]:
    """trajectory_msgs/JointTrajectory."""
    kinds = _kinds()
    none, zero = np.empty(0), kinds["builtin_interfaces/msg/Duration"](0, 0)
    made = [
        kinds["trajectory_msgs/msg/JointTrajectoryPoint"](np.array(own, dtype=float, order="C"), none, none, none, zero)
        for own in points
    ]
    fields = {"header": header(), "joint_names": list(names), "points": made}
    return topic, "trajectory_msgs/msg/JointTrajectory", at, fields


def write_json_mcap(path: Path, topics: dict[str, tuple[str, list[tuple[float, Any]]]]) -> Path:
    """An MCAP file by mcap: topic → (schema's name, [(time, message)])."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, (kind, messages) in topics.items():
            schema = writer.register_schema(kind, "jsonschema", b'{"type": "object"}')
            channel = writer.register_channel(topic, "json", schema)
            for at, message in messages:
                stamp = round((1000.0 + at) * 1e9)
                writer.add_message(channel, stamp, json.dumps(message).encode(), stamp)
        writer.finish()
    return path


def lerobot_info(version: str, names: Any, frames: int, **more: Any) -> dict[str, Any]:
    """Of meta/info.json."""
    feature = {"dtype": "float32", "shape": [2], "names": names, **more}
    return {
        "codebase_version": version, "fps": 100, "total_frames": frames,
        "features": {"observation.state": feature, "action": feature},
    }  # fmt: skip


def write_lerobot(path: Path, version: str = "v3.0", names: Any = ("shoulder.pos", "elbow.pos"), **more: Any) -> Path:
    """A dataset of two episodes in degrees, by pyarrow; LeRobot's own writer makes the same columns."""
    import pyarrow
    import pyarrow.parquet

    count = 2 * len(TIMES)
    (path / "meta").mkdir(parents=True)
    own = list(names) if isinstance(names, tuple) else names
    (path / "meta" / "info.json").write_text(json.dumps(lerobot_info(version, own, count, **more)))
    kind = pyarrow.list_(pyarrow.float32(), 2)
    tables = []
    for episode in range(2):
        state, action = (np.degrees(f(TIMES + episode)).astype(np.float32) for f in (motion, goals))
        tables.append(
            pyarrow.table(
                {
                    "observation.state": pyarrow.array(list(state), kind),
                    "action": pyarrow.array(list(action), kind),
                    "timestamp": TIMES.astype(np.float32),
                    "frame_index": np.arange(len(TIMES)),
                    "episode_index": np.full(len(TIMES), episode),
                }
            )
        )
    folder = path / "data" / "chunk-000"
    folder.mkdir(parents=True)
    if version.startswith("v3"):
        pyarrow.parquet.write_table(pyarrow.concat_tables(tables), folder / "file-000.parquet")
    else:
        for episode, table in enumerate(tables):
            pyarrow.parquet.write_table(table, folder / f"episode_{episode:06d}.parquet")
    return path


class _Global:
    """Stands for a class or function of torch in a pickle."""

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name


class _Storage:
    def __init__(self, kind: str, key: str, count: int) -> None:
        self.pid = ("storage", _Global("torch", kind), key, "cpu", count)


class _Pickler(pickle._Pickler):  # type: ignore[name-defined]
    """Writes the opcodes that torch.save writes for tensors; the Python one, which can be told of new kinds."""

    def persistent_id(self, value: Any) -> Any:
        return value.pid if isinstance(value, _Storage) else None

    def save(self, value: Any, save_persistent_id: bool = True) -> Any:
        if isinstance(value, _Global):
            self.write(pickle.GLOBAL + f"{value.module}\n{value.name}\n".encode())
            return None
        if isinstance(value, tuple) and value and value[0] == "tensor":
            self.save(_Global("torch._utils", "_rebuild_tensor_v2"))
            self.save(value[1])
            self.write(pickle.REDUCE)
            return None
        return super().save(value, save_persistent_id)


def write_torch(path: Path, arrays: dict[str, Array], views: dict[str, Any] | None = None) -> Path:
    """A dictionary of tensors in the layout of torch.save (a zip with ``data.pkl`` and storages).

    Args:
        path: of the file.
        arrays: name → numbers.
        views: name → (offset, size, stride) of some that are other views of their storage than the whole.
    """
    held: dict[str, Any] = {}
    with zipfile.ZipFile(path, "w") as archive:
        for key, (name, values) in enumerate(arrays.items()):
            data = np.ascontiguousarray(values, dtype=np.float32)
            archive.writestr(f"archive/data/{key}", data.tobytes())
            stride = tuple(s // 4 for s in data.strides)
            storage = _Storage("FloatStorage", str(key), data.size)
            view = (views or {}).get(name, (0, tuple(data.shape), stride))
            held[name] = ("tensor", (storage, *view, False, OrderedDict()))
        with archive.open("archive/data.pkl", "w") as file:
            _Pickler(file, protocol=2).dump(held)
    return path


def write_bam(path: Path, torque: Any = None) -> Path:
    """A log of BAM's test bench."""
    entries = [
        {
            "position": float(q), "speed": 0.0, "load": 0.1, "input_volts": 7.4, "temp": 30, "timestamp": float(t),
            "goal_position": float(u), "torque_enable": bool(torque is None or torque[k]),
        }
        for k, (t, q, u) in enumerate(zip(TIMES, motion(TIMES)[:, 0], goals(TIMES)[:, 0], strict=True))
    ]  # fmt: skip
    path.write_text(json.dumps({"mass": 0.5, "length": 0.15, "kp": 32, "motor": "xl330", "entries": entries}))
    return path
