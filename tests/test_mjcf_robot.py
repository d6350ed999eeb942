"""MJCF robots: their numbers, which of them are free by default, and what is refused."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mjcf_models import CRANE, PENDULUM, pendulum, refusal, slider

from equimus_ctrl.effects import CoulombFriction
from equimus_ctrl.errors import ModelError
from equimus_ctrl.identification.parameters import default_names, free_parameters
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.inertia import SHAPE
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array
from equimus_ctrl.workflow import load_mjcf, parameter_rows

# --- numbers ----------------------------------------------------------------------------------------------------

Place = tuple[str, str, str, int | None]
"""What has it (as ``MjModel`` calls it), its name there, the field, and the entry in it."""

NUMBERS: dict[str, tuple[float, str, Place]] = {
    "arm.mass": (2.0, "kg", ("body", "arm", "body_mass", None)),
    "arm.com_x": (0.1, "m", ("body", "arm", "body_ipos", 0)),
    "arm.com_y": (0.02, "m", ("body", "arm", "body_ipos", 1)),
    "arm.com_z": (-0.3, "m", ("body", "arm", "body_ipos", 2)),
    "rod.mass": (0.5, "kg", ("body", "rod", "body_mass", None)),
    "rod.com_x": (0.01, "m", ("body", "rod", "body_ipos", 0)),
    "rod.com_y": (0.0, "m", ("body", "rod", "body_ipos", 1)),
    "rod.com_z": (-0.1, "m", ("body", "rod", "body_ipos", 2)),
    "shoulder.damping": (0.1, "N·m·s/rad", ("dof", "shoulder", "dof_damping", None)),
    "shoulder.quadratic_damping": (0.0, "N·m·s²/rad²", ("dof", "shoulder", "dof_dampingpoly", 0)),
    "shoulder.armature": (0.02, "kg·m²", ("dof", "shoulder", "dof_armature", None)),
    "shoulder.frictionloss": (0.05, "N·m", ("dof", "shoulder", "dof_frictionloss", None)),
    "shoulder.stiffness": (1.5, "N·m/rad", ("joint", "shoulder", "jnt_stiffness", None)),
    "shoulder.springref": (0.2, "rad", ("qpos", "shoulder", "qpos_spring", None)),
    "reach.damping": (3.0, "N·s/m", ("dof", "reach", "dof_damping", None)),
    "reach.quadratic_damping": (0.0, "N·s²/m²", ("dof", "reach", "dof_dampingpoly", 0)),
    "reach.armature": (0.1, "kg", ("dof", "reach", "dof_armature", None)),
    "reach.frictionloss": (0.4, "N", ("dof", "reach", "dof_frictionloss", None)),
    "reach.stiffness": (40.0, "N/m", ("joint", "reach", "jnt_stiffness", None)),
    "reach.springref": (0.05, "m", ("qpos", "reach", "qpos_spring", None)),
    "push.gain": (1.0, "1", ("actuator", "push", "actuator_gainprm", 0)),
    "drive.gain": (5.0, "N·m/rad", ("actuator", "drive", "actuator_gainprm", 0)),
}
"""Those that are one entry of one field each."""
MORE = {
    "arm.inertia": (0.03, "kg·m²"),
    "rod.inertia": (0.004, "kg·m²"),
    "push.force_limit": (20.0, "N"),
    "servo.kp": (30.0, "N·m/rad"),
    "servo.kv": (1.5, "N·m·s/rad"),
    "drive.kv": (0.5, "N·m·s/rad"),
    "gravity": (9.81, "m/s²"),
    "tilt": (0.0, "rad"),
} | {f"{body}.{kind}": (0.0, "1") for body in ("arm", "rod") for kind in SHAPE}
DERIVED = {
    "actuator_acc0", "body_invweight0", "body_subtreemass", "dof_M0", "dof_invweight0", "dof_length",
    "tendon_invweight0", "tendon_lengthspring",
}  # fmt: skip
"""Fields that MuJoCo works out from others."""


def test_every_number_of_the_file_is_read_with_its_unit() -> None:
    expected = {name: row[:2] for name, row in NUMBERS.items()} | MORE
    found = CRANE.parameters()
    assert set(found) == set(expected)
    assert {name: (pytest.approx(found[name], rel=1e-12), CRANE.unit(name)) for name in found} == expected
    assert {row["name"]: row["unit"] for row in parameter_rows(Model(CRANE))} == {
        name: unit for name, (_, unit) in expected.items()
    }


def fields_of(model: Any) -> dict[str, Array]:
    found = {name: getattr(model, name) for name in dir(model) if isinstance(getattr(model, name), np.ndarray)}
    return {name: np.array(value) for name, value in found.items()} | {"gravity": np.array(model.opt.gravity)}


def changed_fields(values: Mapping[str, float], robot: MjcfRobot = CRANE) -> set[str]:
    """Fields of the model that numbers change, without those that follow from others."""
    before = fields_of(robot.mujoco_model())
    after = fields_of(robot.with_parameters(values).mujoco_model())
    return {name for name in before if not np.array_equal(before[name], after[name])} - DERIVED


def entry(model: Any, place: Place) -> float:
    kind, name, array, at = place
    part = {"dof": "joint", "qpos": "joint"}.get(kind, kind)
    named = getattr(model, part)(name)
    index = {"dof": lambda: named.dofadr[0], "qpos": lambda: named.qposadr[0]}.get(kind, lambda: named.id)()
    row = getattr(model, array)[index]
    return float(row if at is None else row[at])


@pytest.mark.parametrize("name", NUMBERS)
def test_a_number_goes_where_it_belongs_and_nowhere_else(name: str) -> None:
    value, _, place = NUMBERS[name]
    assert entry(CRANE.plan.base, place) == value
    changed = CRANE.with_parameters({name: value + 0.125})
    assert changed.parameters() == {**CRANE.parameters(), name: value + 0.125}
    model = changed.mujoco_model()
    assert entry(model, place) == value + 0.125
    assert changed_fields({name: value + 0.125}) == {place[2]}
    others = [other for _, _, other in NUMBERS.values() if other != place]
    assert [entry(model, other) for other in others] == [entry(CRANE.plan.base, other) for other in others]


def test_an_inertia_is_the_largest_moment_and_keeps_the_shape() -> None:
    model = CRANE.with_parameters({"rod.inertia": 0.008}).mujoco_model()
    np.testing.assert_allclose(model.body("rod").inertia, 2 * CRANE.plan.base.body("rod").inertia, rtol=1e-12)
    np.testing.assert_array_equal(model.body("arm").inertia, CRANE.plan.base.body("arm").inertia)
    assert changed_fields({"rod.inertia": 0.008}) == {"body_inertia"}


def test_what_a_servo_has_goes_into_gain_and_bias() -> None:
    model = CRANE.with_parameters({"servo.kp": 50.0, "servo.kv": 2.5}).mujoco_model()
    np.testing.assert_array_equal(model.actuator("servo").gainprm[:3], [50, 0, 0])
    np.testing.assert_array_equal(model.actuator("servo").biasprm[:3], [0, -50, -2.5])
    for other in ("push", "drive"):
        np.testing.assert_array_equal(model.actuator(other).gainprm, CRANE.plan.base.actuator(other).gainprm)
        np.testing.assert_array_equal(model.actuator(other).biasprm, CRANE.plan.base.actuator(other).biasprm)


def test_a_general_affine_actuator_keeps_the_rest_of_its_bias() -> None:
    model = CRANE.with_parameters({"drive.gain": 7.0, "drive.kv": 0.25}).mujoco_model()
    assert model.actuator("drive").gainprm[0] == 7.0
    np.testing.assert_array_equal(model.actuator("drive").biasprm[:3], [1, -3, -0.25])


def test_a_limit_of_forces_holds_in_both_directions() -> None:
    model = CRANE.with_parameters({"push.force_limit": 12.0}).mujoco_model()
    np.testing.assert_array_equal(model.actuator("push").forcerange, [-12, 12])
    assert changed_fields({"push.force_limit": 12.0}) == {"actuator_forcerange"}


def test_gravity_keeps_its_direction_and_its_size() -> None:
    """In whatever order the two are given."""
    for values in ({"gravity": 3.7, "tilt": 0.2}, {"tilt": 0.2, "gravity": 3.7}):
        gravity = CRANE.with_parameters(values).mujoco_model().opt.gravity
        assert np.linalg.norm(gravity) == pytest.approx(3.7)
        assert math.atan2(math.hypot(gravity[0], gravity[1]), -gravity[2]) == pytest.approx(0.2)
    np.testing.assert_allclose(CRANE.with_parameters({"gravity": 1.62}).mujoco_model().opt.gravity, [0, 0, -1.62])


def test_numbers_that_are_set_to_what_they_are_change_no_bit() -> None:
    for name, value in CRANE.parameters().items():
        assert changed_fields({name: value}) <= {"gravity"}, name
    again = CRANE.with_parameters(CRANE.parameters())
    assert again.parameters() == CRANE.parameters()
    np.testing.assert_allclose(again.mujoco_model().opt.gravity, CRANE.plan.base.opt.gravity, rtol=1e-15, atol=1e-15)


def test_a_change_leaves_the_robot_it_came_from_alone() -> None:
    before = fields_of(CRANE.mujoco_model())
    model = CRANE.with_parameters({"arm.mass": 5.0, "shoulder.damping": 7.0}).mujoco_model()
    model.body_mass[:] = 9.0
    after = fields_of(CRANE.mujoco_model())
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_numbers_follow_from_what_mujoco_makes_of_the_file() -> None:
    """Degrees, defaults, masses of geoms and damping ratios are MuJoCo's to work out."""
    text = """<mujoco model="d"><compiler angle="degree"/><default><joint damping="0.7"/></default><worldbody>
      <body name="ball"><joint name="pivot" axis="0 1 0" springref="30" range="-90 45"/>
      <geom type="sphere" size="0.1" density="1000" pos="0 0 -0.4"/></body></worldbody>
      <actuator><position name="servo" joint="pivot" kp="8" dampratio="1"/></actuator></mujoco>"""
    robot = MjcfRobot("d", text)
    found, mass = robot.parameters(), 1000 * 4 / 3 * math.pi * 0.1**3
    inertia = 0.4 * mass * 0.01
    assert found["pivot.damping"] == 0.7
    assert found["pivot.springref"] == pytest.approx(math.pi / 6)
    assert found["ball.mass"] == pytest.approx(mass) and found["ball.inertia"] == pytest.approx(inertia)
    assert found["ball.com_z"] == pytest.approx(-0.4)
    assert found["servo.kv"] == pytest.approx(2 * math.sqrt(8 * (inertia + mass * 0.16)))
    assert robot.joints[0].range == pytest.approx((-math.pi / 2, math.pi / 4))


