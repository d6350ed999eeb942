"""The tuner's closed loop with every effect there is: the same as a plant in MuJoCo and the controller users have."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from test_catalogue import CASES, LEG, PID, START, effect_of

import equimus_ctrl as eq
from equimus_ctrl.effects import (
    Cutoff,
    DeadZone,
    Effect,
    ForceEffect,
    Saturation,
    SensorDelay,
    ShapingEffect,
    SupplyCoupling,
    make,
    parameter,
    register,
)
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.effects.sensors import recall, sample
from equimus_ctrl.effects.shaping import shape_command
from equimus_ctrl.effects.valves import shaped_commands, shaping_laws
from equimus_ctrl.loop import run
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.tuning.autotune import cross_check
from equimus_ctrl.tuning.closed_loop import Loop, track
from equimus_ctrl.tuning.ensemble import Member, make_ensemble
from equimus_ctrl.tuning.objective import Problem, Task
from equimus_ctrl.tuning.study import EnsembleSettings, Limits, Weights
from equimus_ctrl.types import Array

DT = 1 / 120
PLAIN = EnsembleSettings(members=1, delay=(0.0, 0.0), lag=(0.0, 0.0))
"""One leg, the model itself, behind no other valves than its own."""
COMMAND = np.array([12e3, 4e3])
TARGET = np.array([1.5, 0.3])
JOINT = eq.PidSettings({"hip": eq.PidGains(2.0, 3.0, 0.1), "knee": eq.PidGains(1.5, 1.0, 0.08)}, "joint")
BRISK = eq.PidSettings({"maa": eq.PidGains(500.0, 300.0, 15.0), "baa": eq.PidGains(150.0, 120.0, 8.0)})

SMOOTH = 2e-5
"""Largest difference between the engines [rad]."""
KINKED = dict.fromkeys(("coulomb_friction", "stribeck_friction", "hysteresis"), 6e-5)
"""The same where the law has kinks, which no engine's fixed step resolves."""


def course(n: int, noise: float = 0.0, start: Array | None = START) -> Task:
    disturbed = np.random.default_rng(1).normal(0.0, noise, (n, 2)) if noise else np.zeros((n, 2))
    return Task("hold", 1.0, np.tile(TARGET, (n, 1)), COMMAND, start, True, disturbed, DT)


def problem_of(effects: tuple[Effect, ...], task: Task, phase: Phase = "swing", inverse: bool = False) -> Problem:
    model = eq.Model(LEG, effects, phase)
    return Problem(model, make_ensemble(model, PLAIN, 1, 0), [task], Weights(), Limits(), inverse=inverse)


class Watched:
    """A plant whose true angles are kept."""

    def __init__(self, plant: eq.MujocoPlant) -> None:
        self.plant, self.spec, self.close = plant, plant.spec, plant.close
        self.position: list[Array] = []

    def reset(self, *args: Any) -> Any:
        seen = self.plant.reset(*args)
        self.position.append(self.plant.position)
        return seen

    def step(self, command: Any) -> Any:
        seen = self.plant.step(command)
        self.position.append(self.plant.position)
        return seen


def in_mujoco(
    effects: tuple[Effect, ...], settings: eq.PidSettings, n: int, phase: Phase = "swing", start: Array | None = START
) -> tuple[Array, Array]:
    """(n, 2) true angles and (n, 2) commands of the loop that users have."""
    plant = Watched(eq.MujocoPlant(eq.Model(LEG, effects, phase)))
    begin = eq.Start(position=start, command=COMMAND)
    done = run(plant, eq.PidController(settings), eq.HoldReference(TARGET), n * DT, start=begin)
    return np.array(plant.position[:n]), done.command


def agree(
    effects: tuple[Effect, ...],
    settings: eq.PidSettings = PID,
    n: int = 150,
    phase: Phase = "swing",
    start: Array | None = START,
    tolerance: float = SMOOTH,
) -> Array:
    """(n, 2) angles, once it is known that the plant's are the same."""
    q, u, done = problem_of(effects, course(n, start=start), phase, settings.inverse).simulate(settings, 0, 0)
    expected, command = in_mujoco(effects, settings, n, phase, start)
    assert done == n
    np.testing.assert_allclose(q, expected, rtol=0, atol=tolerance)
    np.testing.assert_allclose(u, command, rtol=0, atol=3e5 * tolerance)
    return q


@lru_cache(maxsize=4)
def without(settings: eq.PidSettings | None = None, phase: Phase = "swing", n: int = 150) -> Array:
    return agree((), settings or PID, n, phase)


