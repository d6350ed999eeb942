"""Laws at joints of MJCF robots that have states of their own: how long a recording has lasted, the way that was gone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import casadi as ca
import mujoco
import numpy as np
import pytest
from mjcf_models import RIG, refusal
from pendulum_runs import MOTOR, PENDULUM, recorded
from scipy.integrate import solve_ivp

from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.confounding import restates
from equimus_ctrl.diagnosis.coordinates import TIME, Coordinate
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.force_basis import ForceFamily
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.diagnosis.torque_screening import torque_domain
from equimus_ctrl.diagnosis.torque_start import laws_asked_for, worth_simulating
from equimus_ctrl.effects import (
    CoulombFriction,
    DahlFriction,
    Effect,
    ForceEffect,
    FrictionDrift,
    FrictionWarmup,
    Hysteresis,
    ViscousFriction,
)
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.force import force_laws
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.encoding import encode, grouped
from equimus_ctrl.engines.lane_functions import SHORT
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.mjcf_inverse import law_force, law_slopes
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

ROBOT = MjcfRobot("arm", PENDULUM.format(drive=MOTOR))
CLOCK = 7.0
"""Where the recordings' clock begins [s]."""
FINE = 1e-4


def drift(slope: float) -> Effect:
    return FrictionDrift("hinge", slope)


def warmup(size: float, time_constant: float) -> Effect:
    return FrictionWarmup("hinge", size, time_constant)


def dahl(friction: float, distance: float) -> Effect:
    return DahlFriction("hinge", friction, distance)


DRIFTING, GIVING = (drift(0.03), dahl(0.0, 1.0)), (drift(0.0), dahl(0.25, 0.05))
"""Each with the other's law doing nothing, so that one kernel has both."""
WARMING = (warmup(0.3, 1.5),)


def trial(until: float = 4.0, start: float = 0.0, inner: bool = False) -> Trial:
    time = CLOCK + np.arange(0, until, 0.01)
    torque = 1.2 * np.sin(2.0 * (time - CLOCK))[:, None] + 0.4 * np.sin(9.0 * time)[:, None]
    later = time[time >= CLOCK + start - 1e-9]
    return Trial("t", time, torque, torque[0], CLOCK + start, np.array([0.4]), later, np.zeros(1), inner=inner)


@cache
def by_hand(drifts: float, friction: float, distance: float, size: float = 0.0) -> Array:
    """(n,) angles of the same trial by MuJoCo, stepped from Python with the laws written out here."""
    model = mujoco.MjModel.from_xml_string(ROBOT.xml)
    model.opt.timestep, model.opt.integrator = FINE, mujoco.mjtIntegrator.mjINT_RK4
    data, own, z, angles = mujoco.MjData(model), trial(), 0.0, []
    data.qpos[0] = own.position[0]
    for torque in own.commands:
        angles.append(float(data.qpos[0]))
        for _ in range(round(0.01 / FINE)):
            v = float(data.qvel[0])
            z += FINE * (v - abs(v) * z) / distance
            data.ctrl[:] = torque
            cold = size * np.exp(-data.time / 1.5)
            data.qfrc_applied[0] = -(drifts * data.time + cold) * v - friction * z
            mujoco.mj_step(model, data)
    return np.array(angles)


Engine = Callable[[Model, Trial], Predicted]


def reduced(model: Model, own: Trial) -> Predicted:
    return simulate([model], [own], dt=1e-3, threads=1, check=False)[0]


def stepped(model: Model, own: Trial) -> Predicted:
    return simulate_mjcf([model], [own], dt=FINE, threads=1)[0]


# The reduced engine compiles a kernel with both laws.
ENGINES = pytest.mark.parametrize(
    "simulated", [pytest.param(reduced, marks=pytest.mark.slow), stepped], ids=["reduced", "mujoco"]
)


@ENGINES
@pytest.mark.parametrize(
    ("effects", "numbers"),
    [(DRIFTING, (0.03, 0.0, 1.0)), (GIVING, (0.0, 0.25, 0.05)), (WARMING, (0.0, 0.0, 1.0, 0.3))],
    ids=["drift", "dahl", "warmup"],
)
def test_both_engines_move_as_mujoco_stepped_by_hand(
    effects: tuple[Effect, ...], numbers: tuple[float, ...], simulated: Engine
) -> None:
    expected, plain = by_hand(*numbers), by_hand(0.0, 0.0, 1.0)
    assert np.abs(expected - plain).max() > 0.2
    found = simulated(Model(ROBOT, effects), trial())
    assert found.sound.all()
    np.testing.assert_allclose(found.position[0, :, 0], expected, rtol=0, atol=2e-3)


