"""Recorded forces of drives as measurements beside joint positions, against MuJoCo stepped by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjcf_models import refusal
from pendulum_runs import MOTOR, PENDULUM

from equimus_ctrl import recordings, workflow
from equimus_ctrl.diagnosis import plausibility
from equimus_ctrl.diagnosis.linear_response import linearise
from equimus_ctrl.diagnosis.observed import observed
from equimus_ctrl.effects import (
    ActuatorGain,
    CoulombFriction,
    DriveCompliance,
    Effect,
    FirstOrderLag,
    SensorDelay,
    SensorOffset,
    TorqueSaturation,
    TransportDelay,
)
from equimus_ctrl.effects.command import DELAY, FILL, VENT
from equimus_ctrl.effects.following import FILTERED, FOLLOW_KIND, FOLLOW_NUMBER, arrived
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.mjcf_inverse import InverseDynamics, MeasuredMotion
from equimus_ctrl.engines.mjcf_motion import simulated_response
from equimus_ctrl.engines.motion import motion
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.channels import Channels, channels_of, unused, with_channels
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.checks import LEG, RecordingWarning
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

MANY = """<mujoco model="many"><compiler angle="radian"/><option timestep="0.001" integrator="RK4"/><worldbody>
  <body name="arm"><joint name="hinge" axis="0 -1 0" armature="0.05" damping="0.3" actuatorfrcrange="-3 3"/>
  <inertial pos="0 0 -0.3" mass="1.5" diaginertia="0.02 0.02 0.01"/></body></worldbody>
  <tendon><fixed name="cable"><joint joint="hinge" coef="0.5"/></fixed></tendon>
  <actuator>
    <motor name="plain" joint="hinge" gear="3" forcerange="-0.3 0.3"/>
    <dcmotor name="dc" joint="hinge" motorconst="0.5" resistance="2" inductance="0 0.03" cogging="0.2 6 0.4"
      lugre="30 0.3 0.05 0.1 0.2"/>
    <pid name="pid" joint="hinge" kp="4" kv="0.2" ki="3" input="pos vel"/>
    <intvelocity name="rate" joint="hinge" kp="2" actrange="-0.2 0.3"/>
    <position name="slow" joint="hinge" kp="5" timeconst="0.05"/>
    <general name="cable" tendon="cable" gainprm="2" biastype="affine" biasprm="0.1 -1 -0.2"/>
  </actuator></mujoco>"""
"""A joint with a drive of every law; the limit of what they exert on it together is no limit of any of them."""
EVERY = 0.01


def stepped(xml: str, given: Array, q0: float, v0: float, *, late: float = 0.0, dt: float = 5e-5) -> tuple[Array, ...]:
    """(n, 1) positions and (n, outputs) forces of actuators by MuJoCo alone, commands (n, nu) held from row to row."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep, model.opt.integrator = dt, mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.ctrl[:] = q0, v0, given[0]
    mujoco.mj_forward(model, data)
    for i, kind in enumerate(model.actuator_dyntype):
        if int(kind) == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):
            data.act[model.actuator_actadr[i]] = np.clip(data.actuator_length[i], *model.actuator_actrange[i])
        elif int(kind) in (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)):
            data.act[model.actuator_actadr[i]] = given[0, model.actuator_ctrladr[i]]
    positions, forces, every, behind = [], [], round(EVERY / dt), round(late / dt)
    for k in range(len(given) * every):
        data.ctrl[:] = given[max(k - behind, 0) // every]
        if k % every == 0:
            mujoco.mj_forward(model, data)
            positions.append(data.qpos.copy())
            forces.append(data.actuator_force.copy())
        mujoco.mj_step(model, data)
    return np.array(positions), np.array(forces)


def commands(count: int, rows: int = 100, index: int = 0) -> Array:
    time = EVERY * np.arange(rows)[:, None]
    return np.asarray(0.4 * np.sin(2 * np.pi * (0.7 + 0.3 * np.arange(count)) * time + np.arange(count) + index))


def simulated(model: Model, given: Array, engine: EngineName, dt: float, q0: float = 0.1, v0: float = 0.2) -> Array:
    """(n, nc) forces of a model's drives."""
    time = EVERY * np.arange(len(given))
    trial = Trial("t", time, given, given[0], 0.0, np.array([q0]), time, np.array([v0]), inner=True, forces=True)
    (found,) = engine_for(model, engine, dt).simulate([model], [trial], [np.array([[q0, v0]])], 1)
    assert found.forces is not None and found.sound.all()
    return np.asarray(found.forces[0])


@pytest.mark.parametrize(("engine", "dt"), [pytest.param("reduced", 5e-4, marks=pytest.mark.slow), ("mujoco", 1e-4)])
def test_forces_of_every_law_are_those_of_mujoco_stepped_by_hand(engine: EngineName, dt: float) -> None:
    robot = MjcfRobot("many", MANY)
    assert robot.actuator_names == ("plain", "dc", "pid.pos", "pid.vel", "rate", "slow", "cable")
    given = commands(7)
    _, expected = stepped(MANY, given, 0.1, 0.2)
    found = simulated(Model(robot), given, engine, dt)
    actuators = [0, 1, 2, 2, 3, 4, 5]  # one with two commands exerts one force
    off = np.abs(found - expected[:, actuators]).max(axis=0)
    assert np.all(expected.std(axis=0) > 0.1) and np.all(off < 5e-4 * np.ptp(expected, axis=0)[actuators] + 1e-4)


def servo(kp: float, kv: float, more: str = "") -> str:
    return f'<position name="drive" joint="hinge" kp="{kp}" kv="{kv}" {more}/>'


SERVO = MjcfRobot("arm", PENDULUM.format(drive=servo(12, 0.4)))


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
@pytest.mark.parametrize(
    ("effects", "drive", "late"),
    [
        ((), servo(12, 0.4), 0.0),
        ((ActuatorGain("drive", 0.5),), servo(6, 0.2), 0.0),
        ((TorqueSaturation("drive", 1.0),), servo(12, 0.4, 'forcerange="-1 1"'), 0.0),
        ((FirstOrderLag("drive", 0.05),), servo(12, 0.4, 'timeconst="0.05"'), 0.0),
        ((TransportDelay("drive", 0.013),), servo(12, 0.4), 0.013),
        ((SensorOffset("hinge", 0.3), SensorDelay("hinge", 0.05)), servo(12, 0.4), 0.0),
    ],
    ids=["none", "gain", "saturation", "lag", "delay", "sensor"],
)
def test_what_changes_a_drive_shows_in_its_force_and_what_a_sensor_does_does_not(
    engine: EngineName, effects: tuple[Effect, ...], drive: str, late: float
) -> None:
    given = 0.5 * np.sign(commands(1, index=1)) + commands(1)
    _, expected = stepped(PENDULUM.format(drive=drive), given, 0.1, 0.2, late=late)
    found = simulated(Model(SERVO, effects), given, engine, {"reduced": 5e-4, "mujoco": 2e-5}[engine])
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


def test_friction_at_the_joint_shows_by_the_motion_alone() -> None:
    """A motor's force is its command, whatever its joint rubs against; that behind a spring too."""
    robot, given = MjcfRobot("arm", PENDULUM.format(drive=MOTOR)), commands(1)
    for effects in ((CoulombFriction("hinge", 0.2),), (DriveCompliance("hinge", 80.0, 0.5),)):
        np.testing.assert_allclose(simulated(Model(robot, effects), given, "mujoco", 1e-3), given, atol=1e-12)


@lru_cache(maxsize=1)
def measured() -> tuple[Recording, ...]:
    """Servo pendulums of half the model's gains by MuJoCo alone, angles to 1 mrad and torques to 20 mN·m."""
    made, rng = [], np.random.default_rng(3)
    for k in range(4):
        given = 0.75 * commands(1, 400, k) + 0.5 * np.sign(commands(1, 400, 2 * k))
        q, f = stepped(PENDULUM.format(drive=servo(6, 0.2)), given, 0.0, 0.0, dt=5e-4)
        noisy = q + rng.normal(0, 1e-3, q.shape), f + rng.normal(0, 2e-2, f.shape)
        time = EVERY * np.arange(len(given))
        made.append(Recording(f"t{k}", time, given, noisy[0], ("drive",), ("hinge",), measured=noisy[1]))
    return tuple(made)


ALL = ["arm.mass", "arm.inertia", "hinge.armature", "drive.kp", "drive.kv"]


def test_a_measured_torque_tells_mass_and_gain_apart() -> None:
    """Of a servo whose gain is half the model's: without it all that moves and all that drives scale together."""
    model = Model(SERVO)
    with pytest.warns(RecordingWarning, match=r"not compared with the model: meas\.drive"):
        without = workflow.identify_recordings(measured()[:2], model, free=ALL, folds=0)
    found = workflow.identify_recordings(measured()[:2], model, free=ALL, folds=0, also=["meas.*"]).fit
    mass, kp = 0, 3
    for place, true in ((mass, 0.6), (kp, 6.0)):
        half = found.uncertainty.half_width[place]
        assert abs(found.theta[place] - true) < 1.6 * half and half < 0.01 * true
        assert not without.fit.uncertainty.half_width[place] < 20 * half
    noise = np.sqrt((np.concatenate(found.residuals) ** 2).mean(axis=0))
    np.testing.assert_allclose(noise, [1e-3, 2e-2], rtol=0.1)


@pytest.mark.slow
def test_a_diagnosis_by_measured_torques_names_the_gain_and_finds_the_mass() -> None:
    with pytest.warns(RecordingWarning):
        blind = workflow.diagnose(list(measured()), Model(SERVO), free=ALL[:3], most=1, threads=1)
    assert not blind.findings and blind.best.fit.theta[0] == pytest.approx(1.2, rel=0.02)
    found = workflow.diagnose(list(measured()), Model(SERVO), free=ALL[:3], most=1, threads=1, also=["meas.*"])
    assert [f.named.effect for f in found.findings] == ["actuator_gain"] and found.verdict == "explained"
    factor = found.findings[0].parameters["factor"]
    assert factor.low < 0.5 < factor.high and factor.high - factor.low < 0.005
    assert found.best.fit.theta[0] == pytest.approx(0.6, rel=0.005)
    (channel,) = found.channels
    assert (channel.name, channel.unit) == ("meas.drive", "N·m") and channel.rmse == pytest.approx(0.02, rel=0.1)


@pytest.mark.slow
def test_both_engines_agree_on_what_small_forces_change_of_a_drives_force() -> None:
    model = Model(SERVO, (FirstOrderLag("drive", 0.02),))
    segments = cut(model, with_channels(measured()[:1], ["meas.drive"]), shoot=2.0)[:1]
    start, trial = np.array([0.0, 0.0]), segments[0].trial
    m = len(trial.sample_times)
    pushes = [np.random.default_rng(1).normal(0, 1, (m - 1, 1, 2)).cumsum(axis=0) / 10]
    exact = observed(linearise(model, [motion(model, trial, start, 1e-3)]), SERVO, segments).response(pushes)
    by_steps = observed(simulated_response(model, [trial], [start], np.ones(1)), SERVO, segments).response(pushes)
    assert exact[0].shape == (m, 2, 2)
    size = np.abs(exact[0][:, 1]).max()
    assert size > 0.1 and np.abs(exact[0][:, 1] - by_steps[0][:, 1]).max() < 0.04 * size


@pytest.mark.slow
def test_shooting_intervals_begin_with_what_has_arrived_of_the_commands() -> None:
    """The force at an interval's first sample hangs on commands of before it, by a delay and a filter."""
    model = Model(MjcfRobot("arm", PENDULUM.format(drive=servo(12, 0.4, 'timeconst="0.1"'))))
    given = 0.5 * np.sign(commands(1, 200)) + commands(1, 200)
    time = EVERY * np.arange(200)
    whole = Trial("t", time, given, given[0], 0.0, np.zeros(1), time, np.zeros(1), inner=True, forces=True)
    for engine, dt in (("reduced", 1e-3), ("mujoco", 5e-5)):
        chosen = engine_for(model, engine, dt)  # type: ignore[arg-type]
        (path,) = chosen.simulate([model], [whole], [np.zeros((1, 2))], 1)
        assert path.forces is not None and path.motion is not None
        later = replace(whole, start=float(time[87]), sample_times=time[87:120])
        (part,) = chosen.simulate([model], [later], [path.motion[:, 87]], 1)
        assert part.forces is not None
        assert np.abs(part.forces[0] - path.forces[0, 87:120]).max() < 1e-3 * np.ptp(path.forces)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (0.015, 0.0), (0.0, 0.04)])
