"""What controllers declare to be searched: ranges, what a study leaves of them, and a controller from outside tuned."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mjcf_models import pendulum, refusal

import equimus_ctrl as eq
from equimus_ctrl import presets, workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.controllers.registry import CONTROLLERS, make_controller, tunable
from equimus_ctrl.controllers.search_space import Narrowing, Range, SearchSpace, space_of
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.tuning.evaluation import Evaluation
from equimus_ctrl.tuning.journal import Memory, RowJournal
from equimus_ctrl.tuning.search import Search
from equimus_ctrl.tuning.study import PlantStudy, study_from_dict

ARM = pendulum('damping="0.3" stiffness="2"').replace('timestep="0.001"', 'timestep="0.004"')
PLUGIN = '''
import numpy as np
import equimus_ctrl as eq


class Springy:
    """A spring and a damper on the joint's error, beside what gravity and the joint's own spring take."""

    search = {"gain": eq.Range(0.5, 50.0, 2.0), "ahead": eq.Range(-0.2, 0.2, 0.0, scale="linear")}

    def __init__(self, gain=2.0, ahead=0.0, damping=0.5):
        self.gain, self.ahead, self.damping = gain, ahead, damping

    def init(self, spec, observation):
        return np.array(observation.position)

    def step(self, observation, reference, before):
        now = np.array(observation.position)
        wanted = reference.position(observation.time + self.ahead)
        torque = 2.0 * wanted + 9.81 * 0.3 * np.sin(wanted) + self.gain * (wanted - now) - self.damping * (now - before) * 125
        return torque, now


eq.register_controller(
    "springy",
    eq.ControllerEntry(
        "a spring and a damper", lambda given: Springy(**(given.settings or {})), "springy.toml", search=Springy.search
    ),
)
'''
STUDY: dict[str, Any] = {
    "format": "equimus-ctrl/plant-tuning/1",
    "candidates": 4,
    "polish": 0.0,
    "objectives": [{"scenario": "step", "duration": 1.6}],
    "limits": {"overshoot": 2.0, "delay_margin": 0.004},
    "ensemble": {"members": 2, "delay": [0.0, 0.004], "unseen": 2},
    "settings": {"damping": 0.6},
    "search": {"gain": {"high": 10.0}},
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A robot, a plugin and a study in a current folder of our own; what the plugin registers is forgotten after."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "own.py").write_text(PLUGIN)
    presets.write_text(tmp_path / "own.toml", presets.toml_text(STUDY))
    known = dict(CONTROLLERS)
    yield tmp_path  # type: ignore[misc]
    CONTROLLERS.clear()
    CONTROLLERS.update(known)


WORDS = ("autotune", "springy", "--plugin", "own.py", "--model", "arm.xml", "--study", "own.toml")


def told(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    capsys.readouterr()
    assert main([*words]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ((0.0, 1.0, 0.5), "low 0, start 0.5, high 1; expected 0 < low ≤ start ≤ high"),
        ((1.0, 1.0, 1.0), "low 1, start 1, high 1; expected 0 < low ≤ start ≤ high"),
        ((-1.0, math.inf, 0.0, "linear"), "low -1, start 0, high inf; expected low ≤ start ≤ high"),
        ((-1.0, 1.0, 2.0, "linear"), "low -1, start 2, high 1; expected low ≤ start ≤ high"),
        ((1.0, 2.0, 1.0, "square"), "there is no scale 'square' (known: linear, log)"),
    ],
)
def test_a_range_that_is_none_is_refused(numbers: tuple[Any, ...], said: str) -> None:
    assert refusal(lambda: Range(*numbers)) == said


def test_values_take_their_places_and_are_those_that_are_written() -> None:
    ranges = {"weight": Range(0.1, 10.0, 1.0), "observer.noise": Range(0.001, 1.0, 0.01)}
    space = SearchSpace(ranges, {"weight": 1.0, "kept": True, "observer": {"noise": 0.01, "walk": 2.0}})
    made = space.settings({"weight": 1 / 3, "observer.noise": 0.02})
    assert made == {"weight": 0.333333, "kept": True, "observer": {"noise": 0.02, "walk": 2.0}}
    assert space.first == {"weight": 1.0, "kept": True, "observer": {"noise": 0.01, "walk": 2.0}}


def test_a_study_narrows_a_space_and_fixes_parts_of_it() -> None:
    space = SearchSpace({"a": Range(0.1, 10.0, 1.0), "b.c": Range(1.0, 4.0, 2.0)}, {"a": 1.0, "b": {"c": 2.0}})
    narrow = space.narrowed({"a": Narrowing(low=2.0)}, {"b": {"c": 3.0}, "d": 5.0})
    assert narrow.ranges == {"a": Range(2.0, 10.0, 2.0)}
    assert narrow.settings({"a": 4.0}) == {"a": 4.0, "b": {"c": 3.0}, "d": 5.0}
    assert space.narrowed({"a": Narrowing(high=5.0, start=0.2)}, {}).ranges["a"] == Range(0.1, 5.0, 0.2)
    for search, settings, said in (
        ({"aa": Narrowing()}, {}, "search: there is no setting 'aa'; did you mean 'a'? (known: a, b.c)"),
        ({"a": Narrowing(high=20.0)}, {}, "search.a: high is 20, expected 0.1 to 10"),
        ({"a": Narrowing(low=5.0, start=2.0)}, {}, "search.a: low 5, start 2, high 10; expected 0 < low ≤ start ≤ hi"),
        ({"a": Narrowing(low=0.5)}, {"a": 2.0}, "search.a: settings say 2.0 of it; expected one of both"),
        ({}, {"a": 2.0, "b": {"c": 1.0}}, "settings leave nothing to search of a, b.c"),
    ):
        assert refusal(lambda search=search, settings=settings: space.narrowed(search, settings)).startswith(said)


def test_a_study_names_settings_within_tables() -> None:
    table = {**STUDY, "search": {"rate": {"low": 0.5}, "observer": {"torque": {"high": 0.001}}}}
    study = study_from_dict(table)
    assert isinstance(study, PlantStudy)
    assert study.search == {"rate": Narrowing(low=0.5), "observer.torque": Narrowing(high=0.001)}
    assert study.ensemble.lag == (0.0, 0.0)  # valves are slow only where the study says it


@pytest.mark.parametrize("robot", ["leg", "arm"])
def test_what_the_packages_controllers_declare_begins_with_what_they_do_untuned(robot: str) -> None:
    model = nominal_model() if robot == "leg" else Model(MjcfRobot("arm", ARM))
    plant = MujocoPlant(model)
    pose = np.array(plant.reset().position)
    for name in ("lqr", "nmpc", "sampling"):
        space = space_of(tunable(name)[1], plant.spec, pose)
        start = {key: own.start for key, own in space.ranges.items()}
        for values in (start, {key: own.low for key, own in space.ranges.items()}):
            make_controller(name, space.settings(values), robot=model.robot)
        untuned = {key: value for key, value in space.first.items() if key != "bandwidth"}
        made = space.settings(start)
        assert {key: made[key] for key in untuned} == untuned


def searched(ranges: list[Range], budget: int, cost: Callable[[Any], float], polish: float = 0.3) -> Search:
    study = study_from_dict({**STUDY, "candidates": budget, "polish": polish, "search": {}})
    search = Search.of(ranges, study, RowJournal(Memory()), lambda trial: None)
    search.evaluate = lambda batch: (
        Evaluation(cost(v), {"error": 0.0}, (cost(v),), 0.0, 0.0, 0.9, 0.9, True, True) for v in batch
    )
    search.run()
    return search


def test_linear_scales_reach_both_sides_of_nothing() -> None:
    ranges = [Range(-2.0, 3.0, 1.0, "linear"), Range(0.1, 100.0, 1.0)]
    search = searched(ranges, 120, lambda v: 1 + (v[0] + 0.7) ** 2 + math.log(v[1] / 9) ** 2)
    assert search.best().values == pytest.approx((-0.7, 9.0), rel=2e-2)
    tried = np.array([trial.values for trial in search.history])
    assert tried[:, 0].min() >= -2 and tried[:, 0].max() <= 3 and search.history[0].values == pytest.approx((1.0, 1.0))


@pytest.mark.parametrize("polish", [0.0, 0.5])
def test_one_number_alone_is_searched(polish: float) -> None:
    search = searched([Range(0.1, 100.0, 1.0)], 40, lambda v: 1 + math.log(v[0] / 20) ** 2, polish)
    assert len(search.history) <= 40 and search.best().values[0] == pytest.approx(20, rel=0.2)


def test_a_search_whose_time_is_up_keeps_what_it_has() -> None:
    search = searched([Range(0.1, 100.0, 1.0)], 1, lambda v: float(v[0]))
    search.budget, search.history, search.over = 30, [], lambda: len(search.history) == 7
    search.run()
    assert len(search.history) == 7 and search.timed_out


@pytest.mark.slow
def test_a_controller_of_a_plugin_is_tuned_and_run_takes_what_was_found(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = told(capsys, *WORDS, "--workers", "1", "--json")
    assert found["controller"] == "springy" and found["evaluated"] == 4 and not found["timed_out"]
    assert found["searched"]["first"] == {"gain": 2.0, "ahead": 0.0}
    tuned = found["searched"]["tuned"]
    assert found["settings"] == {**tuned, "damping": 0.6} and 0.5 <= tuned["gain"] <= 10
    unseen = found["unseen"]
    assert unseen["robots"] == 2 and unseen["worst"] >= unseen["median"] > 0 and unseen["start_worst"] > 0
    written = folder / "controllers" / "springy_pendulum.toml"
    assert presets.read_toml(written) == found["settings"]
    assert written.read_text().startswith("# Settings of springy; written by `equimus-ctrl autotune springy`, free to")
    results = folder / "tuning" / "results" / "springy_own_pendulum"
    drawn = ["convergence.png", "journal.jsonl", "record.json", "response.png", "robustness.png", "springy.toml"]
    assert sorted(file.name for file in results.iterdir()) == drawn
    again = told(capsys, *WORDS, "--workers", "1", "--json", "--no-figures")
    assert again["reused"] == 4 and again["settings"] == found["settings"]
    run = (
        "run",
        "hold",
        "-c",
        "springy",
        "--plugin",
        "own.py",
        "--model",
        "arm.xml",
        "--set",
        "duration=0.3",
        "--json",
    )
    with_it = told(capsys, *run, "--no-figures")
    written.unlink()
    assert told(capsys, *run, "--no-figures") != with_it


@pytest.mark.slow
def test_processes_know_a_plugin_and_find_the_same(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alone = told(capsys, *WORDS, "--workers", "1", "--json", "--no-figures")
    shared = told(capsys, *WORDS, "--workers", "2", "--json", "--no-figures", "--fresh")
    assert shared["best"] == alone["best"] and shared["unseen"] == alone["unseen"]


def test_the_time_that_is_up_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = told(capsys, *WORDS, "--workers", "1", "--budget", "1e-6", "--json", "--no-figures")
    assert found["timed_out"] and found["evaluated"] == 1
    more = told(capsys, *WORDS, "--workers", "1", "--json", "--no-figures")
    assert not more["timed_out"] and more["evaluated"] == 4 and more["reused"] == 1


@pytest.mark.parametrize(
    ("words", "changes", "said"),
    [
        (
            ("autotune", "open_loop"),
            {},
            "controller open_loop declares nothing to be searched; those that do: pid, lqr",
        ),
        (("autotune", "lqrr"), {}, "there is no controller 'lqrr'; did you mean 'lqr'?"),
        (
            WORDS,
            {"search": {"gian": {"low": 1.0}}},
            "own.toml: search: there is no setting 'gian'; did you mean 'gain'?",
        ),
        (WORDS, {"search": {"gain": {"high": 99.0}}}, "own.toml: search.gain: high is 99, expected 0.5 to 50"),
        (WORDS, {"settings": {"dampnig": 1.0}}, "got an unexpected keyword argument 'dampnig'"),
        (
            ("autotune", "lqr", "--study", "own.toml"),
            {},
            "own.toml: search: there is no setting 'gain' (known: observer.",
        ),
        (("autotune", "lqr", "--budget", "0"), {}, "the budget is 0 s, expected more than 0"),
    ],
)
def test_a_wrong_tuning_is_a_sentence(
    words: tuple[str, ...], changes: dict[str, Any], said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    presets.write_text(folder / "own.toml", presets.toml_text({**STUDY, **changes}))
    assert main([*words]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (folder / "tuning").exists() and not (folder / "controllers").exists()


def test_a_study_of_the_compiled_loop_is_of_the_pid_alone(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pid = Path(__file__).parents[1] / "tuning" / "pid.toml"
    assert main(["autotune", "lqr", "--study", str(pid)]) == 2
    assert "format is 'equimus-ctrl/tuning/1', which is of pid alone" in " ".join(capsys.readouterr().err.split())


def test_what_is_searched_needs_a_file_of_settings() -> None:
    said = refusal(lambda: eq.ControllerEntry("mine", lambda given: None, search={}))  # type: ignore[arg-type,return-value]
    assert "needs a file of them" in said


def test_a_controller_that_fails_at_once_says_why(folder: Path) -> None:
    (folder / "own.py").write_text(PLUGIN.replace("return torque, now", "return torque / 0 * np.nan, now"))
    workflow.load_plugins(["own.py"])
    model = Model(MjcfRobot("arm", ARM))
    with pytest.raises(eq.ControllerError, match="expected finite"), np.errstate(all="ignore"):
        workflow.tune_into("springy", folder / "own.toml", model)
