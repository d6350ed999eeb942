"""Robots of MuJoCo's XML: their numbers, what is refused, payloads and gravity, and their files."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from equimus_ctrl.diagnosis.split import check_settings, split
from equimus_ctrl.effects import (
    REGISTRY,
    ActuatorGain,
    AsymmetricFriction,
    Backlash,
    ConstantForce,
    CoulombFriction,
    DriveCompliance,
    DrivePlay,
    Effect,
    FirstOrderLag,
    GravityTilt,
    ParallelSpring,
    PayloadMass,
    QuadraticDamping,
    SensorOffset,
    TorqueSaturation,
    TransportDelay,
    ViscousFriction,
    catalogue,
)
from equimus_ctrl.engines.batch import Trial
from equimus_ctrl.engines.machine import simulate_machines
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.errors import EquimusError, ModelError, RecordingError
from equimus_ctrl.identification.parameters import default_names, free_parameters, unit_of
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.models.leg import nominal_leg
from equimus_ctrl.models.machine import Machine
from equimus_ctrl.models.model import FORMAT, Model, machine_model, machine_of, model_from_dict, model_to_dict
from equimus_ctrl.models.model import places as places_of
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow import load_machine, load_model, offer, parameter_rows, read_free, save_model
from equimus_ctrl.workflow.machines import corrected_xml, read_machine_set, write_corrected

ARM = """<mujoco model="crane">
  <compiler angle="radian"/>
  <option timestep="0.001"/>
  <worldbody>
    <site name="floor"/>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.1" armature="0.02" stiffness="1.5" springref="0.2"
        frictionloss="0.05" range="-1.5 1.6"/>
      <inertial mass="2" pos="0.1 0.02 -0.3" diaginertia="0.03 0.02 0.01"/>
      <body name="rod" pos="0 0 -0.5">
        <joint name="reach" type="slide" axis="0 0 -1" damping="3" armature="0.1" stiffness="40" springref="0.05"
          frictionloss="0.4"/>
        <inertial mass="0.5" pos="0.01 0 -0.1" quat="0.8 0.6 0 0" diaginertia="0.002 0.003 0.004"/>
        <site name="tip" pos="0.03 0.01 -0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="reach" forcerange="-20 20"/>
    <position name="servo" joint="shoulder" kp="30" kv="1.5" ctrlrange="-1 1"/>
    <general name="drive" joint="shoulder" gainprm="5" biastype="affine" biasprm="1 -3 -0.5"/>
  </actuator>
</mujoco>"""
CRANE = Machine("crane", ARM, source="crane.xml")


def pendulum(
    joint: str = "", inertial: str = 'mass="1" pos="0 0 -0.3" diaginertia="0.01 0.01 0.01"', *, head: str = "",
    option: str = "", body: str = "", drive: str = '<motor name="motor" joint="pivot"/>', tail: str = "",
) -> str:  # fmt: skip
    """One hinge about a horizontal axis, with more of this and that."""
    return f"""<mujoco model="pendulum"><compiler angle="radian"/>{head}<option timestep="0.001">{option}</option>
      <worldbody><body name="arm"><joint name="pivot" axis="0 1 0" armature="0.02" {joint}/><inertial {inertial}/>
      <site name="tip" pos="0.2 0 -0.5"/>{body}</body></worldbody>
      <actuator>{drive}</actuator>{tail}</mujoco>"""


PENDULUM = Machine("pendulum", pendulum(), source="pendulum.xml")


def slider(drive: str = '<motor name="motor" joint="way"/>') -> str:
    return f"""<mujoco><worldbody><body name="cart"><joint name="way" type="slide" axis="1 0 0"/>
      <inertial mass="2" pos="0 0 0" diaginertia="0.1 0.1 0.1"/></body></worldbody><actuator>{drive}</actuator></mujoco>"""


def refusal(make: Callable[[], Any]) -> str:
    """The sentence with which something is refused."""
    with pytest.raises(EquimusError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


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
}
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
    assert {row["name"]: row["unit"] for row in parameter_rows(machine_model(CRANE))} == {
        name: unit for name, (_, unit) in expected.items()
    }


def fields_of(model: Any) -> dict[str, Array]:
    found = {name: getattr(model, name) for name in dir(model) if isinstance(getattr(model, name), np.ndarray)}
    return {name: np.array(value) for name, value in found.items()} | {"gravity": np.array(model.opt.gravity)}


def changed_fields(values: Mapping[str, float], machine: Machine = CRANE) -> set[str]:
    """Fields of the model that numbers change, without those that follow from others."""
    before = fields_of(machine.mujoco_model())
    after = fields_of(machine.with_parameters(values).mujoco_model())
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


def test_a_change_leaves_the_machine_it_came_from_alone() -> None:
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
    machine = Machine("d", text)
    found, mass = machine.parameters(), 1000 * 4 / 3 * math.pi * 0.1**3
    inertia = 0.4 * mass * 0.01
    assert found["pivot.damping"] == 0.7
    assert found["pivot.springref"] == pytest.approx(math.pi / 6)
    assert found["ball.mass"] == pytest.approx(mass) and found["ball.inertia"] == pytest.approx(inertia)
    assert found["ball.com_z"] == pytest.approx(-0.4)
    assert found["servo.kv"] == pytest.approx(2 * math.sqrt(8 * (inertia + mass * 0.16)))
    assert machine.joints[0].range == pytest.approx((-math.pi / 2, math.pi / 4))


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
    assert places_of(machine_model(CRANE).morphology) == {
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
        ('<position name="motor" joint="way" kp="3"/>', "m", None),
        ('<general name="motor" joint="way" gainprm="3" biastype="affine" biasprm="0 -2 0"/>', "m", "N/m"),
    ],
)
def test_commands_and_gains_of_a_slide_have_its_units(drive: str, unit: str, gain: str | None) -> None:
    machine = Machine("cart", slider(drive))
    assert machine.actuators[0].unit == unit
    assert gain is None or machine.unit("motor.gain") == gain
    assert gain is not None or machine.unit("motor.kp") == "N/m"


def test_the_unit_of_a_speed_servos_command_does_not_depend_on_its_gain() -> None:
    units = {Machine("cart", slider(f'<velocity name="m" joint="way" kv="{kv}"/>')).actuators[0].unit for kv in (1, 3)}
    assert len(units) == 1 and "N" not in units


def test_a_speed_servo_has_one_gain() -> None:
    machine = Machine("cart", slider('<velocity name="m" joint="way" kv="3"/>'))
    assert "m.gain" not in machine.parameters() and machine.parameters()["m.kv"] == 3
    changed = machine.with_parameters({"m.kv": 5.0}).mujoco_model()
    assert changed.actuator_gainprm[0, 0] == 5.0 and changed.actuator_biasprm[0, 2] == -5.0


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
    model = machine_model(CRANE, (effect,))
    prefix = f"{effect.location}.{effect.name}."
    assert {key: unit_of(model, prefix + key) for key in effect.parameter_info()} == UNITS[effect]


def test_bounds_hold_every_number_and_nothing_negative_that_cannot_be() -> None:
    names = list(CRANE.parameters())
    free = free_parameters(machine_model(CRANE), names)
    assert free.names == tuple(names)
    assert np.all(free.low <= free.start) and np.all(free.low[free.start > 0] < free.start[free.start > 0])
    assert np.all(free.start < free.high)
    least = dict(zip(names, free.low, strict=True))
    for name in names:
        if not name.endswith(("com_x", "com_y", "com_z", "springref", "tilt")):
            assert least[name] >= 0, name
    assert least["arm.com_z"] < -0.3 and least["tilt"] < 0 and least["reach.springref"] < 0


def test_a_motor_that_pulls_can_be_free_like_any_other() -> None:
    machine = Machine("cart", slider('<general name="motor" joint="way" gainprm="-2"/>'))
    assert machine.parameters()["motor.gain"] == -2.0
    assert machine.with_parameters(machine.parameters()).parameters() == machine.parameters()
    (free,) = free_parameters(machine_model(machine), ["motor.gain"]).free
    assert free.low < -2.0 < free.high


# --- what identification begins with ----------------------------------------------------------------------------


def test_of_a_hanging_pendulum_mass_and_inertia_are_free() -> None:
    """What turns with the motor cannot be told from the arm's own inertia."""
    assert default_names(machine_model(PENDULUM)) == ["arm.mass", "arm.inertia"]


