"""Groups of trials: a model that differs between them, what is told of it, and that nothing is told where none does."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mjcf_models import refusal
from pendulum_runs import MOTOR, NOISE, PENDULUM, recorded

import equimus_ctrl as eq
from equimus_ctrl import workflow
from equimus_ctrl.diagnosis.differences import AnotherUnit, Departure, Difference
from equimus_ctrl.diagnosis.estimates import Estimate, Named
from equimus_ctrl.diagnosis.fitting import Data, chi_squared
from equimus_ctrl.diagnosis.group_splits import own_in_each_group, splits_by_group, with_groups
from equimus_ctrl.diagnosis.groups import Apart, Own, absent_with_common, told_apart
from equimus_ctrl.diagnosis.holdout import Split, choose_holdout
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, model_of, parameters_of
from equimus_ctrl.diagnosis.policy import SearchPolicy
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.units_compared import another_unit, differences
from equimus_ctrl.effects import CoulombFriction, ViscousFriction
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import Segment, cut, groups_of, groups_with_own
from equimus_ctrl.identification.simulators import simulator_for
from equimus_ctrl.models.model import Model, model_to_dict
from equimus_ctrl.recordings import write
from equimus_ctrl.report import diagnosis_units
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.workflow.groups import by_folder, check_enough
from equimus_ctrl.workflow.models import by_group

ROBOT = MjcfRobot("arm", PENDULUM.format(drive=MOTOR), source="arm.xml")
MODEL = Model(ROBOT)
FRICTION = Part(Candidate(CoulombFriction, ("hinge",), ()), {"friction": 0.3})


def segment(group: str, until: float = 1.0) -> Segment:
    time = np.arange(0.0, until, 0.01)
    command = np.sin(3.0 * time)[:, None]
    trial = Trial(group, time, command, command[0], 0.0, np.array([0.2]), time, np.array([0.0]))
    return Segment(trial, np.zeros((len(time), 1)), "AB".find(group), group, np.array([0.2, 0.0]), 2, group=group)


def test_a_model_is_another_in_each_group() -> None:
    """Predictions are those of two models simulated by themselves, whatever the order of the trials."""
    two = MODEL.with_groups({"B": {"arm.mass": 0.8}})
    assert two.in_group("A") == MODEL
    assert two.in_group("B").parameters()["arm.mass"] == 0.8 and two.in_group("B").by_group == ()
    assert two.with_parameters({"arm.mass": 0.7}).by_group == two.by_group
    assert model_to_dict(two) == model_to_dict(MODEL)
    segments = [segment("B"), segment("A"), segment("B", 0.5)]
    starts = [s.start[None, :] for s in segments]
    simulate = simulator_for(MODEL)
    together = simulate([two], segments, starts)
    for own, s, start in zip(together, segments, starts, strict=True):
        alone = MODEL.with_parameters({"arm.mass": 0.8}) if s.group == "B" else MODEL
        np.testing.assert_array_equal(own.position, simulate([alone], [s], [start])[0].position)
    assert np.abs(together[0].position - together[1].position).max() > 0.01


def test_parameters_of_an_effect_in_a_group() -> None:
    """A size of its own, and none where the effect does not act."""
    own = Part(replace(FRICTION.candidate, own=(("friction", "B"),)), {"friction": 0.3, "friction in B": 0.5})
    free = parameters_of(free_parameters(MODEL, ["arm.mass"]), (own,))
    assert free.names == ("arm.mass", "hinge.coulomb_friction.friction", "hinge.coulomb_friction.friction in B")
    model = free.model_at(np.array([0.6, 0.31, 0.52]))
    assert [model.in_group(g).effects[0].parameters()["friction"] for g in "AB"] == [0.31, 0.52]
    assert model_of(MODEL, (own,)).in_group("B").effects[0].parameters()["friction"] == 0.5
    absent = Part(replace(FRICTION.candidate, absent=("A",)), {"friction": 0.3})
    whole = parameters_of(free_parameters(MODEL, ["arm.mass"]), (absent,)).model_at(np.array([0.6, 0.31]))
    assert [whole.in_group(g).effects[0].parameters()["friction"] for g in "AB"] == [0.0, 0.31]
    labels = {part.candidate.label for part in (FRICTION, own, absent)}
    assert labels == {
        "coulomb_friction:hinge",
        "coulomb_friction:hinge [friction in B]",
        "coulomb_friction:hinge [not in A]",
    }


def test_a_law_at_fewer_places_keeps_its_sizes_in_groups() -> None:
    candidate = Candidate(ViscousFriction, ("a", "b", "c"), (), each=True, own=(("b.damping", "B"), ("c.damping", "B")))
    values = {"a.damping": 1.0, "b.damping": 2.0, "c.damping": 3.0, "b.damping in B": 4.0, "c.damping in B": 5.0}
    part = Part(candidate, values)
    assert dict(part.narrowed(("b",)).values) == {"damping": 2.0, "damping in B": 4.0}
    assert part.narrowed(("b",)).candidate.own == (("damping", "B"),)
    assert list(part.narrowed(("a", "c")).values) == ["a.damping", "c.damping", "c.damping in B"]


def test_trials_are_held_out_in_each_group() -> None:
    names, groups = [f"{k}" for k in range(12)], ["A"] * 4 + ["B"] * 8
    assert choose_holdout(names, groups=groups).validation == {3, 7}
    assert choose_holdout(names, groups=groups).test == {11}
    assert choose_holdout(names[:4], groups=["A", "A", "B", "B"]).validation == {1, 3}
    assert choose_holdout(names, groups=["A"] * 12) == choose_holdout(names)


def test_of_two_groups_one_has_the_common_values() -> None:
    segments = [segment("A"), segment("B"), segment("A")]
    assert groups_of(segments) == ("A", "B") and groups_of(segments[:1]) == ()
    assert groups_with_own(("A", "B")) == ("B",) and groups_with_own(("A", "B", "C")) == ("A", "B", "C")


def units(masses: dict[str, float], seed: int = 3) -> tuple[Search, Split]:
    """A search that has not begun, on two short trials of each unit and one that judges."""
    train, validation = list[Segment](), list[Segment]()
    for k, (group, mass) in enumerate(masses.items()):
        real = MODEL.with_parameters({"arm.mass": mass})
        runs = recorded(real, count=3, seconds=1.5, size=0.8, seed=seed + k)
        segments = [replace(s, group=group, recording=s.recording + 3 * k) for s in cut(MODEL, runs, fit_start=True)]
        train += segments[:2]
        validation += segments[2:]
    free = free_parameters(MODEL, ["arm.mass", "arm.inertia"])
    simulator = simulator_for(MODEL)
    data = Data(free, train, simulator, policy=SearchPolicy.of(ROBOT.traits, simulator.engine))
    search = Search(data, [FRICTION.candidate])
    return search, Split(tuple(train), tuple(validation))


def test_a_mass_that_differs_is_told_apart() -> None:
    """The estimates are those of fits to each unit alone, and hold the true masses."""
    search, split = units({"A": 0.6, "B": 0.66})
    apart = told_apart(Apart(search, search.data.base()), split)
    assert apart.own == (Own("arm.mass", "B"),)
    fit = apart.best.fit
    found = dict(zip(fit.parameters.names, zip(fit.theta, fit.uncertainty.half_width, strict=True), strict=True))
    for name, true in (("arm.mass", 0.6), ("arm.mass in B", 0.66)):
        value, width = found[name]
        assert abs(value - true) < 2 * width and width < 0.01 * true
    assert float(fit.rmse[0]) < 1.1 * NOISE


@pytest.mark.parametrize("seed", [3, 13])
def test_units_that_are_alike_are_not_told_apart(seed: int) -> None:
    search, split = units({"A": 0.63, "B": 0.63}, seed)
    base = search.data.base()
    apart = told_apart(Apart(search, base), split)
    assert apart.best is base and apart.search is search
    gains = [gain for gain, _ in apart.moves(("A", "B"))]
    assert len(gains) == 2 and max(gains) < search.threshold(1)


def test_the_score_test_is_the_gain_of_a_fit() -> None:
    """Of a small difference the gain to first order is the fall of χ² under the same noise, to second order."""
    search, _ = units({"A": 0.6, "B": 0.6012})
    apart = Apart(search, search.data.base())
    gain, own = apart.moves(("A", "B"))[0]
    after = apart.with_own(own)
    assert after is not None
    times, noise = search.data.times, apart.best.noise
    before, there = (chi_squared(noise, times, f.fit.residuals) for f in (apart.best, after.best))
    assert gain > 10.0 and before - there == pytest.approx(gain, rel=0.15)
    back = after.without(own)
    assert back is not None and back.best.deviance == pytest.approx(apart.best.deviance, abs=1.0)


@pytest.mark.parametrize(
    ("masses", "departs"),
    [
        ({"A": 0.6, "B": 0.6}, []),
        ({"A": 0.63, "B": 0.63}, [("arm.mass", "")]),
        ({"A": 0.6, "B": 0.66}, [("arm.mass", "B")]),
    ],
)
def test_another_unit_than_the_nominal_model_is_of(masses: dict[str, float], departs: list[tuple[str, str]]) -> None:
    """Its parameters are told where they are not nominal, in the groups in which they are not."""
    search, split = units(masses)
    apart = told_apart(Apart(search, search.data.base()), split)
    other = another_unit(apart.search, SearchState(apart.best, apart.best), split)
    if not departs:
        assert other is None
        return
    assert other is not None and other.gain > other.threshold and other.validation_gain > 0
    assert [(d.parameter, d.group) for d in other.departures] == departs
    (only,) = other.departures
    assert only.nominal == 0.6 and only.estimate.value == pytest.approx(masses["B"], rel=0.003)
    told = differences(apart.search, SearchState(apart.best, apart.best), split)
    assert [d.parameter for d in told] == (["arm.mass"] if masses["A"] != masses["B"] else [])
    for difference in told:
        assert difference.gain > difference.threshold and difference.log10_p_value < -10
        for group, estimate in difference.values.items():
            assert estimate is not None and estimate.value == pytest.approx(masses[group], rel=0.003)


def test_candidates_of_groups() -> None:
    """Each that has a size also in each group alone; with a size of its own in each."""
    groups = ("A", "B", "C")
    pool = with_groups([FRICTION.candidate], groups)
    assert [c.absent for c in pool] == [(), ("B", "C"), ("A", "C"), ("A", "B")]
    assert with_groups([FRICTION.candidate], ()) == [FRICTION.candidate]
    assert own_in_each_group((FRICTION,), ()) is None
    split = own_in_each_group((FRICTION,), ("A", "B"))
    assert split is not None and dict(split[0].values) == {"friction": 0.3, "friction in B": 0.3}
    assert own_in_each_group(split, ("A", "B")) is None and splits_by_group(split, ("A", "B")) == []
    three = own_in_each_group((FRICTION,), groups)
    assert three is not None and three[0].candidate.own == (("friction", "B"), ("friction", "C"))
    assert splits_by_group(three, groups) == []
    more = [hypothesis[0].candidate.own for hypothesis in splits_by_group((FRICTION,), groups)]
    assert more == [(("friction", group),) for group in groups]
    alone = Part(pool[1], {"friction": 0.3})
    assert splits_by_group((alone,), groups) == []


def test_an_effect_absent_where_it_has_the_common_size() -> None:
    """The size of a group that is left becomes the common one."""
    candidate = replace(FRICTION.candidate, own=(("friction", "B"),))
    part = Part(candidate, {"friction": 0.0, "friction in B": 0.5})
    left = absent_with_common(part, ["A"], ["A", "B"])
    assert dict(left.values) == {"friction": 0.5} and left.candidate.own == () and left.candidate.absent == ("A",)
    other = absent_with_common(Part(candidate, {"friction": 0.5, "friction in B": 0.0}), ["B"], ["A", "B"])
    assert dict(other.values) == {"friction": 0.5} and other.candidate.absent == ("B",)
    three = Part(replace(candidate, own=(("friction", "B"), ("friction", "C"))), {
        "friction": 0.0, "friction in B": 0.5, "friction in C": 0.7,
    })  # fmt: skip
    kept = absent_with_common(three, ["A"], ["A", "B", "C"])
    assert dict(kept.values) == {"friction": 0.5, "friction in C": 0.7} and kept.candidate.own == (("friction", "C"),)


ESTIMATES = {"A": Estimate(0.31, 0.305, 0.315, "N·m"), "B": Estimate(0.52, 0.51, 0.53, "N·m"), "C": None}
MASS = Estimate(0.72, 0.71, 0.73, "kg")


@pytest.mark.parametrize(
    ("groups", "departures", "findings", "answer"),
    [
        ((), [Departure("arm.mass", "", 0.6, MASS)], (), "The parameters are those of another unit than the nominal model."),
        (("A", "B"), [Departure("arm.mass", "B", 0.6, MASS)], (), "The parameters of B are those of another unit than the "
         "nominal model; A agrees with it."),
        ((), [], (None,), "Beside the missing physics, the parameters are not the nominal ones, though which of them only "
         "several together show."),
    ],
)  # fmt: skip
def test_what_is_said_of_units(
    groups: tuple[str, ...], departures: list[Departure], findings: tuple[Any, ...], answer: str
) -> None:
    differing = Difference("friction", Named("coulomb_friction", ("elbow",)), ESTIMATES, 1234.5, 38.7, -267.4, 300.0)
    other = AnotherUnit(500.0, 40.0, 120.0, tuple(departures))
    diagnosis: Any = SimpleNamespace(groups=groups, differences=(differing,), another_unit=other, findings=findings)
    assert diagnosis_units.unit_answer(diagnosis) == answer
    assert len(diagnosis_units.departures(diagnosis)) == len(departures)
    if groups:
        assert diagnosis_units.differing(diagnosis) == [
            "Coulomb friction at elbow: 0.310 N·m (0.305 to 0.315) in A, 0.520 N·m (0.510 to 0.530) in B, "
            "not seen in C; −2 log likelihood falls by 1230 (threshold 38.7), on validation trials by 300, p-value 10⁻²⁶⁷."
        ]
        diagnosis.differences = ()
        assert diagnosis_units.differing(diagnosis) == ["One set of parameters fits A and B: no difference is seen."]
    else:
        assert diagnosis_units.differing(diagnosis) == []
    diagnosis.another_unit = None
    assert diagnosis_units.unit_answer(diagnosis) == "" and diagnosis_units.departures(diagnosis) == []


def folders(root: Path, masses: dict[str, float], count: int = 2) -> list[Path]:
    found = []
    for k, (name, mass) in enumerate(masses.items()):
        (root / name).mkdir(parents=True)
        real = MODEL.with_parameters({"arm.mass": mass})
        for run in recorded(real, count=count, seconds=1.5, size=0.8, seed=k, dt=None):
            write(root / name / f"{run.name}.csv", run)
        found.append(root / name)
    return found


def test_trials_go_by_their_folders(tmp_path: Path) -> None:
    """Names that trials of two folders share get the folders' in front, folders of one name by those above."""
    given = folders(tmp_path, {"A": 0.6, "B": 0.6})
    trials, group_of = by_folder(given, MODEL)
    assert group_of == {"A_t0": "A", "A_t1": "A", "B_t0": "B", "B_t1": "B"}
    assert [trial.name for trial in trials] == list(group_of)
    more = folders(tmp_path / "x", {"A": 0.6}, count=1)
    assert set(by_folder([*given, *more], MODEL)[1].values()) == {f"{tmp_path.name}/A", f"{tmp_path.name}/B", "x/A"}


