"""Clocks of logs: one origin for all topics, stamps of one sender, and a word on whatever is left out."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl.recordings import Mapping, RecordingWarning
from equimus_ctrl.types import Array

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'equimus-ctrl[logs]'")
pytest.importorskip("mcap", reason="mcap is not installed: pip install 'equimus-ctrl[logs]'")

from foreign_logs import ARM, JOINTS, TIMES, array, goals, joint_state, motion, write_bag, write_json_mcap

EPOCH = 1_700_000_000


def commands() -> list[Any]:
    """Each a moment before the measurement of its row."""
    return [array("/commands", t - 5e-4, u) for t, u in zip(TIMES, goals(TIMES), strict=True)]


def stamped(stamps: Array, late: Array | float = 0.0, topic: str = "/joint_states") -> list[Any]:
    """The arm's states, each with a stamp of the device's clock."""
    late = np.broadcast_to(late, TIMES.shape)
    return [
        joint_state(topic, t + own, JOINTS, q, stamp=s)
        for t, own, q, s in zip(TIMES, late, motion(TIMES), stamps, strict=True)
    ]


def said(path: Path) -> tuple[eq.Recording, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = eq.read_recording(path, ARM)
    return found, [str(own.message) for own in caught if issubclass(own.category, RecordingWarning)]


@pytest.mark.parametrize(("unit", "size"), [("s", 1), ("ms", 10**3), ("us", 10**6), ("ns", 10**9)])
def test_commands_and_measurements_keep_their_distance_in_any_unit(unit: str, size: int, tmp_path: Path) -> None:
    """Commands begin 0.25 s before the measurements, by a clock column of each topic; the log's own knows nothing."""
    begun = EPOCH if unit == "ns" else 100

    def stamp(at: float) -> Any:
        return round((begun + at) * size) if unit != "s" else begun + at

    states = [
        (0.0, {"t": stamp(t + 0.25), "q": {"shoulder": q[0], "elbow": q[1]}})
        for t, q in zip(TIMES, motion(TIMES), strict=True)
    ]
    sent = [(0.0, {"t": stamp(0.1 * k), "u": [float(k), 0.0]}) for k in range(12)]
    path = write_json_mcap(tmp_path / "run.mcap", {"/a": ("mine", states), "/b": ("mine", sent)})
    mapping = Mapping.from_dict(
        {
            "clock": {"column": "t", "unit": unit},
            "columns": {
                "pos.shoulder": "q.shoulder", "pos.elbow": "q.elbow",
                "cmd.m1": {"topic": "/b", "column": "u[0]"}, "cmd.m2": {"topic": "/b", "column": "u[1]"},
            },
        }
    )  # fmt: skip
    found = eq.read_recording(path, ARM, mapping)
    np.testing.assert_array_equal(found.position, motion(TIMES))
    # The first measurement is at 0.25 s of the commands' clock: two have gone before, the next comes 0.05 s later.
    assert found.before is not None
    changes = np.flatnonzero(np.diff(found.command[:, 0])) + 1
    np.testing.assert_allclose(found.time[changes], 0.05 + 0.1 * np.arange(9), atol=6e-3)
    assert found.command[0, 0] == 2.0


def test_two_broadcasters_on_one_topic_may_stamp_alike(tmp_path: Path) -> None:
    """A gripper's states with the very stamps of the arm's, and received first."""
    stamps = TIMES + 50.0
    gripper = [
        joint_state("/joint_states", t - 1e-4, ("finger",), [0.1], stamp=s) for t, s in zip(TIMES, stamps, strict=True)
    ]
    found, told = said(write_bag(tmp_path / "run", [*gripper, *stamped(stamps), *commands()]))
    np.testing.assert_array_equal(found.position, motion(TIMES))
    assert not told


def test_a_sender_that_is_started_again_loses_nothing(tmp_path: Path) -> None:
    late = 0.001 * np.random.default_rng(2).random(len(TIMES))
    stamps = np.where(TIMES < 0.5, 50.0 + TIMES, 0.02 + TIMES - 0.5)
    found, told = said(write_bag(tmp_path / "run", [*stamped(stamps, late), *commands()]))
    np.testing.assert_array_equal(found.position, motion(TIMES))
    np.testing.assert_allclose(np.diff(found.time), 0.01, atol=1.1e-3)
    assert len(told) == 1 and "of 100 messages of /joint_states stamps went back at 0.5" in told[0]


def test_a_stamp_of_zero_is_a_stamp_like_any_other(tmp_path: Path) -> None:
    """A simulation's clock begins at 0; messages that are never stamped are at 0 all the time."""
    late = 0.004 * np.random.default_rng(3).random(len(TIMES))
    found, told = said(write_bag(tmp_path / "simulated", [*stamped(TIMES, late), *commands()]))
    np.testing.assert_allclose(np.diff(found.time), 0.01, atol=1e-6)
    assert not told
    found, told = said(write_bag(tmp_path / "never", [*stamped(0.0 * TIMES, late), *commands()]))
    np.testing.assert_allclose(np.diff(found.time), np.diff(TIMES + late), atol=1e-6)
    assert not told


def test_what_comes_twice_or_late_is_left_out_and_told(tmp_path: Path) -> None:
    stamps = TIMES + 50.0
    stamps[20], stamps[40] = stamps[19], stamps[37] + 0.001
    found, told = said(write_bag(tmp_path / "run", [*stamped(stamps), *commands()]))
    np.testing.assert_array_equal(found.position, np.delete(motion(TIMES), [20, 40], axis=0))
    left = "of 100 messages of /joint_states 2 came twice or after a later one, by their stamps, and are left out"
    assert f"{tmp_path / 'run'}: {left}" in told


@pytest.mark.parametrize("names", [("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs")])
def test_stamps_of_json_count_as_well(names: tuple[str, str], tmp_path: Path) -> None:
    late = 0.004 * np.random.default_rng(4).random(len(TIMES))

    def states(every: int) -> list[Any]:
        stamps = [{names[0]: EPOCH, names[1]: round(t * 1e9)} for t in TIMES]
        return [
            (
                t + own,
                {"name": list(JOINTS), "position": list(q)} | ({"header": {"stamp": s}} if k % every == 0 else {}),
            )
            for k, (t, own, q, s) in enumerate(zip(TIMES, late, motion(TIMES), stamps, strict=True))
        ]

    layout = {"dim": [{"label": "m1,m2"}]}
    sent = [(t, {"layout": layout, "data": list(u)}) for t, u in zip(TIMES, goals(TIMES), strict=True)]
    kinds = "sensor_msgs/JointState", "std_msgs/Float64MultiArray"
    path = write_json_mcap(tmp_path / "run.mcap", {"/a": (kinds[0], states(1)), "/commands": (kinds[1], sent)})
    found, told = said(path)
    np.testing.assert_allclose(np.diff(found.time), 0.01, atol=1e-6)
    assert not told
    path = write_json_mcap(tmp_path / "some.mcap", {"/a": (kinds[0], states(2)), "/commands": (kinds[1], sent)})
    found, told = said(path)
    np.testing.assert_allclose(np.diff(found.time), np.diff(TIMES + late), atol=1e-6)
    assert len(told) == 1 and "50 have no stamp, so all count from when they were received" in told[0]
