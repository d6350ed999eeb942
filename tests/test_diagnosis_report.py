"""A diagnosis told: numbers as people read them, curves against their laws, figures, page and terminal."""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from rich.console import Console

from equimus_ctrl.diagnosis.candidates import Candidate, Part
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.results import (
    Detectable,
    Diagnosis,
    Estimate,
    Evidence,
    Experiment,
    Finding,
    Leftover,
    Named,
    Ranked,
    Residuals,
    Where,
)
from equimus_ctrl.diagnosis.where import excess_of
from equimus_ctrl.effects import (
    REGISTRY,
    BodyEffect,
    ForceEffect,
    SensorEffect,
    ShapingEffect,
    make,
    parameter,
    register,
)
from equimus_ctrl.effects.bodies import Robot
from equimus_ctrl.effects.sensors import LATE, OFFSET
from equimus_ctrl.engines.batch import Trial, simulate
from equimus_ctrl.identification.fit import reduced_simulator, residuals_of
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import free_parameters, unit_of
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.report import diagnosis_text as story
from equimus_ctrl.report.diagnosis_curves import leftover_panel, panels
from equimus_ctrl.report.diagnosis_drawing import finding_figure
from equimus_ctrl.report.diagnosis_figures import diagnosis_figures, summary_figure
from equimus_ctrl.report.diagnosis_page import page
from equimus_ctrl.report.diagnosis_panels import Panel, Scene
from equimus_ctrl.report.diagnosis_sentences import SENTENCES
from equimus_ctrl.report.diagnosis_text import sentence, tell
from equimus_ctrl.report.diagnosis_words import coordinate, estimate_text, number, power_of_ten
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow import load_effects

DRAG = Path(__file__).resolve().parents[1] / "docs" / "examples" / "drag.py"
NOISE = 2e-3
TRUE = 2.8e3
NAMES = ("first", "<b>x", "third")

PLAUSIBLE: dict[str, tuple[tuple[str, ...], dict[str, float]]] = {
    "transport_delay": (("baa",), {"delay": 0.042}),
    "first_order_lag": (("maa",), {"time_constant": 0.16}),
    "asymmetric_lag": (("baa",), {"fill": 0.08, "vent": 0.25}),
    "rate_limit": (("maa",), {"rate": 6e4}),
    "dead_zone": (("maa", "baa"), {"threshold": TRUE}),
    "saturation": (("baa",), {"level": 1.4e4}),
    "supply_coupling": (("maa",), {"share": 0.06}),
    "coulomb_friction": (("maa",), {"friction": 0.21}),
    "stribeck_friction": (("knee",), {"friction": 0.01, "breakaway": 0.012, "velocity": 0.1}),
    "hysteresis": (("maa",), {"size": 0.4, "width": 0.005}),
    "creep": (("maa", "baa"), {"stiffness": 12.0, "time_constant": 1.3}),
    "nonlinear_stiffness": (("baa",), {"cubic": -2e4, "centre": 0.29}),
    "parallel_spring": (("knee",), {"stiffness": 0.12, "rest": 0.4}),
    "joint_stop": (("knee",), {"angle": 0.2, "stiffness": 8.0, "damping": 0.1}),
    "payload_mass": (("foot",), {"mass": 0.08}),
    "gravity_tilt": (("base",), {"angle": 0.09}),
    "sensor_offset": (("hip",), {"offset": -0.05}),
    "sensor_scale": (("knee",), {"scale": 0.96}),
    "sensor_delay": (("hip",), {"delay": 0.031}),
    "backlash": (("hip", "knee"), {"play": 0.011}),
}
SAID = {
    "transport_delay": "Every command reaches baa 42 ms (40 to 44) after it was given",
    "first_order_lag": "The pressure of maa follows its command with a time constant of 160 ms (152 to 168).",
    "asymmetric_lag": "rises with a time constant of 80 ms (76 to 84) and falls with one of 250 ms (238 to 262)",
    "rate_limit": "The pressure of maa changes no faster than 60 kPa/s (57 to 63)",
    "dead_zone": "The valves of maa and baa each lose the first 2.80 kPa (2.66 to 2.94) of every command: a dead zone.",
    "saturation": "The pressure of baa stops rising at 14.0 kPa (13.3 to 14.7)",
    "supply_coupling": "falls by 6.0 % (5.7 to 6.3) of what is asked of the others",
    "coulomb_friction": "Dry friction along maa of 0.210 N (0.199 to 0.221).",
    "stribeck_friction": "Dry friction at the knee of 0.0100 N·m (0.0095 to 0.0105) in fast motion",
    "hysteresis": "a hysteresis of ±0.40 N (0.38 to 0.42) that builds up over 5.0 mm (4.8 to 5.2)",
    "creep": "maa and baa creep: beside the modelled spring 12.0 N/m (11.4 to 12.6) relax",
    "nonlinear_stiffness": "The spring of baa softens away from a length of 290 mm (275 to 304)",
    "parallel_spring": "A spring of 0.120 N·m/rad (0.114 to 0.126) beside the knee",
    "joint_stop": "The lower stop of the knee begins at 11.5° (10.9 to 12.0), not at −2.01°",
    "payload_mass": "At the foot sits a mass of 80 g (76 to 84)",
    "gravity_tilt": "gravity leans by 5.2° (4.9 to 5.4)",
    "sensor_offset": "The measured angle of the hip is 2.86° (2.72 to 3.01) too little",
    "sensor_scale": "The measured angle of the knee is 4 % (−1 to 9) too little",
    "sensor_delay": "The measured angle of the hip is 31.0 ms (29.4 to 32.6) older than its time stamp",
    "backlash": "Between the hip and the knee and their sensors there is a play of 0.63° (0.60 to 0.66).",
}


