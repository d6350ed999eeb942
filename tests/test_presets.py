"""Files a user edits: where they are found, how they are read, and that they are written whole or not at all."""

from __future__ import annotations

import json
import math
import os
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import equimus_ctrl as eq
from equimus_ctrl import presets


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """A current folder, a checkout and a package's presets of our own, all empty."""
    found = {name: tmp_path / name for name in ("cwd", "checkout")}
    found["package"] = found["checkout"] / "equimus_ctrl" / "_presets"
    for folder in found.values():
        for kind in presets.KINDS:
            (folder / kind).mkdir(parents=True)
    (found["checkout"] / "pyproject.toml").touch()
    monkeypatch.setattr(presets, "_PACKAGE", found["checkout"] / "equimus_ctrl")
    monkeypatch.chdir(found["cwd"])
    return found


def test_the_checkout_is_known_by_its_files(places: dict[str, Path]) -> None:
    assert presets.checkout() == places["checkout"]
    (places["checkout"] / "pyproject.toml").unlink()
    assert presets.checkout() is None


def test_the_nearest_file_wins(places: dict[str, Path]) -> None:
    for name in ("package", "checkout", "cwd"):
        path = places[name] / "scenarios" / "hop.py"
        path.touch()
        assert presets.find("scenarios", "hop.py") == path
        assert presets.names("scenarios", ".py") == {"hop": path}
    assert presets.find("controllers", "hop.py") is None and presets.find("scenarios", "hip.py") is None


def test_names_are_gathered_from_everywhere(places: dict[str, Path]) -> None:
    for place, name in (("package", "a"), ("checkout", "b"), ("cwd", "c"), ("cwd", "_hidden")):
        (places[place] / "scenarios" / f"{name}.py").touch()
    (places["cwd"] / "scenarios" / "d.toml").touch()
    assert sorted(presets.names("scenarios", ".py")) == ["a", "b", "c"]


def test_results_go_to_the_checkout_from_inside_it_only(
    places: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert presets.workspace() == places["cwd"]
    monkeypatch.chdir(places["checkout"] / "scenarios")
    assert presets.workspace() == places["checkout"]
    monkeypatch.chdir(places["checkout"])
    assert presets.workspace() == places["checkout"]
    (places["checkout"] / "pyproject.toml").unlink()
    monkeypatch.chdir(places["checkout"] / "scenarios")
    assert presets.workspace() == places["checkout"] / "scenarios"


# Reading.


def test_toml_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('name = "Fuß"\n[table]\nx = 1\n', encoding="utf-8")
    assert presets.read_toml(tmp_path / "a.toml") == {"name": "Fuß", "table": {"x": 1}}


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "there is no such file"),
        (b"a = [", "is not valid TOML: "),
        (b"a = 1\na = 2\n", "is not valid TOML: "),
        (b'a = "\xe9"', "cannot be read ("),
    ],
)
def test_what_cannot_be_read_is_a_sentence(content: bytes | None, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(eq.ConfigError) as caught:
        presets.read_toml(path)
    assert str(caught.value).startswith(f"{path}: {sentence}") and "\n" not in str(caught.value)


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(eq.ConfigError, match="cannot be read"):
        presets.read_toml(tmp_path)


PLAIN = st.recursive(
    st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(min_size=1, max_size=5), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.text(st.characters(codec="ascii"), min_size=1, max_size=5), PLAIN, max_size=4))
def test_what_is_written_as_toml_is_read_back(data: dict[str, Any]) -> None:
    assert tomllib.loads(presets.toml_text(data)) == data


def test_a_comment_stays_one(tmp_path: Path) -> None:
    text = presets.toml_text({"a": 1}, "first line\n\nthird line")
    assert text.startswith("# first line\n\n# third line\n") and tomllib.loads(text) == {"a": 1}


# Writing.


def test_text_is_written_whole(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "a.txt"
    presets.write_text(path, "one")
    presets.write_text(path, "Fuß")
    assert path.read_text(encoding="utf-8") == "Fuß"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]
    assert path.stat().st_mode & 0o444 == 0o444


def fails(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_failure_leaves_the_old_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.txt"
    presets.write_text(path, "old")
    monkeypatch.setattr(os, "replace", fails)
    with pytest.raises(eq.ConfigError):
        presets.write_text(path, "new")
    assert path.read_text() == "old"


def test_text_that_cannot_be_encoded_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    presets.write_text(path, "old")
    with pytest.raises(UnicodeEncodeError):
        presets.write_text(path, "half\ud800")
    assert path.read_text() == "old"


def test_a_failure_leaves_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "replace", fails)
    with pytest.raises(eq.ConfigError, match=r"a.txt: cannot be written \(No space left on device\)"):
        presets.write_text(tmp_path / "a.txt", "new")
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(eq.EquimusError, match="file"):
        presets.write_text(tmp_path / "file" / "a.txt", "new")


