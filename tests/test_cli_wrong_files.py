"""Files of models, settings and studies with something wrong in them: one sentence says what and where."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from wrong_input import RUN, SCORE, Ran, sentence, study

MODELS = {
    'morphology = "nominal_lag"': "there is no morphology 'nominal_lag'; did you mean 'nominal_leg'? (known: ideal",
    "parametres = 3": "there is no key 'parametres'; did you mean 'parameters'? (known: effects, format, m",
    'format = "x/2"': "format is 'x/2', expected 'equimus-ctrl/model/1'",
    "name = 3": "name is 3, expected a text",
    'phase = "swin"': "there is no phase 'swin'; did you mean 'swing'? (known: stance, swing)",
    "morphology = 3": "morphology is 3, expected a name or a table",
    '[morphology]\nname = "x"': "morphology: 'links' is missing",
    "parameters = 3": "parameters: 3 is not a table of numbers",
    "[parameters]\nmaa.stiffness = 3": "parameters: 'maa' is a table; put a dotted name in quotes, such as \"maa.",
    '[parameters]\n"maa.stifness" = 3': "there is no parameter 'maa.stifness'; did you mean 'maa.stiffness'? (known: ",
    '[parameters]\n"maa.stiffness" = -3': "actuator 'maa': stiffness is -3, expected at least 0",
    '[parameters]\n"maa.stiffness" = nan': "actuator 'maa': stiffness is nan, expected a finite number",
    '[parameters]\n"maa.stiffness" = "a"': "parameters: maa.stiffness is 'a', expected a number",
    '[parameters]\n"maa.area" = 0': "actuator 'maa': area is 0, expected more than 0",
    "effects = 3": "effects is 3, expected [[effects]] tables",
    '[[effects]]\nlocation = "baa"': "an [[effects]] table lacks 'effect'",
    '[[effects]]\neffect = "delay"\nlocation = "baa"': "there is no effect 'delay'",
    '[[effects]]\neffect = "transport_delay"\nlocation = "baa"': "effect transport_delay at 'baa' lacks 'delay' [s]",
    '[[effects]]\neffect = "transport_delay"\nlocation = "baa"\ndelay = "a"': "transport_delay: delay is 'a', expected",
    '[[effects]]\neffect = "transport_delay"\nlocation = "baa"\ndelay = 9': "delay is 9 s, expected 0 to 2 s",
    '[[effects]]\neffect = "transport_delay"\nlocation = "hip"\ndelay = 0.1': "there is no actuator 'hip' (known: ",
}


@pytest.mark.parametrize("text", MODELS, ids=lambda text: text.replace("\n", "; "))
@pytest.mark.parametrize("verb", [SCORE, ("run", "hold"), ("autotune-pid",)], ids=lambda verb: verb[0])
def test_a_wrong_model_file(verb: tuple[str, ...], text: str, run_there: Callable[..., Ran]) -> None:
    found = sentence(run_there((*verb, "--model", "leg.toml"), {"leg.toml": text + "\n"}), 2)
    assert MODELS[text] in found


GAINS = "[gains.maa]\nkp = 1.0\n[gains.baa]\nkp = 1.0\n"
SETTINGS = {
    'format = "x/2"\n' + GAINS: "format is 'x/2', expected 'equimus-ctrl/pid/1'",
    "kp = 3\n" + GAINS: "there is no key 'kp' (known: decoupled, derivative_time, ",
    "": "there is no [gains.<channel>] table",
    'space = "lenght"\n' + GAINS: "there is no PID space 'lenght'; did you mean 'length'? (known: joint, length)",
    "derivative_time = -1\n" + GAINS: "derivative_time is -1, expected a finite number of at least 0",
    'derivative_time = "a"\n' + GAINS: "derivative_time is 'a', expected a number",
    "feedforward = 1\n" + GAINS: "feedforward is 1, expected true or false",
    GAINS.replace("1.0", "-1", 1): "gains.maa: kp is -1, expected a finite number of at least 0",
    GAINS.replace(
        "kp", "kpp", 1
    ): "gains.maa: there is no key 'kpp'; did you mean 'kp'? (known: kd, ki, kp, tracking_time)",
    GAINS.replace("kp", "ki", 1): "gains.maa: 'kp' is missing",
    GAINS.replace("baa", "bba"): "there is no length channel 'bba'; did you mean 'baa'? (known: baa, maa)",
    GAINS.split("[gains.baa]")[0]: "channel 'baa' has none (given: maa)",
    'space = "joint"\n' + GAINS: "there is no joint channel 'maa' (known: hip, knee)",
}


@pytest.mark.parametrize("text", SETTINGS, ids=lambda text: text.replace("\n", "; "))
def test_a_wrong_settings_file(text: str, run_there: Callable[..., Ran]) -> None:
    assert SETTINGS[text] in sentence(run_there((*RUN, "--settings", "pid.toml"), {"pid.toml": text}), 2)


STUDIES: list[tuple[dict[str, Any], str]] = [
    ({"format": "x/2"}, "format is 'x/2', expected 'equimus-ctrl/tuning/1'"),
    ({"candidtes": 2}, "study: there is no key 'candidtes'; did you mean 'candidates'? (known: "),
    ({"candidates": 2.5}, "study: candidates is 2.5, expected a whole number"),
    ({"polish": 2}, "study: polish is 2, expected 0 to 0.9"),
    ({"objectives": []}, "a study needs at least one [[objectives]] table"),
    ({"objectives": [{"scenario": "hodl"}]}, "there is no scenario 'hodl'; did you mean 'hold'?"),
    ({"objectives": [{"scenario": "hold", "weight": -1}]}, "objective hold: weight is -1, expected at least 0"),
    ({"ensemble": {"delay": [-0.1, 0.1]}}, "ensemble: delay is -0.1, expected 0 to 2"),
    ({"ensemble": {"delay": [0.2, 0.1]}}, "ensemble: delay is 0.1, expected 0.2 to 2"),
    ({"ensemble": {"stiffness": -0.1}}, "ensemble: stiffness is -0.1, expected 0 to 0.95"),
    ({"ensemble": {"members": 0}}, "ensemble: members is 0, expected 1 to 10000"),
    ({"ensemble": {"noise": -1}}, "ensemble: noise is -1, expected 0 to 0.1"),
    ({"weights": {"error": -1}}, "weights: error is -1, expected at least 0"),
    ({"limits": {"modulus": 2}}, "limits: modulus is 2, expected 0 to 1"),
    (
        {"search": {"kp": {"low": -1, "high": 2, "start": 1}}},
        "search.kp: low -1, start 1, high 2; expected 0 < low ≤ st",
    ),
    ({"search": {"kq": {"low": 1, "high": 2, "start": 1}}}, "search: there is no gain 'kq' (known: derivative_time, k"),
]


@pytest.mark.parametrize(("changes", "said"), STUDIES, ids=[str(changes) for changes, _ in STUDIES])
def test_a_wrong_study(changes: dict[str, Any], said: str, run_there: Callable[..., Ran]) -> None:
    assert said in sentence(run_there(("autotune-pid", "--study", "s.toml"), {"s.toml": study(**changes)}), 2)


@pytest.mark.parametrize(
    "changes", [{"space": "lenght"}, {"objectives": [{"scenario": "hold", "duration": 0.001}]}], ids=str
)
def test_a_wrong_study_leaves_no_journal(changes: dict[str, Any], run_there: Callable[..., Ran]) -> None:
    sentence(run_there(("autotune-pid", "--study", "s.toml"), {"s.toml": study(**changes)}), 2)


def test_gains_for_other_channels_name_their_file(run_there: Callable[..., Ran]) -> None:
    text = GAINS.replace("baa", "bba")
    assert "pid.toml" in sentence(run_there((*RUN, "--settings", "pid.toml"), {"pid.toml": text}), 2)


@pytest.mark.parametrize("more", ['location = "baa"\ndelay = 9', 'location = "hip"\ndelay = 0.1'])
def test_an_effect_of_a_model_file_names_the_file(more: str, run_there: Callable[..., Ran]) -> None:
    text = f'[[effects]]\neffect = "transport_delay"\n{more}\n'
    assert "leg.toml" in sentence(run_there((*SCORE, "--model", "leg.toml"), {"leg.toml": text}), 2)
