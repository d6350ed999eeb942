"""The project's recording format: what goes in comes out, and what is wrong is named with its place."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from equimus_ctrl.errors import ConfigError, RecordingError
from equimus_ctrl.recordings import Limits, RecordingWarning, read
from equimus_ctrl.types import Array

HEADER = "time,cmd.maa,cmd.baa,pos.hip,pos.knee"
VALID = f"""# source = a test
# before.cmd.maa = 0
# before.cmd.baa = 500
{HEADER}
0.00,1000,2000,1.50,0.10
0.01,1000,2000,1.51,0.11

0.02,3000,2000,1.52,0.12
"""


def put(folder: Path, text: str | bytes, name: str = "trial.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_reads_every_part(tmp_path: Path) -> None:
    recording = read(put(tmp_path, VALID))
    assert recording.name == "trial"
    assert (recording.actuators, recording.joints) == (("maa", "baa"), ("hip", "knee"))
    assert recording.time.tolist() == [0.0, 0.01, 0.02]
    assert recording.command.tolist() == [[1000, 2000], [1000, 2000], [3000, 2000]]
    assert recording.position.tolist() == [[1.5, 0.1], [1.51, 0.11], [1.52, 0.12]]
    assert recording.before is not None and recording.before.tolist() == [0, 500]
    assert recording.notes == {"source": "a test"}
    assert recording.velocity is None and recording.measured is None


def test_without_notes_the_first_command_was_in_force(tmp_path: Path) -> None:
    recording = read(put(tmp_path, VALID.partition("500\n")[2]))
    assert recording.before is None and recording.notes == {}
    assert recording.command_before.tolist() == [1000, 2000]


def test_columns_in_any_order_with_velocities_and_pressures(tmp_path: Path) -> None:
    text = "pos.knee,vel.hip,time,meas.b,pos.hip,cmd.a,cmd.b,meas.a,vel.knee\n1,2,0,3,4,5,6,7,8\n1,2,0.1,3,4,5,6,7,8\n"
    recording = read(put(tmp_path, text), limits=Limits(command_high=1e3))
    assert recording.joints == ("knee", "hip") and recording.actuators == ("a", "b")
    assert recording.velocity is not None and recording.velocity[0].tolist() == [8, 2]
    assert recording.measured is not None and recording.measured[0].tolist() == [7, 3]


@pytest.mark.parametrize("ending", ["\r\n", "\r"])
def test_other_line_endings_and_byte_order_mark(tmp_path: Path, ending: str) -> None:
    recording = read(put(tmp_path, b"\xef\xbb\xbf" + VALID.replace("\n", ending).encode()))
    assert len(recording.time) == 3 and recording.notes == {"source": "a test"}


def test_plain_comments_are_kept(tmp_path: Path) -> None:
    recording = read(put(tmp_path, "# windy day\n#\n# second run\n" + VALID))
    assert recording.notes["comment"].split() == ["windy", "day", "second", "run"]


def replaced(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


def in_header(old: str, new: str) -> Callable[[str], str]:
    assert old in HEADER
    return replaced(HEADER, HEADER.replace(old, new))


# what is done to VALID, and the sentence that says so, after the file's name
WRONG: dict[str, tuple[Callable[[str], str], str]] = {
    "no time": (
        in_header("time,", "vel.hip,"),
        "row 4: column 'time' is missing; sample times in seconds belong in it",
    ),
    "misspelt time": (in_header("time", "Time"), "row 4: there is no column 'Time'; did you mean 'time'?"),
    "no commands": (
        replaced("cmd.maa,cmd.baa", "vel.hip,vel.knee"),
        "row 4: there is no column 'cmd.<actuator>'; commanded pressures in Pa belong in such columns",
    ),
    "no positions": (
        replaced("pos.hip,pos.knee", "meas.maa,meas.baa"),
        "row 4: there is no column 'pos.<joint>'; joint angles in rad belong in such columns",
    ),
    "one joint missing": (
        replaced("pos.knee", "pos.ankle"),
        "row 4: column 'pos.knee' is missing, though 'pos.hip' is there; hip and knee belong together",
    ),
    "one actuator missing": (
        lambda text: re.sub(r"(?m)^(time|0\.0\d),[^,]*,", r"\1,", text),
        "row 4: column 'cmd.maa' is missing, though 'cmd.baa' is there; maa and baa belong together",
    ),
    "unknown column": (
        in_header("cmd.maa", "cmd_maa"),
        "row 4: there is no column 'cmd_maa'; did you mean 'cmd.maa'? (known: time, cmd.<actuator>, pos.<joint>",
    ),
    "prefix alone": (in_header("cmd.maa", "cmd."), "row 4: there is no column 'cmd.'"),
    "nameless column": (in_header("cmd.maa", ""), "row 4: column 2 of 5 has no name"),
    "odd column": (
        in_header("cmd.baa", "cmd.b\0a"),
        "row 4: the name of column 3, 'cmd.b\\x00a', has a character that cannot be printed",
    ),
    "repeated column": (
        in_header("cmd.baa", "cmd.maa"),
        "row 4: column 'cmd.maa' is there more than once (as columns 2, 3)",
    ),
    "semicolons": (
        lambda text: text.replace(",", ";"),
        "row 4: the columns are separated by semicolons; commas belong",
    ),
    "tabs": (lambda text: text.replace(",", "\t"), "row 4: the columns are separated by tabs; commas belong"),
    "empty": (lambda text: "", ": the file is empty; a header and rows of numbers belong in it"),
    "blank": (lambda text: "\n \n# a note\n", ": the file is empty"),
    "header only": (lambda text: text[: text.index("0.00")], ": there is a header but not one row of data below it"),
    "one row": (
        lambda text: text[: text.index("0.01,")],
        "row 5, column time: this is the only row; a recording has at least two",
    ),
    "not a number": (
        replaced("3000", "3O00"),
        "row 8, column cmd.maa: '3O00' is not a number; a number belongs there",
    ),
    "underscore": (replaced("3000", "3_000"), "row 8, column cmd.maa: '3_000' is not a number"),
    "other digits": (replaced("3000", "٣"), "row 8, column cmd.maa: '٣' is not a number"),
    "empty cell": (replaced("3000", ""), "row 8, column cmd.maa: an empty cell is not a number"),
    "long cell": (replaced("3000", "x" * 200), "row 8, column cmd.maa: '" + "x" * 39 + "…' is not a number"),
    "too few cells": (replaced(",1.51,", ","), "row 6: 4 cells, but the header names 5 columns"),
    "too many cells": (replaced(",1.51,", ",1.51,7,"), "row 6: 6 cells, but the header names 5 columns"),
    "late note": (replaced("\n\n", "\n# late\n"), "row 7: '# late' stands below the header; notes that start with '#'"),
    "nan": (replaced("0.11", "nan"), "row 6, column pos.knee: 'nan' is not finite; a finite number belongs there"),
    "inf": (replaced("1.52", "-inf"), "row 8, column pos.hip: '-inf' is not finite"),
    "overflow": (replaced("1.52", "1e999"), "row 8, column pos.hip: '1e999' is not finite"),
    "nan time": (replaced("0.02", "NaN"), "row 8, column time: 'NaN' is not finite"),
    "time back": (
        replaced("0.02", "0.005"),
        "row 8, column time: 0.005 s goes back from the 0.01 s of row 6; times must ascend",
    ),
    "time repeats": (
        replaced("0.02", "0.01"),
        "row 8, column time: 0.01 s repeats the 0.01 s of row 6; times must ascend",
    ),
    "milliseconds": (
        lambda text: text.replace("\n0.01", "\n10").replace("\n0.02", "\n20"),
        "row 6, column time: rows are 10 apart, above the 0.5 s allowed; this looks like milliseconds",
    ),
    "degrees": (
        replaced("1.51", "86.5"),
        "row 6, column pos.hip: 86.5 is beyond ±6.9115 rad; this looks like degrees where radians belong",
    ),
    "command above": (
        replaced("3000", "50001"),
        "row 8, column cmd.maa: command 50001 Pa is above the range 0..50000 Pa",
    ),
    "command below": (replaced("3000", "-1"), "row 8, column cmd.maa: command -1 Pa is below the range 0..50000 Pa"),
    "before above": (
        replaced("baa = 500", "baa = 5e5"),
        "row 3, note before.cmd.baa: command 500000 Pa is above the range 0..50000 Pa",
    ),
    "before not a number": (
        replaced("baa = 500", "baa = high"),
        "row 3, note before.cmd.baa: 'high' is not a finite number; a pressure in Pa belongs there",
    ),
    "before nan": (replaced("baa = 500", "baa = nan"), "row 3, note before.cmd.baa: 'nan' is not a finite number"),
    "before of nothing": (
        replaced("before.cmd.baa", "before.cmd.bba"),
        "row 3: there is no note 'before.cmd.bba'; did you mean 'before.cmd.baa'? (known: before.cmd.baa,",
    ),
    "before incomplete": (
        replaced("# before.cmd.baa = 500\n", ""),
        ": note 'before.cmd.baa' is missing, though 'before.cmd.maa' is there; state it for all actuators or none",
    ),
    "neither settled nor not": (
        replaced("# source", "# settled = maybe\n# source"),
        "row 1: note 'settled' is 'maybe', expected yes or no",
    ),
    "note twice": (replaced("# source", "# source = x\n# source"), "row 2: note 'source' is there more than once"),
    "before twice": (
        replaced("# before.cmd.baa", "# before.cmd.maa"),
        "row 3: note 'before.cmd.maa' is there more than once",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_names_what_is_wrong(tmp_path: Path, case: str) -> None:
    change, sentence = WRONG[case]
    path = put(tmp_path, change(VALID))
    with pytest.raises(RecordingError) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(f"{path}{'' if sentence.startswith(':') else ', '}{sentence}")
    assert "\n" not in message


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        ("pos.hip,pos.knee,vel.hip", "column 'vel.knee' is missing, though 'vel.hip' is there"),
        ("pos.hip,pos.knee,vel.nee", "column 'vel.nee': there is no joint 'nee'; did you mean 'knee'?"),
        ("pos.hip,pos.knee,meas.maa", "column 'meas.baa' is missing, though 'meas.maa' is there"),
        ("pos.hip,pos.knee,meas.mba", "column 'meas.mba': there is no actuator 'mba'; did you mean 'maa'?"),
    ],
)
def test_optional_columns_are_all_or_none(tmp_path: Path, columns: str, sentence: str) -> None:
    path = put(tmp_path, f"time,cmd.maa,cmd.baa,{columns}\n0,1,2,3,4,5\n1,1,2,3,4,5\n")
    with pytest.raises(RecordingError, match=re.escape(f"{path}, row 1: {sentence}")):
        read(path)


def test_names_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="this is a folder where a file belongs"):
        read(tmp_path)
    with pytest.raises(RecordingError, match=r"gone\.csv: there is no such file"):
        read(tmp_path / "gone.csv")
    with pytest.raises(RecordingError, match="cannot be read"):
        read("a\0b")
    with pytest.raises(RecordingError, match="cannot be read"):
        read(put(tmp_path, VALID) / "below_a_file.csv")


def test_names_bytes_that_are_not_text(tmp_path: Path) -> None:
    path = put(tmp_path, VALID.encode().replace(b"3000", b"3\xff00"))
    with pytest.raises(RecordingError, match=re.escape(f"{path}, row 8: byte 0xff is not UTF-8 text")):
        read(path)


def test_upstream_files_are_pointed_to_the_import(tmp_path: Path) -> None:
    path = put(tmp_path, "relative_time,pressure1_end\n0,1\n")
    with pytest.raises(RecordingError, match="the leg's triangle format; `equimus-ctrl recordings import` converts it"):
        read(path)


def test_limits_can_be_moved(tmp_path: Path) -> None:
    path = put(tmp_path, VALID.replace("3000", "200000").replace("1.52", "99").replace("0.02,", "1.9,"))
    wide = Limits(command_high=2e5, rotating=("hip",), max_interval=60.0)
    assert read(path, limits=wide).position[2, 0] == 99.0
    assert read(path, limits=Limits(command_high=2e5, max_angle=100.0, max_interval=60.0)).time[-1] == 1.9
    with pytest.raises(RecordingError, match="degrees"):
        read(path, limits=Limits(command_high=2e5, rotating=("knee",), max_interval=60.0))


def test_other_robots_have_other_names(tmp_path: Path) -> None:
    recording = read(put(tmp_path, "time,cmd.m,pos.shoulder\n0,0,0\n1e-2,0,0\n"))
    assert (recording.actuators, recording.joints) == (("m",), ("shoulder",))


def test_rounding_at_the_ends_of_the_range_is_let_through(tmp_path: Path) -> None:
    recording = read(put(tmp_path, VALID.replace("3000", "50000.0001").replace(",2000", ",-1e-9")))
    assert recording.command.max() == 50000.0001


def test_limits_check_themselves() -> None:
    with pytest.raises(ConfigError, match="lowest command .5 Pa. must be below the highest .5 Pa."):
        Limits(command_low=5.0, command_high=5.0)
    with pytest.raises(ConfigError, match="max_angle is 0; it must be above 0"):
        Limits(max_angle=0.0)
    with pytest.raises(ConfigError, match="max_interval is nan; it must be above 0"):
        Limits(max_interval=float("nan"))


@pytest.mark.parametrize("high", ["0.5", "50", "60"])
def test_kilopascals_are_doubted(tmp_path: Path, high: str) -> None:
    path = put(tmp_path, f"{HEADER}\n0,0,0,1,0\n0.01,{high},0,1,0\n")
    with pytest.warns(RecordingWarning, match=f"no command is above {high} Pa, .* are these kPa where Pa belong"):
        assert read(path).command.max() == float(high)


@pytest.mark.parametrize("text", [f"{HEADER}\n0,0,0,1,0\n0.01,0,0,1,0\n", f"{HEADER}\n0,0,0,1,0\n0.01,61,0,1,0\n"])
def test_no_pressure_at_all_is_not_doubted(tmp_path: Path, text: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(put(tmp_path, text))
        read(put(tmp_path, "# before.cmd.maa = 2e4\n# before.cmd.baa = 0\n" + text.replace("61", "10")))


def test_concealed_sets_read(recordings_dir: Path) -> None:
    files = sorted((recordings_dir / "concealed").glob("*/*.csv"))
    if not files:
        pytest.skip(f"no concealed recordings in {recordings_dir}")
    for path in files:
        recording = read(path)
        assert recording.joints == ("hip", "knee") and recording.actuators == ("maa", "baa")
        assert 11.9 < recording.time[-1] < 12.1 and recording.before is None


WITH_ALL = VALID.replace("pos.hip", "vel.knee,pos.hip,vel.hip").replace(",1.5", ",0,0.5,1.5").encode()


@settings(deadline=None, max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_corruption_is_reported_or_harmless(tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(data.draw(st.sampled_from([VALID.encode(), WITH_ALL])))
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        end = min(len(content), start + data.draw(st.sampled_from([0, 1, 1, 2, 10, 1000])))
        pieces = [b"", b"\n", b",", b"#", b"=", b"\0", b"\r", b'"', b"nan", b"-", b"e9", b" ", "\u2028".encode()]
        content[start:end] = data.draw(st.sampled_from(pieces) | st.binary(max_size=4))
    path = put(tmp_path, bytes(content), "spoilt.csv")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RecordingWarning)
            recording = read(path)
    except RecordingError as error:
        assert str(error).startswith(str(path)) and str(error).isprintable()
    else:
        assert np.isfinite(recording.position).all() and (np.diff(recording.time) > 0).all()


def test_a_gap_that_is_most_of_a_recording_is_refused(tmp_path: Path) -> None:
    """A wrong time in the last row, or two recordings in one file; a pause shorter than what was recorded is none."""
    times = np.arange(101) * 0.01

    def text(time: Array) -> str:
        rows = "".join(f"{at!r},0,0,1.5,0.1\n" for at in time.tolist())
        return "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n" + rows

    path = tmp_path / "gap.csv"
    path.write_text(text(np.append(times, 200000.0)))
    with pytest.raises(RecordingError) as caught:
        read(path)
    assert str(caught.value) == (
        f"{path}, row 103, column time: nothing was recorded for 199999 s before 200000 s, where rows are 0.01 s "
        "apart; these are several recordings, or one with a wrong time"
    )
    path.write_text(text(np.append(times, times + 2.5)))
    assert len(read(path).time) == 202
    path.write_text(text(np.append(times, times + 4.0)))
    with pytest.raises(RecordingError, match=r"row 103, column time: nothing was recorded for 3 s before 4 s"):
        read(path)
    path.write_text(text(np.array([0.0, 0.01, 1e5])))
    with pytest.raises(RecordingError, match="nothing was recorded for 100000 s"):
        read(path, limits=Limits(max_interval=1e6))
    bursts = (np.arange(8)[:, None] * 0.5 + np.arange(10) * 1e-3).ravel()
    path.write_text(text(bursts))
    assert len(read(path).time) == 80, "it was written in bursts"