def test_joints_and_actuators_are_told() -> None:
    assert CRANE.joint_names == ("shoulder", "reach") and CRANE.actuator_names == ("push", "servo", "drive")
    assert [joint.slides for joint in CRANE.joints] == [False, True]
    assert CRANE.joints[0].range == (-1.5, 1.6) and CRANE.joints[1].range == (-math.inf, math.inf)
    assert [(d.joint, d.servo, d.unit) for d in CRANE.actuators] == [
        ("reach", False, "N"),
        ("shoulder", True, "rad"),
        ("shoulder", True, "rad"),
    ]
    assert [d.range for d in CRANE.actuators] == [(-math.inf, math.inf), (-1, 1), (-math.inf, math.inf)]
    assert CRANE.timestep == 0.001
    assert CRANE.places() == {
        "joint": ("shoulder", "reach"),
        "actuator": ("push", "servo", "drive"),
        "link": ("arm", "rod"),
        "foot": ("tip",),
        "base": ("base",),
    }


@pytest.mark.parametrize(
    ("drive", "unit", "gain"),
    [
        ('<motor name="motor" joint="way"/>', "N", "1"),
        ('<general name="motor" joint="way" gainprm="3"/>', "1", "N"),
        ('<motor name="motor" joint="way" gear="10"/>', "1", "N"),
        ('<motor name="motor" joint="way" gear="-1"/>', "N", "1"),
        ('<position name="motor" joint="way" kp="3"/>', "m", None),
        ('<general name="motor" joint="way" gainprm="3" biastype="affine" biasprm="0 -2 0"/>', "m", "N/m"),
    ],
)
def test_commands_and_gains_of_a_slide_have_its_units(drive: str, unit: str, gain: str | None) -> None:
    robot = MjcfRobot("cart", slider(drive))
    assert robot.actuators[0].unit == unit
    assert gain is None or robot.unit("motor.gain") == gain
    assert gain is not None or robot.unit("motor.kp") == "N/m"


