"""Effects that push, in the compiled engine: each law at every place against integrations that share nothing with it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pytest
from effect_cases import CASES, Law
from morphologies import pendulum
from scipy.integrate import solve_ivp

from equimus_ctrl.effects import (
    REGISTRY,
    CoulombFriction,
    Effect,
    ForceEffect,
    ParallelSpring,
    StribeckFriction,
    catalogue,
    make,
)
from equimus_ctrl.effects.force import force_laws
from equimus_ctrl.engines import lane_functions
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.encoding import encode
from equimus_ctrl.engines.lane_equations import load_lanes
from equimus_ctrl.engines.lane_functions import LANES, ROW_X
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, structure
from equimus_ctrl.types import Array

LEG = nominal_leg()
FREE = replace(LEG, joints=tuple(replace(j, lower=None, upper=None) for j in LEG.joints))
"""The leg without stops, whose kinks are another test's matter."""
START = np.array([1.3, 0.9])
TIMES = np.array([0.0, 0.4, 0.9])
COMMANDS = np.array([[12e3, 2e3], [18e3, 9e3], [5e3, 4e3]])


def trial(q0: Array, until: float = 1.4, every: float = 0.01, pressure: Array | None = None) -> Trial:
    """From rest, under pressures that change on the physics' grid, or under constant ones."""
    times, commands = (TIMES, COMMANDS) if pressure is None else (np.zeros(1), np.atleast_2d(pressure))
    return Trial("t", times, commands, commands[0], 0.0, np.array(q0), np.arange(0, until + every / 2, every))


def moved(model: Model, one: Trial, dt: float = 1e-3) -> Array:
    found = simulate([model], [one], dt=dt, threads=1)[0]
    assert found.sound.all()
    return found.position[0]


def states(model: Model, q0: Array, v0: Array, pressure: Array, until: float, dt: float) -> tuple[Array, Array]:
    """(steps + 1, nj) angles and rates on the physics' grid itself, under constant pressures."""
    coded = encode([model])
    form = structure(model.morphology)
    lanes = load_lanes(form, model.phase, force_laws())
    nj, steps, w = len(q0), round(until / dt), lanes.work()
    for lane in range(LANES):
        lane_functions.prepare_lane(lanes.robot, coded.parameters[0], w, lane)
    rows = w.reshape(-1, LANES)
    rows[lanes.robot[ROW_X] :][: 2 * nj] = np.concatenate([q0, v0])[:, None]
    lane_functions.lane_start(lanes.robot, w)
    drive = np.zeros((steps, 2, len(pressure) * LANES))
    drive[:, 0] = np.repeat(pressure, LANES)
    out = np.empty((steps + 1, 2 * nj * LANES))
    lanes.kernel.run_lanes(lanes.robot, w, drive, dt, coded.rubbing, out)
    found = out.reshape(-1, 2 * nj, LANES)[:, :, 0]
    return found[:, :nj], found[:, nj:]


# --- laws that are smooth between their kinks, in plain Python --------------------------------------------------

PLAIN: dict[type[Effect], Law] = {REGISTRY[name]: case.law for name, case in CASES.items() if case.law is not None}

EFFECTS: dict[str, tuple[Effect, ...]] = {
    label: (make(name, place, numbers),)
    for name, case in CASES.items()
    for label, (place, numbers) in case.moves.items()
}
EFFECTS["all at once"] = tuple(effect for effects in EFFECTS.values() for effect in effects)


def coordinate(k: Kinematics, q: Array, effect: Effect) -> tuple[float, Array]:
    """What an effect acts along, and its gradient."""
    m = k.morphology
    if effect.location in m.joint_names:
        j = m.joint_names.index(effect.location)
        return float(q[j]), np.eye(len(q))[j]
    i = m.actuator_names.index(effect.location)
    return float(k.lengths(q)[i]), k.jacobian(q)[i]


def drive(m: Morphology, effect: Effect, pressure: Array) -> dict[str, float]:
    if effect.location not in m.actuator_names:
        return {}
    i = m.actuator_names.index(effect.location)
    return {"driven": m.actuators[i].area * float(pressure[i]), "l0": m.actuators[i].rest_length}