def test_what_has_arrived_of_commands_is_that_of_the_instant(linear: bool, delay: float, lag: float) -> None:
    """A command counts from its row on, one before the first row until then; a lag by its exponential."""
    times, given, at = (
        np.array([0.0, 0.1, 0.2]),
        np.array([[1.0], [3.0], [2.0]]),
        np.array([0.0, 0.05, 0.1, 0.155, 0.3]),
    )
    valve = valve_settings((), ["drive", "other"])
    valve[:, DELAY], valve[:, [FILL, VENT]] = delay, lag
    both, own, out = given.repeat(2, axis=1), np.array([linear, not linear]), np.empty((len(at), 2))
    arrived(times, both, np.zeros(2), valve, np.zeros((2, 6)), np.zeros(2), 0.0, 1e-3, at, out, own)
    assert np.abs(out[:, 0] - out[:, 1]).max() > 0.1  # each as it goes by itself
    fine = np.arange(0.0, 0.3 + 1e-9, 1e-5)

    def target(t: Array) -> Array:
        held = given[np.clip(np.searchsorted(times, t + 1e-12, side="right") - 1, 0, 2), 0]
        return np.where(t < -1e-12, 0.0, np.interp(t, times, given[:, 0]) if linear else held)

    expected, value = target(at - delay), 0.0
    if lag:
        path = []
        for u in target(fine):
            path.append(value)
            value += 1e-5 / lag * (u - value)
        expected = np.interp(at, fine, path)
    np.testing.assert_allclose(out[:, 0], expected, atol=1e-3 if lag else 1e-9)


