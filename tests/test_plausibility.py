"""Recordings and models that cannot belong together are told in a sentence, before any search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest
from mjcf_models import ARM, refusal
from pendulum_runs import MOTOR, PENDULUM, SERVO, recorded

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis import plausibility
from equimus_ctrl.effects import CoulombFriction, Effect, PayloadMass, TransportDelay
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

ROBOT = MjcfRobot("arm", PENDULUM.format(drive=MOTOR))
LIMITED = MjcfRobot("arm", PENDULUM.format(drive=MOTOR).replace('axis="0 -1 0"', 'axis="0 -1 0" range="-100 120"'))


@lru_cache(maxsize=1)
def runs() -> tuple[Recording, ...]:
    return tuple(recorded(Model(ROBOT), count=2, seed=1))


def crane() -> MjcfRobot:
    head, _, _ = ARM.partition("<actuator>")
    drives = '<actuator><motor name="turn" joint="shoulder"/><motor name="push" joint="reach"/></actuator></mujoco>'
    return MjcfRobot("crane", head + drives)


def test_what_belongs_together_passes() -> None:
    plausibility.check(Model(ROBOT), runs())
    plausibility.check(Model(LIMITED), runs())
    plausibility.check(nominal_model(), ())


@pytest.mark.parametrize(
    "effect", [CoulombFriction("hinge", 0.3), PayloadMass("tip", 1.2), TransportDelay("drive", 0.1)]
)
def test_missing_physics_is_no_mistake_of_the_recordings(
    effect: CoulombFriction | PayloadMass | TransportDelay,
) -> None:
    """Even a payload of twice the arm's own mass."""
    plausibility.check(Model(ROBOT), recorded(Model(ROBOT, (effect,)), count=2, seed=3))


def test_a_negated_torque_is_told() -> None:
    said = refusal(lambda: plausibility.check(Model(ROBOT), [replace(r, command=-r.command) for r in runs()]))
    assert "the forces of hinge look negated" in said and "cmd.drive" in said and "change the sign" in said


def test_a_joint_that_friction_holds_says_nothing_of_signs() -> None:
    """It creeps the one way while its servo pushes the other way: both forces are constant."""
    held = PENDULUM.format(drive=SERVO).replace('armature="0.004"', 'armature="0.004" frictionloss="0.3"')
    robot = MjcfRobot("arm", held)
    time = np.arange(0, 4, 0.01)
    rows = [np.column_stack([np.full(len(time), size), 1e-7 * (1 - time)]) for size in (0.02, 0.015)]
    trials = [Recording(f"t{k}", time, own[:, :1], own[:, 1:], ("drive",), ("hinge",)) for k, own in enumerate(rows)]
    plausibility.check(Model(robot), trials)


def test_currents_in_the_place_of_torques_are_told() -> None:
    said = refusal(lambda: plausibility.check(Model(ROBOT), [replace(r, command=r.command / 12) for r in runs()]))
    assert "another unit, such as currents" in said and "gear or gain" in said
    factor = float(said.partition("needs is ")[2].partition(" times")[0])
    assert factor == pytest.approx(12.0, rel=0.1)


def test_a_servo_that_asks_for_far_more_is_no_other_unit() -> None:
    robot = MjcfRobot("arm", PENDULUM.format(drive=SERVO))
    stiff = MjcfRobot("arm", PENDULUM.format(drive=SERVO.replace("12", "400").replace("0.4", "9")))
    plausibility.check(Model(stiff), recorded(Model(robot), count=2, seed=2))


def test_exchanged_columns_are_told() -> None:
    robot = crane()
    trials = recorded(Model(robot), count=2, seed=5, size=3.0, noise=2e-4)
    plausibility.check(Model(robot), trials)
    exchanged = [replace(r, command=r.command[:, ::-1].copy()) for r in trials]
    said = refusal(lambda: plausibility.check(Model(robot), exchanged))
    assert "look exchanged" in said and "shoulder" in said and "reach" in said and "order" in said


LINKS = """<mujoco model="links"><option timestep="0.001"/><worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0" damping="0.4"/><inertial mass="1" pos="0 0 -0.2" diaginertia="0.02 0.02 0.01"/>
  <body name="fore" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.3"/>
  <inertial mass="0.6" pos="0 0 -0.15" diaginertia="0.01 0.01 0.01"/></body></body></worldbody>
  <actuator><DRIVE name="m1" joint="shoulder"/><DRIVE name="m2" joint="elbow"/></actuator></mujoco>"""
MOTORS = MjcfRobot("links", LINKS.replace("DRIVE", "motor"))
SERVOS = MjcfRobot("links", LINKS.replace("DRIVE", 'position kp="8" kv="0.4"'))


