"""Wrong and hostile input for every verb: an exit code, one sentence, nothing lost and nothing taken in silence.

``tests/fuzz_runner.py`` runs the cases in a process of its own; by hand it takes any seed, and shows a single case.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from random import Random
from typing import Any

import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'equimus-ctrl[logs]'")
pytest.importorskip("mcap", reason="mcap is not installed: pip install 'equimus-ctrl[logs]'")
pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'equimus-ctrl[logs]'")

from fuzz_cases import CALLS, case, right_files
from fuzz_inputs import flipped
from hardware_rig import MODEL, still

from equimus_ctrl.plants.hardware.guard import Guard, Measurements
from equimus_ctrl.plants.hardware.interface import interface_of
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.plants.hardware.transport import Sample
from equimus_ctrl.plants.mujoco_plant import make_spec

RUNNER = Path(__file__).with_name("fuzz_runner.py")
SEED, COUNT, PARTS = 1, 1000, 2


def outcomes(log: Path, *arguments: str) -> list[dict[str, Any]]:
    """What came of each case; the last is one that was begun and has no end where the process was killed."""
    command = [sys.executable, "-X", "faulthandler", str(RUNNER), "--log", str(log), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "COLUMNS": "100"}, check=False)
    rows: list[dict[str, Any]] = [json.loads(line) for line in log.read_text().splitlines()]
    assert rows and "problems" in rows[-1], (
        f"{rows[-1:]} ended the process with {done.returncode}: {done.stderr[-2000:]}"
    )
    return [row for row in rows if "problems" in row]


@pytest.mark.slow
@pytest.mark.parametrize("part", [0, *(pytest.param(k, marks=pytest.mark.long) for k in range(1, PARTS))])
def test_whatever_is_given_is_answered_with_a_sentence(part: int, tmp_path: Path) -> None:
    count = COUNT // PARTS
    found = outcomes(tmp_path / "log", "--seed", str(SEED), "--first", str(part * count), "--count", str(count))
    assert len(found) == count
    assert {row["code"] for row in found} <= {0, 2, 3}
    wrong = [
        f"{row['case']} {row['arguments']}: {'; '.join(row['problems'])}; {row['failed']}" for row in found if row["problems"]
    ]  # fmt: skip
    assert not wrong, "\n".join(wrong)
    # Not all of it stops at the door, and not all of it is let through.
    assert min(sum(row["code"] == 0 for row in found), sum(row["code"] == 2 for row in found)) > count / 50


@pytest.mark.slow
def test_each_call_is_right_before_anything_is_changed(tmp_path: Path) -> None:
    found = outcomes(tmp_path / "log", "--right")
    assert len(found) == len(CALLS)
    for row in found:
        assert not row["problems"], row
        assert (
            row["code"] == 0 or "the fuzzer goes no farther" in row["err"] or "too short to diagnose" in row["err"]
        ), row


def test_the_same_seed_gives_the_same_cases(tmp_path: Path) -> None:
    right = right_files(tmp_path / "right")
    again = {name: data for name, data in right.items() if not name.startswith("bag/")}  # which have the time in them
    for k in (0, 7, 500):
        assert case(3, k, again) == case(3, k, dict(again)) != case(4, k, again)


# What a robot may send. Decoded by the decoder of DDS itself, which takes the bytes as they come.


def messages(monkeypatch: pytest.MonkeyPatch, payloads: list[bytes], kind: Any) -> list[Any]:
    """What is left of payloads after they have arrived."""
    from cyclonedds import sub

    from equimus_ctrl.plants.hardware.dds import _Arriving

    class Info:
        valid_data, publication_handle = True, 7

    class Topic:
        data_type = kind

    reader = object.__new__(sub.DataReader)
    reader._topic = Topic()
    monkeypatch.setattr(sub.DataReader, "_ref", 0, raising=False)
    waiting = [(data, Info()) for data in payloads]
    monkeypatch.setattr(sub, "ddspy_take", lambda ref, mask, n: [waiting.pop(0) for _ in range(min(n, len(waiting)))])
    arriving = _Arriving()
    arriving.on_data_available(reader)
    assert not waiting and arriving.heard + arriving.malformed == len(payloads)
    return [message for _, _, message in arriving.take()]


@pytest.mark.parametrize("seed", range(4))
def test_a_malformed_message_is_lost_and_the_next_is_not(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cyclonedds.core", reason="Cyclone DDS is not installed: pip install 'equimus-ctrl[hardware]'")
    from equimus_ctrl.plants.hardware.messages import Float64MultiArray, JointState, joint_state, multi_array

    random = Random(seed)
    good, command = joint_state(12.5, ("hip", "knee"), still(0.0).position), multi_array([1e3, 2e3])
    payloads = [flipped(good.serialize(), random) for _ in range(300)]
    found = messages(monkeypatch, [*payloads, good.serialize()], JointState)
    assert found[-1].position == good.position and len(found) < 250
    spec = make_spec(MODEL.robot, 1 / 120, MODEL)
    settings = HardwareSettings()
    guard = Guard(spec, settings.safety, interface_of(settings, MODEL.robot))
    for message in found:
        stamp = message.header.stamp.sec + message.header.stamp.nanosec / 1e9
        judged = guard.first(Sample(stamp, 0.0, tuple(message.name), tuple(message.position), 0))
        assert isinstance(judged, Measurements) or (judged and "\n" not in judged)
    left = messages(
        monkeypatch,
        [*(flipped(command.serialize(), random) for _ in range(300)), command.serialize()],
        Float64MultiArray,
    )
    assert left[-1].data == command.data
