"""The inverse of a model: against the equations it inverts, and by how well a known robot follows."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from effect_cases import CASES
from test_closed_loop import EVERYWHERE, Watched

import equimus_ctrl as eq
from equimus_ctrl.controllers.inverse import SMOOTHING, Inverse
from equimus_ctrl.controllers.pid_kernel import blend
from equimus_ctrl.effects import Effect, make
from equimus_ctrl.effects.base import catalogue
from equimus_ctrl.effects.force import ForceEffect, force_laws
from equimus_ctrl.effects.valves import command_for, shaped_commands, useful_commands
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.loop import run
from equimus_ctrl.models.augmented import augmented_model, law_parameters
from equimus_ctrl.models.inverse import inverse_dynamics
from equimus_ctrl.robots.elastic.morphology import pack, structure
from equimus_ctrl.types import Array

LEG = eq.nominal_leg()
DT = 1 / 120
PID = eq.PidSettings({"maa": eq.PidGains(500.0, 300.0, 8.0), "baa": eq.PidGains(120.0, 90.0, 4.0)}, inverse=True)
RUBBING = ("coulomb_friction", "stribeck_friction")


def sway(time: float) -> Array:
    """Both joints well inside the workspace, with pressures well inside the range."""
    return np.array([1.45 + 0.08 * np.sin(1.8 * time), 0.45 + 0.12 * np.sin(2.5 * time + 1.0)])


SWAY = eq.FunctionReference(sway)
START = eq.Start(command=np.array([12e3, 8e3]))


# The equations.


@pytest.mark.parametrize("phase", ["swing", "stance"])
@pytest.mark.parametrize("laws", [(), force_laws()], ids=["plain", "all laws"])
def test_the_pressures_make_the_motion(
    laws: tuple[type[ForceEffect], ...], phase: eq.robots.elastic.morphology.Phase
) -> None:
    """Put into the equations of motion, with dry friction that slides, they give the accelerations asked for."""
    m = augmented_model(structure(LEG), phase, laws)
    law = inverse_dynamics(structure(LEG), phase, laws)
    bound = ca.Function("bound", [m.q, m.v, m.v0, m.p], [m.bound, m.rows])
    motion = ca.Function("motion", [m.q, m.v, m.z, m.pressure, m.phi, m.p], [m.acceleration])
    effects = [e for e in EVERYWHERE if isinstance(e, ForceEffect) and type(e) in laws]
    p = np.array([*pack(LEG), *law_parameters(m.slots, effects, LEG.joint_names, LEG.actuator_names)])
    rng = np.random.default_rng(5)
    for _ in range(20):
        q, v, a = rng.uniform([1.0, 0.2], [1.9, 1.2]), rng.uniform(0.3, 2.0, 2), rng.normal(0, 20, 2)
        v *= rng.choice([-1.0, 1.0], 2)
        z = rng.normal(0, 0.1, m.z.numel())
        size, rows = (np.array(x).ravel() for x in bound(q, v, v, p))
        if np.any(np.abs(rows) < 0.02):
            continue
        pressure = law.pressure(q, v, a, z, p)
        found = np.array(motion(q, v, z, pressure, -size * np.sign(rows), p)).ravel()
        np.testing.assert_allclose(found, a, rtol=1e-5, atol=1e-5)


def test_the_states_end_where_they_rest() -> None:
    laws = force_laws()
    m, law = augmented_model(structure(LEG), "swing", laws), inverse_dynamics(structure(LEG), "swing", laws)
    p = np.array([*pack(LEG), *law_parameters(m.slots, EVERYWHERE, LEG.joint_names, LEG.actuator_names)])
    q, still = np.array([1.4, 0.5]), np.zeros(2)
    z = np.array(law.rest([1.3, 0.6], p)).ravel()
    rate = ca.Function("rate", [m.q, m.v, m.z, m.p], [m.z_rate])
    one = np.array(law.advanced(q, [0.1, 0.2], z, p, 1e-6)).ravel()
    np.testing.assert_allclose((one - z) / 1e-6, np.array(rate(q, [0.1, 0.2], z, p)).ravel(), rtol=1e-3, atol=1e-4)
    creeping = [s.law.name for s in m.slots for _ in range(s.law.n_states)].index("creep")
    for _ in range(2000):
        z = np.array(law.advanced(q, still, z, p, 0.05)).ravel()
    assert np.all(np.isfinite(z))
    assert z[creeping + 1] == pytest.approx(np.array(law.rest(q, p)).ravel()[creeping + 1], abs=1e-9)


# Valves.

SHAPING = (
    make("dead_zone", "maa", {"threshold": 3e3}),
    make("supply_coupling", "baa", {"share": 0.1}),
    make("saturation", "baa", {"level": 2e4}),
)
NAMES = LEG.actuator_names


def test_commands_undo_shaping() -> None:
    pressure = np.random.default_rng(0).uniform(100.0, 19e3, (40, 2))
    command = command_for(SHAPING, NAMES, pressure, 0.0, 5e4)
    np.testing.assert_allclose(shaped_commands(SHAPING, NAMES, command), pressure, atol=1e-3)
    np.testing.assert_array_equal(command_for((), NAMES, pressure, 0.0, 1e3), pressure)


def test_a_jump_is_taken_on_the_nearer_side() -> None:
    cutoff = (make("cutoff", "maa", {"least": 2e3}),)
    pressure = np.array([[100.0, 5e3], [1.9e3, 5e3], [2.1e3, 5e3]])
    command = command_for(cutoff, NAMES, pressure, 0.0, 5e4)
    left = shaped_commands(cutoff, NAMES, command)
    np.testing.assert_allclose(left[[0, 2]], pressure[[0, 2]], atol=101.0)
    assert abs(left[1, 0] - 1.9e3) <= 1.9e3
    low, _ = useful_commands(cutoff, NAMES, 0.0, 5e4)
    assert low[0] == pytest.approx(2e3) and shaped_commands(cutoff, NAMES, low[None])[0, 0] == 0.0


def test_the_range_of_use_is_where_commands_make_a_difference() -> None:
    low, high = useful_commands(SHAPING, NAMES, 0.0, 5e4)
    np.testing.assert_allclose(low, [3e3, 0.0], atol=1e-6)
    np.testing.assert_allclose(high, [5e4, 2e4], atol=1e-6)
    low, high = useful_commands((make("saturation", "maa", {"level": 0.0}),), NAMES, 0.0, 5e4)
    assert np.all(low <= high)


# Following.


def followed(model: eq.Model, settings: eq.PidSettings = PID, nominal: eq.Model | None = None) -> float:
    """Largest error of the true angles once the path is reached [rad]."""
    plant = Watched(eq.MujocoPlant(model, nominal=nominal))
    n = 360
    done = run(plant, eq.PidController(settings), SWAY, n * DT, start=START)
    return float(np.abs(np.array(plant.position[:n]) - done.reference)[120:].max())


KNOWN: dict[str, tuple[Effect, ...]] = {
    "nothing": (),
    "late valves": (make("transport_delay", "baa", {"delay": 0.07}), make("transport_delay", "maa", {"delay": 0.013})),
    "a lag": (make("first_order_lag", "maa", {"time_constant": 0.15}),),
    "two lags": (make("asymmetric_lag", "baa", {"fill": 0.05, "vent": 0.2}),),
    "shaped commands": (
        make("dead_zone", "maa", {"threshold": 3e3}),
        make("supply_coupling", "baa", {"share": 0.1}),
    ),
    "springs": (
        make("parallel_spring", "hip", {"stiffness": 0.4, "rest": 1.2}),
        make("nonlinear_stiffness", "baa", {"cubic": 2e4, "centre": 0.28}),
    ),
    "areas": (make("narrowing_area", "maa", {"loss": 1.0}), make("narrowing_area", "baa", {"loss": 0.4})),
    "states": (
        make("creep", "maa", {"stiffness": 60.0, "time_constant": 0.4}),
        make("hysteresis", "baa", {"size": 0.6, "width": 0.01}),
    ),
    "dry friction": (make("coulomb_friction", "hip", {"friction": 0.05}),),
    "bodies": (make("payload_mass", "foot", {"mass": 0.03}), make("gravity_tilt", "base", {"angle": 0.03})),
    "sensors": (
        make("sensor_offset", "hip", {"offset": 0.1}),
        make("sensor_scale", "knee", {"scale": 0.9}),
        make("sensor_delay", "hip", {"delay": 0.05}),
    ),
    "play": (make("backlash", "knee", {"play": 0.02}),),
}
KINKED = {"two lags": 1e-3, "states": 2e-3, "dry friction": 6e-3, "play": 2e-3}
"""What is not smooth is not followed as well, largest error [rad]; all else within 0.4 mrad."""


@pytest.mark.parametrize(
    ("name", "space"), [*((name, "length") for name in KNOWN), ("late valves", "joint"), ("sensors", "joint")]
)
def test_what_is_known_is_no_obstacle(name: str, space: str) -> None:
    """In MuJoCo a robot follows closely where all its effects are known, and much worse where they are not."""
    joint = eq.PidSettings(
        {"hip": eq.PidGains(3.0, 3.0, 0.1), "knee": eq.PidGains(1.0, 1.0, 0.05)}, "joint", inverse=True
    )
    settings = PID if space == "length" else joint
    model = eq.Model(LEG, KNOWN[name])
    error = followed(model, settings)
    assert error < KINKED.get(name, 4e-4)
    if name == "nothing":
        assert followed(model, replace(settings, inverse=False)) > 20 * error
    else:
        assert followed(model, settings, eq.Model(LEG)) > 2.5 * error


def test_every_effect_has_its_place_in_the_inverse() -> None:
    """All at once, those with kinks and those that cannot be undone left out."""
    left_out = ("coulomb_friction", "hysteresis", "rate_limit", "backlash", "asymmetric_lag")
    effects = tuple(e for e in EVERYWHERE if e.name not in left_out)
    assert len(effects) >= 10
    model = eq.Model(LEG, effects)
    assert followed(model) < 1e-3 < 0.1 * followed(model, nominal=eq.Model(LEG))


def test_the_course_is_the_same_taken_at_once_or_step_by_step() -> None:
    inverse = Inverse(eq.Model(LEG, EVERYWHERE), DT, 0.3)
    first = inverse.start(0.0, np.array([1.4, 0.6]))
    times = np.arange(90) * DT
    shown, command, last = inverse.follow(SWAY, times, times, first)
    course = first
    for k, time in enumerate(times):
        seen, fed, course = inverse.follow(SWAY, np.array([time]), np.array([time]), course)
        np.testing.assert_allclose(seen[0], shown[k], rtol=0, atol=1e-12)
        np.testing.assert_allclose(fed[0], command[k], rtol=1e-9)
    np.testing.assert_allclose(course.states, last.states, rtol=1e-9)
    np.testing.assert_allclose(course.held, last.held, rtol=1e-12)
    late, last = inverse.later(SWAY, times, first, 0.7)
    assert np.abs(late - shown).max() > 0.01
    for k, time in enumerate(times):
        seen, course = inverse.later(SWAY, np.array([time]), course, 0.7)
        np.testing.assert_allclose(seen[0], late[k], rtol=0, atol=1e-12)
    np.testing.assert_allclose(course.held_late, last.held_late, rtol=1e-12)


def test_what_sensors_show_is_what_they_make_of_the_reference() -> None:
    effects = (
        make("sensor_offset", "hip", {"offset": 0.1}),
        make("sensor_scale", "knee", {"scale": 0.8}),
        make("sensor_delay", "knee", {"delay": 0.04}),
        make("backlash", "hip", {"play": 0.02}),
    )
    inverse = Inverse(eq.Model(LEG, effects), DT, 0.3)
    measured = np.array([1.5, 0.4])
    course = inverse.start(0.0, measured)
    np.testing.assert_allclose(course.pose, [1.4, 0.5])
    instants = np.array([0.0, 0.2, 2.0])
    shown, _, _ = inverse.follow(SWAY, instants, instants, course)
    np.testing.assert_allclose(shown[0], measured)
    weight = blend(0.16, 0.3)
    np.testing.assert_allclose(shown[1, 1], 0.8 * ((1 - weight) * sway(0.16)[1] + weight * 0.5))
    np.testing.assert_allclose(shown[2, 1], 0.8 * sway(1.96)[1])
    assert abs(shown[2, 0] - 0.1 - sway(2.0)[0]) == pytest.approx(0.01)


@pytest.mark.parametrize("name", ["nothing", "shaped commands", "springs", "bodies"])
def test_where_it_rests_it_stays(name: str) -> None:
    """No bump: the first command leaves the pressures that are in force, whatever is attached."""
    model = eq.Model(LEG, KNOWN[name])
    command = np.array([14e3, 9e3])
    pose = rest_pose(model, command)
    inverse = Inverse(model, DT, 0.3)
    course = inverse.start(0.0, pose)
    np.testing.assert_allclose(inverse.hold(course), command, atol=1e-3)
    np.testing.assert_allclose(inverse.surplus(course, command), 0.0, atol=1e-3)
    plant = eq.MujocoPlant(model)
    done = run(plant, eq.PidController(PID), eq.HoldReference(pose), 0.5, start=eq.Start(command=command))
    np.testing.assert_allclose(done.command, np.tile(command, (60, 1)), atol=5.0)
    np.testing.assert_allclose(done.position, np.tile(pose, (60, 1)), atol=2e-5)


def test_a_reference_that_jumps_is_smoothed() -> None:
    """Only so close to the jump do commands differ from those that hold the two poses."""
    before, after = np.array([1.40, 0.50]), np.array([1.45, 0.45])
    jump = eq.FunctionReference(lambda time: before if time < 1.0 else after)
    inverse = Inverse(eq.Model(LEG), DT, 0.0)
    times = np.arange(240) * DT
    _, command, _ = inverse.follow(jump, times, times, inverse.start(0.0, before))
    holds = [inverse.hold(inverse.start(0.0, pose)) for pose in (before, after)]
    far = np.abs(times + DT / 2 - 1.0) > SMOOTHING + 1e-9
    np.testing.assert_allclose(command[far], np.where(times[far, None] < 1.0, *holds), rtol=1e-9)
    assert np.all((command >= 0) & (command <= 5e4))


def test_commands_of_no_use_are_not_given() -> None:
    """Above a saturation and within a dead zone nothing changes: the integral is not to wind up there."""
    effects = (make("saturation", "maa", {"level": 1e4}), make("dead_zone", "baa", {"threshold": 2e3}))
    plant = eq.MujocoPlant(eq.Model(LEG, effects))
    far = eq.HoldReference([1.8, 0.9])  # would take 38 and -10 kPa
    done = run(plant, eq.PidController(PID), far, 2.0)
    assert done.command[:, 0].max() == pytest.approx(1e4)
    assert done.command[:, 1].min() == pytest.approx(2e3)


def test_the_catalogue_s_pushes_are_all_tried() -> None:
    names = {e.name for own in KNOWN.values() for e in own}
    pushing = {name for name, cls in catalogue("elastic").items() if cls.__module__.startswith("equimus_ctrl.")} - names
    assert pushing == {name for name, case in CASES.items() if not case.inverted}
