"""The formats the leg was recorded in: what is in the real files, and what is wrong in spoilt ones."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from equimus_ctrl.errors import RecordingError
from equimus_ctrl.recordings import Limits, RecordingWarning, read_set, read_static_poses, upstream

STEP = "relative_time,pressure1_start,pressure2_start,current_pressure1,current_pressure2,thigh_theta21,calf_theta32\n"
TRIANGLE = "relative_time,pressure1_start,pressure2_start,pressure1_end,pressure2_end,thigh_theta21,calf_theta32\n"
SPARSE = Limits(max_interval=10.0)
STATIC = "P1 (kPa),P2 (kPa),theta1 (deg),theta2 (deg)\n"


def put(folder: Path, text: str, name: str = "upstream.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def step_group(p1: float, p2: float, first: float = 74.0) -> str:
    rows = [(0.0, p1, p2, first), (2.5, p1, p2, 90.0), (5.0, 0.0, 0.0, 90.0), (9.9, 0.0, 0.0, 74.0)]
    return "".join(f"{t},{p1},{p2},{c1},{c2},{angle},60\n" for t, c1, c2, angle in rows)


def segment(start: tuple[float, float], end: tuple[float, float], first: float, last: float) -> str:
    rows = [(0.017, first), (1.0, last), (1.99, last)]
    return "".join(f"{t},{start[0]},{start[1]},{end[0]},{end[1]},{angle},{angle}\n" for t, angle in rows)


def test_step_release_groups(leg_dir: Path) -> None:
    trials = {trial.name: trial for trial in read_set(leg_dir / "step_release.csv")}
    assert len(trials) == 27 and sum(len(trial.time) for trial in trials.values()) == 15932
    for name, trial in trials.items():
        start = np.array([1e3 * float(p) for p in name.removeprefix("step_release_p").split("_")])
        release = np.flatnonzero(trial.time >= 5.0)[0]
        assert (trial.command[:release] == start).all() and (trial.command[release:] == 0.0).all()
        assert trial.time[0] == 0.0 and 9.98 < trial.time[-1] < 10.0
        assert np.diff(trial.time).min() > 0.016 and np.diff(trial.time).max() < 0.021
        if name == "step_release_p0_0":
            assert trial.before is None and trial.notes["settled"] == "no"
        else:
            assert trial.before is not None and not trial.before.any() and "settled" not in trial.notes
            assert np.abs(np.degrees(trial.position[0] - trial.position[-1])).max() < 3.1
    rest = trials["step_release_p0_0"].position[-1]
    np.testing.assert_allclose(rest, np.radians([73.14, 61.34]), atol=1e-3)
    assert trials["step_release_p30_20"].notes == {"source": "step_release.csv", "source_rows": "9445-10033"}


def test_triangle_clock_is_rebuilt(leg_dir: Path) -> None:
    (trial,) = read_set(leg_dir / "triangle.csv")
    assert trial.name == "triangle" and len(trial.time) == 3804
    steps = np.diff(trial.time)
    changes = np.flatnonzero((np.diff(trial.command, axis=0) != 0.0).any(axis=1))
    assert trial.time[0] == pytest.approx(0.0168, abs=1e-4) and trial.time[-1] == pytest.approx(39.9995, abs=1e-4)
    assert len(changes) == 19
    assert steps[changes].min() > 0.016 and steps[changes].max() < 0.028
    others = np.delete(steps, changes)
    assert others.min() > 0.0099 and others.max() < 0.012
    assert (np.floor(trial.time[changes + 1] / 2.0) == np.arange(1, 20)).all()
    np.testing.assert_allclose(trial.command[0], [3757.28, 7261.15], atol=0.01)
    assert trial.before is not None and not trial.before.any()
    np.testing.assert_allclose(np.degrees(trial.position[0]), [73.86, 62.48], atol=0.01)


@pytest.mark.parametrize("count", [36, 13])
def test_static_poses(leg_dir: Path, count: int) -> None:
    poses = read_static_poses(leg_dir / f"static_poses_{count}.csv")
    assert poses.name == f"static_poses_{count}"
    assert poses.pressure.shape == poses.position.shape == (count, 2)
    assert poses.actuators == ("maa", "baa") and poses.joints == ("hip", "knee")
    np.testing.assert_allclose(poses.position[0], np.radians([73.0852, 61.3880]))
    assert poses.pressure.min() == 0.0 and poses.pressure[1].tolist() == [0.0, 1e4]
    assert not poses.pressure.flags.writeable and not poses.position.flags.writeable


def test_a_whole_folder_passes_static_poses_over(leg_dir: Path) -> None:
    assert len(read_set(leg_dir)) == 28


def test_repeated_groups_and_odd_pressures_get_names(tmp_path: Path) -> None:
    text = STEP + step_group(1e4, 0) + step_group(1e4, 0) + step_group(2500, 0)
    trials = read_set(put(tmp_path, text), limits=SPARSE)
    assert [trial.name for trial in trials] == [
        "step_release_p10_0",
        "step_release_p10_0_2",
        "step_release_p2d5_0",
    ]
    assert [trial.notes["source_rows"] for trial in trials] == ["2-5", "6-9", "10-13"]


def test_a_start_away_from_the_end_is_not_called_settled(tmp_path: Path) -> None:
    settled, moving = read_set(put(tmp_path, STEP + step_group(1e4, 0) + step_group(2e4, 0, first=80.0)), limits=SPARSE)
    assert settled.before is not None and moving.before is None


def test_columns_decide_and_others_are_ignored(tmp_path: Path) -> None:
    text = STEP + step_group(1e4, 0)
    lines = [f"{line},{extra}" for line, extra in zip(text.split(), ["stamp", *"abcd"], strict=True)]
    (trial,) = read_set(put(tmp_path, "\n".join(lines), "TriStatic_A2B_data.csv"), limits=SPARSE)
    assert trial.name == "step_release_p10_0"


def test_before_of_a_triangle_is_what_the_first_pose_says(tmp_path: Path) -> None:
    a, b = (6000.0, 3000.0), (4000.0, 7000.0)
    rested = TRIANGLE + segment(a, b, 80.0, 70.0) + segment(b, a, 70.0, 80.0)
    (trial,) = read_set(put(tmp_path, rested), limits=SPARSE)
    assert trial.before is not None and trial.before.tolist() == [6000.0, 3000.0]
    elsewhere = TRIANGLE + segment(a, b, 74.0, 70.0) + segment(b, a, 70.0, 80.0)
    (trial,) = read_set(put(tmp_path, elsewhere), limits=SPARSE)
    assert trial.before is not None and trial.before.tolist() == [0.0, 0.0]
    without_starts = "\n".join(
        ",".join(cell for k, cell in enumerate(line.split(",")) if k not in (1, 2)) for line in rested.split()
    )
    (trial,) = read_set(put(tmp_path, without_starts), limits=SPARSE)
    assert trial.before is not None and trial.before.tolist() == [0.0, 0.0]
    assert trial.time.tolist() == [0.017, 1.0, 1.99, 2.017, 3.0, 3.99]


def spoil(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


GROUP = STEP + step_group(1e4, 0)
SEGMENTS = TRIANGLE + segment((0, 0), (1e4, 0), 74.0, 80.0) + segment((1e4, 0), (0, 0), 80.0, 74.0)
WRONG = {
    "missing column": (
        spoil(GROUP, "calf_theta32", "calf"),
        "row 1: column 'calf_theta32' is missing; the leg's step_release format has relative_time, pressure1_start,",
    ),
    "missing column of the triangle": (
        spoil(SEGMENTS, "pressure1_end", "pressure1"),
        "row 1: column 'pressure1_end' is missing; the leg's triangle format has relative_time, pressure1_end,",
    ),
    "no rows": (STEP, ": there is a header but not one row of data below it"),
    "not a number": (spoil(GROUP, "90.0", "9o"), "row 3, column thigh_theta21: '9o' is not a number"),
    "nan": (spoil(GROUP, "90.0", "nan"), "row 3, column thigh_theta21: 'nan' is not finite"),
    "radians": (
        GROUP.replace(",74.0,60", ",1.3,1").replace(",90.0,60", ",1.6,1"),
        "row 2, column thigh_theta21: no angle is beyond 1.6; this looks like radians where degrees belong",
    ),
    "above the range": (
        spoil(GROUP, "2.5,10000.0,0,10000.0", "2.5,10000.0,0,60000.0"),
        "row 3, column current_pressure1: command 60000 Pa is above the range 0..50000 Pa",
    ),
    "time back": (
        spoil(GROUP, "5.0,", "1.0,"),
        "row 4, column relative_time: 1.0 s does not come after the 2.5 s of row 3; times must ascend, or",
    ),
    "one wrong time is no restart": (
        spoil(GROUP, "5.0,", "0.0,"),
        "row 4, column relative_time: 0.0 s does not come after the 2.5 s of row 3",
    ),
    "repeated time": (
        spoil(GROUP, "2.5,", "0.0,"),
        "row 3, column relative_time: 0.0 s does not come after the 0.0 s of row 2",
    ),
    "pressures change within": (
        spoil(GROUP, "2.5,10000.0", "2.5,20000.0"),
        "row 3, column pressure1_start: 20000 Pa differs from the 10000 Pa of row 2, though relative_time does not",
    ),
    "a row alone": (
        GROUP + "0.0,20000,0,20000,0,74,60\n",
        "row 6, column relative_time: this row stands alone between two restarts",
    ),
    "long segment": (
        spoil(SEGMENTS, "1.99,", "2.5,"),
        "row 4, column relative_time: 2.5 s is not below the 2 s a segment lasts",
    ),
    "segment pressures change within": (
        spoil(SEGMENTS, "1.99,0,0,10000.0", "1.99,0,0,10001.0"),
        "row 4, column pressure1_end: 10001 Pa differs from the 10000 Pa of row 3",
    ),
    "milliseconds": (
        GROUP,
        "row 3, column relative_time: rows are 2.5 apart, above the 0.5 s allowed; this looks like",
    ),
    "segments in half seconds": (
        SEGMENTS,
        "row 3, column relative_time: rows are 0.983 apart, above the 0.5 s allowed",
    ),
    "static poses": (STATIC + "0,0,73,61\n", ": these are static poses, not a recording over time"),
}


@pytest.mark.parametrize("case", WRONG)
def test_names_what_is_wrong(tmp_path: Path, case: str) -> None:
    text, sentence = WRONG[case]
    path = put(tmp_path, text)
    with pytest.raises(RecordingError) as caught:
        read_set(path)
    assert str(caught.value).startswith(f"{path}{'' if sentence.startswith(':') else ', '}{sentence}")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            spoil(STATIC, "P2 (kPa)", "P2") + "0,0,73,61\n",
            "row 1: column 'P2 (kPa)' is missing; the leg's static_poses",
        ),
        (STATIC + "0,0,73,61\n0,5e4,70,50\n", "row 3, column P2 (kPa): command 5e+07 Pa is above the range"),
        (STATIC + "0,0,1.3,1.1\n", "row 2, column theta1 (deg): no angle is beyond 1.3; this looks like radians"),
        (STATIC, "there is a header but not one row"),
    ],
)
def test_names_what_is_wrong_in_static_poses(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(RecordingError, match=re.escape(sentence)):
        read_static_poses(put(tmp_path, text))


def test_recordings_of_another_format_are_refused(tmp_path: Path) -> None:
    from equimus_ctrl.recordings.sheet import open_sheet

    with pytest.raises(RecordingError, match="this is none of the leg's upstream formats"):
        upstream.recordings(open_sheet(put(tmp_path, "a,b\n1,2\n")))


@settings(deadline=None, max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_corruption_is_reported_or_harmless(tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(data.draw(st.sampled_from([GROUP + step_group(0, 2e4), SEGMENTS])).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        end = min(len(content), start + data.draw(st.sampled_from([0, 1, 2, 30, 1000])))
        pieces = [b"", b"\n", b",", b"#", b"\0", b"nan", b"-", b"e9", b"0"]
        content[start:end] = data.draw(st.sampled_from(pieces) | st.binary(max_size=4))
    path = tmp_path / "spoilt.csv"
    path.write_bytes(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RecordingWarning)
            trials = read_set(path, limits=SPARSE)
    except RecordingError as error:
        assert str(error).startswith(str(path)) and str(error).isprintable()
    else:
        assert all((np.diff(trial.time) > 0).all() for trial in trials)
