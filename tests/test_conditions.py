"""Known conditions that a user can make: what texts mean, and what becomes of trials, models, notes and rests."""

from __future__ import annotations

import numpy as np
import pytest
from mjcf_models import CRANE, pendulum, refusal

from equimus_ctrl.effects import PayloadMass
from equimus_ctrl.engines.predict import in_its_condition
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.experiments.conditions import known_condition, known_conditions
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

FREE = Model(MjcfRobot("free", pendulum()))
SERVO = Model(MjcfRobot("servo", pendulum(drive='<position name="goal" joint="pivot" kp="60" kv="1"/>')))
LEG = nominal_model()


@pytest.mark.parametrize(
    ("model", "text", "notes"),
    [
        (LEG, "payload:foot=0.2", {"payload.foot": "0.2"}),
        (LEG, "maa.stiffness=300", {"set.maa.stiffness": "300.0"}),
        (FREE, "times:arm.mass=1.5, payload:tip=0.1", {"times.arm.mass": "1.5", "payload.tip": "0.1"}),
        (FREE, "supply:all=0.8", {"times.motor.gain": "0.8"}),
        (FREE, "supply:motor=0.9", {"times.motor.gain": "0.9"}),
        (FREE, "pose:pivot=20", {}),
    ],
)
def test_a_text_is_what_a_recordings_notes_then_say(model: Model, text: str, notes: dict[str, str]) -> None:
    """Read back from the notes, the trial is the same."""
    condition, robot = known_condition(text, model), model.robot
    assert condition.notes == notes
    nj, na = len(robot.joint_names), len(robot.actuator_names)
    time = np.arange(3.0)
    recording = Recording("r", time, np.zeros((3, na)), np.zeros((3, nj)), robot.actuator_names, robot.joint_names,
                          notes=condition.notes)  # fmt: skip
    trial = Trial.of(recording, np.zeros(nj))
    assert condition.trial(trial).condition == in_its_condition(model, recording, trial).condition
    assert condition.trial(trial).robot_in(robot).parameters() == condition.model(model).robot.parameters()


def test_a_payload_moves_the_rest_of_the_model_as_the_effect_does() -> None:
    for model, place, command in ((LEG, "foot", [1e4, 5e3]), (FREE, "tip", [0.5])):
        here = known_condition(f"payload:{place}=0.2", model).model(model)
        wanted = rest_pose(Model(model.robot, (PayloadMass(place, 0.2),)), command)
        np.testing.assert_allclose(rest_pose(here, command), wanted, atol=1e-9)
        assert np.abs(wanted - rest_pose(model, command)).max() > 1e-3


@pytest.mark.parametrize(
    ("model", "text"),
    [(FREE, "pose:pivot=30"), (FREE, "pose:pivot=30,payload:tip=0.3"), (SERVO, "pose:pivot=-40"),
     (LEG, "pose:hip=85,pose:knee=30")],
)  # fmt: skip
def test_a_pose_is_held_by_the_command_at_rest(model: Model, text: str) -> None:
    condition = known_condition(text, model)
    command = condition.rest_command(model, np.zeros(len(model.robot.actuator_names)))
    rest = dict(zip(model.robot.joint_names, rest_pose(condition.model(model), command), strict=True))
    for joint, value in condition.pose.items():
        assert rest[joint] == pytest.approx(value, abs=1e-3)


def test_without_a_pose_the_usual_command_is_that_at_rest() -> None:
    usual = np.array([0.3])
    assert known_condition("payload:tip=0.1", FREE).rest_command(FREE, usual).tolist() == [0.3]
    none, other = known_conditions(["payload:tip=0.1", "payload:tip=0.1"], FREE)
    assert none.text == "" and none.notes == {} and none.model(FREE) is FREE and other.text == "payload:tip=0.1"


@pytest.mark.parametrize(
    ("model", "text", "said"),
    [
        (FREE, "lighter", "condition 'lighter': expected such as payload:SITE=0.2"),
        (FREE, "payload:tip=", "condition 'payload:tip=': '' is no finite number"),
        (FREE, "payload:tip=inf", "'inf' is no finite number"),
        (FREE, "payload:tpi=0.1", "note payload.tpi: "),
        (FREE, "payload:tip=-1", "note payload.tip: "),
        (FREE, "load:tip=1", "there is no kind of condition 'load'; did you mean 'payload'?"),
        (FREE, "pose:elbow=3", "condition 'pose:elbow=3': there is no joint 'elbow'"),
        (LEG, "pose:knee=200", "knee at 200° is outside its range, -2.005° to 114.6°"),
        (FREE, "arm.mas=1", "there is no parameter 'arm.mas'; did you mean 'arm.mass'?"),
        (FREE, "arm.mass=-1", "expected a finite number of at least 0"),
        (FREE, "arm.mass=1,arm.mass=2", "arm.mass is said twice"),
        (FREE, "supply:motor=0", "expected a share of the usual supply, more than 0"),
        (FREE, "supply:mtor=1", "there is no actuator 'mtor'"),
        (LEG, "supply:all=0.8", "the model of nominal_leg has no maa.gain that a supply would change"),
        (SERVO, "supply:all=0.8", "the model of servo has no goal.gain"),
        (Model(CRANE), "supply:all=0.8", "has no servo.gain"),
    ],
)
def test_what_cannot_be_is_one_sentence(model: Model, text: str, said: str) -> None:
    told = refusal(lambda: known_condition(text, model))
    assert said in told and told.startswith("condition ")


def test_a_pose_that_nothing_holds_is_told() -> None:
    upright = known_condition("pose:pivot=170", FREE)
    assert "free does not rest there under any command; pivot comes to" in refusal(
        lambda: upright.rest_command(FREE, np.zeros(1))
    )
