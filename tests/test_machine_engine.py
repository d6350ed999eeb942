"""Machines simulated: every law against what is known in closed form, and what must not matter does not."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from equimus_ctrl.diagnosis.candidates import Candidate, Part
from equimus_ctrl.diagnosis.results import Estimate, Evidence, Finding
from equimus_ctrl.diagnosis.split import window_length
from equimus_ctrl.effects import (
    REGISTRY,
    ActuatorGain,
    AsymmetricDamping,
    AsymmetricFriction,
    Backlash,
    ConstantForce,
    CoulombFriction,
    DriveCompliance,
    DrivePlay,
    Effect,
    FirstOrderLag,
    ForceEffect,
    LoadFriction,
    ParallelSpring,
    PayloadMass,
    QuadraticDamping,
    SensorDelay,
    SensorOffset,
    SensorScale,
    ShapingEffect,
    StribeckFriction,
    TorqueSaturation,
    TransportDelay,
    ViscousFriction,
    catalogue,
    parameter,
    register,
)
from equimus_ctrl.engines.batch import Trial
from equimus_ctrl.engines.machine import pushes, realise, simulate_machines
from equimus_ctrl.engines.machine_motion import machine_motion, pushed
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.errors import ConfigError, EquimusError, SimulationDiverged
from equimus_ctrl.identification.parameters import unit_of
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import machine_simulator
from equimus_ctrl.models.machine import Machine
from equimus_ctrl.models.model import Model, machine_model
from equimus_ctrl.report.diagnosis_sentences import SENTENCES, sentence
from equimus_ctrl.types import Array, Recording

M = 2.0
"""Mass of the cart [kg]."""
DT = 1e-3


def cart(
    joint: str = "", *, dt: float = DT, option: str = "", drive: str = '<motor name="motor" joint="way"/>',
    flags: str = "", head: str = "", mass: float = M,
) -> Machine:  # fmt: skip
    """A mass on a level slide."""
    return Machine(
        "cart",
        f"""<mujoco>{head}<option timestep="{dt}" gravity="0 0 0" {option}>{flags}</option><worldbody>
        <body name="box"><joint name="way" type="slide" axis="1 0 0" {joint}/>
        <inertial mass="{mass}" pos="0 0 0" diaginertia="0.1 0.1 0.1"/></body></worldbody>
        <actuator>{drive}</actuator></mujoco>""",
    )


RK4 = 'integrator="RK4"'
SERVO = '<position name="motor" joint="way" kp="200" kv="30"/>'


def hung(joint: str = "", *, head: str = "", option: str = "") -> Machine:
    """A pendulum of 1 kg at 0.3 m, 0.1 kg·m² about its pivot."""
    return Machine(
        "pendulum",
        f"""<mujoco>{head}<option timestep="{DT}" {option}/><worldbody><body name="arm">
        <joint name="pivot" axis="0 1 0" {joint}/>
        <inertial mass="1" pos="0 0 -0.3" diaginertia="0.01 0.01 0.01"/><site name="tip" pos="0 0 -0.5"/></body>
        </worldbody><actuator><motor name="motor" joint="pivot"/></actuator></mujoco>""",
    )


WEIGHT = 0.3 * 9.81


@dataclass(frozen=True, eq=False)
class Ran:
    """A path at its sample times."""

    t: Array
    x: Array


def trial_of(
    u: float | Sequence[tuple[float, float]] = 0.0, *, q: float = 0.0, v: float = 0.0, until: float = 1.0,
    every: float = DT,
) -> Trial:  # fmt: skip
    """One joint: a constant command, or (from, value) rows after none, sampled on the physics' grid by default."""
    rows = [(0.0, u)] if isinstance(u, int | float) else list(u)
    times, values = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    before = values[:1] if isinstance(u, int | float) else np.zeros(1)
    samples = every * np.arange(round(until / every) + 1)
    return Trial("t", times, values[:, None], before, 0.0, np.array([q]), samples, np.array([v]))


def run(machine: Machine, *effects: Effect, dt: float | None = None, trial: Trial | None = None, **of: object) -> Ran:
    one = trial or trial_of(**of)  # type: ignore[arg-type]
    (found,) = simulate_machines([machine_model(machine, effects)], [one], threads=1, dt=dt)
    assert found.sound.all()
    return Ran(one.sample_times, found.position[0, :, 0])


# --- what moves freely ------------------------------------------------------------------------------------------


