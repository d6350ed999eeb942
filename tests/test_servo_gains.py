"""Servos that are softer than a model says are seen before a search, and what they hold forgets where it began."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, SERVO, recorded

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis.holdout import never_held_out, split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.intervals import forgets
from equimus_ctrl.diagnosis.servo_gains import ServoGain, servo_gains, told, with_servo_gains
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import simulator_for
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.diagnosis_page import page
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

TRUE = 12.0


def model(drive: str = SERVO, kp: float = TRUE) -> Model:
    return Model(MjcfRobot("arm", PENDULUM.format(drive=drive).replace('kp="12"', f'kp="{kp:g}"')))


def whole(trials: list[Recording]) -> list[Segment]:
    return cut(model(), trials)


@pytest.mark.parametrize("said", [0.02, 1.0, 3.0, 80.0])
def test_a_stiffness_far_from_the_models_is_measured(said: float) -> None:
    """The goals lead the pendulum by what its weight needs over the servo's stiffness."""
    gains = servo_gains(model(kp=said * TRUE), whole(recorded(model())))
    if 0.2 < said < 5:
        assert gains == ()
        return
    (gain,) = gains
    assert gain.name == "drive.kp" and gain.joint == "hinge" and gain.loaded
    assert gain.model == pytest.approx(said * TRUE) and gain.measured == pytest.approx(TRUE, rel=0.15)
    assert f"drive.kp {said * TRUE:.4g} → {gain.measured:.3g}" in told(gains)


def test_what_is_held_out_tells_nothing_of_what_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither trials that judge, in either split, nor those of the test set; of a trial alone of its kind its end."""
    asked: list[list[Segment]] = []

    class Seen(Exception):
        pass

    def seen(own: Model, segments: list[Segment]) -> tuple[ServoGain, ...]:
        asked.append(segments)
        raise Seen

    monkeypatch.setattr(importlib.import_module("equimus_ctrl.workflow.prepared"), "servo_gains", seen)
    trials = [*recorded(model(), count=8), replace(recorded(model(), count=1)[0], name="slow")]
    with pytest.raises(Seen):
        workflow.diagnose(trials, model())
    segments = {s.recording_name: s for s in asked[0]}
    assert list(segments) == ["t0", "t1", "t4", "t5", "slow"]
    assert segments["t0"].trial.sample_times[-1] == trials[0].time[-1]
    assert segments["slow"].trial.sample_times[-1] <= trials[-1].time[-1] * 0.75
    with pytest.raises(Seen):
        workflow.diagnose(trials, model(), validation=["t[01]"], test=["t2"], until=None)
    assert {s.recording_name for s in asked[1]}.isdisjoint({"t0", "t1", "t2"})
    # Whatever is measured in those, the same is told.
    stiff = model(kp=100 * TRUE)
    others = [r if r.name in segments else replace(r, position=0.3 * r.position) for r in trials]
    gains = [servo_gains(stiff, never_held_out(stiff, own)) for own in (trials, others)]
    assert gains[0] == gains[1] and gains[0][0].measured == pytest.approx(TRUE, rel=0.15)


def test_then_bodies_are_the_standard_of_force() -> None:
    stiff = model(kp=100 * TRUE)
    gains = servo_gains(stiff, whole(recorded(model())))
    before, after = default_free_parameters(stiff), with_servo_gains(default_free_parameters(stiff), gains)
    assert {"arm.mass", "arm.inertia"} == set(before.names) and {"drive.kp", "drive.kv", "hinge.armature"} == set(
        after.names
    )
    place = after.names.index("drive.kp")
    assert after.low[place] < TRUE < after.high[place] and after.start[place] == gains[0].measured
    assert with_servo_gains(before, ()) is before
    softer = 0.4 * gains[0].measured / (100 * TRUE)  # of the same firmware
    assert after.start[after.names.index("drive.kv")] == pytest.approx(softer)
    assert after.model.parameters()["drive.kv"] == 0.4 and after.model.parameters()["drive.kp"] == 1200


def test_where_damping_is_free_a_servos_own_is_not() -> None:
    """Both do the same."""
    damped = PENDULUM.format(drive=SERVO).replace("armature=", 'damping="0.1" armature=')
    given = Model(MjcfRobot("arm", damped.replace('kp="12"', 'kp="1200"')))
    gains = servo_gains(given, whole(recorded(Model(MjcfRobot("arm", damped)))))
    after = with_servo_gains(default_free_parameters(given), gains)
    assert "hinge.damping" in after.names and "drive.kv" not in after.names
    assert after.model.parameters()["drive.kv"] == pytest.approx(0.4 * gains[0].measured / 1200)


@pytest.mark.slow
def test_a_servo_that_is_too_stiff_is_another_unit_with_its_stiffness() -> None:
    """Nominal is what was given, wherever fits begin."""
    given = model(kp=100 * TRUE)
    found = workflow.diagnose(recorded(model(), count=4), given, most=1)
    assert found.verdict == "consistent" and any("drive.kp 1200 → " in note for note in found.notes)
    assert found.model is given and found.another_unit is not None
    told_of = {d.parameter: d for d in found.another_unit.departures}
    stiffness = told_of["drive.kp"]
    assert stiffness.nominal == 1200
    assert stiffness.estimate.low < TRUE < stiffness.estimate.high
    assert "drive.kv" not in told_of  # it is what it was said to be
    nominal, refitted = (float(np.mean(np.concatenate(found.residuals[s].train) ** 2)) for s in ("nominal", "refitted"))
    assert refitted < 1e-2 * nominal
    assert "1200" in page(found, "servo")


def test_a_joint_without_load_tells_no_stiffness() -> None:
    """About an upright axis nothing but the servo and the body's own inertia act."""
    upright = PENDULUM.format(drive=SERVO).replace('axis="0 -1 0"', 'axis="0 0 1"')
    real = Model(MjcfRobot("arm", upright))
    stiff = Model(MjcfRobot("arm", upright.replace('kp="12"', 'kp="1200"')))
    assert servo_gains(stiff, whole(recorded(real))) == ()