def test_a_filter_of_commands_follows_them_within_a_sample_interval() -> None:
    """A command that comes and goes between two samples."""
    times, given, at, lag = (
        np.array([0.0, 0.03, 0.05]),
        np.array([[0.0], [2.0], [0.0]]),
        np.array([0.0, 0.1, 0.2]),
        0.02,
    )
    follow, out = np.array([[0.0, 0.0, -9.0, 9.0, -9.0, 9.0]]), np.empty((3, 1))
    follow[0, [FOLLOW_KIND, FOLLOW_NUMBER]] = FILTERED, lag
    arrived(
        times,
        given,
        np.zeros(1),
        valve_settings((), ["drive"]),
        follow,
        np.zeros(1),
        0.0,
        1e-3,
        at,
        out,
        np.zeros(1, dtype=bool),
    )
    expected = 2.0 * (1 - math.exp(-0.02 / lag)) * np.exp(-(at[1:] - 0.05) / lag)
    np.testing.assert_allclose(out[:, 0], [0.0, *expected], rtol=2e-3)


def test_names_units_and_joints_of_forces() -> None:
    channels = Channels((0,), (("tip", 0),), (0,))
    assert channels.names(SERVO) == ("vel.hinge", "site.tip.x", "meas.drive")
    assert channels.units(SERVO) == ("rad/s", "m", "N·m") and channels.joints(SERVO) == (0, None, 0)
    (trial,) = with_channels(measured()[:1], ["meas.*"])
    assert channels_of(Model(SERVO), trial) == Channels(forces=(0,)) and unused([trial]) == []
    told = refusal(lambda: with_channels([replace(trial, measured=None)], ["meas.drive"]))
    assert "there is no column 'meas.drive'" in told


