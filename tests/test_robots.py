"""Every kind of robot against the one interface, and the engines' policies against the robots' traits."""

from __future__ import annotations

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
from mjcf_models import CRANE, PENDULUM
from morphologies import STRUCTURES, random_morphology

from equimus_ctrl.diagnosis.policy import SearchPolicy, SearchSettings
from equimus_ctrl.effects import CoulombFriction, NarrowingArea
from equimus_ctrl.effects.base import PLACES
from equimus_ctrl.engines.choice import MujocoEngine, ReducedEngine, engine_for
from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.identification.parameters import default_bounds, default_names, unit_of
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, model_from_dict, model_to_dict
from equimus_ctrl.robots.base import Robot, RobotTraits
from equimus_ctrl.robots.elastic.leg import ideal_leg, nominal_leg
from equimus_ctrl.robots.elastic.morphology import Point, elastic_of
from equimus_ctrl.robots.mjcf.robot import mjcf_of

ROBOTS: tuple[Robot, ...] = (nominal_leg(), ideal_leg(), CRANE, PENDULUM)
every_robot = pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)


@every_robot
def test_every_parameter_has_a_unit_and_bounds_about_its_value(robot: Robot) -> None:
    for name, value in robot.parameters().items():
        low, high = robot.bounds(name)
        assert low <= value <= high and low < high, name
        assert robot.unit(name)
        assert not (robot.positive(name) and low < 0)
        assert (robot.size(name) or 1.0) > 0


@every_robot
def test_parameters_are_replaced_by_name_and_others_refused(robot: Robot) -> None:
    name = robot.default_names()[0]
    changed = robot.with_parameters({name: 1.25 * robot.parameters()[name]})
    assert type(changed) is type(robot)
    assert {n for n, v in changed.parameters().items() if v != robot.parameters()[n]} == {name}
    assert robot.has_parameters(robot.default_names()) and not robot.has_parameters(["no.such"])
    with pytest.raises(ModelError, match=r"no\.such"):
        robot.with_parameters({"no.such": 1.0})


@every_robot
def test_a_model_asks_its_robot(robot: Robot) -> None:
    model = Model(robot)
    assert model.robot is robot and model.name == robot.name
    assert default_names(model) == robot.default_names()
    for name in robot.default_names():
        assert default_bounds(model, name) == robot.bounds(name)
        assert unit_of(model, name) == robot.unit(name)


@every_robot
def test_an_actuator_drives_joints_of_its_robot(robot: Robot) -> None:
    for actuator in robot.actuator_names:
        assert robot.driven_joints(actuator) and robot.driven_joints(actuator) <= set(robot.joint_names)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_an_elastic_actuator_drives_the_joints_on_which_it_has_a_lever_arm(structure: str) -> None:
    for seed in range(10):
        robot = random_morphology(structure, seed)
        kinematics, rng = Kinematics(robot), np.random.default_rng(seed)
        poses = rng.uniform(-2, 2, (20, len(robot.joints)))
        arms = np.max([np.abs(kinematics.jacobian(q)) for q in poses], axis=0)
        for own, actuator in zip(arms, robot.actuator_names, strict=True):
            found = {name for name, arm in zip(robot.joint_names, own, strict=True) if arm > 1e-9}
            assert found == robot.driven_joints(actuator)


def test_an_elastic_actuator_does_not_drive_a_joint_on_whose_pivot_it_ends() -> None:
    leg = nominal_leg()
    baa = replace(leg.actuators[1], insertion=Point("calf", 0.0))
    assert leg.driven_joints("baa") == {"hip", "knee"}
    assert replace(leg, actuators=(leg.actuators[0], baa)).driven_joints("baa") == {"hip"}


@every_robot
def test_places_are_of_the_kinds_that_effects_know(robot: Robot) -> None:
    places, pushed = robot.places(), robot.force_places()
    assert set(places) == set(pushed) == set(PLACES)
    assert places["joint"] == pushed["joint"] == robot.joint_names
    assert places["actuator"] == robot.actuator_names
    assert pushed["actuator"] == (robot.actuator_names if robot.traits.forces_along_actuators else ())
    low, high = robot.joint_range
    assert low.shape == high.shape == (len(robot.joint_names),) and np.all(low < high)


@every_robot
def test_a_payload_and_a_tilt_make_another_robot_of_the_same_kind(robot: Robot) -> None:
    heavy = robot.with_payload(robot.places()["link"][-1], 0.3)
    assert type(heavy) is type(robot) and heavy.name == robot.name
    assert robot.with_parameters({"tilt": 0.1}).tilt == 0.1


