"""Tuning studies: what a file may hold, what it may not, and what a candidate's vector means."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl import presets
from equimus_ctrl.tuning.study import (
    FORMAT,
    EnsembleSettings,
    Limits,
    Objective,
    Range,
    Study,
    Weights,
    study_from_dict,
)

GOOD: dict[str, Any] = {
    "format": FORMAT,
    "space": "length",
    "seed": 3,
    "candidates": 40,
    "polish": 0.25,
    "objectives": [{"scenario": "hold", "weight": 2, "duration": 2.0}, {"scenario": "triangle"}],
    "weights": {"error": 5, "worst": 0.25},
    "limits": {"overshoot": 0.1},
    "ensemble": {"members": 3, "delay": [0, 0.05]},
    "search": {
        "kp": {"low": 5, "high": 3000, "start": 150},
        "ki": {"low": 6.0, "high": 400.0, "start": 200.0},
        "kd": {"low": 0.2, "high": 200.0, "start": 5.0},
        "derivative_time": {"low": 0.005, "high": 0.1, "start": 0.02},
    },
}


def changed(path: str, value: Any) -> dict[str, Any]:
    """The good study with one dotted key set, or left out where the value is ``...``."""
    data = copy.deepcopy(GOOD)
    *above, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    table: Any = data
    for part in above:
        table = table[part]
    if value is ...:
        del table[last]
    else:
        table[last] = value
    return data


def test_a_study_is_read() -> None:
    study = study_from_dict(GOOD, "s.toml")
    assert study.objectives == (Objective("hold", 2.0, 2.0), Objective("triangle"))
    assert study.weights == Weights(error=5.0, worst=0.25) and study.limits == Limits(overshoot=0.1)
    assert study.ensemble == EnsembleSettings(members=3, delay=(0.0, 0.05))
    assert study.search["kp"] == Range(5.0, 3000.0, 150.0)
    assert (study.seed, study.candidates, study.polish, study.space) == (3, 40, 0.25, "length")
    assert isinstance(study.objectives[0].weight, float) and isinstance(study.search["kp"].low, float)


def test_reading_does_not_change_what_was_read() -> None:
    data = copy.deepcopy(GOOD)
    study_from_dict(data)
    assert data == GOOD


def test_the_study_of_the_repository_loads_and_says_what_the_defaults_are() -> None:
    path = presets.find("tuning", "pid.toml")
    assert path is not None
    study = study_from_dict(presets.read_toml(path), str(path))
    assert (study.weights, study.limits, study.ensemble) == (Weights(), Limits(), EnsembleSettings())
    assert [o.scenario for o in study.objectives] == ["hold", "triangle"]


def test_a_vector_holds_the_gains_channel_by_channel() -> None:
    study = study_from_dict(GOOD)
    labels = [label for label, _ in study.ranges(("maa", "baa"))]
    assert labels == ["maa.kp", "maa.ki", "maa.kd", "baa.kp", "baa.ki", "baa.kd", "derivative_time"]
    assert [r.start for _, r in study.ranges(("maa", "baa"))] == [150, 200, 5, 150, 200, 5, 0.02]
    settings = study.settings(np.arange(1.0, 8.0), ("maa", "baa"))
    assert settings.gains == {
        "maa": eq.PidGains(1.0, 2.0, 3.0, 1.22474),  # √(T_i T_d) = √(k_d/k_i)
        "baa": eq.PidGains(4.0, 5.0, 6.0, 1.09545),
    }
    assert settings.derivative_time == 7.0 and settings.space == "length" and not settings.inverse
    informed = study_from_dict(changed("inverse", True)).settings(np.arange(1.0, 8.0), ("maa", "baa"))
    assert informed.inverse


WRONG = [
    ("format", "x/1", "format is 'x/1', expected 'equimus-ctrl/tuning/1'"),
    ("candidtes", 5, "study: there is no key 'candidtes'; did you mean 'candidates'? (known: candidates, ensemble,"),
    ("candidates", 0, "study: candidates is 0, expected 1 to 1e+06"),
    ("candidates", 1.5, "study: candidates is 1.5, expected a whole number"),
    ("candidates", "many", "study: candidates is 'many', expected a whole number"),
    ("seed", -1, "study: seed is -1, expected at least 0"),
    ("seed", True, "study: seed is True, expected a whole number"),
    ("inverse", 1, "study: inverse is 1, expected true or false"),
    ("polish", 0.95, "study: polish is 0.95, expected 0 to 0.9"),
    ("polish", math.nan, "study: polish is nan, expected 0 to 0.9"),
    ("objectives", [], "a study needs at least one [[objectives]] table"),
    ("objectives", ..., "a study needs at least one [[objectives]] table"),
    ("objectives", 3, "objectives: expected [[objectives]] tables"),
    ("objectives", ["hold"], "objectives is 'hold', expected a table"),
    ("objectives.0.scenario", ..., "objectives: 'scenario' is missing"),
    ("objectives.0.scenario", 3, "objectives: scenario is 3, expected a text"),
    ("objectives.0.wieght", 1.0, "objectives: there is no key 'wieght'; did you mean 'weight'? (known: duration,"),
    ("objectives.0.weight", -1.0, "objective hold: weight is -1, expected at least 0"),
    ("objectives.0.duration", -2.0, "objective hold: duration is -2, expected 0.1 to 3600"),
    ("objectives.0.duration", math.inf, "objective hold: duration is inf, expected 0.1 to 3600"),
    ("weights", 3, "weights is 3, expected a table"),
    ("weights.eror", 3, "weights: there is no key 'eror'; did you mean 'error'? (known: chatter, effort, error,"),
    ("weights.error", -1, "weights: error is -1, expected at least 0"),
    ("weights.error", "a", "weights: error is 'a', expected a number"),
    ("weights.worst", 1.5, "weights: worst is 1.5, expected 0 to 1"),
    ("limits.overshoot", -0.1, "limits: overshoot is -0.1, expected at least 0"),
    ("limits.saturation", 2, "limits: saturation is 2, expected 0 to 1"),
    ("limits.modulus", 1.1, "limits: modulus is 1.1, expected 0 to 1"),
    ("limits.gain_margin", 0.9, "limits: gain_margin is 0.9, expected 1 to 100"),
    ("ensemble.members", 0, "ensemble: members is 0, expected 1 to 10000"),
    ("ensemble.members", 2.0, "ensemble: members is 2.0, expected a whole number"),
    ("ensemble.unseen", -1, "ensemble: unseen is -1, expected 0 to 10000"),
    ("ensemble.stiffness", -0.1, "ensemble: stiffness is -0.1, expected 0 to 0.95"),
    ("ensemble.mass", 1.0, "ensemble: mass is 1, expected 0 to 0.95"),
    ("ensemble.valve_spread", 2.0, "ensemble: valve_spread is 2, expected 0 to 0.95"),
    ("ensemble.noise", 0.5, "ensemble: noise is 0.5, expected 0 to 0.1"),
    ("ensemble.delay", 0.1, "ensemble: delay is 0.1, expected two numbers"),
    ("ensemble.delay", [0.1], "ensemble: delay is [0.1], expected two numbers"),
    ("ensemble.delay", [0.1, "a"], "ensemble: delay is [0.1, 'a'], expected two numbers"),
    ("ensemble.delay", [-0.1, 0.1], "ensemble: delay is -0.1, expected 0 to 2"),
    ("ensemble.delay", [0.2, 0.1], "ensemble: delay is 0.1, expected 0.2 to 2"),
    ("ensemble.lag", [0.1, 3.0], "ensemble: lag is 3, expected 0.1 to 2"),
    ("search", 3, "search: expected [search.<gain>] tables"),
    ("search.kp", ..., "search: [search.kp] is missing"),
    ("search.kp", 3, "search.kp is 3, expected a table"),
    (
        "search.kq",
        {"low": 1, "high": 2, "start": 1},
        "search: there is no gain 'kq' (known: derivative_time, kd, ki, kp)",
    ),
    ("search.kp.low", ..., "search.kp: 'low' is missing"),
    ("search.kp.low", 0, "search.kp: low 0, start 150, high 3000; expected 0 < low ≤ start ≤ high"),
    ("search.kp.low", 151.0, "search.kp: low 151, start 150, high 3000; expected 0 < low ≤ start ≤ high"),
    ("search.kp.high", math.inf, "search.kp: low 5, start 150, high inf; expected 0 < low ≤ start ≤ high"),
    ("search.kp.start", "a", "search.kp: start is 'a', expected a number"),
    (
        "search.kp.strat",
        3,
        "search.kp: there is no key 'strat'; did you mean 'start'? (known: high, low, scale, start)",
    ),
]


@pytest.mark.parametrize(("path", "value", "sentence"), WRONG, ids=[f"{path}={value}" for path, value, _ in WRONG])
def test_a_wrong_study_is_a_sentence(path: str, value: Any, sentence: str) -> None:
    with pytest.raises(eq.ConfigError) as caught:
        study_from_dict(changed(path, value), "s.toml")
    assert str(caught.value).startswith(f"s.toml: {sentence}") and "\n" not in str(caught.value)


def test_weights_must_not_all_be_nothing() -> None:
    data = changed("objectives.0.weight", 0)
    data["objectives"][1]["weight"] = 0
    with pytest.raises(eq.ConfigError, match="needs an objective with a weight above 0"):
        study_from_dict(data)


@pytest.mark.parametrize(
    ("path", "value", "names"),
    [
        pytest.param("space", "lenght", ("lenght", "length"), id="unknown space"),
        pytest.param("space", 3, ("3", "length"), id="space a number"),
        pytest.param("ensemble.delay", [0.0, True], ("delay", "True"), id="boolean in a pair"),
        pytest.param("search.kp.low", -5, ("kp", "-5"), id="the gain of a wrong range"),
        pytest.param("objectives.0.duration", 0.001, ("duration", "0.001"), id="shorter than a control period"),
    ],
)
def test_a_wrong_study_is_seen_when_it_is_read(path: str, value: Any, names: tuple[str, ...]) -> None:
    with pytest.raises(eq.ConfigError) as caught:
        study_from_dict(changed(path, value), "s.toml")
    assert all(name in str(caught.value) for name in ("s.toml", *names))


def test_a_study_is_frozen() -> None:
    study = study_from_dict(GOOD)
    assert isinstance(study, Study)
    with pytest.raises(AttributeError):
        study.seed = 4  # type: ignore[misc]


def test_a_channel_may_have_ranges_of_its_own() -> None:
    study = study_from_dict(changed("search.maa", {"kp": {"low": 1.0, "high": 9.0, "start": 3.0}}), "s.toml")
    assert isinstance(study, Study)
    ranges = dict(study.ranges(("maa", "baa")))
    assert ranges["maa.kp"] == Range(1.0, 9.0, 3.0) and ranges["baa.kp"] == Range(5.0, 3000.0, 150.0)
    assert list(ranges) == ["maa.kp", "maa.ki", "maa.kd", "baa.kp", "baa.ki", "baa.kd", "derivative_time"]
    with pytest.raises(eq.ConfigError, match=r"search: there is no length channel 'maa'; did you mean 'caa'"):
        study.ranges(("caa",))
    with pytest.raises(eq.ConfigError, match=r"search: there is no gain 'maa\.kq'"):
        study_from_dict(changed("search.maa", {"kq": {"low": 1.0, "high": 9.0, "start": 3.0}}))


def test_tracking_times_follow_the_integral_times() -> None:
    """Seven tenths of k_p/k_i, unless √(k_d/k_i) is longer."""
    study = study_from_dict(GOOD)
    assert isinstance(study, Study)
    found = study.settings(np.array([200.0, 400.0, 1.0, 100.0, 400.0, 100.0, 0.01]), ("maa", "baa"))
    assert found.gains["maa"].tracking_time == pytest.approx(0.35)
    assert found.gains["baa"].tracking_time == pytest.approx(0.5)