def test_a_constant_force_accelerates_a_mass() -> None:
    """Euler's semi-implicit steps sum up to an arithmetic series, which is half a step ahead."""
    force = 3.0
    found = run(cart(), u=force)
    n = np.arange(len(found.t))
    np.testing.assert_allclose(found.x, force / M * DT**2 * n * (n + 1) / 2, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found.x, force / M * found.t**2 / 2, rtol=0, atol=1.01 * force / M * DT / 2)


def test_the_integrator_is_the_one_that_the_file_asks_for() -> None:
    found = run(cart(option=RK4), u=3.0, q=0.2, v=-1.0)
    np.testing.assert_allclose(found.x, 0.2 - found.t + 0.75 * found.t**2, rtol=0, atol=1e-12)


def test_between_physics_steps_the_path_is_a_cubic() -> None:
    """Of constant acceleration that is the path itself, wherever it is sampled."""
    found = run(cart(option=RK4), u=3.0, v=-1.0, until=0.9, every=0.00037)
    np.testing.assert_allclose(found.x, -found.t + 0.75 * found.t**2, rtol=0, atol=1e-12)


def crossings(found: Ran, level: float = 0.0) -> Array:
    """When it passes a level, by straight lines between samples."""
    x = found.x - level
    k = np.flatnonzero(x[:-1] * x[1:] < 0)
    return np.asarray(found.t[k] + (found.t[k + 1] - found.t[k]) * x[k] / (x[k] - x[k + 1]))


def test_a_torsion_pendulum_has_the_period_of_its_inertia_and_stiffness() -> None:
    inertia, stiffness, rest = 0.1, 8.0, 0.3
    machine = Machine(
        "torsion",
        f"""<mujoco><compiler angle="radian"/><option timestep="{DT}" gravity="0 0 0"/><worldbody><body name="disc">
        <joint name="wire" axis="0 0 1" stiffness="{stiffness}" springref="{rest}"/>
        <inertial mass="1" pos="0 0 0" diaginertia="0.05 0.05 {inertia}"/></body></worldbody>
        <actuator><motor name="m" joint="wire"/></actuator></mujoco>""",
    )
    found = run(machine, q=rest + 0.5, until=8.0)
    times, omega = crossings(found, rest), math.sqrt(stiffness / inertia)
    assert len(times) > 20
    # cos(ω'·dt) = 1 − (ω·dt)²/2 is what the steps make of it.
    slack = 2 * (omega * DT) ** 2 / 24 * math.pi / omega
    np.testing.assert_allclose(np.diff(times), math.pi / omega, rtol=0, atol=slack + 1e-6)
    assert np.ptp(found.x) == pytest.approx(1.0, abs=omega * DT)


def test_a_spring_beside_a_joint_is_one_in_it() -> None:
    own = run(cart('stiffness="50" springref="0.1"'), q=0.3)
    beside = run(cart(), ParallelSpring("way", 50.0, 0.1), q=0.3)
    np.testing.assert_allclose(beside.x, own.x, rtol=0, atol=1e-12)
    exact = 0.1 + 0.2 * np.cos(5.0 * own.t)
    np.testing.assert_allclose(own.x, exact, rtol=0, atol=0.2 * 5.0 * DT)


def test_a_constant_push_is_a_motor_that_pushes_all_the_time() -> None:
    np.testing.assert_allclose(run(cart(), ConstantForce("way", -2.0)).x, run(cart(), u=-2.0).x, rtol=0, atol=1e-13)
    assert run(cart(), ConstantForce("way", -2.0)).x[-1] == pytest.approx(-0.5, abs=2 * DT)


def test_a_trial_may_begin_at_any_time() -> None:
    rows = [(0.1, 2.0), (0.4, -3.0)]
    plain = trial_of(rows, q=0.1, v=0.2)
    later = replace(plain, times=plain.times + 7.0, start=7.0, sample_times=plain.sample_times + 7.0)
    np.testing.assert_allclose(run(cart(), trial=later).x, run(cart(), trial=plain).x, rtol=0, atol=1e-9)


def test_starts_may_be_given_beside_the_trials() -> None:
    model, one = machine_model(cart()), trial_of(1.0)
    both = simulate_machines([model, model], [one], starts=[np.array([[0.5, 2.0], [0.3, 0.0]])], threads=1)[0]
    still = simulate_machines([model, model], [one], starts=[np.array([[0.5], [0.3]])], threads=1)[0]
    expected = [run(cart(), u=1.0, q=q, v=v).x for q, v in ((0.5, 2.0), (0.3, 0.0), (0.5, 0.0))]
    np.testing.assert_array_equal(both.position[0, :, 0], expected[0])
    np.testing.assert_array_equal(both.position[1, :, 0], expected[1])
    np.testing.assert_array_equal(still.position[0, :, 0], expected[2])


