"""Commands, drives and sensors of MJCF robots against what is known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from mjcf_models import DT, M, cart, run, trial_of

from equimus_ctrl.effects import (
    ActuatorGain,
    Backlash,
    ConstantForce,
    DriveCompliance,
    DrivePlay,
    FirstOrderLag,
    SensorDelay,
    SensorOffset,
    SensorScale,
    TorqueSaturation,
    TransportDelay,
)
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

SERVO = '<position name="motor" joint="way" kp="200" kv="30"/>'


# --- drives and commands ----------------------------------------------------------------------------------------


def test_the_force_of_a_drive_may_be_more_or_less() -> None:
    np.testing.assert_allclose(run(cart(), ActuatorGain("motor", 0.8), u=5.0).x, run(cart(), u=4.0).x, rtol=1e-12)
    # Of a servo both its stiffness and its damping.
    weaker = cart(drive='<position name="motor" joint="way" kp="100" kv="15"/>')
    np.testing.assert_allclose(
        run(cart(drive=SERVO), ActuatorGain("motor", 0.5), u=0.3).x, run(weaker, u=0.3).x, rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("side", [1, -1])
def test_the_force_of_a_drive_may_stop_growing(side: int) -> None:
    limited = (TorqueSaturation("motor", 2.0),)
    np.testing.assert_array_equal(run(cart(), *limited, u=side * 5.0).x, run(cart(), u=side * 2.0).x)
    np.testing.assert_array_equal(run(cart(), *limited, u=side * 1.5).x, run(cart(), u=side * 1.5).x)
    # A servo far from its goal pushes with all it has: 200 N/m and 2 N.
    found = run(cart(drive=SERVO), *limited, u=side * 3.0)
    np.testing.assert_allclose(found.x, side * found.t**2 / 2, rtol=0, atol=DT)


def test_a_gain_acts_before_the_limit() -> None:
    effects = (ActuatorGain("motor", 0.5), TorqueSaturation("motor", 2.0))
    np.testing.assert_array_equal(run(cart(), *effects, u=3.0).x, run(cart(), u=1.5).x)
    np.testing.assert_array_equal(run(cart(), *effects[::-1], u=9.0).x, run(cart(), u=2.0).x)


def test_a_transport_delay_shifts_a_step() -> None:
    rows = [(0.2, 3.0), (0.5, -1.0)]
    plain, late = run(cart(), u=rows), run(cart(), TransportDelay("motor", 0.125), u=rows)
    np.testing.assert_allclose(late.x[125:], plain.x[:-125], rtol=0, atol=1e-12)
    assert np.all(late.x[:326] == 0) and late.x[330] > 0
    # Between steps the mean over a step counts.
    between = run(cart(), TransportDelay("motor", 0.1254), u=[(0.2, 3.0)])
    exact = 1.5 * np.maximum(between.t - 0.3254, 0) ** 2 / 2
    np.testing.assert_allclose(between.x, exact, rtol=0, atol=1.5 * DT)
    assert np.diff(between.x)[-1] / DT == pytest.approx(1.5 * (1.0 - 0.3254), rel=1e-9)


def lagged(t: Array, tau: float) -> Array:
    """Way of a unit mass under a unit force that comes by and by."""
    return np.asarray(t**2 / 2 - tau * t + tau**2 * (1 - np.exp(-t / tau)))


def test_a_lag_softens_a_step() -> None:
    tau = 0.15
    found = run(cart(), FirstOrderLag("motor", tau), u=[(0.0, 3.0)])
    np.testing.assert_allclose(found.x, 1.5 * lagged(found.t, tau), rtol=0, atol=1.5 * DT / 2)
    # Of the speed, which no step hurries, it is the law itself.
    t = found.t[1:]
    np.testing.assert_allclose(np.diff(found.x) / DT, 1.5 * (t - tau * (1 - np.exp(-t / tau))), rtol=0, atol=1e-9)


def test_a_step_may_come_late_and_softened() -> None:
    effects = (TransportDelay("motor", 0.2), FirstOrderLag("motor", 0.1))
    found = run(cart(), *effects, u=[(0.1, 3.0)])
    np.testing.assert_allclose(
        found.x, 1.5 * lagged(np.maximum(found.t - 0.3, 0), 0.1), rtol=0, atol=1.5 * DT / 2 + 1e-12
    )


def test_before_the_first_command_the_last_one_holds() -> None:
    one = replace(trial_of([(0.3, 0.0)]), before=np.array([2.0]))
    found = run(cart(), FirstOrderLag("motor", 0.1), trial=one)
    early = found.t <= 0.3
    np.testing.assert_allclose(found.x[early], found.t[early] ** 2 / 2, rtol=0, atol=DT)


# --- drives that give way ---------------------------------------------------------------------------------------


def test_a_drive_that_gives_way_moves_as_two_masses_and_a_spring() -> None:
    """x = F/(m + a)·(t²/2 − (1 − cos ωt)/ω²) with ω² = k·(1/m + 1/a): the common way and the swing about it."""
    armature, k, force = 0.5, 200.0, 4.0
    found = run(cart(f'armature="{armature}"'), DriveCompliance("way", k, 0.0), u=force)
    omega = math.sqrt(k * (1 / M + 1 / armature))
    swing = (1 - np.cos(omega * found.t)) / omega**2
    exact = force / (M + armature) * (found.t**2 / 2 - swing)
    np.testing.assert_allclose(found.x, exact, rtol=0, atol=force / (M + armature) * DT)
    assert force / (M + armature) * swing.max() > 2 * force / (M + armature) * DT


def test_at_the_antiresonance_the_drive_stands_still() -> None:
    """Where the mass swings on its spring, it takes all that the motor pushes: x = −F·sin(ωt)/k."""
    armature, k, force = 0.5, 200.0, 4.0
    omega = math.sqrt(k / M)
    times = np.arange(0, 2, DT)
    rows = [(t, force * math.sin(omega * (t + DT / 2))) for t in times]
    # Begun as it would swing for ever: the drive at rest, the mass passing through the middle.
    own = realise(Model(cart(f'armature="{armature}"'), (DriveCompliance("way", k, 0.0),)))
    data = mujoco.MjData(own.mujoco)
    place, dof, rotor = own.places[0, 0], own.places[0, 1], own.rotors[0, 0]
    data.qvel[dof] = -force * omega / k
    path = np.empty((len(rows), 2))
    for i, (_, u) in enumerate(rows):
        data.ctrl[0] = u
        mujoco.mj_step(own.mujoco, data)
        path[i] = data.qpos[[place, rotor]]
    np.testing.assert_allclose(path[:, 0], -force / k * np.sin(omega * (times + DT)), rtol=0, atol=0.05 * force / k)
    assert np.abs(path[:, 1]).max() < 0.05 * force / k


def test_at_rest_a_drive_gives_way_by_force_over_stiffness() -> None:
    """A servo holds the drive, not the mass."""
    k, force = 500.0, 10.0
    robot = cart('armature="0.5" damping="40"', drive=SERVO)
    rigid = run(robot, ConstantForce("way", force), u=0.1, until=8.0)
    soft = run(robot, ConstantForce("way", force), DriveCompliance("way", k, 5.0), u=0.1, until=8.0)
    assert rigid.x[-1] == pytest.approx(0.1 + force / 200, abs=1e-6)
    assert soft.x[-1] - rigid.x[-1] == pytest.approx(force / k, abs=1e-6)


def test_a_very_stiff_drive_is_rigid() -> None:
    robot = cart('armature="0.5"', drive=SERVO)
    rigid, stiff = run(robot, u=0.2), run(robot, DriveCompliance("way", 2e4, 100.0), u=0.2)
    np.testing.assert_allclose(stiff.x, rigid.x, rtol=0, atol=2e-3)
    assert np.abs(rigid.x).max() > 0.1


def test_joints_that_the_file_describes_by_default_do_not_describe_drives() -> None:
    """What turns with a drive is its armature and nothing else."""
    head = (
        '<default><joint damping="3" stiffness="70" frictionloss="0.5" limited="true" range="-0.01 0.01"/>'
        '<tendon frictionloss="2" limited="true" range="-0.001 0.001"/></default>'
    )
    bare = 'armature="0.5" damping="0" stiffness="0" frictionloss="0" limited="false"'
    effects = (DriveCompliance("way", 200.0, 1.0),)
    np.testing.assert_array_equal(run(cart(bare, head=head), *effects, u=4.0).x, run(cart(bare), *effects, u=4.0).x)


def test_within_its_play_a_drive_moves_alone() -> None:
    """The drive takes √(play·armature/force) to come to an end of its play, and the mass stays until then."""
    play, armature, force = 0.08, 0.5, 1.0
    found = run(cart(f'armature="{armature}"'), DrivePlay("way", play), u=force)
    touch = math.sqrt(play * armature / force)
    before, after = found.t < touch - 2 * DT, found.t > touch + 0.02
    assert 0.1 < touch < 0.5
    assert np.abs(found.x[before]).max() < 1e-9
    assert found.x[after].min() > 0.0


def test_beyond_its_play_a_drive_takes_its_mass_along() -> None:
    """After some time both have gone what their masses and the force make of it, up to the play."""
    play, armature, force = 0.02, 0.5, 3.0
    for side in (-1, 1):
        found = run(cart(f'armature="{armature}"'), DrivePlay("way", play), u=side * force, until=2.0)
        common = side * force / (M + armature) * 2.0
        assert found.x[-1] == pytest.approx(common, abs=play)
        without = run(cart(f'armature="{armature}"'), DrivePlay("way", 0.0), u=side * force, until=2.0)
        assert without.x[-1] == pytest.approx(common, abs=2e-3)
        assert side * (without.x[-1] - found.x[-1]) > play / 20


@pytest.mark.parametrize("armature", [1e-3, 300.0])
@pytest.mark.parametrize("dt", [None, 4e-3])
def test_play_can_be_followed_whatever_turns_with_the_drive(armature: float, dt: float | None) -> None:
    force = 2.0 * (M + armature)
    found = run(cart(f'armature="{armature}"'), DrivePlay("way", 0.01), u=force, until=2.0, every=0.02, dt=dt)
    assert found.x[-1] == pytest.approx(4.0, abs=0.03)


# --- sensors ----------------------------------------------------------------------------------------------------

STEPS = [(0.0, 3.0), (0.3, -6.0), (0.6, 5.0)]


def test_sensors_scale_and_offset_what_they_show() -> None:
    plain = run(cart(), u=STEPS, q=0.2)
    both = run(cart(), SensorOffset("way", -0.3), SensorScale("way", 1.5), u=STEPS, q=0.2)
    np.testing.assert_allclose(both.x, 1.5 * plain.x - 0.3, rtol=0, atol=1e-14)


def test_sensors_show_what_was() -> None:
    plain, late = run(cart(), u=STEPS), run(cart(), SensorDelay("way", 0.05), u=STEPS)
    np.testing.assert_allclose(late.x[50:], plain.x[:-50], rtol=0, atol=1e-13)
    np.testing.assert_array_equal(late.x[:50], 0.0)
    assert np.abs(late.x - plain.x).max() > 0.01


def test_sensors_follow_with_play() -> None:
    plain, loose = run(cart(), u=STEPS), run(cart(), Backlash("way", 0.04), u=STEPS)
    held, expected = 0.0, []
    for x in plain.x:
        held = min(max(held, x - 0.02), x + 0.02)
        expected.append(held)
    np.testing.assert_allclose(loose.x, expected, rtol=0, atol=1e-14)
    assert np.ptp(plain.x - loose.x) == pytest.approx(0.04), "it should use the play in both directions"