def test_a_servo_forgets_where_it_began_and_a_pendulum_does_not() -> None:
    for drive, expected in ((SERVO.replace("0.4", "2.4"), True), (MOTOR, False)):
        own = model(drive)
        trials = recorded(own, count=2)
        follow = simulator_for(own, [r.position for r in trials])
        assert forgets(own, trials, None, follow) is expected
        # Short intervals tell nothing that long ones do not, where the state is forgotten within them.
        short = split(own, trials, shoot=None if expected else 4.0).short_segments
        assert bool(short) is not expected


def test_where_a_joint_stands_nothing_is_told_of_what_it_forgets() -> None:
    """Dry friction keeps a change of where it stands until it moves again; most of these trials it stands."""
    own = Model(MjcfRobot("arm", PENDULUM.format(drive=SERVO).replace("armature=", 'frictionloss="0.6" armature=')))
    time = np.arange(0, 12, 0.02)
    goal = np.where(time < 3, 0.4 * np.sin(2 * np.pi * time / 1.5), 0.1)[:, None]
    trials = []
    for k in range(2):
        angle = simulate_mjcf([own], [Trial("t", time, goal, goal[0], 0.0, np.zeros(1), time)], threads=1)[0].position[
            0
        ]
        trials.append(Recording(f"t{k}", time, goal, angle, ("drive",), ("hinge",)))
    assert forgets(own, trials, None, simulator_for(own, [r.position for r in trials]))


def test_the_loop_decides_what_is_forgotten() -> None:
    """A servo without damping rings as long as a pendulum swings."""
    ringing = Model(MjcfRobot("arm", PENDULUM.format(drive=SERVO).replace('kv="0.4"', 'kv="0.004"')))
    trials = recorded(ringing, count=2)
    assert not forgets(ringing, trials, None, simulator_for(ringing, [r.position for r in trials]))
    assert np.isfinite(trials[0].position).all()


TURRET = """<mujoco model="turret">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="post">
    <joint name="pan" axis="0 0 1" armature="0.02" damping="0.3"/>
    <inertial pos="0 0 0" mass="1" diaginertia="0.002 0.002 0.002"/>
    <body name="arm"><joint name="hinge" axis="0 -1 0" armature="0.02" damping="0.3" frictionloss="0.05"/>
      <inertial pos="0.2 0 0" mass="0.6" diaginertia="0.002 0.002 0.001"/></body>
  </body></worldbody>
  <actuator><position name="pan" joint="pan" kp="{kp}" kv="0.1"/><position name="hinge" joint="hinge" kp="{kp}" kv="0.1"/></actuator>
</mujoco>"""


def test_a_servo_without_load_is_as_soft_as_the_others() -> None:
    """Its rotor inertia is free in its stiffness' place; friction and damping begin where motion has them."""
    real, stiff = (Model(MjcfRobot("turret", TURRET.format(kp=kp))) for kp in (12, 1200))
    gains = {g.joint: g for g in servo_gains(stiff, cut(stiff, recorded(real, size=0.5)))}
    assert not gains["pan"].loaded and gains["hinge"].loaded
    assert gains["pan"].measured == gains["hinge"].measured == pytest.approx(12, rel=0.15)
    assert gains["hinge"].joint_begins["hinge.frictionloss"] == pytest.approx(0.05, rel=0.3)
    # What the servo's own damping lacks of 0.1 when it is as much softer is the joint's.
    assert gains["hinge"].joint_begins["hinge.damping"] == pytest.approx(0.4, rel=0.3)
    assert gains["pan"].joint_begins["pan.damping"] == pytest.approx(0.4, rel=0.3)
    after = with_servo_gains(default_free_parameters(stiff), list(gains.values()))
    assert {"hinge.kp", "pan.armature", "hinge.armature", "pan.damping"} <= set(after.names)
    assert "pan.kp" not in after.names and after.model.parameters()["pan.kp"] == gains["pan"].measured
    assert after.start[after.names.index("hinge.frictionloss")] == gains["hinge"].joint_begins["hinge.frictionloss"]
    assert "Nothing loads pan" in told(list(gains.values()))