def part_of(name: str, locations: tuple[str, ...], values: dict[str, float]) -> Part:
    return Part(Candidate(REGISTRY[name], locations, (values,)), values)


def finding_of(part: Part, spread: float = 0.05, evidence: Evidence | None = None) -> Finding:
    whole = replace(nominal_model(), effects=part.effects)
    prefix = whole.effect_prefixes()[0]
    estimates = {
        key: Estimate(value, *sorted((value * (1 - spread), value * (1 + spread))), unit_of(whole, prefix + key))
        for key, value in part.values.items()
    }
    return Finding(part, estimates, evidence or Evidence(812.0, 26.4, -171.3, 205.0, 0.93, 0.91))


def plausible(name: str, spread: float = 0.05) -> Finding:
    return finding_of(part_of(name, *PLAUSIBLE[name]), spread)


def trial(model: Model, index: int) -> Trial:
    """Six seconds of pressures that jump every 1.2 s."""
    rng = np.random.default_rng(index)
    before = np.array([12e3, 6e3])
    times = np.arange(0.0, 6.0, 1 / 60)
    levels = rng.uniform([2e3, 0.0], [34e3, 18e3], (5, 2))
    commands = np.where(times[:, None] < 0.3, before, levels[np.minimum(times / 1.2, 4).astype(int)])
    start = Kinematics(model.morphology).equilibrium(before)
    return Trial(NAMES[index], times, commands, before, 0.0, start, times)


def recorded(model: Model) -> list[Recording]:
    """Three trials of a leg, with noise."""
    trials = [trial(model, k) for k in range(3)]
    rng = np.random.default_rng(7)
    found = []
    for one, predicted in zip(trials, simulate([model], trials, dt=2e-3), strict=True):
        measured = predicted.position[0] + NOISE * rng.standard_normal(predicted.position[0].shape)
        found.append(
            Recording(one.name, one.times, one.commands, measured, ("maa", "baa"), ("hip", "knee"), before=one.before)
        )
    return found


@pytest.fixture(scope="module")
def diagnosis() -> Diagnosis:
    """A leg whose BAA has a dead zone, its parameters and the threshold fitted; found, and something left besides."""
    nominal = nominal_model()
    part = part_of("dead_zone", ("baa",), {"threshold": TRUE})
    recordings = recorded(replace(nominal, effects=part.effects))
    train = tuple(cut(nominal, recordings[:2], fit_start=True))
    heldout = tuple(replace(s, recording=2) for s in cut(nominal, recordings[2:]))
    simulator = reduced_simulator(threads=1)
    data = Data(free_parameters(nominal), list(train), simulator)
    weights = white_noise([np.full((9, 2), NOISE)])
    starts = [s.start for s in train]
    base = data.rough((), [(data.free.start, starts)], weights, 4)
    begin = (np.append(data.free.start, TRUE), starts)
    best = data.rough((part,), [begin], weights, 3)
    models = {"nominal": nominal, "refitted": base.fit.model, "corrected": best.fit.model}
    train_residuals = {
        "nominal": tuple(residuals_of(nominal, train, simulator)),
        "refitted": base.fit.residuals,
        "corrected": best.fit.residuals,
    }
    residuals = {
        state: Residuals(train_residuals[state], tuple(residuals_of(model, heldout, simulator)))
        for state, model in models.items()
    }
    return assembled(nominal, base, best, train, heldout, residuals)