@ENGINES
def test_drift_counts_from_the_recordings_start_in_a_later_interval(simulated: Engine) -> None:
    """An interval goes on as the whole trial does from where that is then."""
    model = Model(ROBOT, DRIFTING)
    whole = simulated(model, trial(inner=True))
    assert whole.motion is not None
    k = 250
    at = whole.motion[0, k]
    interval = replace(trial(start=0.01 * k), position=at[:1], velocity=at[1:])
    found = simulated(model, interval).position[0]
    np.testing.assert_allclose(found, whole.position[0, k:], rtol=0, atol=2e-5)
    shorter = replace(interval, times=interval.times[k:], commands=interval.commands[k:])
    assert np.abs(simulated(model, shorter).position[0] - whole.position[0, k:]).max() > 0.02


def test_a_stiff_law_gains_no_energy_from_long_steps() -> None:
    """After the drive has stopped a light joint swings on friction that gives way, less and less."""
    body = "<worldbody><body name='arm'><joint name='hinge'/><inertial pos='0 0 0' mass='1' diaginertia='{0} {0} {0}'/>"
    drive = "</body></worldbody><actuator><motor name='motor' joint='hinge'/></actuator>"
    robot = MjcfRobot("light", f"<mujoco><option gravity='0 0 0'/>{body.format(0.01)}{drive}</mujoco>")
    time, torque = np.array([0.0, 0.2]), np.array([[1.0], [0.0]])
    own = Trial("t", time, torque, torque[0], 0.0, np.zeros(1), np.arange(0.0, 2.0, 2e-3), np.zeros(1))

    def swings(dt: float) -> float:
        (found,) = simulate_mjcf([Model(robot, (dahl(0.5, 0.01),))], [own], dt=dt, threads=1)
        return float(np.ptp(found.position[0, -250:, 0]))

    assert swings(2e-3) == pytest.approx(swings(2e-5), rel=0.3)


def test_a_model_without_such_a_law_keeps_its_kernel() -> None:
    plain, rubbing = Model(ROBOT), Model(ROBOT, (CoulombFriction("hinge", 0.1),))
    warming = Model(ROBOT, (drift(0.01),))
    groups = grouped([plain, warming, rubbing], trial())
    assert [rows for rows, _ in groups] == [[0, 2], [1]]
    laws, with_drift = (set(coded.laws) for _, coded in groups)
    assert laws == {law for law in force_laws("mjcf") if not law.n_states}
    assert with_drift - laws == {FrictionDrift}
    coded = groups[0][1]
    lanes = coded.lanes
    assert lanes.n_states == 0 and lanes.robot[SHORT]
    assert set(encode([plain, warming]).laws) == with_drift


def test_presliding_begins_as_a_motion_at_that_rate_would_have_it() -> None:
    """Nothing at rest, all of it in fast motion, of either sign."""

    def begins(rate: float) -> float:
        p = {"friction": 1.0, "distance": 0.02}
        x = np.zeros(1)
        return float(-law_force(DahlFriction, p, x, np.full(1, rate), x, np.zeros(1))[0])

    assert begins(0.0) == 0.0
    assert begins(3.0) == pytest.approx(1.0, abs=1e-5) and begins(-3.0) == pytest.approx(-1.0, abs=1e-5)
    assert 0.3 < begins(0.1) == -begins(-0.1) < 0.5


def test_along_a_measured_motion_states_follow_it() -> None:
    time = np.linspace(2.0, 8.0, 601)
    x, rate, none = np.sin(2 * time), 2 * np.cos(2 * time), np.zeros(601)
    warmer = law_force(FrictionDrift, {"slope": 0.1}, x, rate, none, time)
    np.testing.assert_allclose(warmer, -0.1 * time * rate, rtol=1e-12)
    p = {"friction": 0.5, "distance": 0.1}

    def slope(t: float, z: Array) -> Array:
        v = 2 * np.cos(2 * t)
        return np.asarray((v - abs(v) * z) / p["distance"])

    start = np.sign(rate[:1]) * (1 - np.exp(-0.1 * abs(rate[0]) / 0.1))
    z = solve_ivp(slope, (2, 8), start, t_eval=time, rtol=1e-9, atol=1e-9).y[0]
    np.testing.assert_allclose(law_force(DahlFriction, p, x, rate, none, time), -0.5 * z, rtol=0, atol=2e-3)
    slopes = law_slopes(DahlFriction, p, x, rate, none, time)
    np.testing.assert_allclose(slopes[:, 0], -z, rtol=0, atol=4e-3)