def test_the_unit_of_a_speed_servos_command_does_not_depend_on_its_gain() -> None:
    units = {
        MjcfRobot("cart", slider(f'<velocity name="m" joint="way" kv="{kv}"/>')).actuators[0].unit for kv in (1, 3)
    }
    assert len(units) == 1 and "N" not in units


def test_a_speed_servo_has_one_gain() -> None:
    robot = MjcfRobot("cart", slider('<velocity name="m" joint="way" kv="3"/>'))
    assert "m.gain" not in robot.parameters() and robot.parameters()["m.kv"] == 3
    changed = robot.with_parameters({"m.kv": 5.0}).mujoco_model()
    assert changed.actuator_gainprm[0, 0] == 5.0 and changed.actuator_biasprm[0, 2] == -5.0


def test_bounds_hold_every_number_and_nothing_negative_that_cannot_be() -> None:
    names = list(CRANE.parameters())
    free = free_parameters(Model(CRANE), names)
    assert free.names == tuple(names)
    assert np.all(free.low <= free.start) and np.all(free.low[free.start > 0] < free.start[free.start > 0])
    assert np.all(free.start < free.high)
    least = dict(zip(names, free.low, strict=True))
    for name in names:
        if not name.endswith(("com_x", "com_y", "com_z", "springref", "tilt", *SHAPE)):
            assert least[name] >= 0, name
    assert least["arm.com_z"] < -0.3 and least["tilt"] < 0 and least["reach.springref"] < 0


