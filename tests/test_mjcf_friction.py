"""Friction and damping of MJCF robots against what is known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mjcf_models import DT, RK4, M, cart, run, trial_of
from scipy.integrate import solve_ivp

from equimus_ctrl.effects import (
    AsymmetricDamping,
    AsymmetricFriction,
    CoulombFriction,
    DriveCompliance,
    Effect,
    LoadFriction,
    QuadraticDamping,
    StribeckFriction,
    ViscousFriction,
)
from equimus_ctrl.errors import EquimusError
from equimus_ctrl.types import Array

# --- dry friction -----------------------------------------------------------------------------------------------

FRICTION = 4.0
CREEP = 1e-6
"""What something at rest may creep in a second [m]."""


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_dry_friction_stops_a_mass_and_holds_it(integrator: str) -> None:
    """A mass stops after v·m/F seconds, having gone half as far as it would have."""
    v = 1.0
    found = run(cart(option=f'integrator="{integrator}"'), CoulombFriction("way", FRICTION), v=v, until=2.0)
    stop = v * M / FRICTION
    moving = found.t <= stop
    exact = np.where(moving, v * found.t - FRICTION / M * found.t**2 / 2, v * stop / 2)
    np.testing.assert_allclose(found.x, exact, rtol=0, atol=v * DT)
    resting = found.x[found.t > stop + DT]
    assert np.ptp(resting) < CREEP and len(resting) > 1000


@pytest.mark.parametrize("solver", ["Newton", "CG", "PGS"])
@pytest.mark.parametrize("share", [0.3, -0.95])
@pytest.mark.parametrize("dt", [5e-4, 1e-3, 2e-3])
def test_below_its_friction_a_mass_stays_where_it_is(share: float, dt: float, solver: str) -> None:
    found = run(cart(dt=dt, option=f'solver="{solver}"'), CoulombFriction("way", FRICTION), u=share * FRICTION)
    assert np.abs(found.x).max() < CREEP


def test_above_its_friction_a_mass_moves_by_what_is_left() -> None:
    for side in (-1, 1):
        found = run(cart(), CoulombFriction("way", FRICTION), u=side * 1.25 * FRICTION)
        left = side * 0.25 * FRICTION / M
        np.testing.assert_allclose(found.x, left * found.t**2 / 2, rtol=0, atol=abs(left) * DT)


@pytest.mark.parametrize("dt", [2.5e-4, 5e-3, 2e-2])
def test_friction_holds_with_any_physics_step(dt: float) -> None:
    """With one that is not the file's too."""
    found = run(cart(), CoulombFriction("way", FRICTION), u=0.75 * FRICTION, dt=dt, every=dt)
    # Of what is left of the acceleration, a step's worth remains as speed.
    assert np.abs(found.x).max() < 2e-4 * 0.75 * FRICTION / M * dt


def test_friction_of_the_file_and_of_an_effect_add_up() -> None:
    found = run(cart('frictionloss="1.5"'), CoulombFriction("way", 2.5), v=1.0, until=1.0)
    assert found.x[-1] == pytest.approx(M / (2 * 4.0), abs=DT)
    assert np.ptp(found.x[600:]) < CREEP


@pytest.mark.parametrize(("side", "size"), [(1, 6.0), (-1, 2.0)])
def test_friction_may_depend_on_the_direction(side: int, size: float) -> None:
    effect = AsymmetricFriction("way", 6.0, 2.0)
    found = run(cart(), effect, v=side * 1.0, until=2.0)
    assert found.x[-1] == pytest.approx(side * M / (2 * size), abs=DT)
    assert np.ptp(found.x[1100:]) < CREEP
    assert np.abs(run(cart(), effect, u=side * 0.95 * size).x).max() < CREEP
    left = 0.1 * size / M
    assert run(cart(), effect, u=side * 1.1 * size).x[-1] == pytest.approx(side * left / 2, abs=left * DT)


def test_static_friction_holds_more_than_sliding_friction() -> None:
    effect = StribeckFriction("way", 2.0, 3.0, 0.05)
    for side in (-1, 1):
        assert np.abs(run(cart(), effect, u=side * 4.9).x).max() < CREEP
        # Once it moves, little is left of the breakaway friction.
        assert side * run(cart(), effect, u=side * 5.1).x[-1] > 0.5 * 2.0 / M / 2
    sliding = run(cart(), effect, u=4.9, v=0.5)
    assert sliding.x[-1] > 0.5


def test_static_friction_falls_off_with_speed() -> None:
    effect = StribeckFriction("way", 2.0, 3.0, 0.3)
    found = run(cart(), effect, v=1.0, until=0.5)

    def slope(t: float, x: Array) -> list[float]:
        return [x[1], -(2.0 + 3.0 / (1 + (x[1] / 0.3) ** 2)) / M]

    exact = solve_ivp(slope, (0, 0.5), [0.0, 1.0], t_eval=found.t, rtol=1e-10, atol=1e-12)
    assert exact.y[1, -1] > 0.1
    # The friction of a step is that of its beginning: one step of the speed's change.
    np.testing.assert_allclose(found.x, exact.y[0], rtol=0, atol=2 * DT * 1.0)
    slower = run(cart(), CoulombFriction("way", 2.0), v=1.0, until=0.5)
    assert slower.x[-1] - exact.y[0, -1] > 0.02


