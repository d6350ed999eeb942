"""Effects on MJCF robots: their units, where they sit, payloads and tilts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from mjcf_models import ARM, CRANE, PENDULUM, RK4, M, cart, pendulum, refusal, run, slider

from equimus_ctrl.effects import (
    REGISTRY,
    ActuatorGain,
    AsymmetricFriction,
    CoulombFriction,
    DriveCompliance,
    DrivePlay,
    Effect,
    GravityTilt,
    ParallelSpring,
    PayloadMass,
    PayloadOffCentre,
    QuadraticDamping,
    SensorOffset,
    SpringTether,
    TorqueSaturation,
    TransportDelay,
    ViscousFriction,
    catalogue,
)
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.native import Draft
from equimus_ctrl.identification.parameters import free_parameters, unit_of
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.mjcf.export import exported
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

# --- units and places -------------------------------------------------------------------------------------------

UNITS: dict[Effect, dict[str, str]] = {
    CoulombFriction("reach", 1.0): {"friction": "N"},
    CoulombFriction("shoulder", 1.0): {"friction": "N·m"},
    ViscousFriction("reach", 1.0): {"damping": "N·s/m"},
    ViscousFriction("shoulder", 1.0): {"damping": "N·m·s/rad"},
    QuadraticDamping("reach", 1.0): {"drag": "N·s²/m²"},
    ParallelSpring("reach", 1.0, 0.0): {"stiffness": "N/m", "rest": "m"},
    ParallelSpring("shoulder", 1.0, 0.0): {"stiffness": "N·m/rad", "rest": "rad"},
    DrivePlay("reach", 0.1): {"play": "m"},
    SensorOffset("reach", 0.1): {"offset": "m"},
    SensorOffset("shoulder", 0.1): {"offset": "rad"},
    TorqueSaturation("push", 1.0): {"level": "N"},
    TorqueSaturation("servo", 1.0): {"level": "N·m"},
    TransportDelay("push", 0.1): {"delay": "s"},
    PayloadMass("tip", 0.1): {"mass": "kg"},
    GravityTilt("base", 0.1): {"angle": "rad"},
}


@pytest.mark.parametrize("effect", UNITS, ids=lambda e: f"{e.name}:{e.location}")
def test_effects_at_slides_and_hinges_have_their_units(effect: Effect) -> None:
    model = Model(CRANE, (effect,))
    prefix = f"{effect.location}.{effect.name}."
    assert {key: unit_of(model, prefix + key) for key in effect.parameter_info()} == UNITS[effect]


def middle(name: str, place: str) -> Effect:
    """An effect with numbers within its bounds."""
    cls = REGISTRY[name]
    return cls(place, **{key: 0.5 * (m["low"] + m["high"]) for key, m in cls.parameter_info().items()})


@pytest.mark.parametrize("name", sorted(set(catalogue("elastic")) - set(catalogue("mjcf"))))
def test_effects_of_elastic_robots_are_refused_on_mjcf_robots(name: str) -> None:
    place = {"joint": "shoulder", "actuator": "push", "link": "arm", "foot": "tip", "base": "base"}
    told = refusal(lambda: Model(CRANE, (middle(name, place[REGISTRY[name].sits_at[0]]),)))
    assert told.startswith(f"crane: an MJCF robot cannot have effect {name} (it can: ")
    assert all(other in told for other in catalogue("mjcf"))


@pytest.mark.parametrize("name", sorted(set(catalogue("mjcf")) - set(catalogue("elastic"))))
def test_effects_of_mjcf_robots_are_refused_on_elastic_robots(name: str) -> None:
    place = {"joint": "hip", "actuator": "maa", "link": "calf", "foot": "foot", "base": "base"}
    told = refusal(lambda: Model(nominal_leg(), (middle(name, place[REGISTRY[name].sits_at[0]]),)))
    assert told.startswith(f"nominal_leg: a robot with elastic actuators cannot have effect {name} (it can: ")
    assert all(other in told for other in catalogue("elastic"))


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        (
            (ViscousFriction("sholder", 1.0),),
            "effect viscous_friction: there is no joint 'sholder'; did you mean 'shoulder'? (known: reach, shoulder)",
        ),
        ((TransportDelay("shoulder", 0.1),), "effect transport_delay: there is no actuator 'shoulder'"),
        ((PayloadMass("floor", 0.1),), "effect payload_mass: there is no foot or link 'floor'"),
        ((GravityTilt("arm", 0.1),), "effect gravity_tilt: there is no base 'arm' (known: base)"),
        (
            (CoulombFriction("reach", 1.0), AsymmetricFriction("reach", 1.0, 2.0)),
            "'reach' has two effects that exclude each other, coulomb_friction and asymmetric_friction",
        ),
        (
            (DrivePlay("reach", 0.1), DriveCompliance("reach", 10.0, 0.1)),
            "'reach' has two effects that exclude each other, drive_play and joint_compliance",
        ),
        ((ActuatorGain("push", 0.9), ActuatorGain("push", 0.8)), "'push' has two effects that exclude each other"),
    ],
)
def test_effects_sit_where_they_can(effects: tuple[Effect, ...], message: str) -> None:
    assert refusal(lambda: Model(CRANE, effects)).startswith(f"crane: {message}")


def test_dry_friction_sits_at_joints_of_mjcf_robots_alone() -> None:
    """On elastic robots it can rub along an actuator, which has no coordinate of its own here."""
    assert "coulomb_friction" in refusal(lambda: Model(CRANE, (CoulombFriction("push", 1.0),)))


@pytest.mark.parametrize("effect", [DriveCompliance("way", 10.0, 0.1), DrivePlay("way", 0.1)], ids=lambda e: e.name)
def test_a_drive_that_gives_way_needs_something_that_turns_with_it(effect: Effect) -> None:
    told = refusal(lambda: Model(MjcfRobot("cart", slider()), (effect,)))
    assert told.startswith("cart: way has no armature, expected more than 0")


# --- payloads and gravity ---------------------------------------------------------------------------------------


def tensor(model: Any, body: str) -> Array:
    """(3, 3) inertia about the centre of mass, along the body's axes."""
    part, turn = model.body(body), np.empty(9)
    mujoco.mju_quat2Mat(turn, part.iquat)
    axes = turn.reshape(3, 3)
    return np.asarray(axes @ np.diag(part.inertia) @ axes.T)