def test_a_motor_that_pulls_can_be_free_like_any_other() -> None:
    robot = MjcfRobot("cart", slider('<general name="motor" joint="way" gainprm="-2"/>'))
    assert robot.parameters()["motor.gain"] == -2.0
    assert robot.with_parameters(robot.parameters()).parameters() == robot.parameters()
    (free,) = free_parameters(Model(robot), ["motor.gain"]).free
    assert free.low < -2.0 < free.high


# --- what identification begins with ----------------------------------------------------------------------------


def test_of_a_hanging_pendulum_mass_and_inertia_are_free() -> None:
    """What turns with the motor cannot be told from the arm's own inertia."""
    assert default_names(Model(PENDULUM)) == ["arm.mass", "arm.inertia"]


def test_without_gravity_one_number_tells_all_of_a_single_inertia() -> None:
    weightless = MjcfRobot("p", pendulum().replace('timestep="0.001"', 'timestep="0.001" gravity="0 0 0"'))
    assert weightless.default_names() == ["arm.mass"]
    assert "gravity" not in weightless.parameters()


@pytest.mark.parametrize("joint", ['range="-0.1 0.1"', 'frictionloss="0.4"', 'damping="0.1" stiffness="2"'])
def test_ends_and_friction_do_not_change_which_masses_are_told(joint: str) -> None:
    names = MjcfRobot("p", pendulum(joint)).default_names()
    assert [n for n in names if n.startswith("arm") or n.endswith("armature")] == ["arm.mass", "arm.inertia"]
    kinds = re.findall(r"(damping|frictionloss|stiffness)=", joint)
    assert names[2:] == [f"pivot.{kind}" for kind in kinds]


def test_default_names_hold_effects_too_and_actuators_are_taken_to_be_known() -> None:
    names = default_names(Model(CRANE, (CoulombFriction("reach", 0.3),)))
    assert names == [
        "arm.mass", "rod.mass", "arm.inertia", "reach.armature", "shoulder.damping", "reach.damping",
        "shoulder.frictionloss", "reach.frictionloss", "shoulder.stiffness", "reach.stiffness",
        "reach.coulomb_friction.friction",
    ]  # fmt: skip


# --- what is refused --------------------------------------------------------------------------------------------

BODY = "<mujoco><worldbody><body name='b'>{}<geom size='1'/></body></worldbody>{}</mujoco>"

WRONG: dict[str, tuple[str, str]] = {
    "free joint": (BODY.format("<freejoint name='flight'/>", ""), "cart: joint 'flight' is a free joint, expected"),
    "unnamed free joint": (BODY.format("<freejoint/>", ""), "cart: joint 0 is a free joint, expected hinges and"),
    "ball joint": (BODY.format("<joint name='wrist' type='ball'/>", ""), "cart: joint 'wrist' is a ball joint, exp"),
    "unnamed joint": (BODY.format("<joint/>", ""), "cart: joint 0 has no name"),
    "no joint": (BODY.format("", ""), "cart: has no joint"),
    "no actuator": (BODY.format("<joint name='j'/>", ""), "cart: has no actuator"),
    "second unnamed actuator": (slider('<motor joint="way"/><motor joint="way"/>'), "cart: actuator 1 has no name"),
    "user dynamics": (
        slider('<general name="puller" joint="way" dyntype="user" actdim="1"/>'),
        "cart: actuator 'puller' has the dynamics 'user', which neither engine takes; expected motor, position,",
    ),
    "broken": ("<mujoco><worldbody><bod></worldbody></mujoco>", "cart: MuJoCo cannot load it ("),
    "no XML": ("arm = 1", "cart: MuJoCo cannot load it ("),
    "empty": ("", "cart: MuJoCo cannot load it ("),
    "unknown joint": (slider('<motor name="m" joint="wya"/>'), "'wya'"),
    "no mass": ("<mujoco><worldbody><body name='b'><joint name='j'/></body></worldbody></mujoco>", "mass and inertia"),
}


