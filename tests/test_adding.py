"""One effect, controller, plant and scenario from outside the package, through the verbs: nothing else has to know them."""

from __future__ import annotations

import ast
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded

import equimus_ctrl as eq
from equimus_ctrl import workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.controllers.registry import CONTROLLERS
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.registry import PLANTS
from equimus_ctrl.proof.drawing import attached, draw_case
from equimus_ctrl.proof.legs import Legs, leg_draws
from equimus_ctrl.proof.mjcf import Experiment
from equimus_ctrl.proof.sizes import drawn, size_of
from equimus_ctrl.recordings import write
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.registry import SCENARIOS
from equimus_ctrl.types import CountsInstants, Ends, KnowsTruth

ROOT = Path(__file__).resolve().parents[1]
PLUGIN = ROOT / "docs" / "examples" / "plugin.py"
OWN = ["--plugin", str(PLUGIN)]
QUIET = ["--no-figures", "--json"]
NAMES = {"effects": "ripple", "controllers": "leaning", "plants": "slow_leg", "scenarios": "nod"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def told(capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> Any:
    """What a verb prints as JSON."""
    capsys.readouterr()
    assert main([*words]) == code
    return json.loads(capsys.readouterr().out)


def pendulum() -> Model:
    return Model(MjcfRobot("robot", PENDULUM.format(drive=MOTOR)))


def written(folder: Path, size: float, count: int = 4, seconds: float = 5.0) -> tuple[str, str]:
    """The XML of a pendulum and the folder of what was recorded of one with a ripple."""
    workflow.load_plugins([PLUGIN])
    model = pendulum()
    assert isinstance(model.robot, MjcfRobot)
    real = Model(model.robot, (eq.effects.make("ripple", "hinge", {"size": size}),))
    (folder / "runs").mkdir()
    (folder / "robot.xml").write_text(model.robot.xml)
    for trial in recorded(real, count=count, seconds=seconds):
        write(folder / "runs" / f"{trial.name}.csv", trial)
    return str(folder / "robot.xml"), str(folder / "runs")


@pytest.mark.parametrize("kind", NAMES)
def test_it_is_listed(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert NAMES[kind] not in {row["name"] for row in told(capsys, "list", kind, "--json")[kind]}
    (row,) = [row for row in told(capsys, "list", kind, *OWN, "--json")[kind] if row["name"] == NAMES[kind]]
    assert row["summary"]
    if kind == "scenarios":
        assert row["options"] == {"knee": 30.0, "duration": 4.0} and row["summary"].startswith("The knee bends")


def test_it_runs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The scenario, driven by the controller on the plant, with the effect and without."""
    nod = ["run", "nod", *OWN, "-c", "leaning", "--plant", "slow_leg", "--set", "duration=1", *QUIET]
    without = told(capsys, *nod)
    assert (without["plant"], without["controller"], without["scenario"]) == ("slow_leg", "leaning", "nod")
    assert np.all(np.array(list(without["rmse_rad"].values())) < 0.5)
    rippled = told(capsys, *nod, "--effect", "ripple:knee:size=0.05")
    assert rippled["rmse_rad"]["knee"] != without["rmse_rad"]["knee"]
    done = eq.run_scenario("nod", "leaning", plant="slow_leg", options={"duration": "1"})
    assert len(done.run.time) == 60 and done.run.truth is not None


@pytest.mark.slow
def test_it_is_compared(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["compare", "nod", *OWN, "-c", "leaning", "-c", "open_loop", "--condition", "nominal"]
    found = told(capsys, *words, "--set", "duration=1", *QUIET)
    errors = {row["controller"]: row["rmse_rad"] for row in found["entries"]}
    assert set(errors) == {"leaning", "open_loop"} and errors["leaning"] != errors["open_loop"]


def test_a_robot_that_lacks_what_the_controller_computes_with_is_not_driven(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("robot.xml").write_text(PENDULUM.format(drive=MOTOR))
    assert main(["run", "hold", *OWN, "-c", "leaning", "--model", "robot.xml", *QUIET]) == 2
    assert "lengths of elastic actuators, which arm does not have" in capsys.readouterr().err


@pytest.mark.slow
def test_the_effect_is_diagnosed_and_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    xml, runs = written(folder, 0.15)
    words = ["diagnose", runs, "--model", xml, *OWN, "--report", "report", "--write-model", "found.toml", "--json"]
    record = told(capsys, *words, "--most", "1")
    (found,) = record["findings"]
    assert (found["effect"], found["locations"]) == ("ripple", ["hinge"])
    assert found["parameters"]["size"]["value"] == pytest.approx(0.15, rel=0.05)
    kept = json.loads(Path("report/record.json").read_text(encoding="utf-8"))
    assert kept == {**record, "files": ["report.html"]}
    page = next(Path("report").glob("*.html")).read_text(encoding="utf-8")
    assert "comes back six times a turn at the hinge." in page and "Curves of ripple at hinge" in page
    # The XML has no field for it, the model file has it.
    own, nominal = (
        told(capsys, "score", runs, "--model", model, *OWN, "--json")["rmse_rad"]["hinge"]
        for model in ("found.toml", xml)
    )
    assert own < 0.3 * nominal  # from measured starts, whose errors grow over such a torque


def test_the_effect_is_drawn_by_the_proof_on_legs() -> None:
    before = [Legs(1, 1.0).draw(3, case, "single").effects for case in range(5)]
    workflow.load_plugins([PLUGIN])
    cls, draws = eq.effects.REGISTRY["ripple"], leg_draws()
    rng = np.random.default_rng(0)
    for _ in range(20):
        (effect,) = attached(rng, draws, cls)
        size = size_of(draws.table, "ripple", "size", "joint", effect.location)
        assert (size.low, size.high) == (2e-3, 0.05) and size.holds(effect.parameters()["size"])
    names = set()
    for case in range(60):
        found = draw_case(draws, (), np.zeros((0, 4)), 3, case, "single")
        names |= {effect.name for effect in found.effects}
    assert "ripple" in names
    eq.effects.REGISTRY.pop("ripple")
    assert [Legs(1, 1.0).draw(3, case, "single").effects for case in range(5)] == before


@pytest.mark.long
@pytest.mark.slow
def test_the_effect_is_put_to_the_proof_on_a_pendulum(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    xml, runs = written(folder, 0.15, count=3, seconds=4.0)
    model = pendulum()
    experiment = Experiment(model, tuple(workflow.gather([Path(runs)], model)))
    (size,) = experiment.draws.table["ripple"]
    assert size.at == "hinge" and size.low == pytest.approx(size.high * 0.05 / 0.3)
    seed = next(s for s in range(200) if [e.name for e in experiment.draw(s, 0, "single").effects] == ["ripple"])
    words = ["prove", runs, "--model", xml, "--cases", "1", "--kind", "single", "--seed", str(seed), "-o", "proof"]
    capsys.readouterr()
    assert main([*words, *OWN, *QUIET]) in (0, 3)
    truth = json.loads(Path("proof/truth/case_0000.json").read_text())
    report = json.loads(Path("proof/reports/case_0000.json").read_text())
    assert truth["findings"][0]["effect"] == "ripple"
    assert not report["proof"]["failed"]
    if truth["findings"][0]["alone"] > 1.0:
        assert [f["effect"] for f in report["findings"]] == ["ripple"]
    capsys.readouterr()
    assert main([*words, *QUIET]) == 2
    assert "proof: holds a proof with other plugins; choose another folder" in capsys.readouterr().err


# --- what is asked of entries ----------------------------------------------------------------------------------


def test_a_name_that_is_taken_or_no_name_is_refused() -> None:
    entry = CONTROLLERS["pid"]
    with pytest.raises(ConfigError, match=r"^controller pid: there is one of that name already$"):
        eq.register_controller("pid", entry)
    with pytest.raises(ConfigError, match=r"^plant 'a plant': expected a plain name of letters, digits and '_'"):
        eq.register_plant("a plant", PLANTS["mujoco"])
    with pytest.raises(ControllerError, match=r"^there is no controller 'pidd'; did you mean 'pid'\?"):
        CONTROLLERS.entry("pidd")
    eq.register_scenario("twice", lambda context: None)  # type: ignore[arg-type, return-value]
    with pytest.raises(ConfigError, match="scenario twice: there is one of that name already"):
        eq.register_scenario("twice", lambda context: None)  # type: ignore[arg-type, return-value]
    assert SCENARIOS["twice"].summary == ""


def test_a_file_that_is_loaded_again_takes_back_all_that_it_registered(folder: Path) -> None:
    text = PLUGIN.read_text(encoding="utf-8")
    Path("own.py").write_text(text)
    assert workflow.load_plugins(["own.py"]) == ("ripple", "leaning", "slow_leg", "nod")
    Path("own.py").write_text(text.replace('"leaning"', '"straight"').replace('"slow_leg"', '"slower"'))
    assert workflow.load_plugins(["own.py"]) == ("ripple", "straight", "slower", "nod")
    assert "leaning" not in CONTROLLERS and "slow_leg" not in PLANTS
    Path("own.py").write_text(text.replace('eq.register_scenario("nod", nod)', "1 / 0"))
    with pytest.raises(ConfigError, match="own.py: fails when it is loaded: ZeroDivisionError"):
        workflow.load_plugins(["own.py"])
    assert "straight" in CONTROLLERS and "slower" in PLANTS and "nod" in SCENARIOS


@pytest.mark.parametrize(
    ("plant", "own", "attached_too", "said"),
    [
        ("mujoco", True, True, None),
        ("hardware", True, False, None),
        ("hardware", False, True, "effects cannot be attached to a real robot"),
        ("replay", False, True, "the replay plant plays a recording; effects cannot be attached to it"),
        ("replay", True, False, "the replay plant plays a recording; effects cannot be attached to it"),
    ],
)
def test_a_plant_says_which_effects_it_can_carry(plant: str, own: bool, attached_too: bool, said: str | None) -> None:
    effect = (eq.TransportDelay("baa", 0.1),)
    given = (effect if attached_too else (), effect if own else ())
    if said is None:
        PLANTS[plant].check_effects(*given)
    else:
        with pytest.raises(ConfigError, match=said):
            PLANTS[plant].check_effects(*given)


def test_a_plant_is_asked_for_no_more_than_it_can() -> None:
    plant = eq.MujocoPlant(nominal_model())
    plant.reset()
    assert isinstance(plant, KnowsTruth) and not isinstance(plant, Ends) and not isinstance(plant, CountsInstants)
    np.testing.assert_array_equal(plant.truth, plant.position)


def test_sizes_that_do_not_fit_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = PLUGIN.read_text(encoding="utf-8")
    for old, new, said in (
        ('Size("size", 2e-3', 'Size("sise", 2e-3', "leg_sizes are for sise, expected one for each parameter"),
        ('Share("size", 0.05, 0.3)', 'Share("size", 0.3, 0.05)', "mjcf_sizes of 'size': from 0.3 to 0.05, expected"),
        ('Share("size", 0.05, 0.3)', 'Share("size", 0.05, 0.3, "even")', "law is 'even', expected log, linear"),
        ('0.05, 0.3)', '0.05, 0.3, of="weight")', "is a share of 'weight', expected unit, drive"),
    ):  # fmt: skip
        assert old in text
        Path("own.py").write_text(text.replace(old, new))
        assert main(["list", "effects", "--plugin", "own.py"]) == 2
        assert said in capsys.readouterr().err


def test_what_is_made_of_another_effect_is_not_drawn_in_its_place() -> None:
    @eq.register
    @dataclass(frozen=True)
    class Tamed(eq.DeadZone):
        name, exclusive = "tamed", None

    assert eq.DeadZone.leg_sizes and not Tamed.leg_sizes
    assert "tamed" not in drawn("elastic") and "dead_zone" in drawn("elastic")


# --- where names may be known ------------------------------------------------------------------------------------


def modules(*without: str) -> dict[str, str]:
    package = ROOT / "equimus_ctrl"
    files = {path.relative_to(package).as_posix(): path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
    return {name: text for name, text in files.items() if not name.startswith((*without, "_presets"))}


def test_a_diagnosis_does_not_look_at_what_a_proof_draws() -> None:
    for name, text in modules("effects", "proof").items():
        assert not re.search(r"\b(leg_sizes|mjcf_sizes|leg_alike)\b|effects\.sizes", text), name


@pytest.mark.slow
def test_no_other_module_asks_what_a_controller_or_plant_is() -> None:
    classes = {"PidController", "LqrController", "NmpcController", "SamplingController", "OpenLoopController"}
    classes |= {"MujocoPlant", "ReplayPlant", "HardwarePlant"}
    known = {*CONTROLLERS, *PLANTS}
    for name, text in modules("controllers", "plants").items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "isinstance":
                assert not classes & {n.id for n in ast.walk(node.args[1]) if isinstance(n, ast.Name)}, name
            if isinstance(node, ast.Compare) and getattr(node.left, "id", "") in ("plant", "controller"):
                assert not known & {n.value for n in ast.walk(node) if isinstance(n, ast.Constant)}, name


@pytest.mark.slow
def test_no_module_but_its_own_holds_a_table_by_effects() -> None:
    """Effects are named elsewhere where somebody chooses one, never to tell one from others."""
    names = {name for name, cls in eq.effects.REGISTRY.items() if cls.__module__.startswith("equimus_ctrl.")}
    for name, text in modules("effects").items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Dict | ast.Set):
                keys = node.keys if isinstance(node, ast.Dict) else node.elts
                assert len(names & {k.value for k in keys if isinstance(k, ast.Constant)}) < 2, name
            if isinstance(node, ast.Compare):
                assert not names & {n.value for n in ast.walk(node) if isinstance(n, ast.Constant)}, name


def test_the_documents_show_what_is_tried_here() -> None:
    text = re.sub(r"\s+", "", PLUGIN.read_text(encoding="utf-8"))
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 4
    for block in blocks:
        assert re.sub(r"\s+", "", block) in text