def test_what_is_no_place_for_toml_is_told_before_it_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "folder.toml").mkdir()
    presets.check_toml(tmp_path / "new" / "a.toml")
    for name, said in (("robot.xml", "expected a name that ends in .toml"), ("folder.toml", "is a folder")):
        with pytest.raises(eq.ConfigError, match=said):
            presets.check_toml(tmp_path / name)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(eq.ConfigError, match="nothing can be written there"):
        presets.check_toml(tmp_path / "new" / "a.toml")


# Users' Python.


def test_scripts_are_run(tmp_path: Path) -> None:
    (tmp_path / "s.py").write_text("value = 3\n")
    assert presets.load_script(tmp_path / "s.py").value == 3
    (tmp_path / "s.py").write_text("value = 44\n")
    os.utime(tmp_path / "s.py", (1, 1))
    assert presets.load_script(tmp_path / "s.py").value == 44


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1 / 0", "fails when it is loaded: ZeroDivisionError: division by zero"),
        ("def (", "fails when it is loaded: SyntaxError: "),
        ("import no_such_module_at_all", "fails when it is loaded: ModuleNotFoundError: No module named 'no_such"),
    ],
)
def test_a_script_that_fails_is_a_sentence(text: str, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "s.py"
    path.write_text(text)
    with pytest.raises(eq.ConfigError) as caught:
        presets.load_script(path)
    assert str(caught.value).startswith(f"{path}: {sentence}")


def test_a_script_that_exits_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "s.py").write_text("import sys\nsys.exit(3)\n")
    with pytest.raises(eq.ConfigError, match=r"s\.py"):
        presets.load_script(tmp_path / "s.py")


def test_a_scenario_is_a_script_with_build(places: dict[str, Path]) -> None:
    path = places["cwd"] / "scenarios" / "hop.py"
    path.write_text("def build(context):\n    return 7\n")
    for name in ("hop", "scenarios/hop.py", str(path)):
        build, where = presets.load_scenario(name)
        assert build(None) == 7 and Path(where).resolve() == path.resolve()
    with pytest.raises(eq.ConfigError) as caught:
        presets.load_scenario("hopp")
    assert str(caught.value) == "there is no scenario 'hopp'; did you mean 'hop'? (known: hop)"
    with pytest.raises(eq.ConfigError, match=r"^else.py: there is no such file$"):
        presets.load_scenario("else.py")
    path.write_text("build = 3\n")
    with pytest.raises(eq.ConfigError, match=r"has no function build\(context, …\) that returns a Scenario"):
        presets.load_scenario("hop")


def test_a_preset_is_told_by_its_name_and_a_file_of_ones_own_by_its_path(
    places: dict[str, Path], tmp_path: Path
) -> None:
    for place, said in ((places["package"], "tuning/pid.toml"), (places["cwd"], "mine/pid.toml")):
        (place / said).parent.mkdir(exist_ok=True)
        assert presets.shown(place / said) == said
    assert presets.shown(places["checkout"] / "scenarios" / "hop.py") == "scenarios/hop.py"
    assert presets.shown(tmp_path / "elsewhere.py") == str(tmp_path / "elsewhere.py")


