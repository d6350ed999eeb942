"""Friction over two joints that a gear couples: beside a tendon in MuJoCo, in both engines, as XML, and found."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from coupled_arm import ARM_OF_HINGES, driven, gear, recorded_alone, stepped, xml_of
from mjcf_models import HINGES, RIG, corrected_xml, refusal

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis.hypothesis import Candidate, default_free_parameters
from equimus_ctrl.diagnosis.torque_columns import columns_of
from equimus_ctrl.effects import (
    CoulombFriction,
    CoupledDamping,
    CoupledDampingDifference,
    CoupledFriction,
    CoupledFrictionDifference,
    DriveCompliance,
    Effect,
)
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.mjcf_inverse import MeasuredMotion, inverse_dynamics
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

CASES: list[tuple[Effect, str]] = [
    (CoupledFriction("shoulder", 0.15), gear(1, frictionloss=0.15)),
    (CoupledFrictionDifference("shoulder", 0.1), gear(-1, frictionloss=0.1)),
    (CoupledDamping("shoulder", 0.08), gear(1, damping=0.08)),
    (CoupledDampingDifference("shoulder", 0.08), gear(-1, damping=0.08)),
]
NAMES = [effect.name for effect, _ in CASES]


def trial(seconds: float = 1.0, seed: int = 3) -> Trial:
    time, commands = driven(np.random.default_rng(seed), seconds)
    return Trial("t", time, commands, commands[0], 0.0, np.array([0.3, -0.2]), time)


def alone(xml: str, given: Trial) -> Array:
    return stepped(mujoco.MjModel.from_xml_string(xml), given.position, given.commands)


def reduced(model: Model, given: Trial, dt: float = 5e-4) -> Array:
    return np.asarray(simulate([model], [given], dt=dt, check=False)[0].position[0])


# --- the motion -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("effect", "tendon"), CASES, ids=NAMES)
def test_both_engines_and_the_written_xml_move_as_a_tendon_does(effect: Effect, tendon: str) -> None:
    model, given = Model(ARM_OF_HINGES, (effect,)), trial()
    real, bare = alone(xml_of(tendon), given), alone(xml_of(), given)
    assert np.abs(real - bare).max() > 0.03
    xml, left = corrected_xml(model)
    assert left == ()
    with_mujoco = simulate_mjcf([model], [given], threads=1, dt=1e-4)[0].position[0]
    np.testing.assert_allclose(with_mujoco, real, rtol=0, atol=2e-5)
    np.testing.assert_allclose(reduced(model, given), real, rtol=0, atol=2e-3)
    np.testing.assert_allclose(alone(xml, given), real, rtol=0, atol=2e-3)
    written = mujoco.MjModel.from_xml_string(xml)
    (value,) = effect.parameters().values()
    field = written.tendon_frictionloss if "friction" in effect.parameters() else written.tendon_damping
    assert written.ntendon == 1 and field[0] == pytest.approx(value, rel=1e-5)


def pushed(effect: Effect, first: float, second: float) -> Array:
    """(4,) where both joints end up that nothing else moves, and how fast, by the reduced engine and by MuJoCo."""
    floating = MjcfRobot(
        "free", HINGES.xml.replace("<option", '<option gravity="0 0 0"').replace('stiffness="120"', "")
    )
    command = np.array([[first, second]])
    given = Trial("t", np.zeros(1), command, command[0], 0.0, np.zeros(2), np.linspace(0, 0.5, 51))
    model = Model(floating, (effect,))
    ends = reduced(model, given), simulate_mjcf([model], [given], threads=1)[0].position[0]
    return np.concatenate([one[-1] for one in ends])


@pytest.mark.slow
def test_friction_holds_what_pushes_both_joints_alike_and_no_other_way() -> None:
    """Torques τ on both are a force along the tendon of τ: less than the friction holds. Against each other they move."""
    assert np.abs(pushed(CoupledFriction("shoulder", 1.0), 0.9, 0.9)).max() < 1e-5
    assert np.abs(pushed(CoupledFriction("shoulder", 1.0), 1.1, 1.1)).max() > 1e-3
    first, second, *_ = moved = pushed(CoupledFriction("shoulder", 1.0), 0.5, -0.5)
    assert abs(first) > 1e-3 and first == pytest.approx(-second, rel=1e-6)
    np.testing.assert_allclose(moved[2:], moved[:2], rtol=0.02)
    assert np.abs(pushed(CoupledFrictionDifference("shoulder", 1.0), 0.9, -0.9)).max() < 1e-5


def test_beside_friction_of_both_joints_nothing_is_held_twice() -> None:
    """Three rows of dry friction over two joints: MuJoCo's limit and the reduced engine's agree."""
    effects = CoupledFriction("shoulder", 0.1), CoulombFriction("shoulder", 0.1), CoulombFriction("elbow", 0.05)
    model, given = Model(ARM_OF_HINGES, effects), trial()
    fine, coarse = (simulate_mjcf([model], [given], threads=1, dt=step)[0].position[0] for step in (5e-5, 1e-4))
    np.testing.assert_allclose(reduced(model, given), 2 * fine - coarse, rtol=0, atol=2e-4)


# --- where it can be --------------------------------------------------------------------------------------------

CHAIN = """<mujoco><compiler angle="radian"/><worldbody>
  <body><joint name="a" axis="0 0 1"/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
    <body><joint name="b" axis="0 1 0"/><joint name="c" axis="1 0 0"/>
      <inertial mass="1" pos="0 0 0.1" diaginertia="1 1 1"/>
      <body><joint name="d" axis="0 1 0"/><inertial mass="1" pos="0 0 0.1" diaginertia="1 1 1"/>
        <body><joint name="left" type="slide" axis="0 1 0"/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body>
      </body>
      <body><joint name="e" axis="0 1 0"/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
        <body><joint name="f" axis="0 1 0"/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
          <body><joint name="passive" axis="0 1 0"/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body></body></body>
    </body></body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/><motor joint="c"/><motor joint="d"/><motor joint="e"/><motor joint="f"/>
    <motor joint="left"/></actuator></mujoco>"""


def test_it_is_between_driven_hinges_of_which_the_first_carries_the_second_alone() -> None:
    assert MjcfRobot("chain", CHAIN).next_hinges == {"a": "b", "b": "c", "e": "f"}
    assert RIG.next_hinges == {} and ARM_OF_HINGES.next_hinges == {"shoulder": "elbow"}
    assert "coupled_friction" in refusal(lambda: Model(RIG, (CoupledFriction("shoulder", 0.1),)))
    assert "coupled_damping" in refusal(lambda: Model(ARM_OF_HINGES, (CoupledDamping("elbow", 0.1),)))


def test_one_pair_rubs_against_the_sum_or_the_difference() -> None:
    both = CoupledFriction("shoulder", 0.1), CoupledFrictionDifference("shoulder", 0.2)
    assert "exclude each other" in refusal(lambda: Model(ARM_OF_HINGES, both))
    made = ARM_OF_HINGES.with_coupling("shoulder", 1, friction=0.1)
    assert "expected one of both" in refusal(lambda: made.with_coupling("shoulder", -1, friction=0.2))
    more = made.with_coupling("shoulder", 1, damping=0.3).with_coupling("shoulder", 1, friction=0.05)
    (own,) = more.couplings
    assert own.friction == pytest.approx(0.15) and own.damping == 0.3
    assert len(more.with_coupling("shoulder", -1, damping=0.2).couplings) == 2
    assert more.digest != made.digest != ARM_OF_HINGES.digest


@pytest.mark.slow
def test_an_xml_that_switches_friction_off_has_none_of_it() -> None:
    flag = '<option timestep="0.002"><flag frictionloss="disable"/></option>'
    off = MjcfRobot("off", xml_of().replace('<option timestep="0.002" integrator="implicitfast"/>', flag))
    assert "frictionloss" in refusal(lambda: Model(off, (CoupledFriction("shoulder", 0.1),)))
    model, given = Model(off, (CoupledDamping("shoulder", 0.1),)), trial(0.3)
    with_mujoco = simulate_mjcf([model], [given], threads=1, dt=1e-4)[0].position[0]
    np.testing.assert_allclose(reduced(model, given), with_mujoco, rtol=0, atol=1e-3)


def test_nothing_of_the_files_defaults_describes_the_tendon() -> None:
    defaults = (
        '<default><tendon stiffness="7" damping="3" frictionloss="2" armature="0.5" range="-0.1 0.1" limited="true"'
        ' springlength="0.3"/></default><worldbody>'
    )
    robot, effect = MjcfRobot("d", xml_of().replace("<worldbody>", defaults)), CoupledDamping("shoulder", 0.08)
    own, plain = (simulate_mjcf([Model(r, (effect,))], [trial(0.4)], threads=1)[0] for r in (robot, ARM_OF_HINGES))
    np.testing.assert_array_equal(own.position, plain.position)


def test_it_goes_with_a_drive_that_gives_way() -> None:
    effects = CoupledFriction("shoulder", 0.1), DriveCompliance("shoulder", 200.0, 1.0)
    xml, left = corrected_xml(Model(ARM_OF_HINGES, effects))
    names = {mujoco.MjModel.from_xml_string(xml).tendon(k).name for k in range(2)}
    assert left == () and names == {"shoulder and elbow", "shoulder drive"}


# --- what a diagnosis makes of it -------------------------------------------------------------------------------


def motion_of(one: Recording) -> MeasuredMotion:
    return MeasuredMotion(Trial.of(one, one.position[0]), one.time, one.position, np.full(2, 1e-6))


@pytest.mark.parametrize(("effect", "tendon"), CASES, ids=NAMES)
def test_in_the_torque_domain_it_is_the_force_that_is_missing(effect: Effect, tendon: str) -> None:
    """Least squares of the missing forces by the effect's column give its size; with it nothing is missing."""
    given = trial(3.0)
    positions = alone(xml_of(tendon), given)
    one = Recording("t", given.times, given.commands, positions, ("m1", "m2"), ("shoulder", "elbow"))
    without, with_it = (inverse_dynamics(Model(ARM_OF_HINGES, own), [motion_of(one)], 3)[0] for own in ((), (effect,)))
    missing, left = (at.weighted(at.missing)[at.counts] for at in (without, with_it))
    assert np.sqrt(np.mean(left**2)) < 0.25 * np.sqrt(np.mean(missing**2))
    free = default_free_parameters(Model(ARM_OF_HINGES))
    key, size = next(iter(effect.parameters().items()))
    candidate = Candidate(type(effect), ("shoulder",), ({key: 0.05},))
    (seen,), columns, counts, _ = columns_of(free, free.start, [motion_of(one)], 3, [candidate], lambda: None)
    column, target = columns[..., len(free.start)][counts], columns[..., -1][counts]
    assert seen.values([seen.nothing(key) + float(column @ target / (column @ column)) * seen.unit(key)])[key] == (
        pytest.approx(size, rel=0.05)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "tendon"),
    [
        pytest.param(*case, id=name, marks=[pytest.mark.long] if k else [])
        for k, (case, name) in enumerate(zip(CASES, NAMES, strict=True))
    ],
)
def test_a_diagnosis_names_it_with_its_size(effect: Effect, tendon: str) -> None:
    """Recordings by MuJoCo alone."""
    found = workflow.diagnose(recorded_alone(4, 3, tendons=tendon), Model(ARM_OF_HINGES), most=1)
    assert [(f.named.effect, f.named.locations) for f in found.findings] == [(effect.name, ("shoulder",))]
    key, size = next(iter(effect.parameters().items()))
    assert found.findings[0].parameters[key].value == pytest.approx(size, rel=0.02)


@pytest.mark.slow
def test_a_diagnosis_names_nothing_where_nothing_couples() -> None:
    assert workflow.diagnose(recorded_alone(4, 5), Model(ARM_OF_HINGES), most=1).findings == ()
