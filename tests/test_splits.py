"""Other splits of the same trials: which are drawn, what they agree on, and how it is told."""

from __future__ import annotations

import io
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from leg_runs import recordings
from rich.console import Console
from test_imports import ROOT

from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.estimates import Estimate
from equimus_ctrl.diagnosis.holdout import Holdout, choose_holdout, split
from equimus_ctrl.diagnosis.random_splits import ENDS, random_holdouts
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.split_comparison import HeldOutError, SplitAnswer, SplitComparison
from equimus_ctrl.errors import ConfigError, RecordingError
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.options import DiagnoseOptions
from equimus_ctrl.report.diagnosis_page import page
from equimus_ctrl.report.diagnosis_text import print_diagnosis
from equimus_ctrl.workflow import diagnose, load_model
from equimus_ctrl.workflow.splits import answer_of, over_splits

STEPS = [f"step_{k}" for k in range(9)]


@given(st.integers(1, 30), st.integers(0, 12), st.integers(0, 2**31), st.booleans())
def test_a_random_split_fits_half_of_what_no_test_has(trials: int, count: int, seed: int, alone: bool) -> None:
    names = [*(f"step_{k}" for k in range(trials)), *(["triangle"] if alone else [])]
    usual = choose_holdout(names)
    drawn = random_holdouts(names, count, seed)
    assert drawn == random_holdouts(names, count, seed)  # nothing else is random
    assert drawn[: count // 2] == random_holdouts(names, count // 2, seed)  # asked for more, the first are the same
    assert len(drawn) <= count and len(set(drawn)) == len(drawn)
    for own in drawn:
        assert own.test == usual.test and own.ends == usual.ends and own.last == usual.last
        assert not own.validation & (own.test | own.ends) and not own.other
        assert len(own.validation) == (len(names) - len(own.test) - len(own.ends)) // 2
        assert ENDS[0] <= own.share <= ENDS[1] if own.ends else own.share == usual.share


def test_every_trial_is_as_often_fitted_as_another_and_each_group_halved() -> None:
    drawn = random_holdouts(STEPS[:8], 34, 1)
    held = Counter(k for own in drawn for k in own.validation)
    assert len(drawn) == 34  # of 35 halves of seven trials, beside one for the test
    assert set(held) == set(range(7)) and set(held.values()) <= {14, 15}
    groups = ["A"] * 5 + ["B"] * 4
    for own in random_holdouts(STEPS, 20, 2, groups=groups):
        assert Counter(groups[k] for k in own.validation) == {"A": 2, "B": 2}


def test_there_are_no_more_splits_than_the_trials_have() -> None:
    assert [own.validation for own in random_holdouts(["a", "b"], 9)] == [frozenset({0})]  # the default holds out b
    assert not random_holdouts(["a", "b"], 9, test=["a"])  # one trial is all that is left to fit
    assert len(random_holdouts(["a"], 9)) == 9  # the end of one trial may begin anywhere
    named = random_holdouts(STEPS, 5, test=["step_0"])
    assert all(own.test == {0} and 0 not in own.validation for own in named)


def test_a_split_that_leaves_nothing_to_judge_by_is_none() -> None:
    (trial,) = recordings((), count=1)
    short = float(trial.time[0]), float(trial.time[130])
    with pytest.raises(ConfigError, match="nothing is held out that has 60 samples, too few to judge by"):
        split(nominal_model(), [trial], window=short, heldout=Holdout(ends=frozenset({0}), share=0.375))


def test_no_random_split_fits_what_the_test_set_has() -> None:
    trials = recordings((), count=8)
    trials = [replace(r, name=f"step_{k}") for k, r in enumerate(trials)] + [replace(trials[0], name="triangle")]
    usual, model = split(nominal_model(), trials), nominal_model()
    for own in random_holdouts([t.name for t in trials], 4):
        parts = split(model, trials, heldout=own)
        assert _spans(parts.test) == _spans(usual.test)
        (end,) = (s for s in parts.validation if s.recording_name == "triangle")
        (begun,) = (s for s in parts.train if s.recording_name == "triangle")
        whole = trials[-1].time[-1] - trials[-1].time[0]
        assert (
            begun.trial.sample_times[-1] < end.trial.sample_times[0] < trials[-1].time[0] + (1 - ENDS[0]) * whole + 0.1
        )


def _spans(segments: Sequence) -> list[tuple[str, float, float]]:
    return [(s.recording_name, float(s.trial.sample_times[0]), float(s.trial.sample_times[-1])) for s in segments]


def estimate(value: float) -> Estimate:
    return Estimate(value, value - 0.1, value + 0.1, "N·m")


def answer(
    *named: tuple[str, str, float], number: int = 0, as_well: Sequence[tuple[str, str]] = (), ratio: float = 0.5
) -> SplitAnswer:
    found = {(effect, place): {"friction": estimate(size)} for effect, place, size in named}
    errors = (HeldOutError("step", "hip", 0.02, 0.02 * ratio),)
    return SplitAnswer(number, ("step_1",), "explained", found, frozenset(as_well), errors, 3.0)


def test_what_all_splits_name_and_what_hangs_on_them() -> None:
    creep = ("creep", "maa")
    answers = (
        answer(("coulomb_friction", "hip", 0.3), ("lag", "maa", 2.0)),
        answer(("coulomb_friction", "hip", 0.5), number=2, as_well=[("lag", "maa")]),
        answer(("coulomb_friction", "hip", 0.4), (*creep, 1.0), number=3, ratio=1.25),
    )
    compared = SplitComparison(answers, 3, ("split 1 could not be diagnosed: the hip never moves",))
    friction, *others = compared.effects
    assert (friction.effect, friction.place, friction.named) == ("coulomb_friction", "hip", (0, 2, 3))
    assert [e.value for e in friction.estimates["friction"]] == [0.3, 0.5, 0.4]
    assert {law.effect for law in compared.undecided} == {"lag", "creep"} == {law.effect for law in others}
    (lag,) = (law for law in others if law.effect == "lag")
    assert lag.named == (0,) and lag.as_well == (2,)
    assert compared.worst is not None and compared.worst.ratio == pytest.approx(1.25)
    written = json.loads(json.dumps(compared.to_dict()))
    assert written["effects"][0]["parameters"]["friction"] == {"least": 0.3, "most": 0.5, "unit": "N·m"}
    assert [len(own["findings"]) for own in written["answers"]] == [2, 1, 2]


def test_where_nothing_fits_better_nothing_is_worse() -> None:
    compared = SplitComparison((answer(ratio=1.0), answer(ratio=1.0, number=1)), 1)
    assert compared.effects == () and compared.worst is None
    failed = SplitComparison((answer(("lag", "maa", 1.0)), answer(ratio=40.0, number=1)), 1)  # it names nothing
    assert failed.worst is not None and failed.worst.ratio == pytest.approx(40.0)


def test_an_answer_is_what_the_diagnosis_says(diagnosis: Diagnosis) -> None:
    own = answer_of(0, diagnosis, 2.0)
    assert {place for finding in diagnosis.findings for place in finding.named.locations} == {p for _, p in own.named}
    (finding,) = diagnosis.findings
    assert own.named[finding.named.effect, finding.named.locations[0]] is finding.parameters
    assert not own.as_well & own.named.keys()
    assert len({e.kind for e in own.errors}) == 1 and not diagnosis.test
    for j, (joint, error) in enumerate(zip(diagnosis.joints, own.errors, strict=True)):
        assert error.joint == joint
        assert error.refitted == pytest.approx(diagnosis.rmse("refitted", "validation")[j])
        assert error.corrected == pytest.approx(diagnosis.rmse("corrected", "validation")[j])


def test_errors_are_of_the_test_set_too(diagnosis: Diagnosis) -> None:
    (first,) = diagnosis.validation
    walk = replace(first, trial=replace(first.trial, name="walk_1"), recording_name="walk_1")
    residuals = {state: replace(r, validation=(), test=r.validation) for state, r in diagnosis.residuals.items()}
    parted = replace(diagnosis, validation=(), test=(walk,), residuals=residuals)
    errors = {(e.kind, e.joint): e for e in answer_of(0, parted, 2.0).errors}
    assert {kind for kind, _ in errors} == {"walk"}
    for j, joint in enumerate(diagnosis.joints):
        left = diagnosis.residuals["corrected"].validation[0][:, j]
        assert errors["walk", joint].corrected == pytest.approx(float(np.sqrt((left**2).mean())))


def test_where_groups_differ_each_has_an_effect_of_its_own(diagnosis: Diagnosis) -> None:
    (finding,) = diagnosis.findings
    own = dict(finding.parameters)
    d = replace(diagnosis, findings=(replace(finding, by_group={"A": own, "B": {}}),))
    place = finding.named.locations[0]
    assert set(answer_of(0, d, 2.0).named) == {(finding.named.effect, f"{place} in A")}


@pytest.mark.usefixtures("undrawn")
def test_it_is_told_on_the_terminal_and_on_the_page(diagnosis: Diagnosis) -> None:
    (finding,) = diagnosis.findings
    effect, place = finding.named.effect, finding.named.locations[0]
    first = answer_of(0, diagnosis, 2.0)
    other = answer(("coulomb_friction", "hip", 0.4), number=2, as_well=[(effect, place)], ratio=1.25)
    d = replace(diagnosis, splits=SplitComparison((first, other), 2, ("the time was up",)))
    out = io.StringIO()
    print_diagnosis(Console(file=out, width=200), d)
    text = out.getvalue()
    assert "Undecided, as some splits name it and others do not: " in text and "(1 of 2)" in text
    assert "Over 2 splits: the default one and 1 random half of the trials" in text
    assert "undecided, named in 1 of 2, and not distinguishable in 1 more" in text
    assert "at most 1.25 of the refitted one's (hip, step): it is worse there." in text
    assert "1 of the 2 random halves asked for is missing: the time was up." in text
    shown = page(d, "leg")
    section = shown[shown.index('<section id="splits">') :].split("</section>")[0]
    assert "1 of 2" in section and "<img" in section and "1.25" in section and "it is worse there" in section
    assert ">2</td>" in section and ">default</td>" in section  # by its number, of which there is no 1
    alone = page(replace(diagnosis, splits=SplitComparison((first,), 2, ("the time was up",))), "leg")
    assert "named in all" not in alone and "Over 1" not in alone and "2 of the 2 random halves" in alone
    assert 'id="splits"' not in page(diagnosis, "leg") and "Undecided" not in page(diagnosis, "leg")
    assert d.to_dict()["splits"]["fewer"] == ["the time was up"] and "splits" not in diagnosis.to_dict()


OTHERS = (Holdout(frozenset({0})), Holdout(frozenset({1})), Holdout(frozenset({2})))


def test_the_default_split_is_the_answer_and_the_others_are_compared(diagnosis: Diagnosis) -> None:
    asked: list[Holdout | None] = []
    told: list[tuple[str, float]] = []

    def diagnosed(heldout: Holdout | None, progress: object) -> Diagnosis:
        asked.append(heldout)
        progress("search", 0.5, "")  # type: ignore[operator]
        return diagnosis if heldout is None else replace(diagnosis, findings=())

    found = over_splits(diagnosed, OTHERS, 5, lambda stage, share, best: told.append((stage, share)))
    assert asked == [None, *OTHERS] and found.findings == diagnosis.findings
    assert told == [("search", 0.125), *((f"split {k} of 3: search", (k + 0.5) / 4) for k in (1, 2, 3))]
    assert found.splits is not None and [bool(a.named) for a in found.splits.answers] == [True, False, False, False]
    assert found.splits.fewer == ("no more than 3 different ones were found",)


@pytest.mark.parametrize("ends", ["spent", "unfinished"])
def test_a_split_that_was_ended_does_not_count(diagnosis: Diagnosis, ends: str) -> None:
    def diagnosed(heldout: Holdout | None, progress: object) -> Diagnosis:
        if heldout == OTHERS[1]:
            if ends == "spent":
                raise BudgetSpent
            return replace(diagnosis, not_done=("confirmation",))
        assert heldout != OTHERS[2]  # nobody goes on after the end
        return diagnosis

    splits = over_splits(diagnosed, OTHERS, 3, lambda stage, share, best: None).splits
    assert splits is not None and len(splits.answers) == 2
    assert splits.fewer == ("the time was up, or the best so far was asked for",)


def test_a_split_that_cannot_be_diagnosed_is_told_and_the_others_go_on(diagnosis: Diagnosis) -> None:
    def diagnosed(heldout: Holdout | None, progress: object) -> Diagnosis:
        if heldout == OTHERS[0]:
            raise RecordingError("the hip never moves")
        return diagnosis

    splits = over_splits(diagnosed, OTHERS, 3, lambda stage, share, best: None).splits
    assert splits is not None and len(splits.answers) == 3
    assert splits.fewer == ("split 1 could not be diagnosed: the hip never moves",)
    unfinished = replace(diagnosis, not_done=("search",))
    splits = over_splits(lambda heldout, progress: unfinished, OTHERS, 3, lambda stage, share, best: None).splits
    assert splits is not None and len(splits.answers) == 1


@pytest.mark.long
@pytest.mark.slow
def test_every_split_names_the_friction_of_a_pendulum() -> None:
    docs = ROOT.parent / "docs" / "examples"
    found = diagnose(docs / "pendulum", load_model(docs / "pendulum.xml"), splits=2, most=1)
    splits = found.splits
    assert splits is not None and len(splits.answers) == 3 and not splits.fewer and not splits.undecided
    (law,) = splits.effects
    assert (law.effect, law.place, law.named) == ("coulomb_friction", "hinge", (0, 1, 2))
    assert all(e.value == pytest.approx(0.1, rel=0.01) for e in law.estimates["friction"])
    assert len({answer.fitted for answer in splits.answers}) == 3  # no two fitted the same trials
    assert splits.worst is not None and splits.worst.ratio < 0.1


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"validation": ["a"]}, "splits are drawn at random, and validation says what is held out; expected one of"),
        ({"until": 3.0}, "splits are drawn at random, and until says what is held out"),
        ({"seed": -1}, "seed is -1, expected at least 0"),
    ],
)
def test_what_cannot_be_asked_for_with_splits(given: dict, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        DiagnoseOptions(splits=2, **given)
    with pytest.raises(ConfigError, match="splits is -1, expected at least 0"):
        DiagnoseOptions(splits=-1)