@pytest.mark.parametrize("dt", [0.0, -1e-3, math.nan, math.inf])
def test_a_step_that_is_none_is_refused(dt: float) -> None:
    with pytest.raises(ConfigError, match=r"the physics step is .* s, expected more than 0"):
        simulate_machines([machine_model(cart())], [trial_of()], dt=dt)


def test_another_physics_step_can_be_asked_for() -> None:
    found = run(cart(), u=3.0, dt=5e-3, every=5e-3)
    n = np.arange(len(found.t))
    np.testing.assert_allclose(found.x, 1.5 * 25e-6 * n * (n + 1) / 2, rtol=1e-12, atol=1e-15)


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
    machine = cart(f'stiffness="{k}" damping="10"', mass=0.05)
    found = run(machine, LoadFriction("way", share), u=rows, until=6.0)
    assert found.x[2990] == pytest.approx((1 - share) * top / k, abs=2e-4)
    assert found.x[-1] == pytest.approx((1 + share) * low / k, abs=2e-4)
    free = run(machine, u=rows, until=6.0)
    assert free.x[2990] == pytest.approx(top / k, abs=2e-4) and free.x[-1] == pytest.approx(low / k, abs=2e-4)


def test_a_drive_that_does_not_push_does_not_rub() -> None:
    machine = cart('stiffness="50"')
    np.testing.assert_array_equal(run(machine, LoadFriction("way", 0.5), q=0.3).x, run(machine, q=0.3).x)


def test_friction_of_a_drive_counts_behind_a_drive_that_gives_way_too() -> None:
    """The push goes through the spring; what is left of it moves both masses."""
    share, force, armature = 0.9, 3.0, 1.0
    machine = cart(f'armature="{armature}"')
    stiff = run(machine, LoadFriction("way", share), u=force, until=2.0)
    soft = run(machine, LoadFriction("way", share), DriveCompliance("way", 1e4, 20.0), u=force, until=2.0)
    expected = (1 - share) * force / (M + armature) * 2.0
    assert stiff.x[-1] == pytest.approx(expected, rel=0.02)
    assert soft.x[-1] == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("flag", ["frictionloss", "constraint"])
def test_friction_that_the_file_switches_off_is_not_left_out_in_silence(flag: str) -> None:
    machine = cart(flags=f'<flag {flag}="disable"/>')
    try:
        found = run(machine, CoulombFriction("way", FRICTION), v=1.0)
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
    machine = cart(flags=f'<flag {flag}="disable"/>')
    try:
        found = run(machine, effect, v=1.0)
    except EquimusError as error:
        assert flag in str(error)
    else:
        assert found.x[-1] == pytest.approx(M / 6.0 * (1 - math.exp(-3.0)), abs=2 * DT)


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
    own = realise(machine_model(cart(f'armature="{armature}"'), (DriveCompliance("way", k, 0.0),)))
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
    machine = cart('armature="0.5" damping="40"', drive=SERVO)
    rigid = run(machine, ConstantForce("way", force), u=0.1, until=8.0)
    soft = run(machine, ConstantForce("way", force), DriveCompliance("way", k, 5.0), u=0.1, until=8.0)
    assert rigid.x[-1] == pytest.approx(0.1 + force / 200, abs=1e-6)
    assert soft.x[-1] - rigid.x[-1] == pytest.approx(force / k, abs=1e-6)


def test_a_very_stiff_drive_is_rigid() -> None:
    machine = cart('armature="0.5"', drive=SERVO)
    rigid, stiff = run(machine, u=0.2), run(machine, DriveCompliance("way", 2e4, 100.0), u=0.2)
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


# --- what must not matter ---------------------------------------------------------------------------------------