def assembled(
    nominal: Model,
    base: Fitted,
    best: Fitted,
    train: tuple[Segment, ...],
    heldout: tuple[Segment, ...],
    residuals: dict[str, Residuals],
) -> Diagnosis:
    value, width = float(best.fit.theta[-1]), float(best.fit.uncertainty.half_width[-1])
    other = Named("supply_coupling", ("baa",))
    found = Finding(
        best.hypothesis[0],
        {"threshold": Estimate(value, value - width, value + width, "Pa")},
        Evidence(base.deviance - best.deviance, 26.4, -math.inf, 205.0, 0.93, 0.91),
        (other,),
    )
    x = np.linspace(0.9, 1.7, 61)
    left = Leftover(
        "hip", 0.7, "pos.hip·vel.hip", ("hip",), 88.0, 43.2, "N·m·s/rad", "pos.hip", "rad", x, 0.02 * np.sin(9 * x),
        np.full(61, 4e-3),
    )  # fmt: skip
    ranking = [
        Ranked(found.named, 500.0, 812.0),
        Ranked(other, 430.0, 806.0),
        *(Ranked(Named(name, locations), 90.0 / k, None) for k, (name, (locations, _)) in enumerate(PLAUSIBLE.items(), 1)),
    ]  # fmt: skip
    noise = best.noise
    return Diagnosis(
        verdict="partly_explained",
        model=nominal,
        refitted=base.fit.model,
        corrected=best.fit.model,
        base=base,
        best=best,
        train=train,
        heldout=heldout,
        residuals=residuals,
        where=(
            Where(
                "knee", 0.83, "at rest (91% of the excess error in 47% of the samples)", "commands of baa of 0 to 4 kPa"
            ),
            Where("hip", 0.17, "nowhere in particular", "nowhere in particular"),
        ),
        findings=(found,),
        leftover=(left,),
        doubtful=(Named("creep", ("maa",)),),
        ranking=tuple(ranking),
        detectable=(),
        experiment=Experiment("hold", {"p1": 12.0, "p2": 2.5}, (found.named, other), 6.2),
        excess={s: float(excess_of(r.train, noise).mean()) for s, r in residuals.items()},
        notes=("maa.damping ended at a bound & more.",),
        seconds=21.3,
    )


@pytest.fixture(scope="module")
def scene(diagnosis: Diagnosis) -> Scene:
    return Scene.of(diagnosis)


def explained(d: Diagnosis) -> Diagnosis:
    return replace(d, verdict="explained", leftover=(), doubtful=(), notes=())


def unexplained(d: Diagnosis) -> Diagnosis:
    return replace(d, verdict="unexplained", findings=(), experiment=None)


def consistent(d: Diagnosis) -> Diagnosis:
    smallest = (
        Detectable(Named("dead_zone", ("baa",)), "threshold", 61.0, "Pa"),
        Detectable(Named("dead_zone", ("maa", "baa")), "threshold", 50.0, "Pa"),
        Detectable(Named("sensor_scale", ("hip",)), "scale", 2e-3, "1"),
        Detectable(Named("saturation", ("baa",)), "level", math.nan, "Pa"),
    )
    return replace(
        d, verdict="consistent", findings=(), leftover=(), doubtful=(), experiment=None, notes=(), detectable=smallest
    )


VERDICTS = {
    "partly_explained": lambda d: d,
    "explained": explained,
    "unexplained": unexplained,
    "consistent": consistent,
}


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
        (0.5, -math.inf, math.inf, "kg", "500 g (not told by these recordings)"),
        (0.5, 0.4, math.inf, "kg", "500 g (at least 400)"),
        (0.5, -math.inf, 0.6, "kg", "500 g (at most 600)"),
        (2800.0, 2800.0, 2800.0, "Pa", "2.80 kPa (sure to all digits shown)"),
        (2800.0, 2799.99999, 2800.00001, "Pa", "2.8000 kPa (sure to all digits shown)"),
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
        ("something.else", "something.else"),
    ],
)
def test_coordinates_are_told_in_words(given: str, told: str) -> None:
    assert coordinate(given) == told


