"""Writing recordings: every bit comes back, and nothing is written that could not be read."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.recordings import Limits, read, write
from equimus_ctrl.recordings.checks import LARGEST
from equimus_ctrl.types import Recording

ANY = Limits(command_low=-np.inf, command_high=np.inf, max_angle=np.inf, max_interval=np.inf, joints=(), actuators=())
quick = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])

VALID = "time,cmd.maa,pos.hip\n"


def put(folder: Path) -> Path:
    path = folder / "trial.csv"
    path.write_text(VALID)
    return path


def simple(**changes: object) -> Recording:
    fields: dict[str, object] = {
        "name": "trial",
        "time": [0.0, 0.01, 0.02],
        "command": np.full((3, 2), 1e4),
        "position": np.full((3, 2), 0.1),
        "actuators": ("maa", "baa"),
        "joints": ("hip", "knee"),
    }
    return Recording(**(fields | changes))  # type: ignore[arg-type]


finite = st.floats(-LARGEST, LARGEST)
names = st.text(st.characters(codec="utf-8", exclude_characters=",=", exclude_categories=["C", "Z"]), min_size=1)
note_keys = names.filter(lambda key: not key.startswith("before"))


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    n = draw(st.integers(2, 6))
    actuators = tuple(draw(st.lists(names, min_size=1, max_size=3, unique=True)))
    joints = tuple(draw(st.lists(names, min_size=1, max_size=3, unique=True)))

    def block(*shape: int) -> np.ndarray:
        return draw(hnp.arrays(np.float64, shape, elements=finite))

    return Recording(
        name="trial",
        time=draw(st.floats(-1e6, 1e6)) + np.cumsum(draw(st.lists(st.floats(1e-3, 1.9), min_size=n, max_size=n))),
        command=block(n, len(actuators)),
        position=block(n, len(joints)),
        actuators=actuators,
        joints=joints,
        velocity=draw(st.none() | st.just(block(n, len(joints)))),
        measured=draw(st.none() | st.just(block(n, len(actuators)))),
        before=draw(st.none() | st.just(block(len(actuators)))),
        notes=draw(st.dictionaries(note_keys, names | st.sampled_from(["", "a = b", "1 2"]), max_size=3)),
    )


@quick
@given(recordings())
@pytest.mark.filterwarnings("ignore:overflow")
def test_round_trip(tmp_path: Path, recording: Recording) -> None:
    write(tmp_path / "trial.csv", recording)
    again = read(tmp_path / "trial.csv", limits=ANY)
    for key in ("name", "actuators", "joints", "notes"):
        assert getattr(again, key) == getattr(recording, key)
    for key in ("time", "command", "position", "velocity", "measured", "before"):
        one, other = getattr(recording, key), getattr(again, key)
        assert (one is None and other is None) or one.tobytes() == other.tobytes(), key
    assert os.listdir(tmp_path) == ["trial.csv"]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"time": [0, 1, np.nan]}, "sample 2 of time is nan; only finite numbers are written"),
        ({"position": [[0, 0], [0, np.inf], [0, 0]]}, "sample 1 of pos.knee is inf; only finite numbers are written"),
        ({"time": [0, 2, 1]}, "time 1.0 s of sample 2 does not come after 2.0 s; times must ascend"),
        ({"time": [0], "command": [[0, 0]], "position": [[0, 0]]}, "has 1 row(s); at least two are needed"),
        ({"joints": (), "position": np.empty((3, 0))}, "the recording has no joint; at least one is needed"),
        ({"joints": ("hip", "hip")}, "the joint names hip, hip are not all different"),
        ({"actuators": ("a,b", "c")}, "actuator name 'a,b' cannot be written; it holds ','"),
        ({"actuators": ("", "c")}, "actuator name '' cannot be written; it is empty or has blanks at an end"),
        ({"before": [np.nan, 0]}, "the command before the first row is [nan  0.]; it must be finite"),
        ({"notes": {"a=b": "c"}}, "note 'a=b' cannot be written; it holds '='"),
        ({"notes": {"a": "b\nc"}}, "text of note 'a' 'b\\nc' cannot be written; it holds '\\n'"),
        ({"notes": {"a": " b"}}, "text of note 'a' ' b' cannot be written; it is empty or has blanks at an end"),
        ({"notes": {"before.cmd.maa": "1"}}, "note 'before.cmd.maa' cannot be written; names that start with 'before'"),
    ],
)
def test_what_could_not_be_read_back_is_not_written(tmp_path: Path, changes: dict[str, object], sentence: str) -> None:
    with pytest.raises(RecordingError, match=re.escape(sentence)) as caught:
        write(tmp_path / "trial.csv", simple(**changes))
    assert str(caught.value).startswith(str(tmp_path / "trial.csv"))
    assert os.listdir(tmp_path) == []


def test_writing_fails_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path)

    def fail(source: object, target: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(RecordingError, match=r"trial\.csv: the file cannot be written \(No space left on device\)"):
        write(path, simple())
    assert path.read_text() == VALID and os.listdir(tmp_path) == ["trial.csv"]

    def interrupt(source: object, target: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write(path, simple())
    assert path.read_text() == VALID and os.listdir(tmp_path) == ["trial.csv"]


def test_writing_needs_a_folder(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="the file cannot be written .No such file or directory."):
        write(tmp_path / "nowhere" / "trial.csv", simple())