RIG = Machine(
    "rig",
    f"""<mujoco><compiler angle="radian"/><option timestep="{DT}"/><worldbody><body name="arm">
    <joint name="shoulder" axis="0 1 0" damping="0.3" armature="0.05"/>
    <inertial mass="1.5" pos="0.02 0 -0.2" diaginertia="0.02 0.02 0.01"/>
    <body name="rod" pos="0 0 -0.4"><joint name="reach" type="slide" axis="0 0 -1" damping="4" armature="0.2"
      stiffness="120"/><inertial mass="0.5" pos="0 0 -0.1" diaginertia="0.002 0.002 0.001"/>
    <site name="tip" pos="0.05 0 -0.2"/></body></body></worldbody>
    <actuator><motor name="lift" joint="shoulder"/><motor name="push" joint="reach"/></actuator></mujoco>""",
)


def swinging(index: int = 0, until: float = 2.0) -> Trial:
    times = np.arange(0.0, until, 0.25)
    commands = np.column_stack([4 * np.sin(2.1 * times + index), 8 * np.cos(3.3 * times - index)])
    samples = np.arange(0.0, until + 1e-9, 0.01)
    return Trial(f"t{index}", times, commands, commands[0], 0.0, np.array([0.5, 0.02]), samples, np.array([0.3, -0.1]))


VARIED: tuple[tuple[Effect, ...], ...] = (
    (),
    (CoulombFriction("shoulder", 0.4), TransportDelay("lift", 0.05)),
    (PayloadMass("tip", 0.4), StribeckFriction("reach", 1.0, 1.0, 0.05)),
    (DriveCompliance("shoulder", 80.0, 0.2), LoadFriction("reach", 0.3), SensorDelay("reach", 0.03)),
    (DriveCompliance("reach", 900.0, 1.0), ActuatorGain("lift", 0.7)),
)


def test_results_do_not_depend_on_threads_or_on_what_is_simulated_beside() -> None:
    models = [machine_model(RIG, effects) for effects in VARIED]
    trials = [swinging(k) for k in range(3)]
    together = simulate_machines(models, trials, threads=1)
    assert all(found.sound.all() for found in together)
    for threads in (2, 5):
        for one, two in zip(together, simulate_machines(models, trials, threads=threads), strict=True):
            np.testing.assert_array_equal(one.position, two.position)
    for k, model in enumerate(models):
        for i, trial in enumerate(trials):
            alone = simulate_machines([model], [trial], threads=2)[0]
            np.testing.assert_array_equal(alone.position[0], together[i].position[k])
    backwards = simulate_machines(models[::-1], trials[::-1], threads=2)
    for one, two in zip(together, backwards[::-1], strict=True):
        np.testing.assert_array_equal(one.position, two.position[::-1])
    spread = [np.abs(found.position - found.position[:1]).max(axis=(1, 2)) for found in together]
    assert np.min([row[1:] for row in spread]) > 1e-3, "the models should differ"


HUGE = cart(mass=1e-9)
"""What pushes it makes accelerations that MuJoCo warns of."""


