"""``identify`` and ``sensitivity`` on the command line: what they print and write, and that errors leave nothing."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import equimus_ctrl as eq
from equimus_ctrl import recordings, workflow
from equimus_ctrl.cli import identify as verb
from equimus_ctrl.cli.main import main
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.identification.statics import static_names
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.report import identification_figures
from equimus_ctrl.types import Recording

TRUE = nominal_model().with_parameters(
    {"maa.stiffness": 300.0, "baa.area": 4.8e-4, "baa.rest_length": 0.252, "knee.damping": 0.09}
)
POSES_HEADER = "P1 (kPa),P2 (kPa),theta1 (deg),theta2 (deg)"


def made_up(name: str, first: Sequence[float], second: Sequence[float], seed: int) -> Recording:
    time = np.arange(90) / 60
    command = np.where(time[:, None] < 0.7, first, second)
    start = eq.Kinematics(TRUE.morphology).equilibrium(first)
    bare = Recording(name, time, command, np.tile(start, (90, 1)), ("maa", "baa"), ("hip", "knee"))
    noise = np.random.default_rng(seed).normal(0, 5e-4, (90, 2))
    return replace(bare, position=predict(TRUE, bare) + noise)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three trials and nine poses of one leg, and files that are wrong."""
    folder = tmp_path_factory.mktemp("data")
    (folder / "trials").mkdir()
    for k, (first, second) in enumerate((((8e3, 4e3), (24e3, 3e3)), ((20e3, 6e3), (9e3, 10e3)))):
        recordings.write(folder / "trials" / f"step_{k}.csv", made_up(f"step_{k}", first, second, k))
    recordings.write(folder / "other.csv", made_up("other", (5e3, 8e3), (16e3, 2e3), 7))
    kinematics = eq.Kinematics(TRUE.morphology)
    rows = [(a, b, *np.degrees(kinematics.equilibrium([a * 1e3, b * 1e3]))) for a in (0, 10, 20) for b in (0, 5, 9)]
    (folder / "poses.csv").write_text(
        POSES_HEADER + "\n" + "".join(",".join(f"{x:.6f}" for x in row) + "\n" for row in rows)
    )
    other = [(a, 3, *np.degrees(kinematics.equilibrium([a * 1e3, 3e3]))) for a in (5, 15)]
    lines = [",".join(f"{x:.6f}" for x in row) for row in (*other, rows[0])]
    (folder / "unseen.csv").write_text("\n".join([POSES_HEADER, *lines]) + "\n")
    few = (folder / "poses.csv").read_text().splitlines()[:4]
    (folder / "few.csv").write_text("\n".join(few) + "\n")
    (folder / "short.csv").write_text("\n".join((folder / "other.csv").read_text().splitlines()[:8]) + "\n")
    (folder / "plain_file").write_text("")
    return folder