@lru_cache(maxsize=2)
def moves(robot: MjcfRobot) -> tuple[Recording, ...]:
    return tuple(recorded(Model(robot), count=2, seed=11, size=1.5))


def changed(trials: Sequence[Recording], *, add: float = 0.0, signs: Sequence[float] = (1, 1)) -> list[Recording]:
    """Recordings whose elbow has another zero, or whose joints turn the other way round."""
    return [replace(r, position=r.position * signs + np.array([0.0, add]), command=r.command * signs) for r in trials]


def test_another_zero_is_told_with_what_to_add() -> None:
    said = refusal(lambda: plausibility.check(Model(MOTORS), changed(moves(MOTORS), add=np.pi / 2)))
    assert "the zero of elbow looks off by 90°" in said and "add -1.5708 rad to pos.elbow, or" in said


def test_a_joint_recorded_the_other_way_round_is_told() -> None:
    said = refusal(lambda: plausibility.check(Model(MOTORS), changed(moves(MOTORS), signs=(1, -1))))
    assert "elbow looks as if it turned the other way round" in said and "sign of pos.elbow and cmd.m2" in said
    assert "shoulder looks as if" in said, "a mirrored plane is the same"


@pytest.mark.parametrize(("commands", "words"), [(False, "these columns"), (True, "commands as well as positions")])
def test_joints_in_another_order_are_told(commands: bool, words: str) -> None:
    other = [
        replace(r, position=r.position[:, ::-1].copy(), command=r.command[:, ::-1].copy() if commands else r.command)
        for r in moves(MOTORS)
    ]
    said = refusal(lambda: plausibility.check(Model(MOTORS), other))
    assert "shoulder" in said and "elbow look exchanged" in said and words in said


def test_a_servos_goal_has_its_joints_zero() -> None:
    trials = moves(SERVOS)
    turn = np.array([0.0, np.pi])
    other = [replace(r, position=r.position + turn, command=r.command + turn) for r in trials]
    said = refusal(lambda: plausibility.check(Model(SERVOS), other))
    assert "off by 180°" in said and "to pos.elbow and to its drive's goal" in said


@pytest.mark.parametrize(
    "effects",
    [(PayloadMass("fore", 1.5),), (CoulombFriction("shoulder", 1.0), CoulombFriction("elbow", 0.8))],
)
def test_missing_physics_at_several_joints_is_no_mistake_of_the_recordings(effects: tuple[Effect, ...]) -> None:
    plausibility.check(Model(MOTORS), recorded(Model(MOTORS, effects), count=2, seed=12, size=1.5))


def test_angles_in_degrees_are_told() -> None:
    turned = [replace(r, position=np.rad2deg(r.position)) for r in runs()]
    assert "in degrees? They are expected in rad" in refusal(lambda: plausibility.check(Model(LIMITED), turned))


def test_a_model_whose_angles_are_read_in_degrees_is_told() -> None:
    xml = PENDULUM.format(drive=MOTOR).replace('axis="0 -1 0"', 'axis="0 -1 0" range="-2 2.2"')
    said = refusal(lambda: plausibility.check(Model(MjcfRobot("arm", xml)), runs()))
    assert '<compiler angle="radian"/>' in said and "hinge goes from" in said


def test_a_zero_that_cannot_be_is_told() -> None:
    moved = [replace(r, position=r.position + 4.5) for r in runs()]
    said = refusal(lambda: plausibility.check(Model(LIMITED), moved))
    assert "encoder's zero" in said and "-1.75 to 2.09 rad" in said


def test_a_diagnosis_looks_first() -> None:
    said = refusal(lambda: workflow.diagnose([replace(r, command=-r.command) for r in runs()], Model(ROBOT)))
    assert "look negated" in said


@pytest.mark.parametrize(("per_turn", "slow"), [(4096, 0.5), (1000, 2.0)])
def test_an_encoders_steps_are_told(per_turn: int, slow: float) -> None:
    """Also through text of few digits."""
    time, step = np.arange(0, 6, 0.01), 2 * np.pi / per_turn
    angle = np.sin(slow * time)[:, None]
    exact = Recording("exact", time, angle, angle, ("drive",), ("hinge",))
    coarse = replace(exact, position=np.round(np.round(angle / step) * step, 7))
    noisy = replace(exact, position=coarse.position + np.random.default_rng(0).normal(0, step, angle.shape))
    told = partial(plausibility.coarse_steps, ROBOT)
    assert told([exact]) == told([noisy]) == []
    (said,) = told([coarse, coarse])
    turn = " (4096 a turn)" if per_turn == 4096 else ""
    assert said.startswith(f"pos.hinge: measured in steps of {1e3 * step:.3g} mrad{turn}, which are most of the noise")
