"""The curves of a finding against the laws of its effect."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from diagnosed_leg import DRAG, PLAUSIBLE, TRUE, finding_of, part_of, plausible

from equimus_ctrl.diagnosis.coordinates import read
from equimus_ctrl.diagnosis.results import Diagnosis, Finding
from equimus_ctrl.effects import BodyEffect, ForceEffect, SensorEffect, ShapingEffect, make, parameter, register
from equimus_ctrl.effects.bodies import Robot
from equimus_ctrl.effects.sensors import OFFSET, SENSOR_DELAY
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.report.diagnosis_curves import panels, unexplained_panel
from equimus_ctrl.report.diagnosis_drawing import finding_figure
from equimus_ctrl.report.diagnosis_figures import summary_figure
from equimus_ctrl.report.diagnosis_panels import Panel, Scene
from equimus_ctrl.report.diagnosis_text import Law, sentence
from equimus_ctrl.types import Array
from equimus_ctrl.workflow import load_plugins


def curve(panel: Panel, without: bool = False) -> tuple[Array, Array]:
    line = next(line for line in panel.lines if line.without == without)
    return line.x, line.y


DRAWN = ("coulomb_friction", "dead_zone", "first_order_lag", "payload_mass", "sensor_scale")
"""One of each kind of panel; drawing takes most of the time."""


@pytest.mark.parametrize("name", sorted(PLAUSIBLE))
def test_the_figure_of_every_effect_can_be_drawn(scene: Scene, name: str) -> None:
    finding = plausible(name)
    shown = panels(scene, finding)
    assert shown
    for panel in shown:
        assert panel.rows or len(panel.lines) == 2
        for line in panel.lines:
            assert np.all(np.isfinite(line.x)) and np.isfinite(line.y).any()
    figure = finding_figure(scene, Law((finding,), 0))
    if name in DRAWN:
        figure.canvas.draw()


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
    load_plugins([DRAG])
    finding = finding_of(part_of("quadratic_drag", ("knee",), {"coefficient": 0.02}))
    (panel,) = panels(scene, finding)
    rate, torque = curve(panel)
    assert "[°/s]" in panel.x and panel.y == "torque [N·m]"
    np.testing.assert_allclose(torque, -0.02 * np.radians(rate) * np.abs(np.radians(rate)), atol=1e-9)
    finding_figure(scene, Law((finding,), 0)).canvas.draw()


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
            sensor[SENSOR_DELAY], sensor[OFFSET] = self.late, 0.01

    cases = {"squared": ("maa", {"bend": 0.5}), "heavy": ("calf", {"factor": 3.0}),
             "spot": ("hip", {"friction": 0.05, "centre": 1.5}), "noisy": ("knee", {"late": 0.03})}  # fmt: skip
    return [finding_of(part_of(name, (place,), values)) for name, (place, values) in cases.items()]


@pytest.mark.slow
def test_effects_of_ones_own_of_every_kind_are_drawn(diagnosis: Diagnosis, scene: Scene) -> None:
    titles = {}
    for finding in own_effects():
        shown = panels(scene, finding)
        titles[finding.named.effect] = [panel.title.split(",")[0] for panel in shown]
        finding_figure(scene, Law((finding,), 0)).canvas.draw()
        summary_figure(replace(diagnosis, findings=(finding,)), scene).canvas.draw()
        assert sentence(finding, nominal_model()).startswith(finding.part.candidate.effect.summary.capitalize())
    assert titles["squared"][0] == "once it has settled"
    assert titles["heavy"] == ["parameters of the robot"]
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


def test_a_residual_force_is_a_curve_with_a_band(diagnosis: Diagnosis, scene: Scene) -> None:
    left = diagnosis.unexplained[0]
    panel = unexplained_panel(scene, left)
    assert panel is not None and panel.band is not None and panel.data is not None
    x, y = curve(panel)
    np.testing.assert_allclose(x, np.degrees(left.x))
    np.testing.assert_allclose(y, left.force)
    np.testing.assert_allclose(panel.band[2] - y, left.band)
    assert (
        unexplained_panel(scene, replace(left, axis=None, x=np.empty(0), force=np.empty(0), band=np.empty(0))) is None
    )


@pytest.mark.parametrize("axis", ["vel.knee", "cmd.maa", "cmd.maa−cmd.baa", "len.baa", "time", "rate.maa"])
def test_a_residual_force_over_any_coordinate_can_be_drawn(diagnosis: Diagnosis, scene: Scene, axis: str) -> None:
    panel = unexplained_panel(scene, replace(diagnosis.unexplained[0], axis=read(axis)[0], axis_unit="furlong"))
    assert panel is not None
    assert (panel.data is None) == (axis == "rate.maa")