def exact(m: Morphology, effects: Sequence[Effect], one: Trial, phase: Phase = "swing") -> Array:
    """By an adaptive method, restarted at every command."""
    k, n = Kinematics(m, phase), len(m.joints)
    laws = [(PLAIN[type(e)], e, e.parameters()) for e in effects if isinstance(e, ForceEffect)]
    rest = [coordinate(k, one.position, e)[0] if CASES[e.name].begins_at_x else 0.0 for _, e, _ in laws]
    state = np.concatenate([one.position, np.zeros(n), rest])
    out = np.empty((len(one.sample_times), n))
    for begin, end, pressure in zip(one.times, [*one.times[1:], one.sample_times[-1]], one.commands, strict=True):

        def slope(t: float, x: Array, pressure: Array = pressure) -> Array:
            q, v, z = x[:n], x[n : 2 * n], x[2 * n :]
            torque, rates = np.zeros(n), []
            for (law, effect, p), own in zip(laws, z, strict=True):
                place, gradient = coordinate(k, q, effect)
                push, rate = law(place, float(gradient @ v), float(own), {**p, **drive(m, effect, pressure)})
                torque += push * gradient
                rates.append(rate)
            return np.concatenate([v, k.acceleration(q, v, pressure, torque), rates])

        found = solve_ivp(slope, (begin, end), state, method="DOP853", rtol=1e-9, atol=1e-11, dense_output=True)
        assert found.success
        inside = (one.sample_times >= begin - 1e-12) & (one.sample_times <= end + 1e-12)
        out[inside] = found.sol(one.sample_times[inside])[:n].T
        state = found.y[:, -1]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("name", EFFECTS)
def test_a_law_moves_the_leg_as_an_independent_integration_says(name: str) -> None:
    one = trial(START)
    expected = exact(FREE, EFFECTS[name], one)
    assert np.abs(expected - plain_motion()).max() > 5e-3
    # Bouc–Wen has a kink wherever the actuator turns, which a step of order four does not see.
    rough = "hysteresis" in name or name == "all at once"
    np.testing.assert_allclose(moved(Model(FREE, EFFECTS[name]), one), expected, rtol=0, atol=2e-6 if rough else 5e-8)


@lru_cache(maxsize=1)
def plain_motion() -> Array:
    return exact(FREE, (), trial(START))


def test_the_laws_hold_in_stance_too() -> None:
    effects = [*EFFECTS["spring at the knee"], *EFFECTS["stiffening"], *EFFECTS["creep of baa"]]
    one = trial(START, until=0.4, pressure=np.array([5e3, 2e3]))
    expected = exact(FREE, effects, one, "stance")
    found = moved(Model(FREE, tuple(effects), "stance"), one)
    assert np.ptp(expected, axis=0).min() > 0.01
    assert np.abs(found - moved(Model(FREE, phase="stance"), one)).max() > 0.01
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-8)


def test_every_law_is_tried_here() -> None:
    tried = {type(e) for effects in EFFECTS.values() for e in effects} | {CoulombFriction, StribeckFriction}
    laws = {cls for cls in catalogue("elastic").values() if issubclass(cls, ForceEffect)}
    assert {cls for cls in laws if cls.__module__.startswith("equimus_ctrl.")} <= tried


@pytest.mark.parametrize("name", ["spring at the knee", "softening", "narrowing maa", "creep of baa"])
def test_smooth_laws_are_followed_with_order_four(name: str) -> None:
    one = trial(START, until=0.384, every=0.032, pressure=np.array([15e3, 5e3]))
    model = Model(FREE, EFFECTS[name])
    fine = moved(model, one, 1e-4)
    errors = [np.abs(moved(model, one, dt) - fine).max() for dt in (4e-3, 2e-3, 1e-3)]
    assert 12 < errors[0] / errors[1] < 20 and 12 < errors[1] / errors[2] < 20


# --- doing nothing ----------------------------------------------------------------------------------------------