def test_legs_start_after_a_long_rest_and_nowhere_else() -> None:
    """Not all that is done with legs asks where else a law's states would start."""

    @dataclass(frozen=True)
    class Begun(Hysteresis):
        name = "begun"

        @classmethod
        def start_state(cls, x: ca.SX, rate: ca.SX, time: ca.SX, p: Mapping[str, ca.SX]) -> Sequence[ca.SX]:
            return (ca.sign(rate),)

    assert "only an MJCF robot has start_state" in refusal(Begun.check_class)


# --- in a diagnosis ---------------------------------------------------------------------------------------------


def data_of(recordings: list[Recording]) -> Data:
    model = Model(ROBOT)
    parts = split(model, recordings, shoot=1.0)
    return Data(default_free_parameters(model), parts.train, Simulator(engine_for(model), 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "numbers", "size"),
    [
        (FrictionDrift, {"slope": 0.02}, "slope"),
        (FrictionWarmup, {"size": 0.3, "time_constant": 2.0}, "size"),
        (DahlFriction, {"friction": 0.3, "distance": 0.2}, "friction"),
    ],
)
def test_a_search_begins_with_it_where_measured_torques_ask_for_it(
    law: type[ForceEffect], numbers: dict[str, float], size: str
) -> None:
    data = data_of(recorded(Model(ROBOT, (law("hinge", **numbers),)), seed=1, seconds=8.0, noise=1e-4, dt=5e-4))
    pool = candidates(Model(ROBOT), data.segments)
    domain = torque_domain(data, pool)
    assert domain is not None
    found = laws_asked_for(data, domain, pool, 3)
    assert found is not None
    part = next(part for part in found[0] if part.candidate.effect is law)
    assert part.values[size] == pytest.approx(numbers[size], rel=0.3)
    label = part.candidate.label
    assert label in {c.label for c in worth_simulating(data, domain, data.nominal_fit(), pool)}


def test_damping_over_time_that_is_left_restates_a_drift() -> None:
    def part(law: type[ForceEffect], values: dict[str, float]) -> Part:
        return Part(Candidate(law, ("hinge",), (values,)), values)

    speed = Coordinate("vel", "hinge")
    left = ForceFamily("hinge", ("hinge",), (TIME, speed), speed, (), {})
    drifts, damped = part(FrictionDrift, {"slope": 0.1}), part(ViscousFriction, {"damping": 0.1})
    assert restates(left, (drifts,), True) == "same"
    assert restates(left, (damped,), True) == "more"


def test_what_changes_with_time_is_guessed_and_drawn_by_the_time_since_a_recording_began() -> None:
    """Of shooting intervals of 1 s of recordings of 8 s."""
    segments = data_of(recorded(Model(ROBOT), seed=1, seconds=8.0, dt=5e-4)).segments
    seen = excitation_of(Model(ROBOT), segments)["hinge"]
    assert seen.duration < 1.5 and seen.lasts == pytest.approx(8.0, abs=0.1)
    (curve,) = FrictionDrift("hinge", 0.1).curves(ROBOT, seen)
    assert curve.along[-1] == seen.lasts
    largest = max(guess["slope"] for guess in FrictionDrift.guesses(seen))
    assert largest == pytest.approx(0.2 * seen.force / seen.speed / seen.lasts)


def test_a_warmup_takes_the_place_of_a_drift_and_is_drawn_as_what_has_not_faded_yet() -> None:
    assert "friction_drift" in refusal(lambda: Model(ROBOT, (drift(0.1), warmup(0.1, 1.0))))
    seen = Excitation(0.0, 1.0, 2.0, 3.0, 1.0, 0.01, 1.0, 1.0, recorded=20.0)
    assert {guess["time_constant"] for guess in FrictionWarmup.guesses(seen)} == {5.0, 20.0}
    (curve,) = FrictionWarmup("hinge", 0.4, 10.0).curves(ROBOT, seen)
    np.testing.assert_allclose(curve.values, 0.4 * np.exp(-curve.along / 10.0))
    assert curve.along[-1] == 20.0 and curve.without == 0.0


@pytest.mark.parametrize(("robot", "place", "unit"), [(RIG, "shoulder", "N·m·s/rad"), (RIG, "reach", "N·s/m")])
def test_a_drift_is_drawn_as_the_change_of_friction_over_a_trial(robot: MjcfRobot, place: str, unit: str) -> None:
    seen = Excitation(0.0, 1.0, 2.0, 3.0, 1.0, 0.01, 20.0, 1.0)
    (curve,) = FrictionDrift(place, -0.002).curves(robot, seen)
    assert (curve.x_unit, curve.y_unit) == ("s", unit) and curve.without == 0.0
    assert curve.along[[0, -1]] == pytest.approx([0.0, 20.0])
    np.testing.assert_allclose(curve.values, -0.002 * curve.along)