# Sentences


def test_every_effect_of_the_catalogue_has_a_sentence_and_a_case_here() -> None:
    assert set(REGISTRY) == set(PLAUSIBLE) == set(SENTENCES) == set(SAID)


@pytest.mark.parametrize("name", sorted(PLAUSIBLE))
def test_the_sentence_of_an_effect_gives_its_numbers(name: str) -> None:
    text = sentence(plausible(name), nominal_model())
    assert SAID[name] in text
    assert text.endswith(".") and "_" not in text and "nan" not in text


def test_an_effect_of_ones_own_is_told_by_its_summary_and_numbers() -> None:
    load_effects([DRAG])
    drag = finding_of(part_of("quadratic_drag", ("knee",), {"coefficient": 0.02}))
    assert sentence(drag, nominal_model()) == (
        "Drag that grows with the square of the speed, at knee: coefficient (torque at 1 rad/s) 0.0200 N·m·s²/rad² "
        "(0.0190 to 0.0210)."
    )


# Curves


def curve(panel: Panel, without: bool = False) -> tuple[Array, Array]:
    line = next(line for line in panel.lines if line.without == without)
    return line.x, line.y


@pytest.mark.parametrize("name", sorted(PLAUSIBLE))
def test_the_figure_of_every_effect_can_be_drawn(scene: Scene, name: str) -> None:
    finding = plausible(name)
    shown = panels(scene, finding)
    assert shown
    for panel in shown:
        assert panel.rows or len(panel.lines) == 2
        for line in panel.lines:
            assert np.all(np.isfinite(line.x)) and np.isfinite(line.y).any()
    finding_figure(scene, finding).canvas.draw()


@pytest.mark.parametrize("name", sorted(PLAUSIBLE))
def test_a_curve_lies_within_its_band_or_there_is_none(scene: Scene, name: str) -> None:
    bands = [panel for panel in panels(scene, plausible(name, 0.3)) if panel.band is not None]
    assert bands
    for panel in bands:
        _, y = curve(panel)
        assert panel.band is not None
        _, low, high = panel.band
        assert np.all(low <= y + 1e-12) and np.all(y <= high + 1e-12)
    for panel in panels(scene, plausible(name, 0.0)):
        assert panel.band is None


def test_the_curve_of_ones_own_effect_is_its_law(scene: Scene) -> None:
    load_effects([DRAG])
    finding = finding_of(part_of("quadratic_drag", ("knee",), {"coefficient": 0.02}))
    (panel,) = panels(scene, finding)
    rate, torque = curve(panel)
    assert "[°/s]" in panel.x and panel.y == "torque [N·m]"
    np.testing.assert_allclose(torque, -0.02 * np.radians(rate) * np.abs(np.radians(rate)), atol=1e-9)
    finding_figure(scene, finding).canvas.draw()


def own_effects() -> list[Finding]:
    """Effects of a user's that are unlike those of the catalogue."""

    @register
    @dataclass(frozen=True)
    class Squared(ShapingEffect):
        name = "squared"
        summary = "a valve that is not linear"
        order = 5
        bend: float = parameter("1", 0.0, 1.0, "how far")

        def shape(self, commands: Array, own: int) -> Array:
            return np.asarray(commands[:, own] * (1 - self.bend * commands[:, own] / 1e5))

    @register
    @dataclass(frozen=True)
    class Heavy(BodyEffect):
        name = "heavy"
        sits_at = ("link",)
        summary = "more inertia"
        factor: float = parameter("1", 1.0, 10.0, "of the inertia")

        def changes(self, robot: Robot) -> dict[str, float]:
            return {f"{self.location}.inertia": self.factor * robot.link(self.location).inertia}

    @register
    @dataclass(frozen=True)
    class Spot(ForceEffect):
        name = "spot"
        sits_at = ("joint",)
        summary = "a rough spot"
        neutral = {"friction": 0.0}  # noqa: RUF012
        friction: float = parameter("N·m", 0.0, 1.0, "at most")
        centre: float = parameter("rad", -4.0, 4.0, "where")

        @classmethod
        def dry_friction(cls, x, speed, p):
            return p["friction"] * ca.exp(-(((x - p["centre"]) / 0.1) ** 2))

    @register
    @dataclass(frozen=True)
    class Noisy(SensorEffect):
        name = "noisy"
        summary = "late and off"
        late: float = parameter("s", 0.0, 1.0, "age")

        def apply(self, sensor: Array) -> None:
            sensor[LATE], sensor[OFFSET] = self.late, 0.01

    cases = {"squared": ("maa", {"bend": 0.5}), "heavy": ("calf", {"factor": 3.0}),
             "spot": ("hip", {"friction": 0.05, "centre": 1.5}), "noisy": ("knee", {"late": 0.03})}  # fmt: skip
    return [finding_of(part_of(name, (place,), values)) for name, (place, values) in cases.items()]


