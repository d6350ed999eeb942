"""Pushes and payloads on any robot: what they exert, how large they are by default, and the leg's own numbers."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from mjcf_models import CRANE, PENDULUM, RIG, cart, pendulum, refusal

from equimus_ctrl import workflow
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, model_from_dict, model_to_dict
from equimus_ctrl.plants.events import Event, Load, PointForce, Push
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.scenarios.context import SHARE, ScenarioContext
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.types import Array, Start

WEAK = MjcfRobot("weak", pendulum(drive='<motor name="motor" joint="pivot" ctrlrange="-2 2"/>'))
"""A kilogram at 0.3 m, up to 2 N·m; its site is at (0.2, 0, −0.5) m."""


def built(name: str, robot: Robot, **options: str) -> Scenario:
    return workflow.load_scenario(name, robot, options=options, search=False)


def only(scenario: Scenario) -> Event:
    (event,) = scenario.events
    return event


def moved(robot: Robot, *events: Event, until: float = 0.3, start: Start | None = None) -> Array:
    """(n, nj) positions under no command."""
    plant = MujocoPlant(Model(robot), events=events)
    command = np.zeros(len(robot.actuator_names))
    plant.reset(start or Start(command=command, position=np.full(len(robot.joint_names), 0.1)), 0)
    return np.array([plant.step(command).position for _ in range(round(until / plant.spec.control_dt))])


# --- a force at a point ------------------------------------------------------------------------------------------


def test_a_force_at_a_point_is_mujocos_own() -> None:
    """Against ``xfrc_applied`` at a body's centre of mass, the force fixed in the room while the body turns."""
    force = np.array([3.0, 1.0, -2.0])
    plant = MujocoPlant(Model(CRANE), events=[PointForce(0.05, 0.2, force, "rod")])
    plant.reset(Start(command=np.zeros(3), position=np.array([0.3, 0.1])), 0)
    model = CRANE.mujoco_model()
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3, 0.1
    every = round(plant.rates.physics / plant.rates.control)
    for k in range(30):
        seen = plant.step(np.zeros(3)).position
        for n in range(every):
            on = 0.05 <= (k * every + n) * model.opt.timestep + 1e-9 < 0.25
            data.body("rod").xfrc_applied[:3] = force if on else 0.0
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(seen, data.qpos, atol=1e-9)


def test_a_force_along_a_slide_is_a_push_on_it() -> None:
    both = [moved(cart(), event) for event in (PointForce(0.0, 0.2, [2.0, 5.0, 1.0], "box"), Push(0.0, 0.2, [2.0]))]
    np.testing.assert_allclose(*both, atol=1e-12)


def test_a_force_at_the_foot_of_the_leg_is_its_torques() -> None:
    """For a moment, in which the leg hardly moves: Jᵀ F by the leg's own kinematics."""
    leg, pose, force = nominal_leg(), np.array([1.4, 0.6]), np.array([0.5, -0.3])
    torque = Kinematics(leg).foot_jacobian(pose).T @ force
    start = Start(position=pose)
    both = [
        moved(leg, event, until=0.02, start=start) - moved(leg, until=0.02, start=start)
        for event in (PointForce(0.0, 1.0, [*force, 7.0], "foot"), Push(0.0, 1.0, torque))
    ]
    assert np.abs(both[1]).max() > 5e-4
    np.testing.assert_allclose(*both, atol=2e-2 * np.abs(both[1]).max())


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: PointForce(0.0, 0.0, [1, 0, 0], "tip"), "a force at 0 s lasts 0 s, expected more than 0"),
        (lambda: PointForce(0.0, 1.0, [1, 0], "tip"), "the force at tip is [1.0, 0.0] N, expected three"),
        (lambda: MujocoPlant(Model(RIG), events=[PointForce(0.0, 1.0, [1, 0, 0], "tp")]), "did you mean 'tip'?"),
        (lambda: built("push", RIG, joint="rech"), "joint is 'rech', expected one of shoulder, reach"),
        (lambda: built("push", RIG, joint="reach", site="tip"), "joint is that of a push on joints"),
        (lambda: built("push", nominal_leg(), torque="1", site="foot"), "torque is that of a push on joints"),
        (lambda: built("push", RIG, direction="0 0 0"), "direction is '0 0 0', expected other than 0"),
        (lambda: built("push", cart(), direction="0 0 1"), "the disturbance moves no driven joint"),
        (lambda: built("push", RIG, force="inf"), "force is inf N, expected a finite number"),
        (lambda: built("push", RIG, begins="-3", torque="1"), "what befalls the robot -3 s after the start never does"),
        (lambda: built("payload", RIG, begins="12"), "what befalls the robot 12 s after the start never does"),
        (lambda: built("payload", RIG, site="tp"), "there is no site or body 'tp'"),
        (lambda: built("payload", RIG, mass="-1"), "has a mass of -1 kg, expected at least 0"),
    ],
)
def test_what_makes_no_sense_is_told(make: object, sentence: str) -> None:
    assert sentence in refusal(make)  # type: ignore[arg-type]