@every_robot
def test_a_model_file_gives_the_robot_back(robot: Robot) -> None:
    model = Model(robot.with_parameters({name: 1.1 * robot.parameters()[name] for name in robot.default_names()[:2]}))
    plain = replace(CRANE, name="plain") if robot is CRANE else replace(robot, name="plain")
    again = model_from_dict(model_to_dict(model), "here", lambda name, edits: plain)  # type: ignore[arg-type, return-value]
    assert again.name == model.name and again.parameters() == model.parameters()
    assert ("phase" in model_to_dict(model)) == robot.traits.has_stance


@every_robot
def test_what_plants_and_controllers_ask_is_there_for_each_joint_and_actuator(robot: Robot) -> None:
    nj, na = len(robot.joint_names), len(robot.actuator_names)
    low, high = robot.command_limits
    assert low.shape == high.shape == robot.command_rates.shape == (na,) and np.all(low < high)
    assert len(robot.joint_units) == nj and set(robot.joint_units) <= {"rad", "m"}
    assert len(robot.command_units) == len(robot.goals) == na
    for pose in (*robot.keyframes.values(), *([] if robot.home is None else [robot.home])):
        assert pose.shape == (nj,) and np.isfinite(pose).all()
    assert "inverse" in robot.offers


def test_limits_of_commands_are_where_they_make_no_difference_any_more() -> None:
    low, high = CRANE.command_limits
    assert low.tolist() == [-20.0, -1.0, -np.inf] and high.tolist() == [20.0, 1.0, np.inf]
    unclipped = replace(
        CRANE, xml=CRANE.xml.replace("<worldbody>", '<option><flag clampctrl="disable"/></option><worldbody>', 1)
    )
    assert unclipped.command_limits[0].tolist() == [-20.0, -np.inf, -np.inf]


def test_what_one_robot_alone_can_have_is_refused_by_the_other() -> None:
    with pytest.raises(ConfigError, match="cannot have effect narrowing_area"):
        Model(CRANE, (NarrowingArea("push", *([0.1] * len(NarrowingArea.parameter_info()))),))
    with pytest.raises(ConfigError, match="coulomb_friction"):
        Model(CRANE, (CoulombFriction("push", 0.1),))  # forces act at its joints alone
    assert Model(nominal_leg(), (CoulombFriction("maa", 0.1),)).effects


def test_a_robot_of_another_kind_is_refused_in_a_sentence() -> None:
    assert elastic_of(nominal_leg()).actuators and mjcf_of(CRANE).xml
    with pytest.raises(ConfigError, match="crane: has no elastic actuators"):
        _ = Model(CRANE).morphology
    with pytest.raises(ConfigError, match="nominal_leg: is no MJCF robot"):
        mjcf_of(nominal_leg())


def test_every_trait_has_a_sentence() -> None:
    assert all(f"{f.name}:" in (RobotTraits.__doc__ or "") for f in fields(RobotTraits))


def test_an_engines_own_step_is_its_own_matter() -> None:
    reduced, mujoco = engine_for(Model(nominal_leg())), engine_for(Model(CRANE), "mujoco")
    assert isinstance(reduced, ReducedEngine) and isinstance(mujoco, MujocoEngine)
    assert reduced.batched and not reduced.costly and reduced.discretisation is None
    assert reduced.without_step_error() is reduced and reduced.finer() is not None
    own = mujoco.discretisation
    assert not mujoco.batched and mujoco.costly and own is not None and own.step == CRANE.timestep
    finer = mujoco.with_finer_step().discretisation
    assert finer is not None and finer.step == own.step / own.finer
    assert mujoco.without_step_error().discretisation is None
    assert engine_for(Model(nominal_leg()), "mujoco").name == "mujoco"
    with pytest.raises(ConfigError, match="the physics step is -1 s"):
        engine_for(Model(CRANE), dt=-1.0)


def test_the_search_follows_the_robot_and_its_cost_the_engine() -> None:
    """A robot that nothing holds in place, on an engine that is cheap and exact: what each says is kept apart."""
    policy = SearchPolicy.of(CRANE.traits, ReducedEngine())
    assert policy == SearchPolicy(coarse_derivatives=False, rescaled_guesses=True, many_minima=True)
    assert SearchPolicy.of(nominal_leg().traits, MujocoEngine(CRANE)) == SearchPolicy(coarse_derivatives=True)
    plain = SearchSettings()
    assert SearchPolicy().applied(plain) == plain
    assert policy.applied(plain).many_minima


@every_robot
def test_a_robot_that_was_looked_at_goes_to_another_process(robot: Robot) -> None:
    assert robot.joint_names and robot.actuator_names
    again = pickle.loads(pickle.dumps(robot))
    assert again.joint_names == robot.joint_names and again.parameters() == robot.parameters()
