"""Folders and files that results go to: each run's own, and what --force takes away."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from equimus_ctrl import outputs
from equimus_ctrl.errors import ConfigError


def test_default_folders_are_numbered_and_given_ones_have_to_be_free(tmp_path: Path) -> None:
    default, given = tmp_path / "results" / "hold", tmp_path / "mine"
    names = [outputs.Results(None, False, default).opened(default).name for _ in range(3)]
    assert names == ["hold", "hold-2", "hold-3"]
    assert outputs.Results(None, True, default).opened(default) == default
    folder = outputs.Results(given, False, default).opened(default)
    assert folder == given
    outputs.write_record(folder, "record.json", {"a": 1}, [folder / "a.png"])
    assert json.loads((given / "record.json").read_text()) == {"a": 1, "files": ["a.png"]}
    with pytest.raises(ConfigError, match=r"mine: holds the results of an earlier run \(record.json\)"):
        outputs.Results(given, False, default)


def test_what_another_run_has_written_meanwhile_stays(tmp_path: Path) -> None:
    given = tmp_path / "mine"
    one, two = (outputs.Results(given, False, given) for _ in range(2))
    first = one.opened(given)
    (first / "a.png").write_text("first")
    outputs.write_record(first, "score.json", {}, [first / "a.png"])
    second = two.opened(given)
    assert (first, second) == (given, tmp_path / "mine-2")
    assert (first / "a.png").read_text() == "first" and (first / "score.json").exists()


def test_force_takes_away_what_the_record_lists_and_nothing_else(tmp_path: Path) -> None:
    for name in ("a.png", "mine.png", "trial.csv"):
        (tmp_path / name).write_text("x")
    (tmp_path / "folder").mkdir()
    outside = tmp_path.parent / f"{tmp_path.name}_outside"
    outside.write_text("x")
    listed = ["a.png", "", "folder", "gone.png", f"../{outside.name}", str(outside), 3]
    (tmp_path / "record.json").write_text(json.dumps({"files": listed}))
    assert outputs.Results(tmp_path, True, tmp_path).opened(tmp_path) == tmp_path
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "mine.png", "trial.csv"] and outside.exists()
    for odd in ("[]", "no JSON", '{"files": 3}'):
        (tmp_path / "record.json").write_text(odd)
        outputs.Results(tmp_path, True, tmp_path).opened(tmp_path)
        assert not (tmp_path / "record.json").exists() and (tmp_path / "mine.png").exists()


def test_a_place_where_nothing_can_be_written_is_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for given, default in ((tmp_path / "file", tmp_path), (None, tmp_path / "file" / "below")):
        with pytest.raises(ConfigError, match=r"is no folder and cannot become one"):
            outputs.Results(given, False, default)


def test_a_reserved_name_is_nobody_elses_and_free_again_where_writing_fails(tmp_path: Path) -> None:
    wanted = tmp_path / "below" / "hold.csv"
    with outputs.reserved(wanted) as one, outputs.reserved(wanted) as two:
        assert (one.name, two.name) == ("hold.csv", "hold-2.csv")
    with pytest.raises(ZeroDivisionError), outputs.reserved(wanted) as three:
        raise ZeroDivisionError
    assert three.name == "hold-3.csv" and not three.exists() and two.exists()
    assert outputs.free_name(wanted).name == "hold-3.csv"
    (tmp_path / "below" / "hold-3.csv").symlink_to("nowhere")
    assert outputs.free_name(wanted).name == "hold-4.csv"
    with pytest.raises(ConfigError, match="hold-3.csv: is there already"):
        outputs.check_new(tmp_path / "below" / "hold-3.csv")