# --- sizes -------------------------------------------------------------------------------------------------------


def test_a_push_is_a_share_of_what_is_left_beside_holding() -> None:
    """By hand: m g l sin θ holds the pendulum at θ, and a push that way takes that and the motor's 2 N·m to undo."""
    holding = 9.81 * 0.3 * math.sin(math.radians(20))
    for sign in (1.0, -1.0):
        most = ScenarioContext(WEAK).borne(np.radians([20.0]), np.array([sign]))
        assert most == pytest.approx(2 + sign * holding, rel=0.01)
    push = only(built("push", WEAK, pivot="20"))
    assert isinstance(push, Push) and push.torque == pytest.approx([SHARE * (2 + holding)], rel=0.01)


def test_what_is_taken_up_is_a_share_of_what_can_be_carried() -> None:
    """By hand: z of a point (x, 0, z) under the pivot is −x sin θ + z cos θ, and the torque of its weight the slope."""
    angle = math.radians(10)
    holding, per_mass = (9.81 * (-x * math.cos(angle) - z * math.sin(angle)) for x, z in ((0.0, -0.3), (0.2, -0.5)))
    load = only(built("payload", WEAK, pivot="10"))
    assert isinstance(load, Load) and load.location == "tip"
    assert load.mass == pytest.approx(SHARE * (-2 - holding) / per_mass, rel=0.01)


def test_without_limits_they_follow_from_inertia() -> None:
    """A free cart of 2 kg speeds up by 1 m/s²; a load adds a fifth to its mass."""
    push, load = only(built("push", cart())), only(built("payload", cart()))
    assert isinstance(push, Push) and isinstance(load, Load)
    assert push.torque == pytest.approx([2.0]) and load.mass == pytest.approx(0.4)
    force = only(built("push", cart(), site="box"))
    assert isinstance(force, PointForce) and force.force == pytest.approx([2.0, 0.0, 0.0])


def test_one_joint_alone_is_pushed_or_all_that_are_driven() -> None:
    one, size = only(built("push", RIG, joint="reach", torque="3")), only(built("push", RIG, torque="-2"))
    assert isinstance(one, Push) and isinstance(size, Push)
    assert one.torque.tolist() == [0.0, 3.0] and size.torque.tolist() == [-2.0, -2.0]
    force = only(built("push", RIG, site="rod", force="3", direction="0 0 -2"))
    assert isinstance(force, PointForce)
    assert force.force.tolist() == [0.0, 0.0, -3.0] and force.location == "rod"


def test_by_default_a_force_acts_where_the_robot_gives_way_most() -> None:
    """A pendulum's site moves across the line to its pivot."""
    force = only(built("push", PENDULUM, force="2"))
    assert isinstance(force, PointForce)
    np.testing.assert_allclose(force.force, 2 * np.array([0.5, 0.0, 0.2]) / math.hypot(0.5, 0.2), atol=1e-9)