def test_effects_of_ones_own_of_every_kind_are_drawn(diagnosis: Diagnosis, scene: Scene) -> None:
    titles = {}
    for finding in own_effects():
        shown = panels(scene, finding)
        titles[finding.named.effect] = [panel.title.split(",")[0] for panel in shown]
        finding_figure(scene, finding).canvas.draw()
        summary_figure(replace(diagnosis, findings=(finding,)), scene).canvas.draw()
        assert sentence(finding, nominal_model()).startswith(finding.part.candidate.effect.summary.capitalize())
    assert titles["squared"][0] == "once it has settled"
    assert titles["heavy"] == ["numbers of the robot"]
    assert titles["spot"][0] == "to and fro"
    assert len(titles["noisy"]) == 4


def test_a_dead_zone_and_a_saturation_as_static_maps(scene: Scene) -> None:
    command, pressure = curve(panels(scene, plausible("dead_zone"))[0])
    np.testing.assert_allclose(pressure, np.maximum(command - 2.8, 0.0), atol=1e-12)
    command, pressure = curve(panels(scene, plausible("saturation"))[0])
    np.testing.assert_allclose(pressure, np.minimum(command, 14.0), atol=1e-12)


def test_a_lag_has_risen_by_63_percent_after_its_time_constant(scene: Scene) -> None:
    (panel,) = panels(scene, plausible("first_order_lag"))
    time, pressure = curve(panel)
    risen = (np.interp(0.16, time, pressure) - pressure[0]) / (pressure.max() - pressure[0])
    assert panel.x == "time [s]"
    assert risen == pytest.approx(1 - math.exp(-1), abs=0.005)


def test_a_delay_shifts_the_step(scene: Scene) -> None:
    (panel,) = panels(scene, plausible("transport_delay"))
    (_, pressure), (_, before) = curve(panel), curve(panel, without=True)
    assert panel.x == "time [ms]"
    np.testing.assert_allclose(pressure[42:], before[:-42], atol=1e-9)


def test_creep_relaxes_with_its_time_constant(scene: Scene) -> None:
    _, panel = panels(scene, plausible("creep"))
    time, force = curve(panel)
    early, late = (float(np.interp(t, time, force)) for t in (0.5, 1.8))
    assert late / early == pytest.approx(math.exp(-1), abs=1e-3)


def test_hysteresis_takes_work_in_a_loop_between_its_sizes(scene: Scene) -> None:
    loop = panels(scene, plausible("hysteresis"))[0]
    length, force = curve(loop)
    assert np.abs(force).max() == pytest.approx(0.4 * math.tanh(np.ptp(length) / 10.0), rel=1e-3)  # width 5 mm
    assert np.sum((force[1:] + force[:-1]) / 2 * np.diff(length)) < 0  # what it does to the motion


def test_friction_changes_its_sign_with_the_speed(scene: Scene) -> None:
    panel = panels(scene, plausible("stribeck_friction"))[0]
    speed, torque = curve(panel)
    rate = np.radians(np.abs(speed))
    np.testing.assert_allclose(torque, -np.sign(speed) * (0.01 + 0.012 / (1 + (rate / 0.1) ** 2)), atol=1e-6)
    assert panel.data is not None