def test_a_force_may_be_measured_at_some_drives_alone(tmp_path: Path) -> None:
    forces = np.array([[math.nan, 1.0], [math.nan, 2.0]])
    two = Recording("t", np.array([0.0, 0.1]), np.zeros((2, 2)), np.zeros((2, 1)), ("a", "b"), ("j",), measured=forces)
    assert unused([two]) == ["meas.b"] and two.force_columns == (1,)
    limits, file = recordings.Limits.of_mjcf(["j"], ["a", "b"]), tmp_path / "t.csv"
    recordings.write(file, two)
    assert "meas.b" in file.read_text() and "meas.a" not in file.read_text()
    read = recordings.read(file, limits=limits)
    assert read.measured is not None
    np.testing.assert_array_equal(read.measured, forces)
    told = refusal(lambda: recordings.read(file, limits=LEG))
    assert "column 'meas.a' is missing, though 'meas.b' is there" in told


def test_recordings_of_which_one_has_no_measured_forces_are_told_before_a_search() -> None:
    first, second = with_channels(measured()[:2], ["meas.*"])
    lacking = replace(second, measured=None, notes={})
    for trials in ([first, lacking], [lacking, first]):
        told = refusal(lambda trials=trials: plausibility.check(Model(SERVO), trials))
        assert told.startswith(f"{trials[1].name} and {trials[0].name} do not compare the same columns")


def test_a_measured_torque_of_the_other_sign_or_in_another_unit_is_told_before_a_search() -> None:
    model, trials = Model(SERVO), with_channels(measured(), ["meas.*"])
    plausibility.check(model, trials)

    def said(factor: float) -> str:
        changed = [replace(t, measured=factor * np.asarray(t.measured)) for t in trials]
        return refusal(lambda: plausibility.check(model, changed))

    assert "meas.drive looks negated" in said(-1.0) and "pos.hinge" in said(-1.0)
    assert "meas.drive looks like a force in another unit" in said(1e3)
    untold = [replace(t, measured=-np.asarray(t.measured), notes={}) for t in trials]
    plausibility.check(model, untold)  # it is not compared