@pytest.mark.parametrize("begins", ["0", "0.5"])
def test_a_payload_is_there_from_its_time_on(begins: str) -> None:
    """Held by nothing, a pendulum swings as its mass tells: with the load as MuJoCo has it, and before as without."""
    load = only(built("payload", PENDULUM, begins=begins, mass="0.5"))
    assert isinstance(load, Load)
    laden, bare = moved(PENDULUM.with_payload("tip", 0.5), until=0.4), moved(PENDULUM, until=0.4)
    assert np.abs(laden - bare).max() > 1e-2
    np.testing.assert_allclose(moved(PENDULUM, load, until=0.4), laden if begins == "0" else bare, atol=1e-9)


# --- the leg's numbers, and those of any description ---------------------------------------------------------------


def test_the_legs_push_and_payload_have_the_legs_numbers() -> None:
    push, payload = built("push", nominal_leg()), built("payload", nominal_leg())
    for scenario, duration in ((push, 10.0), (payload, 12.0)):
        assert scenario.reference.position(0.0).tolist() == [math.radians(85), math.radians(35)]
        assert (scenario.duration, scenario.score_window) == (duration, (3.5, duration))
        assert scenario.start.command is None and scenario.start.position is None
    event, load = only(push), only(payload)
    assert isinstance(event, Push) and (event.time, event.duration, event.torque.tolist()) == (4.0, 1.0, [0.4, 0.4])
    assert load == Load(4.0, 0.1, "foot")
    bent = built("push", nominal_leg(), hip="80", torque="0.1")
    assert bent.reference.position(0.0).tolist() == [math.radians(80), math.radians(35)]


def test_names_of_joints_make_no_robot_the_leg() -> None:
    leg = nominal_leg()
    other = Morphology("other", leg.links, leg.joints, leg.actuators, leg.foot)
    assert other.keyframes == {} and other.home is None and other.scenario_options == {}
    assert leg.keyframes["stretched"].tolist() == [math.pi / 2, 0.0]


def test_a_description_has_poses_and_options_of_its_own() -> None:
    leg = nominal_leg()
    own = Morphology(
        "own", leg.links, leg.joints, leg.actuators, leg.foot, poses={"bent": (1.5, 0.4)},
        scenarios={"hold": {"duration": 3, "knee": 40.0}, "push": {"torque": 0.2}},
    )  # fmt: skip
    back = model_from_dict(model_to_dict(Model(own))).robot
    for robot in (own, back):
        hold = built("hold", robot)
        assert hold.duration == 3.0 and hold.reference.position(0.0) == pytest.approx([1.5, math.radians(40)])
        assert built("hold", robot, duration="5", knee="10").duration == 5.0
    changed = leg.with_parameters({"maa.stiffness": 300.0})
    assert model_to_dict(Model(changed))["morphology"] == "nominal_leg"
    assert changed.keyframes.keys() == {"stretched"}


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"poses": {"a": [1.0]}}, "pose 'a' is [1.0], expected one finite angle in rad for each of 2 joints"),
        ({"poses": {"a": [1.0, math.nan]}}, "expected one finite angle in rad"),
        ({"poses": 3}, "poses is 3, expected a table"),
        ({"scenarios": {"push": 3}}, "scenario 'push' is 3, expected a table of its options"),
    ],
)
def test_a_description_that_cannot_be_is_told(given: dict[str, object], sentence: str) -> None:
    leg = nominal_leg()
    whole = model_to_dict(Model(Morphology("own", leg.links, leg.joints, leg.actuators, leg.foot)))
    assert sentence in refusal(lambda: model_from_dict({**whole, "morphology": {**whole["morphology"], **given}}))


# --- options at fault --------------------------------------------------------------------------------------------


def test_a_sentence_names_the_option_at_fault_and_no_other() -> None:
    said = refusal(lambda: built("hold", WEAK, duration="1", pivot="90"))
    assert "with pivot = 90: " in said and "duration" not in said
    said = refusal(lambda: built("step", RIG, joint="reach", begins="5", size="1"))
    assert "with begins = 5: " in said and "joint = " not in said
    # Either alone would do, so both are told.
    said = refusal(lambda: built("step", RIG, begins="3", duration="2"))
    assert "with begins = 3 with duration = 2: " in said