def test_a_payload_at_a_site_counts_by_parallel_axes() -> None:
    mass, at = 0.75, np.array([0.03, 0.01, -0.2])
    before = CRANE.mujoco_model()
    own, com = 0.5, np.array([0.01, 0.0, -0.1])
    middle = (own * com + mass * at) / (own + mass)
    away = at - com
    # Two masses about their common centre: the reduced mass at the end of what is between them.
    whole = tensor(before, "rod") + own * mass / (own + mass) * (away @ away * np.eye(3) - np.outer(away, away))
    model = CRANE.with_payload("tip", mass).mujoco_model()
    assert model.body("rod").mass[0] == pytest.approx(own + mass)
    np.testing.assert_allclose(model.body("rod").ipos, middle, atol=1e-15)
    np.testing.assert_allclose(tensor(model, "rod"), whole, atol=1e-15)
    np.testing.assert_array_equal(tensor(model, "arm"), tensor(before, "arm"))
    assert model.body("arm").mass[0] == 2.0 and model.body("arm").subtreemass[0] == pytest.approx(2.5 + mass)


def test_a_payload_at_a_body_sits_at_its_centre_of_mass() -> None:
    model = CRANE.with_payload("arm", 0.5).mujoco_model()
    assert model.body("arm").mass[0] == 2.5
    np.testing.assert_allclose(model.body("arm").ipos, [0.1, 0.02, -0.3], atol=1e-15)
    np.testing.assert_allclose(tensor(model, "arm"), np.diag([0.03, 0.02, 0.01]), atol=1e-15)


def mass_matrix(model: Any, q: Array) -> tuple[Array, Array]:
    """(nv, nv) and (nv,) the weights, in a pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    whole = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, whole)
    return whole, np.array(data.qfrc_bias)


def test_a_payload_beside_the_centre_is_one_at_a_site_there() -> None:
    """The tip is 0.02, 0.01, −0.1 m from the rod's centre of mass, along the body's axes whatever its inertia's."""
    at_tip = CRANE.with_payload("tip", 0.4).mujoco_model()
    beside = CRANE.with_payload("rod", 0.4, (0.02, 0.01, -0.1)).mujoco_model()
    for field in ("body_mass", "body_ipos", "body_inertia"):
        assert getattr(beside, field) == pytest.approx(getattr(at_tip, field))
    model = Model(CRANE, (PayloadOffCentre("rod", 0.4, 0.02, 0.01, -0.1),))
    assert changed_bodies(model.effects, CRANE).mujoco_model().body_ipos == pytest.approx(at_tip.body_ipos)
    assert "exclude each other" in refusal(
        lambda: Model(CRANE, (PayloadOffCentre("rod", 0.4, 0.1, 0.0, 0.0), PayloadMass("rod", 0.1)))
    )