def test_a_stop_is_a_spring_from_its_angle_on(scene: Scene) -> None:
    panel, table = panels(scene, plausible("joint_stop"))
    angle, torque = curve(panel)
    np.testing.assert_allclose(torque, 8.0 * np.maximum(0.2 - np.radians(angle), 0.0), atol=1e-9)
    assert ("knee.lower.angle", "−2.01 → 11.5°") in table.rows


def test_a_payload_weighs_at_the_foot(scene: Scene) -> None:
    hip = next(p for p in panels(scene, plausible("payload_mass")) if p.title == "gravity at the hip")
    (angle, torque), (_, before) = curve(hip), curve(hip, without=True)
    knee = float(np.median(scene.angles[:, 1]))
    first, both = np.radians(angle), np.radians(angle) + knee
    lever = 0.25 * np.cos(first) + 0.25 * np.cos(both)
    np.testing.assert_allclose(torque - before, 0.08 * 9.8 * lever, atol=1e-9)


def test_sensors_show_what_their_laws_say(scene: Scene) -> None:
    error, _ = panels(scene, plausible("sensor_scale"))
    true, wrong = curve(error)
    np.testing.assert_allclose(wrong, -0.04 * true, atol=1e-9)
    time, shown = curve(panels(scene, plausible("sensor_delay"))[0])
    _, prompt = curve(panels(scene, plausible("sensor_delay"))[0], without=True)
    assert time[np.argmax(shown)] - time[np.argmax(prompt)] == pytest.approx(31.0, abs=0.5)
    _, played = curve(panels(scene, plausible("backlash"))[0])
    _, free = curve(panels(scene, plausible("backlash"))[0], without=True)
    assert free.max() - played.max() == pytest.approx(np.degrees(0.011) / 2, rel=1e-2)


def test_what_is_already_in_the_model_is_drawn_beside_the_finding(diagnosis: Diagnosis) -> None:
    lagging = replace(diagnosis.model, effects=(make("first_order_lag", "baa", {"time_constant": 0.1}),))
    scene = replace(Scene.of(diagnosis), model=lagging)
    _, moving = panels(scene, finding_of(part_of("dead_zone", ("baa",), {"threshold": TRUE})))
    time, before = curve(moving, without=True)
    after_one = 0.1 * (1e3 if "[ms]" in moving.x else 1.0)
    risen = (np.interp(after_one, time, before) - before[0]) / (before.max() - before[0])
    assert risen == pytest.approx(1 - math.exp(-1), abs=0.02)


def test_something_left_over_is_a_curve_with_a_band(diagnosis: Diagnosis, scene: Scene) -> None:
    left = diagnosis.leftover[0]
    panel = leftover_panel(scene, left)
    assert panel is not None and panel.band is not None and panel.data is not None
    x, y = curve(panel)
    np.testing.assert_allclose(x, np.degrees(left.x))
    np.testing.assert_allclose(y, left.push)
    np.testing.assert_allclose(panel.band[2] - y, left.band)
    assert leftover_panel(scene, replace(left, axis="", x=np.empty(0), push=np.empty(0), band=np.empty(0))) is None


@pytest.mark.parametrize("axis", ["vel.knee", "cmd.maa", "cmd.maa−cmd.baa", "len.baa", "time", "rate.maa"])
def test_a_push_over_any_coordinate_can_be_drawn(diagnosis: Diagnosis, scene: Scene, axis: str) -> None:
    panel = leftover_panel(scene, replace(diagnosis.leftover[0], axis=axis, axis_unit="furlong"))
    assert panel is not None
    assert (panel.data is None) == (axis == "rate.maa")


# Figures and page


@pytest.mark.parametrize("verdict", VERDICTS)
def test_all_figures_of_every_verdict_can_be_drawn(diagnosis: Diagnosis, verdict: str) -> None:
    d = VERDICTS[verdict](diagnosis)
    figures = diagnosis_figures(d)
    expected = {"summary", "before_after", "residuals", "ranking"}
    expected |= {"finding_1"} if d.findings else set()
    expected |= {"unexplained_1"} if d.leftover else set()
    assert set(figures) == expected
    for figure in figures.values():
        figure.canvas.draw()