def test_without_gravity_one_number_tells_all_of_a_single_inertia() -> None:
    weightless = Machine("p", pendulum().replace('timestep="0.001"', 'timestep="0.001" gravity="0 0 0"'))
    assert weightless.default_names() == ["arm.mass"]
    assert "gravity" not in weightless.parameters()


@pytest.mark.parametrize("joint", ['range="-0.1 0.1"', 'frictionloss="0.4"', 'damping="0.1" stiffness="2"'])
def test_ends_and_friction_do_not_change_which_masses_are_told(joint: str) -> None:
    names = Machine("p", pendulum(joint)).default_names()
    assert [n for n in names if n.startswith("arm") or n.endswith("armature")] == ["arm.mass", "arm.inertia"]
    kinds = re.findall(r"(damping|frictionloss|stiffness)=", joint)
    assert names[2:] == [f"pivot.{kind}" for kind in kinds]


def test_default_names_hold_effects_too_and_actuators_are_taken_to_be_known() -> None:
    names = default_names(machine_model(CRANE, (CoulombFriction("reach", 0.3),)))
    assert names == [
        "arm.mass", "rod.mass", "arm.inertia", "reach.armature", "shoulder.damping", "reach.damping",
        "shoulder.frictionloss", "reach.frictionloss", "shoulder.stiffness", "reach.stiffness",
        "reach.coulomb_friction.friction",
    ]  # fmt: skip


# --- what is refused --------------------------------------------------------------------------------------------

BODY = "<mujoco><worldbody><body name='b'>{}<geom size='1'/></body></worldbody>{}</mujoco>"
MOTOR = "<actuator><motor name='m' joint='j'/></actuator>"

WRONG: dict[str, tuple[str, str]] = {
    "free joint": (BODY.format("<freejoint name='flight'/>", ""), "cart: joint 'flight' is a free joint, expected"),
    "unnamed free joint": (BODY.format("<freejoint/>", ""), "cart: joint 0 is a free joint, expected hinges and"),
    "ball joint": (BODY.format("<joint name='wrist' type='ball'/>", ""), "cart: joint 'wrist' is a ball joint, exp"),
    "unnamed joint": (BODY.format("<joint/>", ""), "cart: joint 0 has no name"),
    "no joint": (BODY.format("", ""), "cart: has no joint"),
    "no actuator": (BODY.format("<joint name='j'/>", ""), "cart: has no actuator"),
    "unnamed actuator": (slider('<motor joint="way"/>'), "cart: actuator 0 has no name"),
    "tendon": (
        slider('<motor name="puller" tendon="rope"/>').replace(
            "<actuator>", '<tendon><fixed name="rope"><joint joint="way" coef="1"/></fixed></tendon><actuator>'
        ),
        "cart: actuator 'puller' does not drive a joint",
    ),
    "dyntype": (
        slider('<general name="slow" joint="way" dyntype="integrator"/>'),
        "cart: actuator 'slow' has a state that recordings do not tell (dyntype), expected none or a first-order filter",
    ),
    "integrated velocity": (
        slider('<intvelocity name="slow" joint="way" kp="2" actrange="-1 1"/>'),
        "cart: actuator 'slow' has a state that recordings do not tell",
    ),
    "damper": (
        slider('<damper name="brake" joint="way" kv="1" ctrlrange="0 1"/>'),
        "cart: actuator 'brake' is neither a motor nor a servo",
    ),
    "broken": ("<mujoco><worldbody><bod></worldbody></mujoco>", "cart: MuJoCo cannot load it ("),
    "no XML": ("arm = 1", "cart: MuJoCo cannot load it ("),
    "empty": ("", "cart: MuJoCo cannot load it ("),
    "unknown joint": (slider('<motor name="m" joint="wya"/>'), "'wya'"),
    "no mass": ("<mujoco><worldbody><body name='b'><joint name='j'/></body></worldbody></mujoco>", "mass and inertia"),
}