@pytest.mark.parametrize("threads", [1, 2])
def test_a_model_that_diverges_says_how_far_it_came(
    threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    sound, wild = machine_model(HUGE), machine_model(HUGE, (ConstantForce("way", 1e3),))
    one = trial_of(until=0.1, every=0.01)
    found, again = simulate_machines([sound, wild, sound], [one, one], threads=threads)
    assert found.reached.tolist() == [11, 1, 11] == again.reached.tolist()
    assert found.sound.tolist() == [True, False, True]
    np.testing.assert_array_equal(found.position[[0, 2]], 0.0)
    assert list(tmp_path.iterdir()) == []
    out, err = capfd.readouterr()
    assert out == "" and err == ""


def test_a_divergence_is_found_where_speeds_mean_nothing_any_more() -> None:
    """After two seconds at 500 m/s²."""
    one = trial_of(until=4.0, every=0.25)
    (found,) = simulate_machines([machine_model(cart(), (ConstantForce("way", 1e3),))], [one], threads=1)
    assert found.reached.tolist() == [8]
    np.testing.assert_allclose(found.position[0, :8, 0], 250 * one.sample_times[:8] ** 2, atol=500 * 2 * DT)


def test_warnings_of_mujoco_are_heard_again_after_a_simulation() -> None:
    heard: list[str] = []
    mujoco.set_mju_user_warning(heard.append)
    try:
        simulate_machines([machine_model(HUGE, (ConstantForce("way", 1e3),))], [trial_of()], threads=1)
        assert heard == []
        assert mujoco.get_mju_user_warning() is not None
        data = mujoco.MjData(HUGE.plan.base)
        data.qfrc_applied[0] = 1e3
        mujoco.mj_step(HUGE.plan.base, data)
        assert len(heard) > 0
    finally:
        mujoco.set_mju_user_warning(None)


def test_trials_may_have_other_numbers() -> None:
    """Each from the same model, and none with what another was given."""
    model = machine_model(RIG.with_parameters({"arm.mass": 1.8}), (CoulombFriction("shoulder", 0.1),))
    plain = swinging()
    given: list[tuple[dict[str, float], dict[str, float], dict[str, float]]] = [
        ({}, {}, {}),
        ({"arm.mass": 2.5}, {}, {"arm.mass": 2.5}),
        ({}, {"arm.mass": 1.5}, {"arm.mass": 1.8 * 1.5}),
        ({"shoulder.damping": 1.0}, {"rod.mass": 2.0, "reach.stiffness": 0.5},
         {"shoulder.damping": 1.0, "rod.mass": 1.0, "reach.stiffness": 60.0}),
        ({"shoulder.frictionloss": 0.5}, {}, {"shoulder.frictionloss": 0.5}),
        ({"tilt": 0.3}, {"gravity": 0.5}, {"tilt": 0.3, "gravity": 0.5 * 9.81}),
        ({}, {}, {}),
    ]  # fmt: skip
    trials = [replace(plain, settings=settings, factors=factors) for settings, factors, _ in given]
    for threads in (1, 2):
        together = simulate_machines([model, model], trials, threads=threads)
        for found, (_, _, values) in zip(together, given, strict=True):
            alone = simulate_machines([model.with_parameters(values)], [plain], threads=1)[0]
            np.testing.assert_allclose(found.position[0], alone.position[0], rtol=0, atol=1e-12)
            np.testing.assert_array_equal(found.position[0], found.position[1])
    spread = [np.abs(found.position[0] - together[0].position[0]).max() for found in together]
    assert min(spread[1:-1]) > 1e-3 and spread[-1] == 0.0


# --- the motion inside, and small pushes ------------------------------------------------------------------------


def test_the_motion_inside_is_what_is_simulated() -> None:
    trial = swinging()
    model = machine_model(RIG, (SensorOffset("shoulder", 0.2), FirstOrderLag("lift", 0.05)))
    start = np.concatenate([trial.position, trial.velocity])
    motion = machine_motion(model, trial, start)
    seen = simulate_machines([model], [trial], threads=1)[0].position[0]
    np.testing.assert_allclose(motion.position, seen - [0.2, 0.0], rtol=0, atol=1e-12)
    slopes = np.diff(motion.position, axis=0) / np.diff(trial.sample_times)[:, None]
    np.testing.assert_allclose(motion.between.velocity, slopes, rtol=0, atol=0.02 * np.abs(slopes).max())
    np.testing.assert_allclose(motion.between.time, trial.sample_times[:-1] + 0.005)
    steady = machine_motion(machine_model(RIG), trial, start).between.pressure
    held = trial.commands[np.searchsorted(trial.times, trial.sample_times[:-1] + 0.005) - 1]
    np.testing.assert_allclose(steady, held, rtol=0, atol=1e-9)


def test_a_motion_that_diverges_is_told() -> None:
    with pytest.raises(SimulationDiverged, match="t: the simulation of cart diverged"):
        machine_motion(machine_model(cart(), (ConstantForce("way", 1e3),)), trial_of(until=3.0), np.zeros(2))


def test_the_answer_to_a_push_of_a_free_mass_is_known() -> None:
    one = trial_of(until=1.0, every=0.01)
    push = np.ones((100, 1, 2))
    push[:, 0, 1] = np.where(np.arange(100) < 30, -2.0, 0.0)
    (found,) = pushed(machine_model(cart()), [one], [np.array([0.1, 0.5])], np.array([1.0])).response([push])
    t = one.sample_times
    np.testing.assert_allclose(found[:, 0, 0], t**2 / 2 / M, rtol=0, atol=DT / M)
    later = np.maximum(t - 0.3, 0)
    np.testing.assert_allclose(found[:, 0, 1], -2 / M * (t**2 - later**2) / 2, rtol=0, atol=2 * DT / M)


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (SensorDelay("shoulder", 0.04), SensorScale("reach", 2.0)),
        (DriveCompliance("shoulder", 80.0, 0.3), ViscousFriction("reach", 3.0)),
    ],
    ids=["plain", "sensors", "compliance"],
)
def test_the_answer_to_a_push_is_the_difference_of_two_simulations(effects: tuple[Effect, ...]) -> None:
    """Also where trials have numbers of their own; columns that push nothing answer nothing."""
    trials = [swinging(), replace(swinging(1), settings={"arm.mass": 2.5})]
    starts = [np.concatenate([t.position, t.velocity]) for t in trials]
    push = np.zeros((len(trials[0].sample_times) - 1, 2, 3))
    push[:, 0, 0], push[:, 1, 2] = 1.0, 1.0
    model = machine_model(RIG, effects)
    found = pushed(model, trials, starts, np.array([1.0, 1.0])).response([push, push])
    h = 1e-3
    for k, trial in enumerate(trials):
        for joint, column in (("shoulder", 0), ("reach", 2)):
            either = [machine_model(RIG, (*effects, ConstantForce(joint, sign * h))) for sign in (1, -1)]
            more, less = simulate_machines(either, [trial], threads=1)[0].position
            slope = (more - less) / (2 * h)
            # One side alone is off by the curvature: a thousandth of a push, on an answer of some tenths.
            np.testing.assert_allclose(found[k][:, :, column], slope, rtol=0, atol=2e-3 * np.abs(slope).max())
            assert np.abs(slope).max() > 1e-3
        np.testing.assert_array_equal(found[k][:, :, 1], 0.0)


