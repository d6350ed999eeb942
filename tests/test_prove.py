"""``equimus-ctrl prove`` with a diagnosis that makes it easy for itself: what is done when, and what is not done again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from proof_answers import LAG, SAID_LAG, SAID_RUB, report, truth

from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import ConfigError, EquimusError
from equimus_ctrl.executors.calls import Ended
from equimus_ctrl.executors.local import OnThisComputer
from equimus_ctrl.proof import blind, fingerprint
from equimus_ctrl.proof.seal import seal_of_all
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.store import Made, Request
from equimus_ctrl.workflow import proofs as workflow
from equimus_ctrl.workflow.proofs import prove

# --- fingerprints


def test_the_fingerprint_is_of_settings_and_of_the_parts_that_decide() -> None:
    one = fingerprint.fingerprint("a")
    assert one == fingerprint.fingerprint("a") != fingerprint.fingerprint("b")
    names = [
        name for part in fingerprint.PARTS for name, source in fingerprint._sources(f"equimus_ctrl.{part}") if source
    ]
    assert {"equimus_ctrl.diagnosis.diagnose", "equimus_ctrl.engines.lane_kernel", "equimus_ctrl.effects.force"} <= set(
        names
    )
    assert "equimus_ctrl.proof.scoring" not in names


CODE = '''"""What it is for."""

LIMIT = 2.0
"""At most."""


class Law:
    """A law."""

    name: str = "law"

    def force(self, speed: float) -> float:
        """Its force."""
        return -LIMIT * speed  # against the motion
'''


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("What it is for.", "What it does.", True),
        ('"""At most."""\n', "", True),
        ('    """A law."""\n', '    """The law: F = −c v."""\n', True),
        ('        """Its force."""\n', "", True),
        ("  # against the motion", "", True),
        ("-LIMIT * speed", "(\n            -LIMIT\n            * speed\n        )", True),
        ("LIMIT = 2.0\n", "\n\nLIMIT = 2.00\n", True),
        ("2.0", "2.5", False),
        ("2.0", "2", False),
        ("-LIMIT", "+LIMIT", False),
        ("* speed", "/ speed", False),
        ('"law"', '"another"', False),
        ("(self, speed: float)", "(self, speed: float = 0.0)", False),
    ],
)
def test_the_fingerprint_is_of_what_code_does(monkeypatch: pytest.MonkeyPatch, old: str, new: str, same: bool) -> None:
    assert CODE.count(old) == 1

    def of(text: str) -> str:
        monkeypatch.setattr(fingerprint, "_sources", lambda name: iter([(name, text)]))
        return fingerprint.fingerprint(parts=("effects",))

    assert (of(CODE) == of(CODE.replace(old, new))) is same


def test_the_fingerprint_sees_a_change_in_any_module(monkeypatch: pytest.MonkeyPatch) -> None:
    one = fingerprint.fingerprint("a")
    real = fingerprint._source

    def changed(loader: object, name: str) -> str:
        return real(loader, name) + "MORE = 1\n" * (name == "equimus_ctrl.diagnosis.search")

    monkeypatch.setattr(fingerprint, "_source", changed)
    assert fingerprint.fingerprint("a") != one


# --- the whole, with a diagnosis that makes it easy for itself


class World:
    """Two ground truths and an answer to each, without a simulation."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.events: list[str] = []
        self.tasks: list[tuple[Any, ...]] = []
        self.truths = {0: {**truth("none"), "case": 0}, 1: {**truth("single", LAG), "case": 1}}
        self.reports = [report(), report(SAID_LAG)]
        self.how: str | None = None
        self.version = "one"
        monkeypatch.setattr(workflow, "make_cases", self.make)
        monkeypatch.setattr(workflow, "open_truth", lambda request, case: self.truths[case])
        monkeypatch.setattr(workflow, "recorded", lambda folder, model: folder)
        monkeypatch.setattr(OnThisComputer, "each_apart", lambda executor, *given: self.work(*given))
        monkeypatch.setattr(blind, "report_fingerprint", lambda further: self.version)
        monkeypatch.setattr(blind, "baselines_fingerprint", lambda further: self.version + "+")

    def make(self, request: Request, cases: Any, executor: Any, notify: Any) -> list[Made]:
        made = [Made(case, f"{request.seed}{case}", 0.0) for case in cases]
        for one in made:
            notify(one)
        return made

    def work(self, work: Any, tasks: Any) -> Iterator[tuple[int, Any]]:
        assert work is blind.answer
        for k, (folder, _, own, others, further, label) in enumerate(tasks):
            assert not further
            self.tasks.append((folder, own, others, label))
            self.events.append(f"diagnosed {folder.name}")
            said = {**self.reports[int(folder.name[-1])]}
            said["proof"] = {**said["proof"], "seal": label, "fingerprint": self.version}
            simple = {"answers": {}, "seal": label, "fingerprint": self.version + "+"}
            texts = json.dumps(said) if own else None, json.dumps(simple) if others else None
            yield k, texts if self.how is None else Ended(self.how)

    def prove(self, folder: Path, **options: Any) -> Any:
        return prove(folder, **{"cases": 2, "workers": 1, "say": self.events.append, **options})


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def test_seals_are_said_before_the_first_diagnosis(world: World, tmp_path: Path) -> None:
    found = world.prove(tmp_path)
    whole = hashlib.sha256(b"00\n01\n").hexdigest()
    assert found.seal == whole == seal_of_all(["00", "01"])
    assert whole in world.events[0] and world.events[1:] == ["diagnosed case_0000", "diagnosed case_0001"]
    assert (tmp_path / "seals.txt").read_text() == f"{whole}  all\n00  case_0000\n01  case_0001\n"
    assert found.score.ours.single["all"] == Share(1, 1)
    assert found.to_dict()["seal"] == whole