def test_groups_that_cannot_be_are_refused(tmp_path: Path) -> None:
    one, two = folders(tmp_path, {"A": 0.6, "B": 0.6}, count=1)
    single = refusal(lambda: workflow.diagnose([one], MODEL, by="folder"))
    assert single == "trials are grouped by folder, but all of them are in A; expected those of two folders or more"
    few = refusal(lambda: workflow.diagnose([one, two], MODEL, by="folder"))
    assert few.startswith("A has one trial, expected at least 2 in each folder")
    selected = refusal(lambda: workflow.diagnose([one, two], MODEL, by="folder", select=["A_*"]))
    assert selected == "all trials selected are in A; expected some of two folders or more"
    trial = recorded(MODEL, count=1, seconds=1.0, dt=None)
    assert "not given as files" in refusal(lambda: workflow.diagnose(trial, MODEL, by="folder"))
    check_enough(["A", "B"], eq.DiagnoseOptions(until=0.7))
    held_out = refusal(lambda: workflow.diagnose([one, two], MODEL, by="folder", validation=["B_*"]))
    assert held_out == "all trials of B are held out; expected one at least that is fitted"


def test_a_model_file_for_each_unit() -> None:
    path = Path("out/arm.toml")
    assert by_group(path, MODEL, ("A", "lab/B")) == [(path, MODEL)]
    two = MODEL.with_groups({"lab/B": {"arm.mass": 0.8}})
    files = dict(by_group(path, two, ("A", "lab/B")))
    assert list(files) == [Path("out/arm_A.toml"), Path("out/arm_lab_B.toml")]
    assert [model.parameters()["arm.mass"] for model in files.values()] == [0.6, 0.8]