def idle_everywhere() -> tuple[Effect, ...]:
    """Every law at every place, with numbers that switch it off; of those that exclude each other, the first."""
    found: dict[tuple[str, str], Effect] = {}
    names = {"joint": LEG.joint_names, "actuator": LEG.actuator_names}
    for cls in (CoulombFriction, StribeckFriction, *PLAIN):
        for kind in cls.sits_at:
            for place in names[kind]:
                middle = {k: 0.5 * (i["low"] + i["high"]) for k, i in cls.parameter_info().items()}
                effect = cls(place, **{**middle, **cls.neutral})
                found.setdefault((str(cls.exclusive), place), effect)
    return tuple(found.values())


def test_laws_that_are_switched_off_change_no_bit() -> None:
    one = trial(START)
    np.testing.assert_array_equal(moved(Model(LEG, idle_everywhere()), one), moved(Model(LEG), one))
    off = (StribeckFriction("hip", 0.0, 0.0, 0.1), StribeckFriction("knee", 0.0, 0.0, 3.0))
    np.testing.assert_array_equal(moved(Model(LEG, off), one), moved(Model(LEG), one))


def test_what_has_crept_and_yielded_for_long_is_at_rest() -> None:
    """A trial starts after a long rest: the states are those in which their forces have died away."""
    pressure = np.array([12e3, 4e3])
    rest = Kinematics(LEG).equilibrium(pressure)
    effects = [*EFFECTS["creep of maa"], *EFFECTS["creep of baa"], *EFFECTS["hysteresis of maa"]]
    found = moved(Model(LEG, tuple(effects)), trial(rest, until=3.0, pressure=pressure))
    np.testing.assert_allclose(found, np.tile(rest, (len(found), 1)), rtol=0, atol=1e-9)


def test_creep_lets_go_of_the_load_in_the_end() -> None:
    """After five seconds of a spring that relaxes in a third of one, the leg stands where it would without."""
    pressure = np.array([12e3, 4e3])
    one = trial(Kinematics(LEG).equilibrium([0.0, 0.0]), until=8.0, pressure=pressure)
    found = moved(Model(LEG, EFFECTS["creep of maa"]), one)
    np.testing.assert_allclose(found[-1], Kinematics(LEG).equilibrium(pressure), atol=1e-6)
    assert np.abs(found - moved(Model(LEG), one)).max() > 0.01


# --- dry friction: an oscillator whose motion is known in closed form -------------------------------------------

ROD = replace(pendulum(), gravity=0.0)
"""Nothing acts on it but what is attached."""
INERTIA = ROD.links[0].inertia + ROD.links[0].mass * ROD.links[0].com ** 2
STIFFNESS, FRICTION = 3.0, 0.25
OMEGA = math.sqrt(STIFFNESS / INERTIA)
OSCILLATOR = Model(ROD, (ParallelSpring("pivot", STIFFNESS, 0.3), CoulombFriction("pivot", FRICTION)))


def sliding(q0: float, t: Array, rest: float = 0.3) -> Array:
    """From rest at q0: half waves about a centre that lies friction/stiffness off, until one ends within reach."""
    reach, half = FRICTION / STIFFNESS, math.pi / OMEGA
    out = np.empty(len(t))
    at, k = q0 - rest, np.floor(t / half).astype(int)
    for n in range(int(k.max()) + 1):
        side = math.copysign(1.0, at) if abs(at) > reach else 0.0
        inside = k == n
        centre = side * reach
        out[inside] = rest + (centre + (at - centre) * np.cos(OMEGA * (t[inside] - n * half)) if side else at)
        at = 2 * centre - at if side else at
    return out


def oscillation(dt: float, q0: float = 1.4, until: float = 4.0) -> float:
    """The greatest error of the oscillator's angles on the physics' grid."""
    q, _ = states(OSCILLATOR, np.array([q0]), np.zeros(1), np.zeros(1), until, dt)
    return float(np.abs(q[:, 0] - sliding(q0, np.arange(len(q)) * dt)).max())