def test_a_tether_is_a_spring_along_a_slide() -> None:
    """A cart on a level slide, tied to a point beside it: harmonic about that point's foot, ω² = k/M."""
    k, at = 50.0, 0.5
    found = run(cart(option=RK4), SpringTether("box", k, at, 0.1, 0.3), q=-0.2)
    np.testing.assert_allclose(found.x, at - 0.7 * np.cos(math.sqrt(k / M) * found.t), rtol=0, atol=1e-6)


@pytest.mark.parametrize("length", [0.0, 0.25])
def test_a_tether_is_written_as_a_tendon(length: float) -> None:
    """At a site, and at the centre of mass of a last body where there is none."""
    for robot, place in ((CRANE, "tip"), (cart(), "box")):
        tied = robot.with_tether(place, 20.0, (0.4, 0.2, -0.3), length)
        own = tied.mujoco_model()
        again = mujoco.MjModel.from_xml_string(exported(tied, Draft(own)))
        for model in (own, again):
            data = mujoco.MjData(model)
            data.qpos[:] = 0.2
            mujoco.mj_forward(model, data)
            at = data.site("tip").xpos if place == "tip" else data.body("box").xipos
            way = np.array([0.4, 0.2, -0.3]) - at
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, at, model.body("rod" if place == "tip" else "box").id)
            stiffness = 20.0 * (1 - length / np.linalg.norm(way))
            bare = robot.mujoco_model()
            free = mujoco.MjData(bare)
            free.qpos[:] = 0.2
            mujoco.mj_forward(bare, free)
            np.testing.assert_allclose(data.qfrc_passive - free.qfrc_passive, jacobian.T @ way * stiffness, atol=1e-9)


def test_a_robot_has_one_tether_at_most_and_where_it_ends() -> None:
    one = SpringTether("tip", 1.0, 0.0, 0.0, 0.0)
    assert "crane" in refusal(lambda: Model(CRANE, (one, SpringTether("tip", 2.0, 0.0, 0.0, 0.0))))
    assert refusal(lambda: Model(CRANE, (SpringTether("arm", 1.0, 0.0, 0.0, 0.0),))).endswith("(known: tip)")


def test_payloads_weigh_as_bodies_of_their_own_would() -> None:
    pieces = '<body name="{}" pos="{}"><inertial mass="{}" pos="0 0 0" diaginertia="1e-9 1e-9 1e-9"/></body>'
    text = ARM.replace('<site name="tip"', pieces.format("load", "0.03 0.01 -0.2", 0.75) + '<site name="tip"')
    text = text.replace('<body name="rod"', pieces.format("weight", "0.1 0.02 -0.3", 0.3) + '<body name="rod"')
    loaded = CRANE.with_payload("tip", 0.5).with_payload("arm", 0.3).with_payload("tip", 0.25).mujoco_model()
    for q in ([0.0, 0.0], [0.7, -0.2], [-1.1, 0.4]):
        found, expected = (mass_matrix(m, np.array(q)) for m in (loaded, mujoco.MjModel.from_xml_string(text)))
        np.testing.assert_allclose(found[0], expected[0], atol=1e-8)
        np.testing.assert_allclose(found[1], expected[1], atol=1e-12)


def test_payloads_come_on_top_of_numbers_that_are_set() -> None:
    model = CRANE.with_payload("tip", 0.25).with_parameters({"rod.mass": 0.75}).mujoco_model()
    assert model.body("rod").mass[0] == 1.0
    assert CRANE.with_payload("tip", 0.25).parameters() == CRANE.parameters()


BALANCED = 'mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.01"'


@pytest.mark.parametrize(
    "change",
    [lambda m: m.with_payload("tip", 0.5), lambda m: m.with_parameters({"arm.com_x": 0.1})],
    ids=["load", "com"],
)
def test_a_balanced_wheel_can_be_unbalanced(change: Callable[[MjcfRobot], MjcfRobot]) -> None:
    """MuJoCo takes bodies whose centre lies in their joint for simple ones, unless it is told otherwise."""
    q = np.array([-0.3])
    whole, weight = mass_matrix(change(MjcfRobot("wheel", pendulum(inertial=BALANCED))).mujoco_model(), q)
    shift = PENDULUM.with_parameters({"arm.com_z": 0.0})
    reference = mass_matrix(change(shift).mujoco_model(), q)
    np.testing.assert_allclose(whole, reference[0], atol=1e-12)
    np.testing.assert_allclose(weight, reference[1], atol=1e-12)
    assert abs(weight[0]) > 0.5