def pulled(xml: str, given: Array, seed: int) -> tuple[Array, Array]:
    """(n, nj) positions and (n, outputs) forces by MuJoCo alone, angles to 0.1 mrad."""
    model = mujoco.MjModel.from_xml_string(xml)
    data, positions, forces = mujoco.MjData(model), [], []
    for row in given:
        data.ctrl[:] = row
        mujoco.mj_forward(model, data)
        positions.append(data.qpos.copy())
        forces.append(data.actuator_force.copy())
        for _ in range(round(EVERY / model.opt.timestep)):
            mujoco.mj_step(model, data)
    return np.array(positions) + np.random.default_rng(seed).normal(0, 1e-4, (len(given), model.nq)), np.array(forces)


def test_of_an_actuator_with_several_commands_any_column_is_checked() -> None:
    drive = '<pid name="pid" joint="hinge" kp="12" kv="0.4" input="pos vel"/>'
    xml = PENDULUM.format(drive=drive)
    robot, given = MjcfRobot("arm", xml), commands(2, 400)
    q, f = pulled(xml, given, 1)
    force = np.column_stack([np.full(400, math.nan), -f[:, 0]])
    trial = Recording("t0", EVERY * np.arange(400), given, q, robot.actuator_names, ("hinge",), measured=force)
    told = refusal(lambda: plausibility.check(Model(robot), with_channels([trial], ["meas.*"])))
    assert "meas.pid.vel looks negated" in told


TWO = """<mujoco><compiler angle="radian"/><option timestep="0.001"/><worldbody><body>
  <joint name="first" axis="0 1 0" damping="0.3" armature="0.05"/>
  <inertial mass="1.5" pos="0.02 0 -0.2" diaginertia="0.02 0.02 0.01"/><body name="rod" pos="0 0 -0.4">
  <joint name="second" axis="0 1 0" damping="0.1" armature="0.02"/>
  <inertial mass="0.5" pos="0 0 -0.1" diaginertia="0.002 0.002 0.001"/></body></body></worldbody>
  <tendon><fixed name="cable"><joint joint="first" coef="{coef}"/><joint joint="second" coef="1"/></fixed></tendon>
  <actuator><motor name="a" joint="first"/><motor name="b" joint="second"/><motor name="c" {third}/></actuator>
</mujoco>"""


def two(coef: float, given: Array, third: str = 'tendon="cable"') -> tuple[Model, Recording]:
    """A recording of it, and what it is of."""
    xml, time = TWO.format(coef=coef, third=third), EVERY * np.arange(len(given))
    robot, (q, f) = MjcfRobot("two", xml), pulled(xml, given, 2)
    trial = Recording("t0", time, given, q, robot.actuator_names, robot.joint_names, measured=f)
    return Model(robot), trial


WAY = np.sin(4 * EVERY * np.arange(400)) + np.sin(9 * EVERY * np.arange(400))


def test_a_joint_on_which_another_actuator_pulls_is_not_checked() -> None:
    """A tendon drives it the other way, and more; where it does not, what was measured is the opposite."""
    model, own = two(0.9, np.column_stack([-0.4 * WAY, 0 * WAY, 2 * WAY]))
    plausibility.check(model, with_channels([own], ["meas.*"]))
    model, own = two(0.0, np.column_stack([1.4 * WAY, 0 * WAY, 2 * WAY]))
    turned = with_channels([replace(own, measured=-np.asarray(own.measured))], ["meas.*"])
    assert "meas.a looks negated" in refusal(lambda: plausibility.check(model, turned))


def test_what_two_joints_need_is_worked_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    widths, evaluated = list[int](), plausibility.inverse_dynamics

    def counted(model: Model, motions: list[MeasuredMotion], width: int) -> list[InverseDynamics]:
        widths.append(width)
        return evaluated(model, motions, width)

    monkeypatch.setattr(plausibility, "inverse_dynamics", counted)
    monkeypatch.setattr(plausibility, "mistaken", lambda *given: "")
    model, own = two(0.0, np.column_stack([1.4 * WAY, 0.3 * WAY, 0.2 * WAY]), 'joint="second"')
    plausibility.check(model, with_channels([own], ["meas.*"]))
    assert sorted(widths) == sorted(
        2 * plausibility.WIDTHS
    )  # for what drives exert by the model, and for what was measured