TAKEN = {
    "tendon": slider('<motor name="drive" tendon="rope"/>').replace(
        "<actuator>", '<tendon><fixed name="rope"><joint joint="way" coef="1"/></fixed></tendon><actuator>'
    ),
    "integrator": slider('<general name="drive" joint="way" dyntype="integrator"/>'),
    "integrated velocity": slider('<intvelocity name="drive" joint="way" kp="5" actrange="-1 1"/>'),
    "damper": slider('<damper name="drive" joint="way" kv="1" ctrlrange="0 1"/>'),
    "pid": slider('<pid name="drive" joint="way" kp="3" ki="1" input="pos"/>'),
    "dcmotor": slider('<dcmotor name="drive" joint="way" resistance="1" motorconst="0.1"/>'),
}


@pytest.mark.parametrize("what", TAKEN)
def test_actuators_with_laws_of_their_own_are_taken(what: str) -> None:
    robot = MjcfRobot("cart", TAKEN[what])
    assert robot.actuator_names == ("drive",) and robot.actuators[0].joint == "way" and not robot.obstacles


def test_the_voltage_of_a_motor_with_a_controller_is_a_parameter() -> None:
    """Beyond it a servo that is held at rest exerts K V/R, whatever its goal."""
    motor = '<dcmotor name="drive" joint="way" resistance="2" motorconst="0.5" input="pos" controller="9 0 0 0 0 6"/>'
    robot = MjcfRobot("cart", slider(motor)).with_parameters({"drive.voltage_limit": 3.0})
    model = robot.mujoco_model()
    data = mujoco.MjData(model)
    data.ctrl[0] = 10.0
    mujoco.mj_forward(model, data)
    assert data.actuator_force[0] == pytest.approx(0.5 * 3.0 / 2)


def test_each_command_of_an_actuator_has_a_column() -> None:
    robot = MjcfRobot("cart", slider('<pid name="drive" joint="way" kp="3" kv="0.2" input="pos vel ff"/>'))
    assert robot.actuator_names == ("drive.pos", "drive.vel", "drive.ff")
    assert [robot.command_unit(name) for name in robot.actuator_names] == ["m", "m/s", "N"]
    assert robot.parameters()["drive.kp"] == 3.0 and robot.parameters()["drive.kv"] == 0.2


SICK = {
    "step": ('timestep="0"', "timestep is 0 s, expected 1e-06 to 0.1 s"),
    "step nan": ('timestep="nan"', "timestep is nan s, expected"),
    "long step": ('timestep="0.5"', "timestep is 0.5 s, expected"),
    "gravity": ('gravity="0 0 nan"', "gravity is [0.0, 0.0, nan], expected three finite numbers"),
}


SICK_PARTS = {
    "armature": ("armature of joint 'way' is nan, expected a number", 'armature="nan"'),
    "no inertia": ("armature of joint 'way' is -1, expected a number from 0 to 1e+10", 'armature="-1"'),
    "stiffness": ("stiffness of joint 'way' is 1e+300, expected a number from -1e+10 to 1e+10", 'stiffness="1e300"'),
    "friction": ("frictionloss of joint 'way' is -5, expected a number from 0 to 1e+10", 'frictionloss="-5"'),
    "range": ("range of joint 'way' is nan, expected a number", 'limited="true" range="nan 1"'),
    "reference": ("qpos0 of joint 'way' is nan, expected a number", 'ref="nan"'),
}


