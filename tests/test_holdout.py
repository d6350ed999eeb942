"""Which trials are fitted and which are held out, and recordings that cannot tell."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from leg_runs import recordings

from equimus_ctrl.diagnosis.holdout import Holdout, choose_holdout, never_held_out, split
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.types import Recording


def test_which_trials_are_held_out() -> None:
    model = nominal_model()
    trials = recordings((), count=5)
    usual = split(model, trials)
    assert [s.trial.name for s in usual.validation] == ["trial_3"]
    chosen = split(model, trials, validation=["trial_[01]"])
    assert [s.trial.name for s in chosen.validation] == ["trial_0", "trial_1"]
    assert not usual.test  # too few trials
    more = split(model, recordings((), count=8))
    assert [[s.trial.name for s in part] for part in (more.validation, more.test)] == [["trial_3"], ["trial_7"]]
    assert more.other is not None and [s.trial.name for s in more.other.test] == ["trial_7"]
    named = split(model, trials, test=["trial_0"])
    assert [[s.trial.name for s in part] for part in (named.validation, named.test)] == [["trial_4"], ["trial_0"]]
    with pytest.raises(ConfigError, match="trial trial_1 is for validation and for the test"):
        split(model, trials, validation=["trial_1"], test=["trial_[12]"])
    with pytest.raises(ConfigError, match="every trial is for the test"):
        split(model, trials, test=["*"])
    assert {s.recording_name for s in usual.train} == {"trial_0", "trial_1", "trial_2", "trial_4"}
    (train,), (heldout,) = (getattr(split(model, trials[:1]), key) for key in ("train", "validation"))
    assert train.trial.sample_times[-1] < heldout.trial.sample_times[0]
    assert heldout.trial.start == 0.0  # the motion is followed from the beginning
    late = split(model, trials, until=3.0)
    assert len(late.train) == len(late.validation) == 5
    with pytest.raises(ConfigError, match=r"for validation: there is no trial 'trial_9'; did you mean 'trial_4'"):
        split(model, trials, validation=["trial_9"])
    with pytest.raises(ConfigError, match="every trial is held out"):
        split(model, trials, validation=["*"])
    with pytest.raises(ConfigError, match="fitted is what comes before 100 s, but the last trial ends at "):
        split(model, trials, until=100.0)
    kept = [s.trial.name for s in never_held_out(model, recordings((), count=8))]
    assert kept == ["trial_0", "trial_1", "trial_4", "trial_5"]  # whichever of both splits it is
    assert [s.trial.name for s in never_held_out(model, trials, validation=["trial_[01]"])] == [
        "trial_2",
        "trial_3",
        "trial_4",
    ]
    assert [s.trial.name for s in never_held_out(model, trials, test=["trial_0"])] == ["trial_1", "trial_2"]
    for given, options in ((trials[:1], {}), (trials, {"until": 3.0}), (trials, {"until": 3.0, "window": (1.0, 4.0)})):
        fitted = split(model, given, **options).train  # type: ignore[arg-type]
        uncut = never_held_out(model, given, **options)  # type: ignore[arg-type]
        for one, other in zip(fitted, uncut, strict=True):
            np.testing.assert_array_equal(one.trial.sample_times, other.trial.sample_times)
            np.testing.assert_array_equal(one.measured, other.measured)
    end = float(trials[0].time[-1])
    for options, sentence in (
        ({"until": -1.0}, "fitted is what comes before -1 s, but the first trial begins at 0 s"),
        ({"until": end - 0.1}, "no trial has 60 samples after that, too few to judge by"),
        ({"until": 2.5, "window": (0.0, 2.0)}, "fitted is what comes before 2.5 s, but what counts ends at 2 s"),
        ({"until": 0.5, "window": (1.0, 2.0)}, "fitted is what comes before 0.5 s, but what counts begins at 1 s"),
        ({"window": (2.0, 1.0)}, "the window goes from 2 to 1 s, expected the earlier time first"),
        ({"window": (np.nan, 1.0)}, "the window goes from nan to 1 s"),
    ):
        with pytest.raises(ConfigError, match=sentence):
            split(model, trials, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("count", "given", "validation", "test", "other"),
    [
        (2, {}, "1", "", ""),
        (3, {}, "2", "", ""),
        (4, {}, "3", "", "2"),
        (8, {}, "3", "7", "26"),
        (9, {"test": ["0"]}, "48", "0", "37"),
        (3, {"test": ["2"]}, "1", "2", ""),
        (2, {"test": ["1"]}, "", "1", ""),
        (8, {"validation": ["[01]"]}, "01", "", ""),
        (8, {"by_time": True}, "", "", ""),
        (8, {"by_time": True, "test": ["3"]}, "", "3", ""),
    ],
)
def test_what_is_held_out_follows_from_the_names(
    count: int, given: dict[str, Any], validation: str, test: str, other: str
) -> None:
    chosen = choose_holdout([str(k) for k in range(count)], **given)
    assert chosen == Holdout(*(frozenset(map(int, places)) for places in (validation, test, other)))


def test_of_a_trial_alone_of_its_kind_the_end_is_held_out() -> None:
    names = [*(f"step_{k}" for k in range(8)), "triangle"]
    chosen = choose_holdout(names)
    assert chosen == Holdout(frozenset({3}), frozenset({7}), frozenset({2, 6}), frozenset({8}), frozenset({8}))
    assert choose_holdout([*names[:4], "triangle"]).last == frozenset()  # without a test set all of it validates
    assert choose_holdout(names, test=["step_0"]).last == frozenset()
    assert choose_holdout(names, validation=["step_0"]).ends == frozenset()
    assert choose_holdout(["walk", "run", "jump", "rest", "fall"]).ends == frozenset()  # no kind has several
    assert choose_holdout(["walk"]) == Holdout(ends=frozenset({0}))


def test_the_end_of_a_trial_alone_of_its_kind_is_divided() -> None:
    trials = recordings((), count=8)
    trials = [replace(r, name=f"step_{k}") for k, r in enumerate(trials)] + [replace(trials[0], name="triangle")]
    parts = split(nominal_model(), trials)
    first, last = float(trials[-1].time[0]), float(trials[-1].time[-1])
    times = [
        [s.trial.sample_times for s in own if s.recording == 8] for own in (parts.train, parts.validation, parts.test)
    ]
    ends = [first + share * (last - first) for share in (0.75, 0.875, 1.0)]
    assert [len(own) for own in times] == [1, 1, 1]
    assert [own[0][-1] for own in times] == pytest.approx(ends, abs=0.02)
    assert times[0][0][-1] < times[1][0][0] < times[1][0][-1] < times[2][0][0]


@pytest.mark.parametrize(
    ("samples", "sets"), [(480, "train validation test"), (320, "train validation"), (200, "train")]
)
def test_an_end_that_is_too_short_to_judge_by_is_not_lost(samples: int, sets: str) -> None:
    trials = [replace(r, name=f"step_{k}") for k, r in enumerate(recordings((), count=8))]
    short = trials[0]
    rows = slice(0, samples)
    alone = replace(
        short, name="alone", time=short.time[rows], position=short.position[rows], command=short.command[rows]
    )
    parts = split(nominal_model(), [*trials, alone])
    whole = {"train": parts.train, "validation": parts.validation, "test": parts.test}
    found = {name: [s for s in own if s.recording == 8] for name, own in whole.items()}
    assert " ".join(name for name, own in found.items() if own) == sets
    assert sum(len(s.trial.sample_times) for own in found.values() for s in own) == samples


def spoilt(change: str) -> list[Recording]:
    good = recordings((), count=2)
    first = good[0]
    position, command = np.array(first.position), np.array(first.command)
    if change == "nan":
        position[7, 1] = np.nan
        return [replace(first, position=position), good[1]]
    if change == "degrees":
        return [replace(r, position=np.rad2deg(r.position)) for r in good]
    if change == "still command":
        return [replace(r, command=np.full_like(command, 1e4), before=None) for r in good]
    if change == "still joint":
        return [replace(r, position=np.column_stack([np.full(len(r.time), 1.5), r.position[:, 1]])) for r in good]
    if change == "short":
        return [Recording("tiny", first.time[:20], command[:20], position[:20], first.actuators, first.joints)]
    return [replace(r, joints=("shin", "toe")) for r in good]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("nan", "trial_0: holds numbers that are not finite"),
        ("degrees", r"trial_0: hip reaches [0-9.]+ rad, more than two turns; are the angles in degrees"),
        ("still command", "the commands never move"),
        ("still joint", "joint hip never moves"),
        ("short", "tiny: has 20 samples over 0.19 s, too short to diagnose"),
        ("columns", "has joints shin, toe"),
    ],
)
def test_recordings_that_cannot_tell_are_refused_in_one_sentence(change: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        split(nominal_model(), spoilt(change))
    with pytest.raises(ConfigError, match="no recording was given"):
        split(nominal_model(), [])