# What it simulates.


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_an_effect_is_in_the_loop_and_known_to_a_controller_that_is_told(name: str, kind: str) -> None:
    tolerance = KINKED.get(name, SMOOTH)
    q = agree((effect_of(name, kind),), tolerance=tolerance)
    assert np.abs(q - without()).max() > 10 * tolerance
    tolerance *= 4  # it moves more briskly
    informed = agree((effect_of(name, kind),), replace(PID, inverse=True), tolerance=tolerance)
    assert np.abs(informed - q).max() > 10 * tolerance


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_on_the_ground_too(name: str, kind: str) -> None:
    agree((effect_of(name, kind, "stance"),), n=40, phase="stance", tolerance=KINKED.get(name, SMOOTH))


EVERYWHERE = (
    make("transport_delay", "baa", {"delay": 0.031}),
    make("asymmetric_lag", "maa", {"fill": 0.05, "vent": 0.1}),
    make("rate_limit", "baa", {"rate": 1e5}),
    make("dead_zone", "maa", {"threshold": 500.0}),
    make("supply_coupling", "baa", {"share": 0.05}),
    make("saturation", "maa", {"level": 3e4}),
    make("cutoff", "baa", {"least": 300.0}),
    make("filling_flow", "maa", {"rate": 5e4, "power": 0.8}),
    make("coulomb_friction", "knee", {"friction": 0.02}),
    make("creep", "baa", {"stiffness": 20.0, "time_constant": 0.3}),
    make("hysteresis", "maa", {"size": 0.3, "width": 0.01}),
    make("parallel_spring", "hip", {"stiffness": 0.1, "rest": 1.0}),
    make("payload_mass", "foot", {"mass": 0.02}),
    make("gravity_tilt", "base", {"angle": 0.03}),
    make("backlash", "knee", {"play": 0.01}),
    make("sensor_delay", "knee", {"delay": 0.021}),
    make("sensor_delay", "hip", {"delay": 0.05}),
    make("sensor_offset", "hip", {"offset": 0.02}),
    make("sensor_scale", "knee", {"scale": 0.97}),
)


@pytest.mark.parametrize("settings", [PID, BRISK, JOINT], ids=["gentle", "brisk", "joint"])
@pytest.mark.parametrize("start", [START, None], ids=["from a pose", "from rest"])
def test_all_at_once(settings: eq.PidSettings, start: Array | None) -> None:
    agree(EVERYWHERE, settings, n=240, start=start, tolerance=1e-4)


@pytest.mark.parametrize("inverse", [False, True])
def test_the_tuner_s_own_cross_check_sees_the_same(inverse: bool) -> None:
    problem = problem_of(EVERYWHERE, course(200, noise=1e-3), inverse=inverse)
    settings = replace(PID, inverse=inverse)
    check = cross_check(problem, settings, 0)
    assert check.difference < 1e-4
    q, _, _ = problem.simulate(settings, 0, 0)
    np.testing.assert_allclose(check.rmse, np.sqrt(((q - problem.wanted(0)) ** 2).mean(axis=0)), rtol=1e-3)


# A user's own effects.


@dataclass(frozen=True)
class Drag(ForceEffect):
    name = "cubic_drag"
    sits_at = ("joint", "actuator")
    summary = "drag"
    neutral = {"size": 0.0, "grip": 0.0}  # noqa: RUF012
    size: float = parameter("N·m·s³/rad³", 0.0, 100.0, "drag")
    grip: float = parameter("N·m", 0.0, 100.0, "dry friction")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Any, p: Any) -> ca.SX:
        return -p["size"] * rate**3

    @classmethod
    def dry_friction(cls, x: ca.SX, speed: ca.SX, p: Any) -> ca.SX:
        return p["grip"]


@dataclass(frozen=True)
class Leak(ShapingEffect):
    name, summary, order, sits_at = "leak", "a share of the pressure is lost", 3, ("actuator",)
    share: float = parameter("1", 0.0, 1.0, "that is lost")

    def shape(self, commands: Array, own: int) -> Array:
        return np.asarray((1 - self.share) * commands[:, own])


@dataclass(frozen=True)
class Tamed(DeadZone):
    """Shaping effects may be refined, too."""

    name, exclusive = "tamed", None

    def shape(self, commands: Array, own: int) -> Array:
        return np.asarray(0.5 * commands[:, own] + 0.5 * super().shape(commands, own))