@pytest.mark.long
@pytest.mark.slow
def test_two_units_from_folders_to_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    """Friction of 0.31 in one and 0.52 in the other: one law, both sizes; the link's mass of both is another's."""
    from equimus_ctrl.cli.main import main

    given = []
    for k, (name, friction) in enumerate({"A": 0.31, "B": 0.52}.items()):
        real = Model(ROBOT.with_parameters({"arm.mass": 0.72}), (CoulombFriction("hinge", friction),))
        (tmp_path / name).mkdir()
        for run in recorded(real, count=3, size=1.3, seed=k):
            write(tmp_path / name / f"{run.name}.csv", run)
        given.append(str(tmp_path / name))
    (tmp_path / "arm.xml").write_text(PENDULUM.format(drive=MOTOR))
    options = ["--by", "folder", "--model", str(tmp_path / "arm.xml"), "--most", "2", "--json"]
    written = ["--report", str(tmp_path / "report"), "--write-model", str(tmp_path / "found.toml")]
    monkeypatch.setattr("sys.argv", ["equimus-ctrl", "diagnose", *given, *options, *written])
    main()
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert record["verdict"] == "explained" and list(record["groups"]) == ["A", "B"]
    (finding,) = record["findings"]
    assert finding["effect"] == "coulomb_friction"
    for group, true in (("A", 0.31), ("B", 0.52)):
        assert finding["by_group"][group]["friction"]["value"] == pytest.approx(true, rel=0.01)
        assert workflow.load_model(tmp_path / f"found_{group}.toml").effects[0].parameters()["friction"] == (
            pytest.approx(true, rel=0.01)
        )
    (difference,) = record["differences"]
    assert difference["parameter"] == "friction" and difference["gain"] > difference["threshold"]
    departures = {own["parameter"]: own["value"] for own in record["another_unit"]["departures"]}
    assert departures["arm.mass"] == pytest.approx(0.72, rel=0.01)
    said = " ".join(err.split())
    assert "Differences between A and B" in said and "those of another unit than the nominal model" in said
    assert "Differences" not in said.split("Differences between A and B")[1]
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert '<section id="units">' in page and "in B" in page
