"""What gears and motors of MJCF robots do, against textbook motions: a cart on a level slide, a wheel without weight."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from mjcf_models import DT, RK4, M, cart, refusal, run

from equimus_ctrl.effects import (
    DirectionalLoadFriction,
    Effect,
    LoadFriction,
    MotorDeadZone,
    PositionDependentFriction,
    RotorInertia,
    TorqueRipple,
)
from equimus_ctrl.engines.mjcf_inverse import law_force
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

INERTIA = 0.05
"""Of the wheel [kg·m²]."""


def wheel() -> MjcfRobot:
    """A hinge that nothing turns."""
    return MjcfRobot(
        "wheel",
        f"""<mujoco><compiler angle="radian"/><option timestep="{DT}" gravity="0 0 0" {RK4}/><worldbody><body name="rim">
        <joint name="way" axis="0 1 0"/>
        <inertial mass="1" pos="0 0 0" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/></body></worldbody>
        <actuator><motor name="motor" joint="way"/></actuator></mujoco>""",
    )


def acceleration(effect: Effect, u: float, v: float = 0.0) -> float:
    """Of the cart in its first tenth of a second."""
    x = run(cart(), effect, u=u, v=v, until=0.1).x
    return float(2 * (x[-1] - v * 0.1) / 0.1**2)


# --- friction of a gear that is driven backwards ----------------------------------------------------------------


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_gear_loses_one_share_driven_and_another_driven_backwards(side: float) -> None:
    """A motor pulls with 10 N: away from rest it moves the cart, against 3 m/s it brakes it."""
    effect = DirectionalLoadFriction("way", 0.1, 0.4)
    assert acceleration(effect, side * 10.0) * side == pytest.approx(10.0 * (1 - 0.1) / M, rel=0.03)
    assert acceleration(effect, side * 10.0, -side * 3.0) * side == pytest.approx(10.0 * (1 + 0.4) / M, rel=0.03)


def test_one_share_in_both_directions_is_friction_of_the_load() -> None:
    for v in (0.0, -2.0, 2.0):
        one, other = (
            run(cart(), e, u=8.0, v=v).x for e in (DirectionalLoadFriction("way", 0.2, 0.2), LoadFriction("way", 0.2))
        )
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


def test_along_a_measured_motion_friction_opposes_it_by_the_share_of_its_power() -> None:
    """What inverse dynamics take of it: −drive·|τ| or −backdrive·|τ| against the rate, by the sign of τ·rate."""
    p = {"drive": 0.1, "backdrive": 0.4}
    rate, drive = np.array([1.0, 1.0, -1.0, -1.0]), np.array([5.0, -5.0, 5.0, -5.0])
    found = law_force(DirectionalLoadFriction, p, np.zeros(4), rate, drive)
    np.testing.assert_allclose(found, -np.sign(rate) * np.where(rate * drive > 0, 0.1, 0.4) * 5.0)
    assert DirectionalLoadFriction.depends() == {"vel", "cmd"} and LoadFriction.depends() == {"vel"}


def test_two_frictions_of_the_load_exclude_each_other() -> None:
    both = LoadFriction("way", 0.1), DirectionalLoadFriction("way", 0.1, 0.2)
    assert "exclude each other" in refusal(lambda: Model(cart(), both))


# --- forces that come back along the way ------------------------------------------------------------------------


def test_ripple_keeps_energy() -> None:
    """½·I·ω² − ∫F dx stays: F = a·sin(kx) + b·cos(kx) has the potential (a·cos(kx) − b·sin(kx))/k."""
    a, b, k = 0.3, -0.2, 2 * math.pi / 0.5
    found = run(wheel(), TorqueRipple("way", a, b, 0.5), v=4.0)
    x, v = found.x, np.gradient(found.x, found.t)
    energy = INERTIA * v**2 / 2 + (a * np.cos(k * x) - b * np.sin(k * x)) / k
    assert np.ptp(INERTIA * v[2:-2] ** 2 / 2) > 0.05 and np.ptp(energy[2:-2]) < 4e-3


def test_ripple_holds_a_wheel_that_is_slow() -> None:
    """From a minimum of the potential with less energy than its maximum it only swings, ω² = 2π·F/(period·I)."""
    found = run(wheel(), TorqueRipple("way", -0.4, 0.0, 0.5), v=0.02, until=0.2)
    omega = math.sqrt(2 * math.pi * 0.4 / (0.5 * INERTIA))
    np.testing.assert_allclose(found.x, 0.02 / omega * np.sin(omega * found.t), rtol=0, atol=2e-5)


def test_less_than_one_wave_is_no_ripple() -> None:
    from test_guesses import SEEN

    assert TorqueRipple.degenerate({"sine": 1.0, "cosine": 0.0, "period": 1.1 * SEEN.span}, SEEN)
    assert not TorqueRipple.degenerate({"sine": 1.0, "cosine": 0.0, "period": 0.4 * SEEN.span}, SEEN)


# --- dry friction that depends on the angle ---------------------------------------------------------------------


def test_a_wheel_stops_where_friction_has_taken_its_energy() -> None:
    """½·I·ω² = ∫F dx, with F = 0.1 + 0.5·(1 + cos(x − 1))/2 from 0 on."""
    found = run(wheel(), PositionDependentFriction("way", 0.1, 0.5, 1.0), v=4.0, until=2.0)
    x = np.linspace(0.0, 6.0, 60001)
    work = np.cumsum((0.1 + 0.25 * (1 + np.cos(x - 1.0))) * (x[1] - x[0]))
    assert found.x[-1] == pytest.approx(float(x[np.searchsorted(work, INERTIA * 4.0**2 / 2)]), abs=0.01)
    assert np.ptp(found.x[-200:]) < 1e-4


def test_friction_is_nowhere_less_than_nothing_and_largest_at_its_angle() -> None:
    x = ca.SX.sym("x")
    p = {"friction": ca.SX(0.0), "more": ca.SX(0.8), "angle": ca.SX(0.7)}
    size = ca.Function("size", [x], [PositionDependentFriction.dry_friction(x, ca.SX(0), p)])
    along = np.linspace(-4, 4, 801)
    values: Array = np.array(size(along[None])).ravel()
    assert values.min() >= 0.0 and along[int(np.argmax(values))] == pytest.approx(0.7, abs=0.01)
    assert values.max() == pytest.approx(0.8)


def test_a_slide_has_no_turn_on_which_its_friction_could_depend() -> None:
    assert "position_dependent_friction" in refusal(
        lambda: Model(cart(), (PositionDependentFriction("way", 0.1, 0.5, 1.0),))
    )


# --- motors -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("u", "left"), [(5.0, 3.0), (-5.0, -3.0), (1.5, 0.0), (-2.0, 0.0)])
def test_a_dead_zone_takes_as_much_of_commands_of_either_sign(u: float, left: float) -> None:
    assert acceleration(MotorDeadZone("motor", 2.0), u) == pytest.approx(left / M, abs=0.05)


def test_a_goal_has_no_dead_zone() -> None:
    servo = cart(drive='<position name="motor" joint="way" kp="10"/>')
    assert "motor_dead_zone" in refusal(lambda: Model(servo, (MotorDeadZone("motor", 0.1),)))


def test_a_rotor_turns_with_the_cart_where_the_file_has_none() -> None:
    assert acceleration(RotorInertia("way", 0.5), 10.0) == pytest.approx(10.0 / (M + 0.5), rel=0.02)
    assert "rotor_inertia" in refusal(lambda: Model(cart('armature="0.1"'), (RotorInertia("way", 0.5),)))