def test_an_oscillator_with_dry_friction_loses_the_same_at_every_turn_and_stops() -> None:
    t = np.linspace(0, 4, 401)
    known = sliding(1.4, t)
    assert np.ptp(known[-60:]) == 0.0 and abs(known[-1] - 0.3) > 0.01, "it should come to stand beside its rest"
    turns = np.flatnonzero(np.diff(np.sign(np.diff(known)))).size
    assert turns >= 6
    found = moved(OSCILLATOR, trial(np.array([1.4]), until=4.0, pressure=np.zeros(1)))[:, 0]
    np.testing.assert_allclose(found, known, rtol=0, atol=1e-6)
    assert np.ptp(found[-60:]) < 1e-9


def test_while_it_slides_friction_is_exact() -> None:
    """The first half wave, before any turn: the error is the method's of order four, not the friction's."""
    half = 0.95 * math.pi / OMEGA
    coarse, fine = oscillation(4e-3, until=half), oscillation(2e-3, until=half)
    assert fine < 1e-6
    # The first step alone starts without knowing its friction.
    assert coarse / fine > 3.5


def test_turns_cost_no_more_than_the_step_squared() -> None:
    """Were friction the same for a whole step, each turn within it would cost in proportion to the step."""
    errors = [max(oscillation(dt, q0) for q0 in (1.4, 1.33, 1.21, 1.17)) for dt in (8e-3, 4e-3, 2e-3, 1e-3)]
    assert errors[-1] < 1e-7
    assert all(coarse / fine > 3.5 for coarse, fine in itertools.pairwise(errors))


@pytest.mark.parametrize("offset", [-0.083, -0.03, 0.0, 0.05, 0.083])
def test_within_reach_of_its_friction_it_stays_for_good(offset: float) -> None:
    """Ten seconds: a friction smoothed over would creep."""
    q, v = states(OSCILLATOR, np.array([0.3 + offset]), np.zeros(1), np.zeros(1), 10.0, 1e-3)
    assert np.abs(q - q[0]).max() < 1e-10 and np.abs(v).max() < 1e-9
    assert np.ptp(q[5:]) < 1e-13


def test_just_out_of_reach_it_moves() -> None:
    for side in (-1, 1):
        q, _ = states(OSCILLATOR, np.array([0.3 + side * 0.0837]), np.zeros(1), np.zeros(1), 0.5, 1e-3)
        assert side * (q[-1, 0] - q[0, 0]) < -1e-4


# --- breaking away ----------------------------------------------------------------------------------------------


def force_of(share: float, friction: float) -> Array:
    """The pressure whose force along the drive is a share of the friction."""
    return np.array([share * friction / ROD.actuators[0].area])


@pytest.mark.parametrize("q0", [1.2, -0.7])
@pytest.mark.parametrize("at_drive", [True, False])
def test_it_breaks_away_where_the_push_exceeds_the_friction(q0: float, at_drive: bool) -> None:
    lever = float(Kinematics(ROD).jacobian([q0])[0, 0])
    friction = 2.0 if at_drive else 2.0 * abs(lever)
    model = Model(ROD, (CoulombFriction("drive" if at_drive else "pivot", friction),))
    for share in (0.5, 0.999):
        q, v = states(model, np.array([q0]), np.zeros(1), force_of(share, 2.0), 10.0, 1e-3)
        assert np.abs(q - q0).max() < 1e-9 and np.abs(v).max() < 1e-9
    q, _ = states(model, np.array([q0]), np.zeros(1), force_of(1.01, 2.0), 0.5, 1e-3)
    assert (q[-1, 0] - q0) * lever > 1e-4


def test_frictions_at_one_joint_and_its_drive_add_up() -> None:
    q0 = 1.2
    lever = abs(float(Kinematics(ROD).jacobian([q0])[0, 0]))
    model = Model(ROD, (CoulombFriction("drive", 1.2), CoulombFriction("pivot", 0.8 * lever)))
    q, _ = states(model, np.array([q0]), np.zeros(1), force_of(0.999, 2.0), 10.0, 1e-3)
    assert np.abs(q - q0).max() < 1e-9
    q, _ = states(model, np.array([q0]), np.zeros(1), force_of(1.01, 2.0), 0.5, 1e-3)
    assert abs(q[-1, 0] - q0) > 1e-4