def test_friction_of_a_drive_grows_with_its_push() -> None:
    """Against a spring the push and the friction decide where it rests: by where it came from."""
    k, share, top, low = 100.0, 0.2, 8.0, 5.0
    up = [(t, top * t / 2) for t in np.arange(0, 2, 0.01)]
    down = [(3 + t, top + (low - top) * t / 2) for t in np.arange(0, 2, 0.01)]
    rows = [*up, (2.0, top), *down, (5.0, low)]
    robot = cart(f'stiffness="{k}" damping="10"', mass=0.05)
    found = run(robot, LoadFriction("way", share), u=rows, until=6.0)
    assert found.x[2990] == pytest.approx((1 - share) * top / k, abs=2e-4)
    assert found.x[-1] == pytest.approx((1 + share) * low / k, abs=2e-4)
    free = run(robot, u=rows, until=6.0)
    assert free.x[2990] == pytest.approx(top / k, abs=2e-4) and free.x[-1] == pytest.approx(low / k, abs=2e-4)


def test_a_drive_that_does_not_push_does_not_rub() -> None:
    robot = cart('stiffness="50"')
    np.testing.assert_array_equal(run(robot, LoadFriction("way", 0.5), q=0.3).x, run(robot, q=0.3).x)


def test_friction_of_a_drive_counts_behind_a_drive_that_gives_way_too() -> None:
    """The push goes through the spring; what is left of it moves both masses."""
    share, force, armature = 0.9, 3.0, 1.0
    robot = cart(f'armature="{armature}"')
    stiff = run(robot, LoadFriction("way", share), u=force, until=2.0)
    soft = run(robot, LoadFriction("way", share), DriveCompliance("way", 1e4, 20.0), u=force, until=2.0)
    expected = (1 - share) * force / (M + armature) * 2.0
    assert stiff.x[-1] == pytest.approx(expected, rel=0.02)
    assert soft.x[-1] == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("flag", ["frictionloss", "constraint"])
def test_friction_that_the_file_switches_off_is_not_left_out_in_silence(flag: str) -> None:
    robot = cart(flags=f'<flag {flag}="disable"/>')
    try:
        found = run(robot, CoulombFriction("way", FRICTION), v=1.0)
    except EquimusError as error:
        assert flag in str(error)
    else:
        assert found.x[-1] == pytest.approx(M / (2 * FRICTION), abs=DT)


# --- damping ----------------------------------------------------------------------------------------------------


def test_viscous_friction_lets_speed_decay() -> None:
    """MuJoCo takes the damping of a joint at the end of a step: v₊ = v/(1 + b·dt/m)."""
    b, v = 6.0, 1.5
    n = np.arange(1, 1001)
    found = run(cart(), ViscousFriction("way", b), v=v)
    np.testing.assert_allclose(np.diff(found.x) / DT, v / (1 + b * DT / M) ** n, rtol=1e-9)
    exact = v * M / b * (1 - np.exp(-b / M * found.t))
    np.testing.assert_allclose(found.x, exact, rtol=0, atol=v * DT)
    np.testing.assert_allclose(run(cart(option=RK4), ViscousFriction("way", b), v=v).x, exact, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(found.x, run(cart(f'damping="{b}"'), v=v).x)
    np.testing.assert_allclose(run(cart('damping="2"'), ViscousFriction("way", b - 2), v=v).x, found.x, atol=1e-12)


@pytest.mark.parametrize("v", [2.0, -2.0])
def test_quadratic_damping_lets_speed_decay(v: float) -> None:
    """v = v₀/(1 + d·|v₀|·t/m)."""
    d = 5.0
    t = trial_of().sample_times
    exact = math.copysign(M / d, v) * np.log1p(d * abs(v) * t / M)
    effect = QuadraticDamping("way", d)
    np.testing.assert_allclose(run(cart(option=RK4), effect, v=v).x, exact, rtol=0, atol=1e-8)
    # The first step overdoes it most: half of d·v²/m·dt a step, for a time of m/(d·v).
    np.testing.assert_allclose(run(cart(), effect, v=v).x, exact, rtol=0, atol=2 * abs(v) * DT)


@pytest.mark.parametrize("side", [1, -1])
def test_damping_may_depend_on_the_direction(side: int) -> None:
    """c + d/2 forwards and c − d/2 backwards."""
    c, d, v = 5.0, 6.0, side * 1.5
    b = c + side * d / 2
    found = run(cart(), ViscousFriction("way", c), AsymmetricDamping("way", d), v=v)
    exact = v * M / b * (1 - np.exp(-b / M * found.t))
    np.testing.assert_allclose(found.x, exact, rtol=0, atol=abs(v) * DT)
    assert np.abs(found.x - run(cart(), ViscousFriction("way", c), v=v).x).max() > 0.05


@pytest.mark.parametrize(("flag", "effect"), [("damper", ViscousFriction("way", 6.0))])
def test_damping_that_the_file_switches_off_is_not_left_out_in_silence(flag: str, effect: Effect) -> None:
    robot = cart(flags=f'<flag {flag}="disable"/>')
    try:
        found = run(robot, effect, v=1.0)
    except EquimusError as error:
        assert flag in str(error)
    else:
        assert found.x[-1] == pytest.approx(M / 6.0 * (1 - math.exp(-3.0)), abs=2 * DT)
