"""A diagnosis in words: numbers as people read them, and a sentence for every effect."""

from __future__ import annotations

import math

import pytest
from diagnosed_leg import DRAG, finding_of, part_of, plausible
from effect_cases import CASES, PLAUSIBLE

from equimus_ctrl.diagnosis.coordinates import read
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.results import Estimate, Evidence, Finding, Named
from equimus_ctrl.effects import REGISTRY, CoulombFriction, Effect
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.report.diagnosis_text import laws, sentence
from equimus_ctrl.report.diagnosis_words import coordinates_text, estimate_text, number, power_of_ten, short
from equimus_ctrl.workflow import load_plugins

# Numbers


@pytest.mark.parametrize(
    ("value", "low", "high", "unit", "text"),
    [
        (2800.0, 2780.0, 2820.0, "Pa", "2.80 kPa (2.78 to 2.82)"),
        (0.0447, 0.0441, 0.0452, "N·m", "0.0447 N·m (0.0441 to 0.0452)"),
        (0.160, 0.158, 0.162, "s", "160 ms (158 to 162)"),
        (2.605e-3, 2.57e-3, 2.64e-3, "N·m", "2.60 mN·m (2.57 to 2.64)"),
        (0.2, 0.19, 0.21, "rad", "11.5° (10.9 to 12.0)"),
        (-0.1, -0.13, -0.07, "rad", "−5.7° (−7.4 to −4.0)"),
        (0.2, -5.0, 5.0, "N", "0.2 N (−5.0 to 5.0)"),
        (0.0, 0.0, 0.01, "N·m·s/rad", "0.000 N·m·s/rad (0.000 to 0.010)"),
        (0.5, -math.inf, math.inf, "kg", "500 g (not identifiable)"),
        (0.5, 0.4, math.inf, "kg", "500 g (at least 400)"),
        (0.5, -math.inf, 0.6, "kg", "500 g (at most 600)"),
        (2800.0, 2800.0, 2800.0, "Pa", "2.80 kPa (certain to all digits shown)"),
        (2800.0, 2799.99999, 2800.00001, "Pa", "2.8000 kPa (certain to all digits shown)"),
        (23456.0, 22500.0, 24400.0, "N/m³", "23500 N/m³ (22500 to 24400)"),
        (1.23e-9, 1.2e-9, 1.26e-9, "furlong", "1.23·10⁻⁹ furlong (1.20·10⁻⁹ to 1.26·10⁻⁹)"),
    ],
)
def test_a_number_has_the_digits_that_its_interval_is_worth(
    value: float, low: float, high: float, unit: str, text: str
) -> None:
    assert estimate_text(Estimate(value, low, high, unit)) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (math.nan, "–"), (math.inf, "∞"), (1234.5, "1230"), (0.012345, "0.0123"), (-0.0004, "−0.000400"),
     (2.5e7, "2.50·10⁷"), (-1e-12, "−1.00·10⁻¹²"), (0.9999, "1.000")],
)  # fmt: skip
def test_a_number_without_an_interval_has_three_digits(value: float, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("exponent", "text"),
    [(0.0, "1.00"), (-0.3, "0.50"), (-1.5, "0.032"), (-3.7, "2·10⁻⁴"), (-5.01, "1·10⁻⁵"), (-171.3, "10⁻¹⁷¹"),
     (-math.inf, "below 10⁻³⁰⁰"), (math.nan, "–")],
)  # fmt: skip
def test_chances_are_powers_of_ten(exponent: float, text: str) -> None:
    assert power_of_ten(exponent) == text


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("pos.hip", "the angle of hip"),
        ("pos.hip·vel.hip", "the angle of hip and the speed of hip"),
        ("pos.knee·sign(vel.knee)", "the angle of knee and the direction in which knee moves"),
        ("cmd.maa−cmd.baa", "the pressure of maa less the pressure of baa"),
        ("time", "the time since a trial's start"),
        ("time at 0.5 Hz", "the time since a trial's start at 0.5 Hz"),
        ("time·cmd.maa", "the time since a trial's start and the pressure of maa"),
        ("path.maa", "the path that the length of maa has taken"),
    ],
)
def test_coordinates_are_told_in_words(given: str, told: str) -> None:
    assert coordinates_text(read(given)) == told


# Sentences


def test_every_effect_of_the_catalogue_has_a_sentence_of_its_own() -> None:
    for name in CASES:
        assert REGISTRY[name].sentence.__func__ is not Effect.sentence.__func__, name  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", sorted(PLAUSIBLE))
def test_the_sentence_of_an_effect_gives_its_numbers(name: str) -> None:
    text = sentence(plausible(name), nominal_model())
    assert CASES[name].said in text
    assert text.endswith(".") and "_" not in text and "nan" not in text


def test_an_effect_of_ones_own_is_told_by_its_summary_and_numbers() -> None:
    load_plugins([DRAG])
    drag = finding_of(part_of("quadratic_drag", ("knee",), {"coefficient": 0.02}))
    assert sentence(drag, nominal_model()) == (
        "Drag that grows with the square of the speed, at knee: coefficient (torque at 1 rad/s) 0.0200 N·m·s²/rad² "
        "(0.0190 to 0.0210)."
    )


def test_a_law_of_several_joints_is_named_once() -> None:
    def found(law: Part | None, place: str) -> Finding:
        part = Part(Candidate(CoulombFriction, (place,), ()), {"friction": 0.1})
        return Finding(part, {}, Evidence(800.0, 25.0, -170.0, 200.0, 0.9, 0.9), (), law)

    law = Part(Candidate(CoulombFriction, ("a", "b", "c"), (), each=True), {})
    findings = [found(law, "a"), found(None, "d"), found(law, "c")]
    assert laws(findings) == [
        Named("coulomb_friction", ("a", "c"), each=True),
        Named("coulomb_friction", ("d",)),
    ]
    assert short(laws(findings)[0]) == "coulomb friction at a and c, each with its own size"
    assert findings[0].also_at == ("b", "c") and findings[1].also_at == ()