def test_stribeck_holds_with_all_of_it_and_slides_with_less() -> None:
    q0, sliding_friction, breakaway = 1.2, 0.05, 0.1
    lever = abs(float(Kinematics(ROD).jacobian([q0])[0, 0]))
    model = Model(ROD, (StribeckFriction("pivot", sliding_friction, breakaway, 0.1),))
    for share in (0.4, 0.999):
        q, _ = states(model, np.array([q0]), np.zeros(1), force_of(share, 0.15 / lever), 5.0, 1e-3)
        assert np.abs(q - q0).max() < 1e-9
    q, v = states(model, np.array([q0]), np.zeros(1), force_of(1.01, 0.15 / lever), 1.0, 1e-4)
    # Once fast, what is left acts: the push less the sliding friction.
    k = Kinematics(ROD)
    push = k.jacobian(q[-1])[0, 0] * force_of(1.01, 0.15 / lever)[0] * ROD.actuators[0].area
    expected = (push - math.copysign(sliding_friction + breakaway / (1 + (v[-1, 0] / 0.1) ** 2), v[-1, 0])) / INERTIA
    assert abs(v[-1, 0]) > 0.5
    assert (v[-1, 0] - v[-21, 0]) / 2e-3 == pytest.approx(expected, rel=0.02)


def test_stribeck_slides_with_the_friction_of_its_mean_speed() -> None:
    """Slowing down from 3 to about 0.5 rad/s: an error of the step squared, as of a midpoint rule."""
    model = Model(ROD, (StribeckFriction("pivot", 0.05, 0.38, 1.0),))

    def slope(t: float, x: Array) -> Array:
        return np.array([x[1], -(0.05 + 0.38 / (1 + x[1] ** 2)) / INERTIA])

    exact = solve_ivp(slope, (0, 0.8), [0.5, 3.0], method="DOP853", rtol=1e-12, atol=1e-12, dense_output=True).sol
    assert 0.2 < exact(0.8)[1] < 0.8
    errors = []
    for dt in (4e-3, 2e-3, 1e-3):
        q, v = states(model, np.array([0.5]), np.array([3.0]), np.zeros(1), 0.8, dt)
        known = exact(np.arange(len(q)) * dt)
        errors.append(max(np.abs(q[:, 0] - known[0]).max(), np.abs(v[:, 0] - known[1]).max()))
    assert errors[-1] < 2e-5
    assert all(coarse / fine > 3.5 for coarse, fine in itertools.pairwise(errors))


def test_a_drive_without_lever_arm_neither_moves_nor_rubs() -> None:
    """At its dead point the drive's length does not change with the angle: its friction acts on nothing."""
    effects = (CoulombFriction("drive", 1.0), CoulombFriction("pivot", 0.1))
    q, v = states(Model(ROD, effects), np.zeros(1), np.zeros(1), np.array([1e4]), 1.0, 1e-3)
    np.testing.assert_array_equal(q, 0.0)
    np.testing.assert_array_equal(v, 0.0)


# --- dry friction on the leg ------------------------------------------------------------------------------------

RUBBING: dict[str, tuple[Effect, ...]] = {
    "hip": (CoulombFriction("hip", 0.3),),
    "knee": (CoulombFriction("knee", 0.05),),
    "maa": (CoulombFriction("maa", 2.0),),
    "baa": (CoulombFriction("baa", 1.5),),
    "both joints": (CoulombFriction("hip", 0.3), CoulombFriction("knee", 0.05)),
    "hip and its drive": (CoulombFriction("hip", 0.15), CoulombFriction("maa", 1.0)),
    "knee and both drives": (CoulombFriction("knee", 0.03), CoulombFriction("maa", 1.0), CoulombFriction("baa", 0.8)),
    "stribeck": (StribeckFriction("hip", 0.1, 0.2, 0.3), StribeckFriction("knee", 0.02, 0.03, 0.5)),
}


@dataclass(frozen=True)
class Smoothed:
    """Friction as a steep function of the rate, which an implicit method can follow.

    Attributes:
        effects: the dry frictions.
        kinematics: of the leg.
        width: rate over which the sign is smoothed [rad/s or m/s]; what should stick creeps by about that.
    """

    effects: tuple[Effect, ...]
    kinematics: Kinematics
    width: float

    def torque(self, q: Array, v: Array) -> Array:
        torque = np.zeros(len(q))
        for effect in self.effects:
            _, gradient = coordinate(self.kinematics, q, effect)
            rate = float(gradient @ v)
            p = effect.parameters()
            size = p["friction"]
            if isinstance(effect, StribeckFriction):
                size += p["breakaway"] / (1 + (rate / p["velocity"]) ** 2)
            torque -= size * math.tanh(rate / self.width) * gradient
        return torque