@pytest.mark.parametrize("what", WRONG)
def test_an_xml_that_is_no_machine_is_refused_in_one_sentence(what: str, tmp_path: Path) -> None:
    text, message = WRONG[what]
    told = refusal(lambda: Machine("cart", text))
    assert told.startswith("cart: ") and message in told
    with pytest.raises(ModelError):
        Machine("cart", text)
    (tmp_path / "cart.xml").write_text(text)
    told = refusal(lambda: load_machine(tmp_path / "cart.xml"))
    assert told.startswith(f"{tmp_path / 'cart.xml'}: ")
    assert message.removeprefix("cart: ").split(" (")[0] in told


def test_a_number_that_does_not_exist_is_told_with_those_that_do() -> None:
    told = refusal(lambda: CRANE.with_parameters({"arm.mas": 1.0}))
    assert told.startswith("crane: there is no parameter 'arm.mas'; did you mean 'arm.mass'? (known: arm.com_x, ")
    assert all(name in told for name in CRANE.parameters())
    assert refusal(lambda: machine_model(CRANE).with_parameters({"elbow.damping": 1.0})).startswith(
        "crane: there is no parameter 'elbow.damping'; did you mean"
    )
    assert CRANE.has_parameters(["arm.mass", "tilt"]) and not CRANE.has_parameters(["arm.mass", "arm.mas"])


@pytest.mark.parametrize(
    "name", [n for n in CRANE.parameters() if not n.endswith(("com_x", "com_y", "com_z", "springref", "tilt", "gain"))]
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


def middle(name: str, place: str) -> Effect:
    """An effect with numbers within its bounds."""
    cls = REGISTRY[name]
    return cls(place, **{key: 0.5 * (m["low"] + m["high"]) for key, m in cls.parameter_info().items()})


@pytest.mark.parametrize("name", sorted(set(catalogue("elastic")) - set(catalogue("mjcf"))))
def test_effects_of_elastic_robots_are_refused_on_machines(name: str) -> None:
    place = {"joint": "shoulder", "actuator": "push", "link": "arm", "foot": "tip", "base": "base"}
    told = refusal(lambda: machine_model(CRANE, (middle(name, place[REGISTRY[name].sits_at[0]]),)))
    assert told.startswith(f"crane: a robot from MuJoCo's XML cannot have effect {name} (it can: ")
    assert all(other in told for other in catalogue("mjcf"))


@pytest.mark.parametrize("name", sorted(set(catalogue("mjcf")) - set(catalogue("elastic"))))
def test_effects_of_machines_are_refused_on_elastic_robots(name: str) -> None:
    place = {"joint": "hip", "actuator": "maa", "base": "base"}
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
    assert refusal(lambda: machine_model(CRANE, effects)).startswith(f"crane: {message}")


def test_dry_friction_sits_at_joints_of_machines_alone() -> None:
    """On elastic robots it can rub along an actuator, which has no coordinate of its own here."""
    assert "coulomb_friction" in refusal(lambda: machine_model(CRANE, (CoulombFriction("push", 1.0),)))


@pytest.mark.parametrize("effect", [DriveCompliance("way", 10.0, 0.1), DrivePlay("way", 0.1)], ids=lambda e: e.name)
def test_a_drive_that_gives_way_needs_something_that_turns_with_it(effect: Effect) -> None:
    told = refusal(lambda: machine_model(Machine("cart", slider()), (effect,)))
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
def test_a_balanced_wheel_can_be_unbalanced(change: Callable[[Machine], Machine]) -> None:
    """MuJoCo takes bodies whose centre lies in their joint for simple ones, unless it is told otherwise."""
    q = np.array([-0.3])
    whole, weight = mass_matrix(change(Machine("wheel", pendulum(inertial=BALANCED))).mujoco_model(), q)
    shift = PENDULUM.with_parameters({"arm.com_z": 0.0})
    reference = mass_matrix(change(shift).mujoco_model(), q)
    np.testing.assert_allclose(whole, reference[0], atol=1e-12)
    np.testing.assert_allclose(weight, reference[1], atol=1e-12)
    assert abs(weight[0]) > 0.5


TOOL = '<body name="tool" pos="0 0 -0.6"><site name="end"/></body>'


@pytest.mark.parametrize("mass", [0.0, 0.4])
def test_a_frame_without_mass_can_carry_a_payload(mass: float) -> None:
    machine = Machine("p", pendulum(body=TOOL)).with_payload("end", mass)
    whole, _ = mass_matrix(machine.mujoco_model(), np.zeros(1))
    assert whole[0, 0] == pytest.approx(0.02 + 0.01 + 0.09 + mass * 0.36)


def test_a_point_mass_has_no_inertia_of_its_own() -> None:
    """No warning either, of which tests make errors."""
    point = '<body name="ball" pos="0 0 -0.6"><inertial mass="0.3" pos="0 0 0" diaginertia="0 0 0"/></body>'
    machine = Machine("p", pendulum(body=point))
    assert machine.parameters()["ball.mass"] == 0.3
    whole, _ = mass_matrix(machine.with_parameters({"ball.mass": 0.5}).mujoco_model(), np.zeros(1))
    assert whole[0, 0] == pytest.approx(0.02 + 0.01 + 0.09 + 0.5 * 0.36)
    free = free_parameters(machine_model(machine))
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
    machine = Machine("m", text)
    models = [machine.with_parameters({"tilt": t}).mujoco_model() for t in (-0.1, 0.1)]
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
    machine = Machine("lift", text)
    np.testing.assert_allclose(np.abs(machine.plan.tilt_axis), [1, 0, 0], atol=1e-12)
    weight = mass_matrix(machine.with_parameters({"tilt": 0.1}).mujoco_model(), np.zeros(2))[1]
    assert abs(weight[1]) == pytest.approx(0.2 * 9.81 * math.sin(0.1))


# --- model files ------------------------------------------------------------------------------------------------


def driven(machine: Machine, until: float = 1.0) -> Trial:
    """Commands that jump on the physics' grid, and a start away from rest."""
    times = np.arange(0.0, until - 0.05, 0.125)
    k, i = np.meshgrid(np.arange(len(times)), np.arange(len(machine.actuators)), indexing="ij")
    commands = np.round(1.5 * np.sin(1.7 * k + i), 3) / (1 + 2 * i)
    start = np.linspace(0.4, 0.1, len(machine.joints))
    return Trial("t", times, commands, commands[0], 0.0, start, np.arange(0.0, until + 1e-9, 0.025))


def moved(model: Model, trial: Trial | None = None) -> Array:
    machine = machine_of(model)
    assert machine is not None
    found = simulate_machines([model], [trial or driven(machine)], threads=1)[0]
    assert found.sound.all()
    return found.position[0]


def stepped(model: Any, machine: Machine, trial: Trial) -> Array:
    """The same trial, by MuJoCo alone."""
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in machine.joint_names]
    for joint, q in zip(joints, trial.position, strict=True):
        data.qpos[joint.qposadr[0]] = q
        if any(model.joint(k).name == f"{joint.name} drive" for k in range(model.njnt)):
            data.qpos[model.joint(f"{joint.name} drive").qposadr[0]] = q
    order = [model.actuator(name).id for name in machine.actuator_names]
    out = [[data.qpos[joint.qposadr[0]] for joint in joints]]
    every = round((trial.sample_times[1] - trial.sample_times[0]) / model.opt.timestep)
    for k in range((len(trial.sample_times) - 1) * every):
        row = np.searchsorted(trial.times, (k + 0.5) * model.opt.timestep, side="right") - 1
        data.ctrl[order] = trial.commands[row]
        mujoco.mj_step(model, data)
        if (k + 1) % every == 0:
            out.append([data.qpos[joint.qposadr[0]] for joint in joints])
    return np.array(out)