def test_objects_are_named_by_file_and_name(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("class Mine: ...\n_hidden = 1\n")
    assert presets.load_object(f"{path}:Mine").__name__ == "Mine"
    with pytest.raises(eq.ControllerError) as caught:
        presets.load_object(f"{path}:Mein")
    assert str(caught.value) == f"{path}: there is no name 'Mein'; did you mean 'Mine'? (known: Mine)"
    for text in (str(path), f"{path}:", f"{path}:not-a-name", "mine:Mine", "mine.txt:Mine"):
        with pytest.raises(eq.ControllerError, match="is neither a known controller nor path/to/file.py:Name"):
            presets.load_object(text)


# Rows kept as they come.


HEADER = {"format": "test/1", "key": "a"}


def lines(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_rows_are_on_disk_at_once(tmp_path: Path) -> None:
    path = tmp_path / "sub" / "j.jsonl"
    store = presets.JsonLines(path, HEADER)
    assert lines(path) == [HEADER]
    for k in range(3):
        store.append({"k": k})
        assert lines(path)[-1] == {"k": k} and len(lines(path)) == k + 2
    store.close()
    again = presets.JsonLines(path, HEADER)
    assert again.rows == [{"k": 0}, {"k": 1}, {"k": 2}]
    again.append({"k": 3})
    again.close()
    assert lines(path) == [HEADER, *({"k": k} for k in range(4))]


@given(st.integers(0, 200))
def test_a_file_cut_anywhere_keeps_its_whole_rows(cut: int) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "j.jsonl"
        store = presets.JsonLines(path, HEADER)
        for k in range(5):
            store.append({"k": k, "text": "x" * k})
        store.close()
        whole = path.read_bytes()
        path.write_bytes(whole[: max(len(whole) - cut, 0)])
        kept = whole[: max(len(whole) - cut, 0)].decode().split("\n")
        again = presets.JsonLines(path, HEADER)
        found = len(again.rows)
        again.append({"k": 99})
        again.close()
        assert lines(path)[0] == HEADER and lines(path)[-1] == {"k": 99}
        # A row whose line break alone is missing is whole; nothing is lost that could be read.
        expected = sum(1 for line in kept[1:] if line.endswith("}"))
        assert found == expected and lines(path)[1:-1] == [{"k": k, "text": "x" * k} for k in range(expected)]


@pytest.mark.parametrize("broken", ['{"k": 1', "[1]", "", "\x00\x00\x00"])
def test_a_broken_row_in_the_middle_ends_what_is_read(broken: str, tmp_path: Path) -> None:
    """What stands after it has lost its place."""
    path = tmp_path / "j.jsonl"
    path.write_text("\n".join([json.dumps(HEADER), '{"k": 0}', broken, '{"k": 2}', ""]))
    store = presets.JsonLines(path, HEADER)
    store.close()
    assert store.rows == [{"k": 0}] and lines(path) == [HEADER, {"k": 0}]


def test_numbers_come_back_bit_for_bit(tmp_path: Path) -> None:
    row = {"values": [0.1, 1 / 3, 5e-324, 1.7e308], "nan": math.nan, "inf": math.inf}
    store = presets.JsonLines(tmp_path / "j.jsonl", HEADER)
    store.append(row)
    store.close()
    again = presets.JsonLines(tmp_path / "j.jsonl", HEADER)
    again.close()
    assert again.rows[0]["values"] == row["values"] and again.rows[0]["inf"] == math.inf
    assert math.isnan(again.rows[0]["nan"])


@pytest.mark.parametrize("other", ['{"format": "test/1", "key": "b"}\n{"k": 0}\n', "no json\n", "", "[1, 2]\n"])
def test_another_file_is_set_aside(other: str, tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    for k in (1, 2):
        path.write_text(other)
        store = presets.JsonLines(path, HEADER)
        store.close()
        assert store.rows == [] and lines(path) == [HEADER]
        assert (tmp_path / f"j-{k}.jsonl").read_text() == other


def test_fresh_sets_its_own_file_aside(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    store = presets.JsonLines(path, HEADER)
    store.append({"k": 0})
    store.close()
    fresh = presets.JsonLines(path, HEADER, fresh=True)
    fresh.close()
    assert fresh.rows == [] and lines(tmp_path / "j-1.jsonl") == [HEADER, {"k": 0}]


# JSON.


def test_json_is_plain() -> None:
    value = {"a": (1, 2.5), 3: [math.nan, math.inf, -math.inf], "b": {"c": None, "d": True}, "e": "ä"}
    found = json.loads(presets.json_text(value))
    assert found == {"a": [1, 2.5], "3": [None, None, None], "b": {"c": None, "d": True}, "e": "ä"}
    assert presets.json_text({}).endswith("\n")


def test_rows_are_dropped_from_the_file_too(tmp_path: Path) -> None:
    """Else a row that fits nothing would stand before those appended later, and end what the next run takes up."""
    lines = presets.JsonLines(tmp_path / "j.jsonl", {"key": "a"})
    for k in range(3):
        lines.append({"k": k})
    lines.truncate(1)
    lines.append({"k": 9})
    lines.close()
    again = presets.JsonLines(tmp_path / "j.jsonl", {"key": "a"})
    assert again.rows == [{"k": 0}, {"k": 9}]
    again.close()


def test_the_package_carries_every_preset() -> None:
    root = Path(presets.__file__).resolve().parents[1]
    if not (root / "pyproject.toml").is_file():
        pytest.skip("the package is installed; there is no checkout whose build file could be read")
    build = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    carried = build["force-include"]
    files = {f"{kind}/{path.name}" for kind in presets.KINDS for path in (root / kind).iterdir() if path.is_file()}
    left = {file for file in files if file not in carried and file.partition("/")[0] not in carried}
    assert not left, f"installed packages lack {sorted(left)}"