def smoothed(name: str, width: float) -> Array:
    k = Kinematics(FREE)
    law, one = Smoothed(RUBBING[name], k, width), trial(START)
    state, out = np.concatenate([START, [0.0, 0.0]]), []
    for begin, end, pressure in zip(TIMES, [*TIMES[1:], one.sample_times[-1]], COMMANDS, strict=True):

        def slope(t: float, x: Array, pressure: Array = pressure) -> Array:
            return np.concatenate([x[2:], k.acceleration(x[:2], x[2:], pressure, law.torque(x[:2], x[2:]))])

        inside = one.sample_times[(one.sample_times >= begin - 1e-12) & (one.sample_times < end - 1e-12)]
        found = solve_ivp(
            slope, (begin, end), state, method="LSODA", rtol=1e-8, atol=1e-10, max_step=0.02, dense_output=True
        )
        assert found.success
        out.append(found.sol(inside)[:2].T)
        state = found.y[:, -1]
    return np.vstack([*out, state[:2]])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["knee", "maa", "knee and both drives", "stribeck"])
def test_a_leg_that_rubs_moves_as_in_the_limit_of_steep_smooth_friction(name: str) -> None:
    """The creep of what should stick is proportional to the smoothing's width, so two widths give the limit."""
    expected = 2 * smoothed(name, 2.5e-5) - smoothed(name, 5e-5)
    assert np.abs(expected - plain_motion()).max() > 0.01
    for dt, tolerance in ((1e-3, 6e-5), (2.5e-4, 2.5e-5)):
        found = moved(Model(FREE, RUBBING[name]), trial(START), dt)
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


def test_a_leg_held_by_friction_everywhere_does_not_drift() -> None:
    """Four rows of friction on two degrees of freedom, for ten seconds, under a load that no balance would hold."""
    effects = tuple(
        CoulombFriction(place, 3.0 if place in LEG.joint_names else 20.0)
        for place in (*LEG.joint_names, *LEG.actuator_names)
    )
    q, v = states(Model(LEG, effects), START, np.zeros(2), np.array([2e4, 1e4]), 10.0, 1e-3)
    assert np.abs(v).max() < 1e-8
    assert np.abs(q - START).max() < 3e-6  # what the first step moves before it knows its friction
    assert np.abs(q[-1] - q[100]).max() < 1e-9


@pytest.mark.parametrize("name", RUBBING)
def test_energy_never_grows(name: str) -> None:
    m = FREE.with_parameters({"hip.damping": 0.0, "knee.damping": 0.0, "maa.damping": 0.0, "baa.damping": 0.0})
    k = Kinematics(m)
    q, v = states(Model(m, RUBBING[name]), START, np.array([2.0, -3.0]), np.zeros(2), 2.0, 1e-3)
    energy = np.array([sum(k.energy(a, b)) for a, b in zip(q, v, strict=True)])
    assert energy[0] - energy[-1] > 0.015
    assert np.diff(energy).max() < 1e-6


def test_a_law_that_is_a_sum_of_others_pushes_and_rubs_as_they_do_together() -> None:
    sums = []
    for law in REGISTRY.values():
        values = {key: 0.2 + 0.3 * k for k, key in enumerate(law.parameter_info())}
        if not (parts := law.as_sum(values)):
            continue
        sums.append(law.name)
        laws = [(REGISTRY[name], own) for name, own in parts.items()]
        pushes, rubs = ((lambda own, p: own.force(0.3, 0.7, (), p)), (lambda own, p: own.dry_friction(0.3, 0.7, p)))
        for does in (pushes, rubs):
            assert float(does(law, values)) == pytest.approx(sum(float(does(own, p)) for own, p in laws))
    assert "asymmetric_friction" in sums