@pytest.fixture
def crane_file(tmp_path: Path) -> Path:
    path = tmp_path / "robots" / "robot.xml"
    path.parent.mkdir()
    path.write_text(ARM)
    return path


HELD: dict[str, tuple[Effect, ...]] = {
    "nothing": (),
    "viscous_friction": (ViscousFriction("shoulder", 0.8),),
    "quadratic_damping": (QuadraticDamping("reach", 20.0),),
    "coulomb_friction": (CoulombFriction("reach", 0.6),),
    "payload_mass": (PayloadMass("tip", 0.7), PayloadMass("arm", 0.4)),
    "actuator_gain": (ActuatorGain("servo", 0.6), ActuatorGain("drive", 1.5)),
    "torque_saturation": (TorqueSaturation("servo", 1.5),),
    "joint_compliance": (DriveCompliance("shoulder", 60.0, 0.3),),
    "gravity_tilt": (GravityTilt("base", 0.3),),
}
HELD["all of them"] = tuple(effect for effects in HELD.values() for effect in effects)


@pytest.mark.parametrize("name", HELD)
def test_a_saved_model_comes_back_and_its_xml_moves_like_it(name: str, crane_file: Path, tmp_path: Path) -> None:
    machine = load_machine(crane_file).with_parameters({"arm.mass": 2.25, "reach.damping": 2.0, "tilt": 0.05})
    model = machine_model(machine, HELD[name])
    path = tmp_path / "found" / "deep" / "model.toml"
    assert save_model(path, model, crane_file) == [path, path.with_suffix(".xml")]
    back = load_model(path)
    assert back.parameters() == model.parameters() and back.effects == model.effects and back.name == "crane"
    np.testing.assert_array_equal(moved(back), moved(model))
    text = path.read_text()
    assert 'mjcf = "../../robots/robot.xml"' in text and "model.xml has all of this in one MuJoCo model." in text
    written = mujoco.MjModel.from_xml_path(str(path.with_suffix(".xml")))
    trial = driven(machine)
    own = stepped(written, machine, trial)
    plain = moved(machine_model(machine))
    # Six digits are written of each number.
    np.testing.assert_allclose(own, moved(model), rtol=0, atol=2e-5)
    assert name == "nothing" or np.abs(own - plain).max() > 2e-3


def test_all_numbers_that_were_found_are_in_the_xml(crane_file: Path, tmp_path: Path) -> None:
    """To the six digits that are written; what gravity leans by is in its direction."""
    machine = load_machine(crane_file)
    changed = {name: 1.2345 * value + 0.0123 for name, value in machine.parameters().items() if name != "tilt"}
    model = machine_model(machine.with_parameters(changed))
    save_model(tmp_path / "found.toml", model, crane_file)
    again = load_machine(tmp_path / "found.xml").parameters()
    assert again == {name: pytest.approx(value, rel=1e-5) for name, value in (changed | {"tilt": 0.0}).items()}
    np.testing.assert_array_equal(moved(load_model(tmp_path / "found.toml")), moved(model))