@pytest.mark.parametrize(
    "effects",
    [
        pytest.param((Drag("knee", size=0.02, grip=0.01), Drag("baa", size=50.0, grip=0.0)), marks=pytest.mark.slow),
        (Leak("baa", share=0.3),),
        (Leak("maa", share=0.1), Saturation("maa", level=9e3), SupplyCoupling("baa", share=0.1)),
        (Tamed("maa", threshold=2e3),),
    ],
    ids=["pushing", "shaping", "shaping with others", "refined"],
)
def test_a_user_s_own_effects(effects: tuple[Effect, ...]) -> None:
    for effect in effects:
        if not type(effect).__module__.startswith("equimus_ctrl.") and type(effect).name not in REGISTRY:
            register(type(effect))
    q = agree(effects, tolerance=1e-4 if isinstance(effects[0], Drag) else SMOOTH)
    assert np.abs(q - without()).max() > 5e-3


# Side by side.


def alone_and_together(problem: Problem, task: Task, loops: list[Loop]) -> None:
    nominal, phase = problem.model.morphology, problem.model.phase
    together = track(nominal, phase, task, loops, 4)
    assert len(together) == len(loops)
    for loop, found in zip(loops, together, strict=True):
        (alone,) = track(nominal, phase, task, [loop], 4)
        assert alone.sound == found.sound
        n = alone.sound if alone.sound < len(task.reference) else None
        np.testing.assert_array_equal(alone.position[:n], found.position[:n])
        np.testing.assert_array_equal(alone.command[:n], found.command[:n])


def members(effects: tuple[Effect, ...], count: int) -> list[Member]:
    return make_ensemble(eq.Model(LEG, effects), EnsembleSettings(members=count), count, 4)


@pytest.mark.parametrize("effects", [(), EVERYWHERE], ids=["plain", "all effects"])
def test_a_loop_is_to_the_bit_what_it_is_alone(effects: tuple[Effect, ...]) -> None:
    """Whatever runs beside it: other legs, other gains, other spaces, and one that diverges."""
    task = course(60, noise=1e-3)
    wild = eq.PidSettings({"maa": eq.PidGains(9e5, 9e5, 9e4), "baa": eq.PidGains(9e5, 9e5, 9e4)})
    light = LEG.with_parameters({"thigh.mass": 1e-9, "thigh.inertia": 0.0, "maa.stiffness": 1e7})
    legs = members(effects, 6)
    loops = [Loop(PID, leg, START + 0.01 * k) for k, leg in enumerate(legs)]
    loops += [Loop(BRISK, leg, START) for leg in legs[:5]] + [Loop(JOINT, legs[0], START), Loop(wild, legs[1], START)]
    broken = replace(legs[2], morphology=light, parameters=np.array(eq.robots.elastic.morphology.pack(light)))
    loops.insert(3, Loop(PID, broken, START))
    problem = Problem(eq.Model(LEG, effects), legs, [task], Weights(), Limits())
    assert track(LEG, "swing", task, loops, 4)[3].sound < 60
    alone_and_together(problem, task, loops)


def test_where_all_diverge_it_ends() -> None:
    light = LEG.with_parameters({"thigh.mass": 1e-9, "thigh.inertia": 0.0, "maa.stiffness": 1e7})
    broken = replace(members((), 1)[0], parameters=np.array(eq.robots.elastic.morphology.pack(light)))
    for found in track(LEG, "swing", course(200), [Loop(PID, broken, START)] * 3, 4):
        assert found.sound < 10


# Its parts.


def test_shaping_compiled_is_shaping_in_python() -> None:
    rng, names = np.random.default_rng(3), ("maa", "baa")
    sets: list[tuple[Effect, ...]] = [
        (),
        (DeadZone("baa", threshold=4e3),),
        (SupplyCoupling("maa", share=0.4), SupplyCoupling("baa", share=0.2)),
        (
            Cutoff("baa", least=8e3),
            Saturation("baa", level=2e4),
            SupplyCoupling("maa", share=0.4),
            DeadZone("baa", threshold=1e3),
            SupplyCoupling("baa", share=0.3),
            DeadZone("maa", threshold=2e3),
            make("transport_delay", "maa", {"delay": 0.1}),
        ),
    ]
    for effects in sets:
        laws, out = shaping_laws(effects, names), np.empty(2)
        assert laws is not None
        for command in rng.uniform(0, 5e4, (50, 2)):
            shape_command(laws, command, out)
            np.testing.assert_array_equal(out, shaped_commands(effects, names, command[None])[0])
    assert shaping_laws((Leak("maa", share=0.1), DeadZone("baa", threshold=1e3)), names) is None
    assert shaping_laws((Tamed("maa", threshold=1e3),), names) is None


