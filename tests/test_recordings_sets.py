"""Sets of trials: which files they are, what binds them, and converting them."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.recordings import Limits, RecordingWarning, convert, read, read_set, summarise

ROWS = "0,1000,2000,1.5,0.1\n0.01,3000,2000,1.6,0.2\n0.03,3000,2000,1.4,0.3\n"
TEXT = "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n" + ROWS
STATIC = "P1 (kPa),P2 (kPa),theta1 (deg),theta2 (deg)\n0,0,73,61\n"
STEP = (
    "relative_time,pressure1_start,pressure2_start,current_pressure1,current_pressure2,thigh_theta21,calf_theta32\n"
    "4.99,10000,0,10000,0,74,60\n5,10000,0,0,0,74,60\n"
)


def put(path: Path, text: str = TEXT) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_a_folder_is_its_csv_files_sorted_by_name(tmp_path: Path) -> None:
    for name in ("b.csv", "a.CSV", "c.csv", ".hidden.csv", "notes.txt", "sub/d.csv"):
        put(tmp_path / name)
    put(tmp_path / "poses.csv", STATIC)
    assert [trial.name for trial in read_set(tmp_path)] == ["a", "b", "c"]
    assert [trial.name for trial in read_set([tmp_path / "c.csv", str(tmp_path / "b.csv")])] == ["c", "b"]


def test_both_formats_in_one_set(tmp_path: Path) -> None:
    put(tmp_path / "ours.csv")
    put(tmp_path / "theirs.csv", STEP)
    assert [trial.name for trial in read_set(tmp_path)] == ["ours", "step_release_p10_0"]


def test_names_stay_unique(tmp_path: Path) -> None:
    for name in ("one/t.csv", "two/t.csv", "two/u.csv", "deep/two/t.csv"):
        put(tmp_path / name)
    trials = read_set([tmp_path / "one", tmp_path / "two", tmp_path / "deep" / "two"])
    assert [trial.name for trial in trials] == ["one_t", "two_t", "u", "two_t_2"]


def test_the_first_trial_gives_the_order(tmp_path: Path) -> None:
    first = put(tmp_path / "a.csv")
    second = put(
        tmp_path / "b.csv",
        "# before.cmd.baa = 7\n# before.cmd.maa = 8\n"
        "pos.knee,pos.hip,cmd.baa,cmd.maa,meas.baa,meas.maa,vel.hip,vel.knee,time\n1,2,3,4,5,6,1,2,0\n1,2,3,4,5,6,1,2,1e-2\n",
    )
    _, trial = read_set([first, second], limits=Limits(command_high=5e3))
    assert trial.joints == ("hip", "knee") and trial.position[0].tolist() == [2, 1]
    assert trial.actuators == ("maa", "baa") and trial.command[0].tolist() == [4, 3]
    assert trial.velocity is not None and trial.velocity[0].tolist() == [1, 2]
    assert trial.measured is not None and trial.measured[0].tolist() == [6, 5]
    assert trial.before is not None and trial.before.tolist() == [8, 7]


def test_wanted_names_are_picked_in_order(tmp_path: Path) -> None:
    (trial,) = read_set(put(tmp_path / "a.csv"), joints=["knee"], actuators=["baa", "maa"])
    assert trial.position[0].tolist() == [0.1] and trial.command[0].tolist() == [2000, 1000]
    for wanted, sentence in (
        ({"joints": ["ankle"]}, "a.csv: there is no column 'pos.ankle' for joint ankle (there: pos.hip, pos.knee)"),
        (
            {"actuators": ["mba"]},
            "a.csv: there is no column 'cmd.mba' for actuator mba; did you mean 'maa'? (there: cmd.maa, cmd.baa)",
        ),
    ):
        with pytest.raises(RecordingError, match=re.escape(sentence)):
            read_set(tmp_path / "a.csv", **wanted)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            "pos.hip,pos.knee",
            "pos.x,pos.y",
            "its joints are x, y, those of {a} are hip, knee; all trials of a set have",
        ),
        ("cmd.maa,cmd.baa", "cmd.x,cmd.y", "its actuators are x, y, those of {a} are maa, baa; all trials of a set"),
    ],
)
def test_a_set_has_one_robot(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    a, b = put(tmp_path / "a.csv"), put(tmp_path / "b.csv", TEXT.replace(old, new))
    with pytest.raises(RecordingError, match=re.escape(f"{b}: " + sentence.format(a=a))):
        read_set(tmp_path)


def test_names_what_is_no_set(tmp_path: Path) -> None:
    with pytest.raises(
        RecordingError, match="there are no recordings in this folder; expected CSV files, one a trial, or"
    ):
        read_set(tmp_path)
    put(tmp_path / "poses.csv", STATIC)
    with pytest.raises(RecordingError, match="there are only static poses in this folder"):
        read_set(tmp_path)
    with pytest.raises(RecordingError, match="no recordings are given; at least one file or folder belongs here"):
        read_set([])
    with pytest.raises(RecordingError, match="gone: there is no such file"):
        read_set(tmp_path / "gone")
    path = put(tmp_path / "a.csv")
    with pytest.raises(RecordingError, match=r"a\.csv: this file is given twice"):
        read_set([tmp_path, path])


def test_an_unreadable_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(RecordingError, match=re.escape(f"{tmp_path}: the folder cannot be read (Permission denied)")):
        read_set(tmp_path)


def test_doubts_of_a_set_are_given(tmp_path: Path) -> None:
    path = put(tmp_path / "a.csv", TEXT.replace("000,", ","))
    with pytest.warns(RecordingWarning, match=re.escape(f"{path}: no command is above 3 Pa")):
        read_set(path)


def test_summary(tmp_path: Path) -> None:
    path = put(tmp_path / "a.csv", "# who = me\n# before.cmd.maa = 1\n# before.cmd.baa = 2\n" + TEXT)
    summary = summarise(read(path)).as_json()
    assert summary["name"] == "a" and summary["rows"] == 3
    assert summary["duration_s"] == 0.03 and summary["rate_hz"] == pytest.approx(1 / 0.015)
    assert summary["interval_s"] == pytest.approx((0.01, 0.02)) and summary["jitter_s"] == pytest.approx(0.005)
    assert summary["command_pa"] == {"maa": (1000, 3000), "baa": (2000, 2000)}
    assert summary["position_rad"] == {"hip": (1.4, 1.6), "knee": (0.1, 0.3)}
    assert summary["before_pa"] == {"maa": 1, "baa": 2} and summary["notes"] == {"who": "me"}
    assert summarise(read(put(path))).before_pa is None


def test_convert_writes_every_trial_and_nothing_else(leg_dir: Path, tmp_path: Path) -> None:
    files = convert(leg_dir, tmp_path / "out")
    assert sorted(path.name for path in files) == sorted(os.listdir(tmp_path / "out")) and len(files) == 28
    for one, other in zip(read_set(leg_dir), read_set(files), strict=True):
        assert one.name == other.name and one.notes == other.notes
        for key in ("time", "command", "position", "command_before"):
            np.testing.assert_array_equal(getattr(one, key), getattr(other, key))


def test_convert_replaces_only_when_told_to(tmp_path: Path) -> None:
    source, output = put(tmp_path / "a.csv", STEP), tmp_path / "out"
    old = put(output / "step_release_p10_0.csv", "old")
    with pytest.raises(RecordingError, match=re.escape(f"{old}: this file is there already; name another folder, or")):
        convert(source, output)
    assert old.read_text() == "old"
    assert convert(source, output, force=True) == (old,)
    assert len(read(old).time) == 2 and os.listdir(output) == [old.name]


def test_convert_is_all_or_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = [put(tmp_path / f"{name}.csv") for name in "abc"]
    output = tmp_path / "out"
    old = put(output / "a.csv", "old")
    replace = os.replace

    def fail(source: Path, target: Path) -> None:
        if Path(target) == output / "c.csv":
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(RecordingError, match=r"out: recordings cannot be written there \(No space left on device\)"):
        convert(sources, output, force=True)
    assert os.listdir(output) == ["a.csv"] and old.read_text() == "old"
    with pytest.raises(RecordingError, match="No space left"):
        convert(sources, tmp_path / "out", force=True)


def test_convert_leaves_no_folder_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good, bad = put(tmp_path / "a.csv"), put(tmp_path / "b.csv", TEXT.replace("1.6", "nan"))
    with pytest.raises(RecordingError, match=r"b\.csv, row 3, column pos\.hip"):
        convert([good, bad], tmp_path / "out")
    assert not (tmp_path / "out").exists()

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("equimus_ctrl.recordings.csvfile.write", interrupt)
    with pytest.raises(KeyboardInterrupt):
        convert(good, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_convert_into_a_file_is_refused(tmp_path: Path) -> None:
    source = put(tmp_path / "a.csv")
    with pytest.raises(RecordingError, match=r"a\.csv: recordings cannot be written there \(File exists\)"):
        convert(source, source)