TOOL = '<body name="tool" pos="0 0 -0.6"><site name="end"/></body>'


@pytest.mark.parametrize("mass", [0.0, 0.4])
def test_a_frame_without_mass_can_carry_a_payload(mass: float) -> None:
    robot = MjcfRobot("p", pendulum(body=TOOL)).with_payload("end", mass)
    whole, _ = mass_matrix(robot.mujoco_model(), np.zeros(1))
    assert whole[0, 0] == pytest.approx(0.02 + 0.01 + 0.09 + mass * 0.36)


def test_a_point_mass_has_no_inertia_of_its_own() -> None:
    """No warning either, of which tests make errors."""
    point = '<body name="ball" pos="0 0 -0.6"><inertial mass="0.3" pos="0 0 0" diaginertia="0 0 0"/></body>'
    robot = MjcfRobot("p", pendulum(body=point))
    assert robot.parameters()["ball.mass"] == 0.3
    whole, _ = mass_matrix(robot.with_parameters({"ball.mass": 0.5}).mujoco_model(), np.zeros(1))
    assert whole[0, 0] == pytest.approx(0.02 + 0.01 + 0.09 + 0.5 * 0.36)
    free = free_parameters(Model(robot))
    assert np.all(np.isfinite(free.low)) and "ball.inertia" not in free.names


TILTING = {
    "hinge along x": ('type="hinge" axis="1 0 0"', True),
    "hinge along y": ('type="hinge" axis="0 1 0"', True),
    "leaning hinge": ('type="hinge" axis="0.5 0.3 0.8"', True),
    "upright hinge": ('type="hinge" axis="0 0 1"', True),
    "slide along x": ('type="slide" axis="1 0 0"', True),
    "slide along y": ('type="slide" axis="0 1 0"', True),
    "leaning slide": ('type="slide" axis="0.5 0.3 0.8"', True),
    "upright slide": ('type="slide" axis="0 0 1"', False),
}


@pytest.mark.parametrize("what", TILTING)
def test_gravity_tilts_about_an_axis_that_matters(what: str) -> None:
    """To first order, where any axis does."""
    joint, first = TILTING[what]
    text = f"""<mujoco><worldbody><body name="b"><joint name="j" {joint}/>
      <inertial mass="2" pos="0.1 0.2 -0.3" diaginertia="0.1 0.1 0.1"/></body></worldbody>
      <actuator><motor name="m" joint="j"/></actuator></mujoco>"""
    robot = MjcfRobot("m", text)
    models = [robot.with_parameters({"tilt": t}).mujoco_model() for t in (-0.1, 0.1)]
    forces = [float(mass_matrix(m, np.zeros(1))[1][0]) for m in models]
    arm = {"hinge": 0.22, "slide": 1.0}[joint.split('"')[1]]
    if first:
        assert abs(forces[1] - forces[0]) > 0.3 * 2 * 9.81 * arm * 2 * math.sin(0.1)
    else:
        assert forces[0] == pytest.approx(forces[1]) == pytest.approx(2 * 9.81 * math.cos(0.1))
    for m in models:
        assert np.linalg.norm(m.opt.gravity) == pytest.approx(9.81)
        assert m.opt.gravity[2] == pytest.approx(-9.81 * math.cos(0.1))


def test_a_hanging_pendulum_follows_the_tilt() -> None:
    model = PENDULUM.with_parameters({"tilt": 0.25}).mujoco_model()
    assert mass_matrix(model, np.array([0.25]))[1][0] == pytest.approx(0, abs=1e-12)
    assert mass_matrix(model, np.array([0.0]))[1][0] == pytest.approx(-0.3 * 9.81 * math.sin(0.25))


def test_where_nothing_moves_the_first_joint_the_next_decides() -> None:
    """An upright slide that carries a hinge along x."""
    text = """<mujoco><worldbody><body name="lift"><joint name="z" type="slide" axis="0 0 1"/>
      <inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><body name="flap"><joint name="x" axis="1 0 0"/>
      <inertial mass="1" pos="0 0 -0.2" diaginertia="0.1 0.1 0.1"/></body></body></worldbody>
      <actuator><motor name="m" joint="x"/></actuator></mujoco>"""
    robot = MjcfRobot("lift", text)
    np.testing.assert_allclose(np.abs(robot.plan.tilt_axis), [1, 0, 0], atol=1e-12)
    weight = mass_matrix(robot.with_parameters({"tilt": 0.1}).mujoco_model(), np.zeros(2))[1]
    assert abs(weight[1]) == pytest.approx(0.2 * 9.81 * math.sin(0.1))