def test_figures_without_held_out_trials_show_those_fitted(diagnosis: Diagnosis) -> None:
    residuals = {state: replace(r, heldout=()) for state, r in diagnosis.residuals.items()}
    d = replace(diagnosis, heldout=(), residuals=residuals)
    figures = diagnosis_figures(d)
    texts = [t.get_text() for axes in figures["before_after"].axes for t in (axes.title, axes._left_title)]
    assert any("first (fitted)" in text for text in texts)
    assert story.heldout(d) == ""
    assert "trials that were fitted" in page(d, "no judges")


class Checker(HTMLParser):
    """Whether tags match; what is linked, shown and named."""

    VOID = ("meta", "img", "br")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text.append(data)


def checked(text: str) -> Checker:
    checker = Checker()
    checker.feed(text)
    checker.close()
    assert checker.open == []
    return checker


def test_the_page_is_whole_and_needs_nothing_else(diagnosis: Diagnosis) -> None:
    text = page(diagnosis, "Leg & <i>co</i>", 'equimus-ctrl diagnose "<my> recordings"')
    found = checked(text)
    assert text.startswith("<!DOCTYPE html>")
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    tags = {tag for tag, _ in found.seen}
    assert not tags & {"script", "link", "iframe", "object", "b", "i"}
    pictures = [attrs for tag, attrs in found.seen if tag == "img"]
    assert len(pictures) == 6
    for attrs in pictures:
        assert str(attrs["src"]).startswith("data:image/png;base64,") and attrs["alt"]
    ids = [attrs["id"] for _, attrs in found.seen if "id" in attrs]
    links = [str(attrs["href"]) for tag, attrs in found.seen if tag == "a"]
    assert [f"#{name}" for name in ids] == links and len(ids) == len(set(ids)) == 10
    said = " ".join(found.text)
    assert "<b>x" in said and "Leg & <i>co</i>" in said and '"<my> recordings"' in said
    for one in diagnosis.findings:
        assert sentence(one, diagnosis.model) in said
        assert estimate_text(one.parameters["threshold"]) in said
    for word in ("supply coupling at baa", "equimus-ctrl run hold --set p1=12 --set p2=2.5", "creep at maa", "21.3 s"):
        assert word in said
    assert "up to 0.020 N·m·s/rad (0.016 to 0.024)" in said
    assert "maa.damping ended at a bound & more." in said


def test_a_consistent_page_tells_what_would_have_shown(diagnosis: Diagnosis) -> None:
    said = " ".join(checked(page(consistent(diagnosis), "Leg")).text)
    assert "Consistent" in said
    assert "0.061 kPa at baa" in said and "1 ± 0.0020 at hip" in said and "no size that was tried at baa" in said
    assert "corrected" not in said and "What the model leaves out" not in said


# Terminal


def told(diagnosis: Diagnosis, width: int = 100) -> str:
    console = Console(width=width, record=True, file=io.StringIO(), highlight=False)
    tell(console, diagnosis)
    return console.export_text()


@pytest.mark.parametrize("verdict", VERDICTS)
@pytest.mark.parametrize("width", [60, 100])
def test_the_terminal_is_told_every_verdict(diagnosis: Diagnosis, verdict: str, width: int) -> None:
    d = VERDICTS[verdict](diagnosis)
    lines = told(d, width).splitlines()
    text = " ".join(line.strip() for line in lines)
    assert len(lines) <= (60 if width == 100 else 90)
    assert max(map(len, lines)) <= width
    assert story.verdict(d) in text
    for one in d.findings:
        assert sentence(one, d.model) in text
    assert ("held out the error changes by" in text or "the trial held out the error" in text) == bool(d.findings)
    assert ("Where the refitted model is off" in text) == (verdict != "consistent")
    assert ("What remains unexplained" in text) == bool(d.leftover)
    assert ("equimus-ctrl run hold --set p1=12 --set p2=2.5" in text) == (d.experiment is not None)
    assert ("0.061 kPa at baa" in text) == (verdict == "consistent")


def test_names_are_not_taken_for_markup(diagnosis: Diagnosis) -> None:
    d = replace(diagnosis, notes=("[red]as it is[/red]", "[/nothing]"))
    assert "[red]as it is[/red]" in told(d)


def test_the_fall_on_held_out_trials_is_that_of_the_rmse(diagnosis: Diagnosis) -> None:
    before, after = (diagnosis.rmse(s, "heldout")[1] for s in ("refitted", "corrected"))
    change = round(100 * (1 - after / before))
    assert f"−{change} % at the knee" in story.heldout(diagnosis)