def test_pushes_belong_to_trials() -> None:
    one = trial_of(until=0.5, every=0.1)
    with pytest.raises(ConfigError, match="torques are for 2 trials, expected 1"):
        pushed(machine_model(cart()), [one], [np.zeros(2)], np.ones(1)).response([np.ones((5, 1, 1))] * 2)


def test_what_drives_and_gravity_push_is_told() -> None:
    own = realise(machine_model(hung(), (ActuatorGain("motor", 2.0), TorqueSaturation("motor", 5.0))))
    angles = np.array([[0.0], [math.pi / 2], [-0.4]])
    drives, weights = pushes(own, angles, np.zeros((3, 1)), np.array([[1.0], [-2.0], [4.0]]))
    np.testing.assert_allclose(drives[:, 0], [2.0, -4.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(weights[:, 0], WEIGHT * np.sin(angles[:, 0]), atol=1e-9)


# --- recordings of machines -------------------------------------------------------------------------------------


def recorded(machine: Machine, *effects: Effect, until: float = 3.0) -> Recording:
    one = trial_of([(0.0, 0.0), (0.5, 1.0), (1.5, -1.0)], q=0.4, until=until, every=0.01)
    found = run(machine, *effects, trial=one)
    command = np.array([0.0 if t < 0.5 else 1.0 if t < 1.5 else -1.0 for t in one.sample_times])[:, None]
    return Recording("r", found.t, command, found.x[:, None], machine.actuator_names, machine.joint_names)


def test_a_recording_is_predicted_from_where_and_how_fast_it_begins() -> None:
    machine = hung('damping="0.1"')
    recording = recorded(machine)
    found = predict(machine_model(machine), recording)
    np.testing.assert_allclose(found, recording.position, rtol=0, atol=5e-3)
    exact = predict(machine_model(machine), recording, start=np.array([0.4, 0.0]))
    np.testing.assert_allclose(exact, recording.position, rtol=0, atol=1e-12)
    late = replace(
        recording, time=recording.time[40:], command=recording.command[40:], position=recording.position[40:]
    )
    np.testing.assert_allclose(predict(machine_model(machine), late), late.position, rtol=0, atol=0.02)


def test_a_window_of_a_late_sensor_begins_in_motion() -> None:
    """What a sensor shows at first is what was before the window, when the joint moved already."""
    machine, effect = cart(), SensorDelay("way", 0.1)
    time = np.arange(0, 2.001, 0.01)
    rolled = 0.8 * np.maximum(time - 0.1, 0.0)
    recording = Recording("r", time, np.zeros((len(time), 1)), rolled[:, None], ("motor",), ("way",))
    model = machine_model(machine, (effect,))
    segments = cut(model, [recording], window=(0.5, 2.0), shoot=0.5)
    found = machine_simulator(threads=1)([model], segments, [s.start[None, :] for s in segments])
    assert len(segments) == 3
    for segment, predicted in zip(segments, found, strict=True):
        np.testing.assert_allclose(predicted.position[0], segment.measured, rtol=0, atol=1e-9)


@pytest.mark.parametrize("start", [np.zeros(5), np.array([math.nan])], ids=["too long", "nan"])
def test_a_start_that_is_none_is_refused_in_a_sentence(start: Array) -> None:
    with pytest.raises(ConfigError, match="r: the start is "):
        predict(machine_model(hung()), recorded(hung()), start=start)


def test_whole_trials_are_compared_where_a_model_can_follow_them() -> None:
    machine = hung('damping="0.1"')
    recording = recorded(machine)
    assert window_length(machine_model(machine), [recording], None) is None
    off = machine_model(machine.with_parameters({"arm.com_z": -0.15}))
    length = window_length(off, [recording], None)
    assert length is not None and 0.5 <= length < 3.0


def test_a_model_that_diverges_in_the_shortest_windows_is_told() -> None:
    wild = machine_model(hung(), (AsymmetricDamping("pivot", -1e4),))
    with pytest.raises(SimulationDiverged, match="pendulum: the model diverges on the recorded commands"):
        window_length(wild, [recorded(hung())], None)


# --- every effect there is --------------------------------------------------------------------------------------

CASES: dict[str, dict[str, float]] = {
    "actuator_gain": {"factor": 0.6},
    "asymmetric_damping": {"difference": 0.5},
    "asymmetric_friction": {"forward": 1.5, "backward": 0.5},
    "backlash": {"play": 0.2},
    "constant_force": {"size": 1.5},
    "coulomb_friction": {"friction": 1.0},
    "drive_play": {"play": 0.3},
    "first_order_lag": {"time_constant": 0.2},
    "gravity_tilt": {"angle": 0.3},
    "joint_compliance": {"stiffness": 15.0, "damping": 0.1},
    "load_friction": {"share": 0.3},
    "parallel_spring": {"stiffness": 4.0, "rest": 0.5},
    "payload_mass": {"mass": 0.6},
    "quadratic_damping": {"drag": 0.5},
    "sensor_delay": {"delay": 0.1},
    "sensor_offset": {"offset": 0.1},
    "sensor_scale": {"scale": 1.2},
    "stribeck_friction": {"friction": 0.5, "breakaway": 1.0, "velocity": 0.5},
    "torque_saturation": {"level": 1.5},
    "transport_delay": {"delay": 0.15},
    "viscous_friction": {"damping": 0.6},
}
"""Strong numbers of each, at the shoulder."""

AT = {
    "shoulder": {"joint": "shoulder", "actuator": "lift", "foot": "tip", "link": "arm", "base": "base"},
    "reach": {"joint": "reach", "actuator": "push", "foot": "tip", "link": "rod", "base": "base"},
}


def strong(name: str, joint: str) -> Effect:
    assert name in CASES, f"{name} has no case here"
    cls = REGISTRY[name]
    return cls(AT[joint][cls.sits_at[0]], **CASES[name])


def seen(model: Model) -> Array:
    (found,) = simulate_machines([model], [swinging(until=3.0)], threads=1)
    assert found.sound.all()
    return found.position[0]


@pytest.mark.parametrize("name", sorted(catalogue("mjcf")))
def test_every_effect_is_seen(name: str) -> None:
    effect = strong(name, "shoulder")
    change = np.abs(seen(machine_model(RIG, (effect,))) - seen(machine_model(RIG)))
    assert change[:, 0].max() > 0.03


@pytest.mark.parametrize("name", sorted(n for n, c in catalogue("mjcf").items() if c.grows_from() is not None))
def test_effects_that_are_nothing_change_nothing(name: str) -> None:
    """With the first parameter at where they grow from."""
    cls = REGISTRY[name]
    first = next(iter(cls.parameter_info()))
    grown = cls.grows_from()
    assert grown is not None
    values = CASES[name] | {first: grown}
    if issubclass(cls, ForceEffect):
        values |= dict(cls.neutral)
    effect = cls(AT["shoulder"][cls.sits_at[0]], **values)
    change = np.abs(seen(machine_model(RIG, (effect,))) - seen(machine_model(RIG)))
    # A drive without play still has a spring, of a few physics steps.
    assert change.max() < (5e-3 if name == "drive_play" else 1e-10)


def finding(model: Model) -> Finding:
    (effect,), (prefix,) = model.effects, model.effect_prefixes()
    values = effect.parameters()
    estimates = {key: Estimate(v, 0.9 * v, 1.1 * v, unit_of(model, prefix + key)) for key, v in values.items()}
    part = Part(Candidate(type(effect), (effect.location,), (values,)), values)
    return Finding(part, estimates, Evidence(800.0, 25.0, -170.0, 200.0, 0.9, 0.9))


@pytest.mark.parametrize("joint", ["shoulder", "reach"])
@pytest.mark.parametrize("name", sorted(catalogue("mjcf")))
def test_every_effect_has_a_sentence_in_its_units(name: str, joint: str) -> None:
    assert name in SENTENCES
    model = machine_model(RIG, (strong(name, joint),))
    text = sentence(finding(model), model)
    assert text.endswith(".") and "_" not in text and "nan" not in text
    assert model.effects[0].location in text or name == "gravity_tilt"
    if joint == "reach" and name != "gravity_tilt":
        for wrong in ("rad", "°", "N·m", "angle", "pressure"):
            assert wrong not in text, text


# --- effects of one's own ---------------------------------------------------------------------------------------


def relaxing() -> type[ForceEffect]:
    @register
    @dataclass(frozen=True)
    class Relaxing(ForceEffect):
        """−stiffness·(x − z), dz/dt = (x − z)/time_constant."""

        name = "relaxing_spring"
        robots = ("mjcf",)
        sits_at = ("joint",)
        summary = "a spring whose rest follows"
        n_states = 1
        neutral = {"stiffness": 0.0}  # noqa: RUF012
        stiffness: float = parameter("N·m/rad", 0.0, 1e4, "of the spring")
        time_constant: float = parameter("s", 0.02, 100.0, "of its rest")

        @classmethod
        def force(cls, x, rate, z, p):  # type: ignore[no-untyped-def]
            return -p["stiffness"] * (x - z[0])

        @classmethod
        def state_rate(cls, x, rate, z, p):  # type: ignore[no-untyped-def]
            return ((x - z[0]) / p["time_constant"],)

        @classmethod
        def rest_state(cls, x, p):  # type: ignore[no-untyped-def]
            return (x,)

    return Relaxing


def test_an_effect_of_ones_own_may_have_states() -> None:
    effect = relaxing()("way", 50.0, 0.3)
    found = run(cart(), effect, v=1.0)

    def slope(t: float, x: Array) -> list[float]:
        return [x[1], -50.0 * (x[0] - x[2]) / M, (x[0] - x[2]) / 0.3]

    exact = solve_ivp(slope, (0, 1), [0.0, 1.0, 0.0], t_eval=found.t, rtol=1e-10, atol=1e-12).y[0]
    np.testing.assert_allclose(found.x, exact, rtol=0, atol=2 * DT)
    assert np.abs(exact - found.t).max() > 0.3


def test_states_begin_at_rest_where_a_trial_begins() -> None:
    """As on elastic robots."""
    found = run(cart(), relaxing()("way", 50.0, 0.3), q=0.4)
    np.testing.assert_allclose(found.x, 0.4, rtol=0, atol=1e-12)


def attached(make: Callable[[], Effect]) -> Ran | str:
    """The motion with an effect, or the sentence with which it is refused."""
    try:
        return run(cart(), make(), u=1.0)
    except EquimusError as error:
        return str(error)


def test_a_law_of_commands_of_ones_own_acts_or_is_refused() -> None:
    def make() -> Effect:
        @register
        @dataclass(frozen=True)
        class Half(ShapingEffect):
            name = "half_command"
            robots = ("mjcf",)
            summary = "a share of the command"
            order = 9
            share: float = parameter("1", 0.0, 1.0, "that is left")

            def shape(self, commands: Array, own: int) -> Array:
                return np.asarray(commands[:, own] * self.share)

        return Half("motor", 0.5)

    found = attached(make)
    assert "half_command" in found or "Half" in found if isinstance(found, str) else found.x[-1] < 0.2


def test_a_force_along_an_actuator_of_ones_own_acts_or_is_refused() -> None:
    def make() -> Effect:
        @register
        @dataclass(frozen=True)
        class MotorDrag(ForceEffect):
            name = "motor_drag"
            robots = ("mjcf",)
            sits_at = ("actuator",)
            summary = "drag in a motor"
            neutral = {"drag": 0.0}  # noqa: RUF012
            drag: float = parameter("N·s/m", 0.0, 100.0, "for each speed")

            @classmethod
            def force(cls, x, rate, z, p):  # type: ignore[no-untyped-def]
                return -p["drag"] * rate

        return MotorDrag("motor", 8.0)

    found = attached(make)
    assert "motor_drag" in found or "MotorDrag" in found if isinstance(found, str) else found.x[-1] < 0.2