@pytest.mark.parametrize("late", [0.0, 0.4, 1.0, 3.7, 6.0])
def test_a_ring_remembers_what_a_whole_motion_tells(late: float) -> None:
    rng, dt, n = np.random.default_rng(2), 0.01, 40
    q, v = rng.normal(size=n), rng.normal(size=n)
    times, seen = dt * np.arange(n), np.empty(n)
    sample(q, v, 0.0, dt, np.array([0.0, 1.0, late * dt, 0.0]), times, seen)
    ring = np.zeros((int(np.ceil(late)) + 3, 2))
    for k in range(n):
        ring[k % len(ring)] = q[k], v[k]
        assert recall(ring, k, late, dt) == pytest.approx(seen[k], abs=1e-9)


# How it is judged.


def test_a_controller_that_knows_the_sensors_is_judged_by_true_angles() -> None:
    effects = (make("sensor_offset", "knee", {"offset": 0.05}), make("sensor_scale", "hip", {"scale": 0.9}))
    known = problem_of(effects, course(1440), inverse=True)
    np.testing.assert_array_equal(known.wanted(0), course(1440).reference)
    np.testing.assert_allclose(known.seen(0)[0], TARGET * [0.9, 1.0] + [0.0, 0.05])
    np.testing.assert_array_equal(known.poses()[0], known.seen(0)[0])
    settings = replace(BRISK, inverse=True)
    q, _, _ = known.simulate(settings, 0, 0)
    np.testing.assert_allclose(q[-1], TARGET, atol=5e-3)
    assert known.outcome(settings, 0, 0).terms[3] < 5e-3


def test_a_sensor_s_error_is_no_fault_of_the_gains() -> None:
    """What no gains can undo is not held against them, and lateness is."""
    offset = problem_of((make("sensor_offset", "knee", {"offset": 0.05}),), course(1440))
    np.testing.assert_allclose(offset.wanted(0)[0], TARGET - [0.0, 0.05])
    q, _, _ = offset.simulate(BRISK, 0, 0)
    assert offset.outcome(BRISK, 0, 0).terms[3] < 5e-3 < 0.03 < np.abs(q[-1] - TARGET).max()
    scale = problem_of((make("sensor_scale", "knee", {"scale": 1.25}),), course(1440))
    np.testing.assert_allclose(scale.wanted(0)[0], TARGET / [1.0, 1.25])
    assert scale.outcome(BRISK, 0, 0).terms[3] < 5e-3
    late = problem_of((SensorDelay("knee", delay=0.1), SensorDelay("hip", delay=0.1)), course(240))
    np.testing.assert_array_equal(late.wanted(0), course(240).reference)
    assert late.outcome(BRISK, 0, 0).terms[1] > problem_of((), course(240)).outcome(BRISK, 0, 0).terms[1] + 0.03


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("settings", [PID, BRISK], ids=["pid", "brisk"])
def test_what_feedback_compares_with_is_late_in_both(settings: eq.PidSettings, inverse: bool) -> None:
    late = replace(settings, lateness=0.1, inverse=inverse)
    q = agree((), late, tolerance=4 * SMOOTH)
    assert np.abs(q - agree((), replace(late, lateness=0.0), tolerance=4 * SMOOTH)).max() > 1e-3


def test_behind_valves_as_late_as_it_thinks_an_integral_gathers_little_at_a_start() -> None:
    """Dead time and lag of 0.06 s, unknown: without, what was gathered of the way there has to be undone."""
    model = eq.Model(LEG)
    valve = np.array([[0.06, 0.06, 0.06, np.inf, np.inf, 0.0]] * 2)
    (leg,) = make_ensemble(model, PLAIN, 1, 0)
    there = np.tile(np.radians([90.0, 0.0]), (300, 1))
    task = Task("hold", 1.0, there, np.zeros(2), None, True, np.zeros((300, 2)), DT)
    problem = Problem(model, [replace(leg, valve=valve)], [task], Weights(), Limits(), inverse=True)
    gains = {"maa": eq.PidGains(565.0, 1260.0, 3.0), "baa": eq.PidGains(120.0, 680.0, 11.0)}
    plain = eq.PidSettings(gains, inverse=True)
    left = []
    for lateness in (0.0, 0.12):
        q, _, done = problem.simulate(replace(plain, lateness=lateness), 0, 0)
        assert done == 300
        left.append(np.abs(q[240:] - there[240:]).max())
    assert left[1] < np.radians(0.5) and left[1] < 0.4 * left[0]