def test_what_xml_has_no_field_for_is_told(crane_file: Path, tmp_path: Path) -> None:
    effects = (
        ViscousFriction("reach", 1.0), ConstantForce("reach", 1.0), TransportDelay("push", 0.1),
        FirstOrderLag("servo", 0.1), SensorOffset("shoulder", 0.1), Backlash("reach", 0.01),
    )  # fmt: skip
    model = machine_model(load_machine(crane_file), effects)
    told = [f"{e.name} at {e.location}" for e in effects[1:]]
    xml, left = corrected_xml(model)
    assert list(left) == told and f"<!-- Not in here: {', '.join(told)}. -->" in xml
    mujoco.MjModel.from_xml_string(xml)
    save_model(tmp_path / "m.toml", model, crane_file)
    assert f"m.xml has all of this in one MuJoCo model, but for {', '.join(told)}." in (tmp_path / "m.toml").read_text()
    assert write_corrected(tmp_path / "again.xml", model) == left
    assert load_model(tmp_path / "m.toml").effects == effects


def test_the_xml_is_found_beside_the_model_file_from_anywhere(
    crane_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beside = crane_file.parent / "model.toml"
    beside.write_text('mjcf = "robot.xml"\nname = "left crane"\n[parameters]\n"arm.mass" = 3\n')
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    model = load_model(os.path.relpath(beside))
    assert model.name == "left crane" and model.parameters()["arm.mass"] == 3
    assert model.parameters()["rod.mass"] == 0.5
    beside.write_text(f'mjcf = "{crane_file}"\n')
    assert load_model(beside).name == "crane"


def test_a_model_that_is_saved_again_still_finds_its_xml(crane_file: Path, tmp_path: Path) -> None:
    model = machine_model(load_machine(crane_file), (ViscousFriction("reach", 1.0),))
    first, second = tmp_path / "a" / "one.toml", tmp_path / "b" / "c" / "two.toml"
    save_model(first, model, crane_file)
    save_model(second, load_model(first), first)
    assert load_model(second).parameters() == model.parameters()


def test_saving_beside_the_xml_leaves_it_as_it_is(crane_file: Path) -> None:
    """The corrected XML must not take the place of the one that the model file changes."""
    model = machine_model(load_machine(crane_file), (PayloadMass("tip", 0.7),))
    save_model(crane_file.with_suffix(".toml"), model, crane_file)
    assert crane_file.read_text() == ARM
    np.testing.assert_array_equal(moved(load_model(crane_file.with_suffix(".toml"))), moved(model))


def test_an_xml_of_somebody_else_stays(crane_file: Path, tmp_path: Path) -> None:
    model = machine_model(load_machine(crane_file), (PayloadMass("tip", 0.7),))
    (tmp_path / "keep.xml").write_text("<mujoco/>")
    assert save_model(tmp_path / "keep.toml", model, crane_file)[1].name == "keep_whole.xml"
    assert (tmp_path / "keep.xml").read_text() == "<mujoco/>"
    for _ in range(2):  # what was written together is written again
        assert save_model(tmp_path / "own.toml", model, crane_file)[1].name == "own.xml"


def test_a_model_is_its_dictionary() -> None:
    model = machine_model(CRANE.with_parameters({"arm.mass": 3.0}), (TransportDelay("push", 0.05),))
    data = model_to_dict(model)
    assert data == {
        "format": FORMAT,
        "name": "crane",
        "mjcf": "crane.xml",
        "parameters": {"arm.mass": 3.0},
        "effects": [{"effect": "transport_delay", "location": "push", "delay": 0.05}],
    }
    asked: list[str] = []

    def read(name: str) -> Machine:
        asked.append(name)
        return CRANE

    back = model_from_dict(data, "m.toml", read)
    assert asked == ["crane.xml"]
    assert back.parameters() == model.parameters() and back.effects == model.effects


WRONG_FILES: dict[str, tuple[str, str]] = {
    'mjcf = "robto.xml"': ("there is no such file", "robto.xml"),
    "mjcf = 3": ("mjcf is 3, expected the name of a file of MuJoCo's XML", ""),
    'mjcf = "robot.xml"\nmorphology = "nominal_leg"': ("there is no key 'morphology'", "known: effects, format, mjcf"),
    'mjcf = "robot.xml"\nphase = "stance"': ("there is no key 'phase'", ""),
    'mjcf = "robot.xml"\nformat = "x"': (f"format is 'x', expected {FORMAT!r}", ""),
    'mjcf = "robot.xml"\nname = 3': ("name is 3, expected a text", ""),
    'mjcf = "robot.xml"\n[parameters]\n"arm.mas" = 1': ("no parameter 'arm.mas'; did you mean 'arm.mass'?", ""),
    'mjcf = "robot.xml"\n[parameters]\n"arm.mass" = "x"': ("parameters: arm.mass is 'x', expected a number", ""),
    'mjcf = "robot.xml"\n[parameters]\n"arm.mass" = -1': ("arm.mass is -1, expected a finite number of at least 0", ""),
    'mjcf = "robot.xml"\n[parameters]\narm.mass = 1': ("'arm' is a table; put a dotted name in quotes", ""),
    'mjcf = "robot.xml"\n[[effects]]\neffect = "creep"\nlocation = "push"\nstiffness = 1\ntime_constant = 1': (
        "a robot from MuJoCo's XML cannot have effect creep", "",
    ),
    'mjcf = "robot.xml"\n[[effects]]\neffect = "viscous_friction"\nlocation = "elbow"\ndamping = 1': (
        "effect viscous_friction: there is no joint 'elbow'", "known: reach, shoulder",
    ),
    'mjcf = "robot.xml"\n[[effects]]\neffect = "viscous_friction"\nlocation = "reach"\ndampng = 1': (
        "there is no parameter 'dampng'; did you mean 'damping'?", "",
    ),
    'mjcf = "robot.xml"\n[[effects]]\neffect = "viscous_friction"\nlocation = "reach"\ndamping = -1': (
        "damping is -1 N·m·s/rad, expected 0 to", "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("text", WRONG_FILES, ids=lambda text: re.sub(r"\W+", " ", text)[:60])
def test_what_is_wrong_in_a_model_file_is_said_with_its_name(text: str, crane_file: Path) -> None:
    path = crane_file.parent / "model.toml"
    path.write_text(text)
    told = refusal(lambda: load_model(path))
    assert told.startswith(f"{path}: ")
    assert all(part in told for part in WRONG_FILES[text])


def test_without_a_file_to_read_from_an_xml_cannot_be_named() -> None:
    assert "mjcf is 'robot.xml', expected" in refusal(lambda: model_from_dict({"mjcf": "robot.xml"}, "m"))


def test_an_xml_is_a_model_by_itself(crane_file: Path) -> None:
    model = load_model(crane_file)
    machine = machine_of(model)
    assert machine is not None and machine.source == "robot.xml"
    assert model.effects == () and model.parameters() == CRANE.parameters()
    assert load_model(str(crane_file)).name == "crane"


def test_a_robot_without_a_name_is_called_after_its_file(tmp_path: Path) -> None:
    (tmp_path / "gripper.xml").write_text(pendulum().replace(' model="pendulum"', ""))
    assert load_model(tmp_path / "gripper.xml").name == "gripper"


def test_numbers_come_out_of_a_file_with_all_their_digits(tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(pendulum(inertial='mass="0.123456789" pos="0 0 -0.3" diaginertia="1 1 1"'))
    assert load_machine(tmp_path / "p.xml").parameters()["arm.mass"] == pytest.approx(0.123456789, rel=1e-12)


def test_included_files_are_read_into_one(tmp_path: Path) -> None:
    drive = '<actuator><motor name="motor" joint="pivot"/></actuator>'
    (tmp_path / "drive.xml").write_text(f"<mujocoinclude>{drive}</mujocoinclude>")
    (tmp_path / "p.xml").write_text(pendulum().replace(drive, '<include file="drive.xml"/>'))
    machine = load_machine(tmp_path / "p.xml")
    (tmp_path / "drive.xml").unlink()
    assert machine.actuator_names == ("motor",)
    assert replace(machine, name="copy").parameters() == PENDULUM.parameters()


SHAPE = "v 0 0 0\nv .2 0 0\nv 0 .2 0\nv 0 0 .2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
MESHED = """<mujoco model="meshed"><compiler meshdir="parts"/><asset><mesh name="shape" file="shape.obj"/></asset>
  <worldbody><body name="arm"><joint name="pivot" axis="0 1 0" armature="0.01"/><geom type="mesh" mesh="shape"/></body>
  </worldbody><actuator><motor name="motor" joint="pivot"/></actuator></mujoco>"""


def test_meshes_are_kept_with_the_machine_and_found_from_what_is_saved(tmp_path: Path) -> None:
    (tmp_path / "robot" / "parts").mkdir(parents=True)
    (tmp_path / "robot" / "parts" / "shape.obj").write_text(SHAPE)
    (tmp_path / "robot" / "meshed.xml").write_text(MESHED)
    model = load_model(tmp_path / "robot" / "meshed.xml")
    assert model.parameters()["arm.mass"] == pytest.approx(1000 * 0.2**3 / 6, rel=1e-5)
    softer = machine_model(model.morphology, (DriveCompliance("pivot", 5.0, 0.1),))  # type: ignore[arg-type]
    assert np.abs(moved(softer) - moved(model)).max() > 1e-3
    save_model(tmp_path / "found" / "new.toml", softer, tmp_path / "robot" / "meshed.xml")
    np.testing.assert_array_equal(moved(load_model(tmp_path / "found" / "new.toml")), moved(softer))
    written = mujoco.MjModel.from_xml_path(str(tmp_path / "found" / "new.xml"))
    assert written.body("arm").mass[0] == pytest.approx(model.parameters()["arm.mass"], rel=1e-5)


def test_machines_that_differ_in_a_mesh_alone_are_two() -> None:
    small, large = (
        Machine("meshed", MESHED, {"shape.obj": SHAPE.replace(".2", size).encode()}) for size in (".2", ".4")
    )
    assert large.parameters()["arm.mass"] == pytest.approx(8 * small.parameters()["arm.mass"], rel=1e-5)


NAMELESS = '<body pos="0 0 -0.6"><inertial mass="0.3" pos="0 0 0" diaginertia="0.01 0.01 0.01"/></body>'


@pytest.mark.parametrize(
    "text",
    [
        pendulum(body=NAMELESS),
        pendulum(tail='<tendon><fixed stiffness="3"><joint joint="pivot" coef="1"/></fixed></tendon>'),
        pendulum()
        .replace('angle="radian"', 'angle="degree"')
        .replace("armature", 'springref="20" stiffness="3" armature'),
        pendulum(head='<default><joint damping="0.4" stiffness="2"/></default>'),
        pendulum(head='<default><geom mass="2"/></default>', body='<geom size="0.1"/>'),
        pendulum(head='<compiler inertiafromgeom="true"/>', body='<geom size="0.1" pos="0 0 -0.4"/>'),
        pendulum(tail='<keyframe><key name="home" qpos="0.1"/></keyframe>'),
    ],
    ids=[
        "nameless body",
        "nameless tendon",
        "degrees",
        "defaults",
        "geoms",
        "geoms' inertia",
        "keyframe",
    ],
)
@pytest.mark.parametrize("effect", [PayloadMass("tip", 0.5), DriveCompliance("pivot", 20.0, 0.1)], ids=lambda e: e.name)
def test_any_machine_can_be_written(text: str, effect: Effect) -> None:
    model = machine_model(Machine("p", text), (effect,))
    machine = machine_of(model)
    assert machine is not None
    xml, left = corrected_xml(model)
    assert left == ()
    trial = driven(machine)
    own = stepped(mujoco.MjModel.from_xml_string(xml), machine, trial)
    np.testing.assert_allclose(own, moved(model, trial), rtol=0, atol=2e-5)
    assert np.abs(own - moved(machine_model(machine), trial)).max() > 1e-3


def test_elastic_robots_are_not_written_as_machines(tmp_path: Path) -> None:
    assert "is no robot of MuJoCo's XML" in refusal(lambda: write_corrected(tmp_path / "leg.xml", Model(nominal_leg())))
    assert list(tmp_path.iterdir()) == []


# --- files of free parameters -----------------------------------------------------------------------------------


def test_a_file_of_free_parameters_offers_what_is_free_by_default(tmp_path: Path) -> None:
    model = machine_model(CRANE, (CoulombFriction("reach", 0.3),))
    path = tmp_path / "free.toml"
    offer(path, model)
    text = path.read_text()
    assert all(f'"{name}" = ' in text or f"{name} = " in text for name in model.parameters())
    given = read_free(path, model)
    chosen = free_parameters(model, given.names, given.bounds)
    usual = free_parameters(model)
    assert set(chosen.names) == set(default_names(model))
    assert {f.name: (f.low, f.high) for f in chosen.free} == {f.name: (f.low, f.high) for f in usual.free}


def free_of(tmp_path: Path, text: str, model: Model) -> Any:
    path = tmp_path / "free.toml"
    path.write_text(text)
    return read_free(path, model)


def test_numbers_are_freed_between_bounds_of_ones_own_or_of_their_kind(tmp_path: Path) -> None:
    model = machine_model(CRANE)
    given = free_of(tmp_path, '[free]\n"arm.mass" = [1, 3]\n"*.damping" = true\n"rod.mass" = false\n', model)
    assert set(given.names) == {"arm.mass", "shoulder.damping", "reach.damping"}
    assert given.bounds == {"arm.mass": (1.0, 3.0)}
    both = given.with_more(["tilt"], {"arm.mass": (1.5, 2.5)})
    assert both == ([*given.names, "tilt"], {"arm.mass": (1.5, 2.5)})


def test_a_pattern_frees_nothing_that_is_said_to_stay(tmp_path: Path) -> None:
    given = free_of(tmp_path, '[free]\n"*.damping" = true\n"reach.damping" = false\n', machine_model(CRANE))
    assert given.names == ("shoulder.damping",)


WRONG_FREE: dict[str, str] = {
    '[fre]\n"arm.mass" = true': "there is no key 'fre'; did you mean 'free'? (known: format, free)",
    'format = "x"\n[free]\n"arm.mass" = true': "format is 'x', expected 'equimus-ctrl/parameters/1'",
    "free = 3": "there is no [free] table of names",
    "[free]": "there is no [free] table of names",
    "[free]\narm.mass = true": "free: put a dotted name in quotes",
    '[free]\n"arm.mas" = true': "free: crane: there is no parameter 'arm.mas'; did you mean 'arm.mass'?",
    '[free]\n"*.mas" = true': "free: crane: there is no parameter '*.mas'",
    '[free]\n"arm.mass" = [1]': "free: arm.mass is [1], expected true, false or [low, high]",
    '[free]\n"arm.mass" = [1, 2, 3]': "free: arm.mass is [1, 2, 3], expected true, false or [low, high]",
    '[free]\n"arm.mass" = 3': "free: arm.mass is 3, expected true, false or [low, high]",
    '[free]\n"arm.mass" = "free"': "free: arm.mass is 'free', expected true, false or [low, high]",
    '[free]\n"arm.mass" = [true, 2]': "free: arm.mass is [True, 2], expected true, false or [low, high]",
    '[free]\n"arm.mass" = false': "free: everything is false, so nothing is free",
    "free = [": "is not valid TOML",
}


@pytest.mark.parametrize("text", WRONG_FREE, ids=lambda text: re.sub(r"\W+", " ", text)[:60])
def test_what_is_wrong_in_a_file_of_free_parameters_is_said_with_its_name(text: str, tmp_path: Path) -> None:
    told = refusal(lambda: free_of(tmp_path, text, machine_model(CRANE)))
    assert told.startswith(f"{tmp_path / 'free.toml'}: ") and WRONG_FREE[text] in told


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        ("[3, 1]", "bounds of arm.mass are 3 to 1, expected the lower one first"),
        ("[nan, 3]", "bounds of arm.mass are nan to 3, expected finite numbers"),
        ("[3, 4]", "arm.mass is 2 kg in the model, outside its bounds 3 to 4"),
        ("[-1, 3]", "arm.mass"),
    ],
)
def test_bounds_that_cannot_be_are_refused_before_anything_is_fitted(pair: str, message: str, tmp_path: Path) -> None:
    model = machine_model(CRANE)

    def chosen() -> None:
        given = free_of(tmp_path, f'[free]\n"arm.mass" = {pair}', model)
        free_parameters(model, given.names, given.bounds)

    assert message in refusal(chosen)


# --- recordings -------------------------------------------------------------------------------------------------


def recording(notes: Mapping[str, str] | None = None, name: str = "trial", machine: Machine = PENDULUM) -> Recording:
    """Two seconds of a swinging pendulum."""
    time = np.arange(0, 2.001, 0.01)
    na, nj = len(machine.actuators), len(machine.joints)
    position = np.tile(0.3 * np.cos(4 * time)[:, None], (1, nj))
    return Recording(
        name, time, np.zeros((len(time), na)), position, machine.actuator_names, machine.joint_names, notes=notes or {}
    )


NOTED = [
    ({"set.arm.mass": "1.7"}, {"arm.mass": 1.7}),
    ({"times.arm.mass": "1.7"}, {"arm.mass": 1.7}),
    ({"set.arm.mass": "1.7", "times.arm.com_z": "0.5", "rig": "A"}, {"arm.mass": 1.7, "arm.com_z": -0.15}),
    ({"set.tilt": "-0.2"}, {"tilt": -0.2}),
    ({"times.arm.com_z": "-1"}, {"arm.com_z": 0.3}),
]


@pytest.mark.parametrize(("notes", "values"), NOTED)
def test_numbers_in_notes_reach_the_simulation(notes: dict[str, str], values: dict[str, float]) -> None:
    """The factors count from what the model has, whatever that is."""
    model = machine_model(PENDULUM, (ViscousFriction("pivot", 0.1),))
    (segment,) = cut(model, [recording(notes)])
    (plain,) = cut(model.with_parameters(values), [recording()])
    found, expected, unchanged = (
        simulate_machines([m], [s.trial], starts=[s.start[None, :]], threads=1)[0].position
        for m, s in ((model, segment), (model.with_parameters(values), plain), (model, plain))
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert np.abs(found - unchanged).max() > 1e-2
    np.testing.assert_allclose(predict(model, recording(notes)), predict(model.with_parameters(values), recording()))


def test_windows_of_one_recording_have_its_notes() -> None:
    segments = cut(machine_model(PENDULUM), [recording({"set.arm.mass": "1.7"}), recording()], shoot=0.5)
    assert [dict(s.trial.settings) for s in segments] == [{"arm.mass": 1.7}] * 4 + [{}] * 4


WRONG_NOTES = [
    ({"set.arm.mas": "1"}, "note set.arm.mas: there is no parameter 'arm.mas'; did you mean 'arm.mass'?"),
    ({"times.arm.mas": "1"}, "note times.arm.mas: there is no parameter 'arm.mas'; did you mean 'arm.mass'?"),
    ({"set.arm.mass": "heavy"}, "note set.arm.mass is 'heavy', expected a number"),
    ({"times.arm.mass": ""}, "note times.arm.mass is '', expected a factor"),
    ({"set.arm.mass": "-1"}, "arm.mass is -1, expected a finite number of at least 0"),
    ({"set.arm.mass": "nan"}, "arm.mass is nan, expected a finite number of at least 0"),
    ({"times.arm.mass": "inf"}, "arm.mass is inf, expected a finite number of at least 0"),
]


@pytest.mark.parametrize(("notes", "message"), WRONG_NOTES, ids=[str(notes) for notes, _ in WRONG_NOTES])
def test_notes_that_say_nothing_usable_are_told_with_the_recordings_name(notes: dict[str, str], message: str) -> None:
    told = refusal(lambda: cut(machine_model(PENDULUM), [recording(notes, "third trial")]))
    assert message in told
    assert told.startswith("third trial: ")


def test_notes_of_numbers_are_for_machines_alone() -> None:
    leg = Model(nominal_leg())
    time = np.arange(0, 2.001, 0.01)
    rest = Recording(
        "leg", time, np.zeros((len(time), 2)), np.tile([1.2, 0.8], (len(time), 1)), leg.morphology.actuator_names,
        leg.morphology.joint_names, notes={"set.hip.damping": "1"},
    )  # fmt: skip
    assert "is for robots from MuJoCo's XML alone" in refusal(lambda: cut(leg, [rest], shoot=0.5))


def test_a_number_that_every_recording_gives_cannot_be_free() -> None:
    model = machine_model(PENDULUM)
    free = free_parameters(model, ["arm.mass", "arm.inertia"])
    noted = [recording({"set.arm.mass": "1.2"}, f"trial {k}") for k in range(3)]
    told = refusal(lambda: check_settings(free, split(model, noted, shoot=1.0)))
    assert told.startswith("arm.mass is free, but the notes of every recording set it (set.arm.mass)")
    mixed = [*noted[:2], recording(name="without")]
    check_settings(free, split(model, mixed, shoot=1.0))
    check_settings(free_parameters(model, ["arm.inertia"]), split(model, noted, shoot=1.0))
    factors = [recording({"times.arm.mass": "1.2"}, f"trial {k}") for k in range(3)]
    check_settings(free, split(model, factors, shoot=1.0))


def test_recordings_with_other_names_are_told_with_the_right_ones() -> None:
    told = refusal(lambda: cut(machine_model(CRANE), [recording(machine=PENDULUM)]))
    assert all(name in told for name in (*CRANE.joint_names, *CRANE.actuator_names, "pivot", "motor"))


def written(path: Path, header: str) -> Path:
    rows = [f"{k * 0.01:.2f}" + ",0" * header.count(",") for k in range(50)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("header", "parts"),
    [
        ("time,cmd.push,cmd.servo,cmd.drive,pos.sholder,pos.reach", ("pos.shoulder", "reach")),
        (
            "time,cmd.push,cmd.servo,cmd.drive,pos.hip,pos.knee",
            ("'pos.shoulder' for joint shoulder", "pos.hip, pos.knee"),
        ),
        ("time,cmd.push,cmd.servo,pos.shoulder,pos.reach", ("cmd.drive", "push and servo and drive")),
        ("time,cmd.a,cmd.b,cmd.c,pos.shoulder,pos.reach", ("'cmd.push' for actuator push", "cmd.a, cmd.b, cmd.c")),
        ("time,push,servo,drive,pos.shoulder,pos.reach", ("push", "cmd.<actuator>")),
        ("time,pos.shoulder,pos.reach", ("cmd.<actuator>",)),
    ],
)
def test_wrong_columns_are_told_with_the_right_ones(header: str, parts: tuple[str, ...], tmp_path: Path) -> None:
    path = written(tmp_path / "trial.csv", header)
    told = refusal(lambda: read_machine_set([path], CRANE))
    assert told.startswith(str(path)) and all(part in told for part in parts)
    with pytest.raises(RecordingError):
        read_machine_set([path], CRANE)


def test_columns_come_in_the_machines_order_whatever_the_files(tmp_path: Path) -> None:
    header = "time,pos.reach,pos.shoulder,cmd.drive,cmd.servo,cmd.push"
    path = tmp_path / "trial.csv"
    rows = [f"{k * 0.01:.2f},{k},{-k * 100},3,-2,1e6" for k in range(50)]
    path.write_text("\n".join([header, *rows]) + "\n")
    (found,) = read_machine_set([path], CRANE)
    assert (found.joints, found.actuators) == (CRANE.joint_names, CRANE.actuator_names)
    np.testing.assert_array_equal(found.command[0], [1e6, -2, 3])
    np.testing.assert_array_equal(found.position[2], [-200, 2])