def test_a_worker_is_told_of_recordings_alone(world: World, tmp_path: Path) -> None:
    world.prove(tmp_path, seed=5)
    for k, task in enumerate(world.tasks):
        assert task == (tmp_path / "recordings" / f"case_000{k}", True, True, f"5{k}")


def test_what_is_there_is_not_done_again(world: World, tmp_path: Path) -> None:
    world.prove(tmp_path)
    world.tasks.clear()
    world.prove(tmp_path)
    assert not world.tasks and "2 of 2 cases were diagnosed before" in world.events
    (tmp_path / "reports" / "case_0001.json").unlink()
    (tmp_path / "baselines" / "case_0000.json").write_text("{ cut o")
    world.prove(tmp_path)
    wanted = [(own, others) for _, own, others, _ in world.tasks]
    assert wanted == [(False, True), (True, False)]
    world.tasks.clear()
    world.prove(tmp_path, baselines=False)
    assert not world.tasks


@pytest.mark.parametrize("change", ["version", "seal"])
def test_answers_of_another_version_or_ground_truth_are_made_again(world: World, tmp_path: Path, change: str) -> None:
    world.prove(tmp_path)
    world.tasks.clear()
    if change == "version":
        world.version = "two"
    else:
        path = tmp_path / "reports" / "case_0001.json"
        path.write_text(path.read_text().replace('"01"', '"99"'))
    world.prove(tmp_path)
    count = 2 if change == "version" else 1
    assert len(world.tasks) == count
    assert any(event.startswith(f"{count} reports were made by another version") for event in world.events)


def test_a_process_that_dies_is_a_sentence_and_the_rest_goes_on(world: World, tmp_path: Path) -> None:
    world.how = "was ended from outside (SIGKILL)"
    with pytest.raises(
        EquimusError, match="diagnosed case_0000 and 1 more was ended from outside .SIGKILL. before it had"
    ):
        world.prove(tmp_path)
    assert len(world.tasks) == 2
    world.how = None
    assert world.prove(tmp_path).score.ours.single["all"] == Share(1, 1)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [("seed", 4, "seed 0, not 4"), ("kind", "pair", "kind None, not pair"), ("trials", 3, "trials 8, not 3")],
)
def test_a_folder_of_another_proof_is_refused(
    world: World, tmp_path: Path, option: str, value: Any, message: str
) -> None:
    world.prove(tmp_path)
    with pytest.raises(ConfigError, match=message):
        world.prove(tmp_path, **{option: value})


# --- the command


@pytest.mark.slow
def test_json_alone_on_standard_output_tables_beside_it(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "110")
    assert main(["prove", "--cases", "2", "--json", "--output", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert record["accurate"] is True and record["seed"] == 0
    assert {Path(file).name for file in record["files"]} >= {"score.json", "score.md", "power.png", "confusion.png"}
    written = json.loads((tmp_path / "out" / "score.json").read_text())
    assert written["goals"] == record["goals"]
    for text in ("SHA-256 of the seals", "false alarms", "≤ 1 %", "diagnosing: 2 of 2", "no goal is missed"):
        assert text in err
    assert err.index("SHA-256") < err.index("diagnosing")


def test_a_missed_goal_is_exit_code_three_and_named(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    world.reports[0] = report(SAID_RUB)
    assert main(["prove", "--cases", "2", "--no-figures", "--no-baselines", "--kind", "single"]) == 3
    out, err = capsys.readouterr()
    assert out == "" and "missed: false alarms" in err
    folder = tmp_path / "proof" / "results" / "seed_0_single"
    assert {path.name for path in folder.iterdir() if path.is_file()} == {
        "request.json", "seals.txt", "score.json", "score.md",
    }  # fmt: skip


def test_help_names_every_option(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "140")
    assert main(["prove", "--help"]) == 0
    shown = capsys.readouterr().out
    for option in ("--cases", "--seed", "--kind", "--workers", "--no-baselines", "--no-figures", "--output", "--json"):
        assert option in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--cases", "0"], "cases is 0, expected at least 1"),
        (["--seed", "-3"], "seed is -3, expected at least 0"),
        (["--workers", "0"], "workers is 0, expected at least 1"),
        (["--trials", "0"], "trials is 0, expected at least 1"),
        (["--duration", "0.5"], "duration is 0.5 s, expected at least 2 s"),
        (["--kind", "pairs"], "did you mean 'pair'?"),
        (["--output", "file/results"], "is no folder and cannot become one"),
        (["--output", "other"], "other: holds a proof with seed 7, not 0; choose another folder"),
    ],
)
def test_what_is_wrong_is_a_sentence(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "request.json").write_text('{"seed": 7}')
    assert main(["prove", *arguments]) == 2
    err = capsys.readouterr().err.strip()
    assert err.startswith("equimus-ctrl: ") and message in err
    assert len(err.splitlines()) == 1 and "Traceback" not in err