@pytest.fixture
def ran(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run the command in an empty folder: (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("EQUIMUS_RECORDINGS", str(data / "trials"))
    monkeypatch.setenv("COLUMNS", "100")

    def call(*arguments: object) -> tuple[int, str, str]:
        code = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return call


def files(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


FREE = ("--free", "maa.stiffness", "--free", "baa.area", "--free", "baa.rest_length", "--free", "knee.damping")


# What goes well.


@pytest.mark.slow
def test_identify_then_score(ran: Any, data: Path, tmp_path: Path) -> None:
    """The model written is taken by the other verbs, and predicts better."""
    code, out, err = ran(
        "identify", data / "trials", *FREE, "--heldout", data / "other.csv", "--folds", 2, "--write-model",
        "new/leg.toml", "--output", "out", "--json",
    )  # fmt: skip
    assert code == 0, err
    found = json.loads(out)
    assert found["schema"] == "equimus-ctrl/identification/1" and found["poses"] is None
    trials = found["trials"]
    assert trials["trials"] == ["step_0", "step_1"] and trials["samples"] == 180 and trials["engine"] == "reduced"
    rmse = trials["rmse_rad"]
    assert set(rmse) == {"before", "after", "before_together", "after_together"} and set(rmse["after"]) == {
        "hip",
        "knee",
    }
    assert rmse["after_together"] < 6e-4 < rmse["before_together"]
    assert rmse["before_together"] == pytest.approx(np.sqrt(np.mean(np.square(list(rmse["before"].values())))))
    for row in trials["parameters"]:
        assert set(row) == {"name", "unit", "start", "value", "low", "high", "bounds", "at_bound"}
        assert row["value"] == pytest.approx(TRUE.parameters()[row["name"]], rel=0.03)
        assert row["low"] < row["value"] < row["high"]
    assert trials["cross_check"]["folds"] == 2 and trials["cross_check"]["rmse_rad"]["after_together"] < 2e-3
    assert [h["trial"] for h in trials["heldout"]] == ["other"]
    assert trials["heldout_rmse_rad"]["after_together"] < 1e-3 < trials["heldout_rmse_rad"]["before_together"]
    assert 0 < trials["effective_samples"] <= 360 and trials["seconds"] > 0 and trials["converged"] is True
    pictures = [f"out/{name}.png" for name in ("correlation", "fits", "parameters", "residuals")]
    assert files(tmp_path) == sorted(["new/leg.toml", *pictures, "out/record.json"])
    assert sorted(found["files"]) == sorted(files(tmp_path))
    record = json.loads((tmp_path / "out/record.json").read_text())
    assert record.pop("files") == [Path(file).name for file in found["files"] if file.endswith(".png")]
    assert record == {key: value for key, value in found.items() if key != "files"}
    for picture in pictures:
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")
    for part in ("2 trials, 180 samples", "initial model", "identified", "cross-validation (2 folds)",
                 "1 held-out trial: identified", "N·m·s/rad", "wrote new/leg.toml"):  # fmt: skip
        assert part in err
    before, after = (
        json.loads(ran("score", data / "other.csv", "--json", *more)[1]) for more in ([], ["--model", "new/leg.toml"])
    )
    assert after["model"] == "leg" and after["rmse_rad"]["knee"] < 0.3 * before["rmse_rad"]["knee"]
    written = workflow.load_model("new/leg.toml").parameters()
    assert written["maa.stiffness"] == next(r["value"] for r in trials["parameters"] if r["name"] == "maa.stiffness")


def test_poses_alone(ran: Any, data: Path, tmp_path: Path) -> None:
    code, out, err = ran("identify", data / "poses.csv", "--heldout", data / "unseen.csv", "--json", "--no-figures")
    assert code == 0, err
    found = json.loads(out)["poses"]
    assert json.loads(out)["trials"] is None and found["poses"] == 9
    assert {row["name"] for row in found["parameters"]} == set(static_names(TRUE))
    for row in found["parameters"]:
        assert row["value"] == pytest.approx(TRUE.parameters()[row["name"]], rel=1e-2)
    assert found["heldout"][0]["poses"] == "unseen" and found["heldout"][0]["after"]["hip"] < 1e-4
    assert "9 poses at rest of poses" in err and "2 held-out poses: identified" in err
    assert "The pressures that would hold the" in err
    assert files(tmp_path) == ["identification/results/poses/record.json"]


@pytest.mark.slow
def test_poses_first_then_trials(ran: Any, data: Path) -> None:
    code, out, err = ran(
        "identify", data / "trials", data / "poses.csv", *FREE, "--folds", 0, "--output", "o", "--json"
    )
    assert code == 0, err
    found = json.loads(out)
    rest, trials = found["poses"], found["trials"]
    assert [row["name"] for row in rest["parameters"]] == ["maa.stiffness", "baa.rest_length", "baa.area"]
    starts = {row["name"]: row["start"] for row in trials["parameters"]}
    for row in rest["parameters"]:
        assert starts[row["name"]] == row["value"]
        assert row["bounds"] == next(r["bounds"] for r in trials["parameters"] if r["name"] == row["name"])
    assert starts["knee.damping"] == nominal_model().parameters()["knee.damping"]
    assert trials["cross_check"] is None and "Then the trials, from the model that the poses gave" in err
    assert {Path(f).name for f in found["files"]} == {
        "poses.png", "poses_parameters.png", "poses_correlation.png", "fits.png", "residuals.png", "parameters.png",
        "correlation.png", "record.json",
    }  # fmt: skip


def test_options_reach_what_they_name(ran: Any, data: Path) -> None:
    base = ("identify", data / "trials", *FREE, "--no-figures", "--folds", 0, "--json")

    def result(*more: object) -> Any:
        code, out, err = ran(*base, *more)
        assert code == 0, err
        return json.loads(out)["trials"]

    plain = result()
    rmse = [plain["rmse_rad"]["after_together"]]
    for more in (("--select", "*_1"), ("--window", 0.7, 1.4), ("--shoot", 0.5), ("--no-fit-start",), ("--dt", 0.004)):
        rmse.append(result(*more)["rmse_rad"]["after_together"])
    assert len(set(rmse)) == len(rmse)
    assert [r["name"] for r in result("--fix", "baa.*")["parameters"]] == ["knee.damping", "maa.stiffness"]
    held = {r["name"]: r for r in result("--bound", "maa.stiffness=200,280")["parameters"]}["maa.stiffness"]
    assert held["at_bound"] == "high" and held["value"] == 280
    (code, _, err) = ran(*base, "--bound", "maa.stiffness=200,280")
    assert (
        code == 0
        and re.search(r"maa\.stiffness .* high", err)
        and "1 of 4 parameters lies on a bound (maa.stiffness)" in " ".join(err.split())
    )


def test_what_cannot_be_seen_is_said(ran: Any, data: Path) -> None:
    code, out, err = ran(
        "identify", data / "other.csv", "--free", "knee.upper.stiffness", "--free", "maa.stiffness", "--json",
        "-o", "out",
    )  # fmt: skip
    assert code == 0, err
    row = {r["name"]: r for r in json.loads(out)["trials"]["parameters"]}["knee.upper.stiffness"]
    assert row["low"] is None and row["high"] is None and row["value"] == row["start"]
    text = " ".join(err.split())
    assert "not identifiable" in text and "knee.upper.stiffness is not identifiable from these data" in text


def test_a_terminal_gets_a_bar(ran: Any, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verb, "people", lambda: Console(stderr=True, force_terminal=True, width=110))
    code, _, err = ran("identify", data / "trials", *FREE, "--no-figures")
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", err)
    assert code == 0 and "left" in shown and re.search(r"best 0\.\d{5} rad", shown)


def test_sensitivity_for_machines_and_people(ran: Any, data: Path, tmp_path: Path) -> None:
    code, out, err = ran(
        "sensitivity", data / "trials", "--parameter", "baa.*", "--share", -10, "--share", 10, "--json", "-o", "out"
    )
    assert code == 0, err
    found = json.loads(out)
    assert found["schema"] == "equimus-ctrl/sensitivity/1" and found["shares"] == [-0.1, 0.1]
    first = found["parameters"][0]
    assert set(first) == {"name", "unit", "reference", "local_rad_per_cent", "changes"}
    assert [c["share"] for c in first["changes"]] == [-0.1, 0.1] and all(
        c["rmse_rad"]["knee"] > found["rmse_rad"]["knee"] for c in first["changes"]
    )
    assert all(row["name"].startswith("baa.") for row in found["parameters"])
    assert files(tmp_path) == [f"out/{name}" for name in ("curves.png", "local.png", "map.png", "record.json")]
    assert first["name"] in err and "+10 %" in err and "How far one per cent of each moves" in err


def test_all_parameters_default_shares_no_figures(ran: Any, data: Path, tmp_path: Path) -> None:
    code, out, err = ran("sensitivity", data / "other.csv", "--no-figures")
    assert code == 0 and out == "" and "more matter less" in err and "No effect on these trials at all" in err
    assert files(tmp_path) == ["identification/results/other_sensitivity/record.json"]


# What does not.


CASES: list[tuple[Sequence[object], str]] = [
    (("identify", "nowhere.csv"), "nowhere.csv: there is no such file"),
    (("identify", "short.csv"), "short: has 7 samples between 0 and 0.1 s, too few"),
    (("identify", "few.csv"), "3 poses are too few to identify 6 parameters from; expected more than 3"),
    (
        ("identify", "other.csv", "--free", "maa.stifness"),
        "there is no parameter 'maa.stifness'; did you mean 'maa.stiff",
    ),
    (("identify", "other.csv", "--fix", "*"), "no parameter is free, so there is nothing to identify"),
    (("identify", "other.csv", "--bound", "maa.area"), "--bound 'maa.area': expected name=low,high"),
    (("identify", "other.csv", "--bound", "maa.area=1"), "--bound 'maa.area=1': expected name=low,high, such as maa.a"),
    (("identify", "other.csv", "--bound", "maa.area=a,b"), "--bound 'maa.area=a,b': expected name=low,high"),
    (
        ("identify", "other.csv", "--bound", "maa.area=1,2"),
        "maa.area is 0.000403 m² in the model, outside its bounds 1",
    ),
    (
        ("identify", "other.csv", "--bound", "maa.area=0,nan"),
        "bounds of maa.area are 0 to nan, expected finite numbers",
    ),
    (("identify", "other.csv", "--select", "x*"), "there is no trial 'x*' (known: other)"),
    (("identify", "other.csv", "--heldout", "other.csv"), "every trial held out takes part in the fit too"),
    (("identify", "other.csv", "--engine", "mujoko"), "there is no engine 'mujoko'; did you mean 'mujoco'?"),
    (("identify", "other.csv", "--window", "9", "10"), "has 0 samples between 9 and 10 s, too few to identify from"),
    (("identify", "other.csv", "--shoot", "0.1"), "no shooting interval of 0.1 s holds 10 samples"),
    (("identify", "other.csv", "--model", "nowhere.toml"), "nowhere.toml: there is no such file"),
    (("identify", "other.csv", "--output", "plain_file"), "plain_file: is no folder and cannot become one"),
    (("identify", "other.csv", "--write-model", "plain_file/m.toml"), "plain_file: is no folder and cannot become one"),
    (("identify", "other.csv", "--write-model", "trials"), "trials: is a folder; a file to write belongs there"),
    (("identify", "other.csv", "poses.csv", "--free", "*.damping"), "none of the free parameters (hip.damping, "),
    (("identify", "poses.csv", "--heldout", "other.csv"), "other.csv: trials are held out, but only poses at rest are"),
    (("identify", "poses.csv", "--heldout", "few.csv"), "few: every pose held out takes part in the fit too"),
    (("identify", "poses.csv", "--select", "x"), "there is no trial to select from: only poses at rest are given"),
    (("identify", "poses.csv", "--window", "1", "2"), "--window is for trials, but only poses at rest are given"),
    (("identify", "poses.csv", "--engine", "mujoco"), "--engine is for trials, but only poses at rest are given"),
    (("sensitivity", "nowhere.csv"), "nowhere.csv: there is no such file"),
    (("sensitivity", "other.csv", "--parameter", "x"), "there is no parameter 'x'"),
    (("sensitivity", "other.csv", "--parameter", "command_low"), "only clip commands; no prediction depends on them"),
    (
        ("sensitivity", "other.csv", "--share", "0"),
        "a share to change the parameters by is 0, expected a finite number",
    ),
    (("sensitivity", "other.csv", "--output", "plain_file"), "plain_file: is no folder and cannot become one"),
]


@pytest.fixture
def refused(data: Path, ran: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[int, str]]:
    """Run among the data; fail where something was written or more than one sentence was said."""
    monkeypatch.chdir(data)

    def call(arguments: Sequence[object]) -> tuple[int, str]:
        before = files(data)
        code, out, err = ran(*arguments)
        assert files(data) == before and out == "" and "Traceback" not in err
        return code, err

    return call


@pytest.mark.parametrize(("arguments", "said"), CASES, ids=[" ".join(map(str, a)) for a, _ in CASES])
def test_one_sentence_and_nothing_written(arguments: Sequence[object], said: str, refused: Any) -> None:
    code, err = refused(arguments)
    assert code == 2 and said in err and err.count("\n") == 1 and err.startswith("equimus-ctrl: "), err


def test_a_model_that_diverges(refused: Any, data: Path, tmp_path: Path) -> None:
    (tmp_path / "stiff.toml").write_text('[parameters]\n"hip.damping" = 1e4\n')
    for name, said in (
        ("identify", "diverges on every trial with the initial model"),
        ("sensitivity", "with the nominal model"),
    ):
        code, err = refused((name, "other.csv", "--model", tmp_path / "stiff.toml"))
        assert code == 3 and said in err and "diverges" in err


@pytest.mark.parametrize("where", ["identify", "figures"])
def test_ctrl_c_writes_nothing(
    where: str, ran: Any, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    if where == "figures":
        monkeypatch.setattr(identification_figures, "correlation_figure", stop)
    else:
        monkeypatch.setattr(workflow, where, stop)
    code, out, err = ran("identify", data / "other.csv", "--free", "maa.stiffness", "--write-model", "m.toml", "--json")
    assert code == 130 and out == "" and err.strip() == "stopped: nothing was written" and files(tmp_path) == []


def test_intervals_have_the_digits_that_they_are_worth() -> None:
    """The ends of a narrow one differ; an end beyond what a parameter can be says nothing."""
    rows = {
        "narrow": (110.0, 0.02, 0.0, 500.0, "109.98 to 110.02"),
        "wide": (0.18, 0.3, 0.0, 1.0, "at most 0.5"),
        "endless": (300.0, 500.0, 0.0, 700.0, "not identifiable"),
        "unseen": (300.0, np.inf, 0.0, 700.0, "not identifiable"),
    }
    text = table_text(rows, 120)
    lines = {line.split()[0]: line for line in text.splitlines() if line.split()}
    for name, row in rows.items():
        assert lines[name].rstrip().endswith(row[-1]), lines[name]


def table_text(rows: dict[str, Any], width: int) -> str:
    """The table of parameters: name → estimate, half the interval, bounds."""
    free = [
        SimpleNamespace(name=name, unit="N·m·s/rad", start=1.0, low=row[2], high=row[3]) for name, row in rows.items()
    ]
    found: Any = SimpleNamespace(
        parameters=SimpleNamespace(free=free, names=list(rows)), theta=np.array([row[0] for row in rows.values()]),
        uncertainty=SimpleNamespace(half_width=np.array([row[1] for row in rows.values()])),
        at_bound=np.array([int(row[0] == row[3]) for row in rows.values()]),
    )  # fmt: skip
    console = Console(width=width, record=True, file=io.StringIO())
    verb._parameter_table(console, found, "of the initial model")
    return console.export_text()


@pytest.mark.parametrize("width", [40, 60, 80, 120])
@pytest.mark.parametrize("name", ["maa.stiffness", "right_shoulder_pitch.friction_loss"])
def test_names_numbers_and_intervals_stay_whole_in_any_terminal(width: int, name: str) -> None:
    rows = {name: (110.0, 0.02, 0.0, 500.0), "b.damping": (1.2345678, 0.001, 0.0, 1.2345678)}
    text = table_text(rows, width)
    assert all(len(line) <= width for line in text.splitlines()) and "…" not in text
    for told in (name, "b.damping", "N·m·s/rad", "110.00", "109.98 to 110.02", "at bound", "high"):
        assert told in text, text