@pytest.mark.parametrize("what", SICK_PARTS)
def test_numbers_of_parts_that_are_none_are_refused(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a word of MuJoCo's own, in its log or on the screen."""
    monkeypatch.chdir(tmp_path)
    told, attribute = SICK_PARTS[what]
    assert told in refusal(lambda: MjcfRobot("cart", slider().replace('name="way"', f'name="way" {attribute}', 1)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('<motor name="motor"', '<motor gear="nan" name="motor"', "gear of actuator 'motor' is nan, expected a number"),
        ('axis="1 0 0"', 'axis="1e308 1 0"', "axis of joint 'way' cannot be normalised"),
    ],
)
def test_what_would_make_motion_of_nothing_is_refused(old: str, new: str, told: str) -> None:
    text = slider()
    assert old in text
    assert told in refusal(lambda: MjcfRobot("cart", text.replace(old, new, 1)))


@pytest.mark.parametrize("what", SICK)
def test_numbers_that_are_none_are_refused(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a word of MuJoCo's own, in its log or on the screen."""
    monkeypatch.chdir(tmp_path)
    option, told = SICK[what]
    text = slider().replace("<worldbody>", f"<option {option}/><worldbody>")
    assert told in refusal(lambda: MjcfRobot("cart", text))
    (tmp_path / "cart.xml").write_text(text)
    assert told in refusal(lambda: load_mjcf(tmp_path / "cart.xml"))
    assert [path.name for path in tmp_path.iterdir()] == ["cart.xml"]


def test_a_joint_without_an_axis_or_with_no_stiffness_is_told_by_its_name() -> None:
    for wrong in ('axis="1 0 nan"', 'axis="1 0 0" stiffness="nan"'):
        told = refusal(lambda: MjcfRobot("cart", slider().replace('axis="1 0 0"', wrong)))  # noqa: B023
        assert "of joint 'way' is nan, expected a number" in told


@pytest.mark.filterwarnings("ignore:.*flex")
def test_what_neither_engine_takes_is_told_with_its_line() -> None:
    soft = '<flexcomp name="f" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="0 0 1" radius=".01"/></worldbody>'
    text = slider().replace("</worldbody>", f"\n\n{soft}")
    assert "line 4 of the XML has <flexcomp>, which neither engine takes" in refusal(lambda: MjcfRobot("cart", text))


@pytest.mark.parametrize("what", WRONG)
def test_an_xml_that_is_no_robot_is_refused_in_one_sentence(what: str, tmp_path: Path) -> None:
    text, message = WRONG[what]
    told = refusal(lambda: MjcfRobot("cart", text))
    assert told.startswith("cart: ") and message in told
    with pytest.raises(ModelError):
        MjcfRobot("cart", text)
    (tmp_path / "cart.xml").write_text(text)
    told = refusal(lambda: load_mjcf(tmp_path / "cart.xml"))
    assert told.startswith(f"{tmp_path / 'cart.xml'}: ")
    assert message.removeprefix("cart: ").split(" (")[0] in told


def test_a_number_that_does_not_exist_is_told_with_those_that_do() -> None:
    told = refusal(lambda: CRANE.with_parameters({"arm.mas": 1.0}))
    assert told.startswith("crane: there is no parameter 'arm.mas'; did you mean 'arm.mass'? (known: arm.com_x, ")
    listed = told.partition("known: ")[2].removesuffix(" more)").rpartition(" and ")
    assert listed[0].split(", ") == sorted(CRANE.parameters())[: -int(listed[2])]
    assert refusal(lambda: Model(CRANE).with_parameters({"elbow.damping": 1.0})).startswith(
        "crane: there is no parameter 'elbow.damping'; did you mean"
    )
    assert CRANE.has_parameters(["arm.mass", "tilt"]) and not CRANE.has_parameters(["arm.mass", "arm.mas"])


@pytest.mark.parametrize(
    "name",
    [n for n in CRANE.parameters() if not n.endswith(("com_x", "com_y", "com_z", "springref", "tilt", "gain", *SHAPE))],
)
def test_what_cannot_be_negative_is_refused_as_such(name: str) -> None:
    told = refusal(lambda: CRANE.with_parameters({name: -0.5}))
    assert told == f"crane: {name} is -0.5, expected a finite number of at least 0"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["arm.mass", "arm.com_x", "tilt"])
def test_numbers_are_finite(name: str, value: float) -> None:
    told = refusal(lambda: CRANE.with_parameters({name: value}))
    assert told.startswith(f"crane: {name} is {value:g}, expected a finite number")
    assert ("at least 0" in told) == (name == "arm.mass")


def test_what_may_be_negative_may() -> None:
    values = {"arm.com_x": -0.2, "shoulder.springref": -0.4, "tilt": -0.3}
    assert CRANE.with_parameters(values).parameters() == {**CRANE.parameters(), **values}
