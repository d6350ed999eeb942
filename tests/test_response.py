"""The linear response against finite differences of the simulator itself, and the motion it is taken along."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from morphologies import random_morphology
from scipy.integrate import cumulative_simpson
from scipy.linalg import expm

from equimus_ctrl.diagnosis.linear_response import along_actuator, exponentials, linearise, response
from equimus_ctrl.effects import (
    CoulombFriction,
    Creep,
    Effect,
    FirstOrderLag,
    Hysteresis,
    JointStop,
    NonlinearStiffness,
    ParallelSpring,
    PayloadMass,
    SensorDelay,
    SensorOffset,
    SensorScale,
    StribeckFriction,
    TransportDelay,
)
from equimus_ctrl.effects.force import force_laws
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.motion import Motion, motion
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.models.augmented import slots_of
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Phase, structure
from equimus_ctrl.types import Array

LEG = nominal_leg()
HIP, KNEE = 0, 1
MAA, BAA = 0, 1
FREE = np.array([[12e3, 9e3], [18e3, 12e3], [9e3, 10e3], [15e3, 6.5e3], [22e3, 14e3]])
PRESSED = np.array([[12e3, 9e3], [20e3, 22e3], [12e3, 9e3], [5e3, 30e3], [35e3, 8e3]])
"""Pressures of which some press the knee onto its lower stop."""
STANDING = np.array([[5e3, 30e3], [8e3, 25e3]])
"""Pressures under which the leg stands for a second without touching a stop."""


def trial(levels: Array, rate: float = 120.0, until: float = 4.0, start: Array | None = None) -> Trial:
    """Levels held for 0.8 s each, sampled with jitter, from rest under the first or from ``start``."""
    steps = np.random.default_rng(0).normal(1 / rate, 0.05 / rate, int(until * rate))
    times = np.round(np.concatenate([[0.0], np.cumsum(steps)]), 4)
    held = levels[np.minimum((times / 0.8).astype(int), len(levels) - 1)]
    q0 = Kinematics(LEG).equilibrium(levels[0]) if start is None else start
    return Trial("t", times, held, levels[0], 0.0, q0, times)


def course(phase: Phase, rate: float = 120.0) -> Trial:
    """In swing as ``trial``, in stance a second's fall."""
    return trial(FREE, rate) if phase == "swing" else trial(STANDING, rate, 1.0, np.array([1.3, 0.9]))


def difference(without_parts: Model, more: Model, given: Trial, size: float) -> Array:
    """(m, nj) by how much the measured angles change for each unit between two models."""
    both = simulate([without_parts, more], [given], check=False)[0].position
    return (both[1] - both[0]) / size


def error(found: Array, wanted: Array) -> float:
    """Root mean square difference of (m, nj), as a share of the wanted one's, of the worse joint."""
    return float(np.sqrt(((found - wanted) ** 2).mean(axis=0) / (wanted**2).mean(axis=0)).max())


def at_joint(joint: int, torque: Array) -> Array:
    return torque[:, None, None] * np.eye(2)[joint][:, None]


# --- the motion ----------------------------------------------------------------------------------------------------


def test_the_motion_is_that_of_the_simulator_at_the_true_joints() -> None:
    inside = (
        FirstOrderLag("maa", 0.1),
        Creep("baa", 40.0, 0.5),
        CoulombFriction("knee", 0.01),
        PayloadMass("foot", 0.05),
    )
    sensors = (SensorScale("knee", 1.1), SensorDelay("hip", 0.03), SensorOffset("hip", 0.2))
    given = trial(FREE, until=2.0)
    followed = motion(Model(LEG, (*inside, *sensors)), given)
    assert np.array_equal(followed.time, given.sample_times)
    seen = simulate([Model(LEG, inside)], [given], check=False)[0].position[0]
    assert np.array_equal(followed.position, seen)


@pytest.mark.parametrize("phase", ["swing", "stance"])
def test_velocities_rates_and_lever_arms_belong_to_the_positions(phase: Phase) -> None:
    model = Model(LEG, (), phase)
    found = motion(model, course(phase, 1000.0))
    time, kinematics = found.time, Kinematics(LEG, phase)
    for rate, value in ((found.velocity, found.position), (found.rate, found.length)):
        way = cumulative_simpson(rate, x=time, axis=0)
        assert np.abs(value[1:] - value[0] - way).max() < 1e-4 * np.ptp(value)
    for k in (0, 300, 900):
        assert found.length[k] == pytest.approx(kinematics.lengths(found.position[k]))
        assert found.arm[k] == pytest.approx(kinematics.jacobian(found.position[k]))


def test_pressures_come_from_behind_the_valves_as_values_and_means() -> None:
    tau, late = 0.15, 0.1
    given = trial(FREE[:2], until=2.0)
    found = motion(Model(LEG, (FirstOrderLag("maa", tau), TransportDelay("baa", late))), given)
    turn = given.times[np.argmax(given.commands[:, MAA] != FREE[0, MAA])]

    def lagged(t: Array) -> Array:
        left = np.exp(-np.maximum(t - turn, 0.0) / tau)
        return FREE[1, MAA] + (FREE[0, MAA] - FREE[1, MAA]) * left

    assert found.pressure[:, MAA] == pytest.approx(lagged(found.time), rel=1e-3)
    fine = np.linspace(found.time[:-1], found.time[1:], 101)
    assert found.between.pressure[:, MAA] == pytest.approx(lagged(fine).mean(axis=0), rel=1e-3)
    share = np.clip((found.time[1:] - turn - late) / np.diff(found.time), 0.0, 1.0)
    wanted = FREE[0, BAA] + share * (FREE[1, BAA] - FREE[0, BAA])
    # A jump within a physics step is known by its mean over the step alone.
    assert np.abs(found.between.pressure[:, BAA] - wanted).max() < 0.1 * abs(FREE[1, BAA] - FREE[0, BAA])
    whole = found.between.pressure[:, BAA] @ np.diff(found.time)
    assert whole == pytest.approx(wanted @ np.diff(found.time), rel=1e-9)


def test_states_of_effects_follow_their_laws() -> None:
    stiffness, tau = 40.0, 0.3
    found = motion(Model(LEG, (Creep("baa", stiffness, tau),)), trial(FREE, rate=500.0, until=2.0))
    slots = slots_of(structure(LEG), force_laws())
    states = [(s.law.name, s.kind, s.index) for s in slots for _ in range(s.law.n_states)]
    z = found.state[:, states.index(("creep", "actuator", BAA))]
    way = cumulative_simpson((found.length[:, BAA] - z) / tau, x=found.time)
    assert z[0] == pytest.approx(found.length[0, BAA])
    assert np.abs(z[1:] - z[0] - way).max() < 1e-4 * np.ptp(z)


def test_what_is_no_motion_is_refused() -> None:
    given = trial(FREE, until=1.0)
    with pytest.raises(ConfigError, match="physics step is 0 s"):
        motion(Model(LEG), given, dt=0.0)
    with pytest.raises(ConfigError, match="has 1 samples"):
        motion(Model(LEG), replace(given, sample_times=np.zeros(1)))
    with pytest.raises(SimulationDiverged, match="diverged"):
        motion(Model(LEG), given, np.array([1.3, -0.5, 0.0, 900.0]), dt=0.02)


# --- the response --------------------------------------------------------------------------------------------------


def test_exponentials_are_those_of_scipy_even_of_stiff_matrices() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(30, 6, 6))
    a[:, 4:] = 0.0
    a[:, 2:4, :2] *= 2e3
    a[10:20, 2, 2] = -1e4
    a[20:, 3, 3] = -1e6
    a *= 0.01
    found, wanted = exponentials(a, 2, 4), expm(a)
    assert np.abs(found - wanted).max(axis=(1, 2)) == pytest.approx(np.zeros(30), abs=1e-9 * np.abs(wanted).max())
    assert np.array_equal(exponentials(np.zeros((2, 3, 3)), 0, 1), np.tile(np.eye(3), (2, 1, 1)))


Columns = Callable[[Motion], Array]
CHANGES: dict[str, tuple[Callable[[float, tuple[Effect, ...], Phase], Model], Columns, float]] = {
    "hip spring": (
        lambda e, effects, phase: Model(LEG, (*effects, ParallelSpring("hip", e, 1.3)), phase),
        lambda m: at_joint(HIP, 1.3 - m.between.position[:, HIP]),
        1e-5,
    ),
    "knee damping": (
        lambda e, effects, phase: Model(LEG.with_parameters({"knee.damping": 0.062 + e}), effects, phase),
        lambda m: at_joint(KNEE, -m.between.velocity[:, KNEE]),
        1e-6,
    ),
    "cubic maa": (
        lambda e, effects, phase: Model(LEG, (*effects, NonlinearStiffness("maa", e, 0.22)), phase),
        lambda m: along_actuator(m, MAA, -((m.between.length[:, [MAA]] - 0.22) ** 3)),
        1e-1,
    ),
    "baa area": (
        lambda e, effects, phase: Model(LEG.with_parameters({"baa.area": 4.36e-4 + e}), effects, phase),
        lambda m: along_actuator(m, BAA, m.between.pressure[:, [BAA]]),
        1e-9,
    ),
}
"""What is changed by a little → the model with it, the torque of a unit, and how much a little is."""

MANY = (
    FirstOrderLag("maa", 0.1),
    Creep("baa", 40.0, 0.5),
    Hysteresis("maa", 0.3, 0.01),
    SensorScale("knee", 1.1),
    SensorDelay("hip", 0.03),
    PayloadMass("foot", 0.05),
)
RUBBING = (CoulombFriction("hip", 0.02), StribeckFriction("knee", 0.003, 0.002, 0.1), CoulombFriction("maa", 0.1))


@pytest.mark.parametrize(
    ("change", "effects", "phase", "rate", "most"),
    [
        *((change, (), "swing", 120.0, 2.5e-3) for change in CHANGES),
        *((change, (), "stance", 240.0, 5e-3) for change in CHANGES),
        ("knee damping", (), "swing", 60.0, 1e-2),
        ("baa area", (), "swing", 60.0, 1e-2),
        *((change, MANY, "swing", 120.0, 2.5e-3) for change in CHANGES),
        ("knee damping", RUBBING, "swing", 120.0, 1e-2),
        ("baa area", RUBBING, "swing", 120.0, 6e-2),
    ],
)
def test_the_response_is_the_derivative_of_the_simulation(
    change: str, effects: tuple[Effect, ...], phase: Phase, rate: float, most: float
) -> None:
    make, columns, small = CHANGES[change]
    base = make(0.0, effects, phase)
    given = course(phase, rate)
    followed = motion(base, given)
    found = response(base, followed, columns(followed))[:, :, 0]
    assert error(found, difference(base, make(small, effects, phase), given, small)) < most


@pytest.mark.parametrize(
    ("change", "effects", "most"),
    [
        *((change, (), 2e-2) for change in CHANGES),
        ("knee damping", (JointStop("knee", 0.05, 20.0, 0.2),), 6e-2),
        ("knee damping", MANY, 6e-2),
    ],
)
def test_it_holds_where_a_joint_hits_and_leaves_its_stop(change: str, effects: tuple[Effect, ...], most: float) -> None:
    make, columns, small = CHANGES[change]
    base = make(0.0, effects, "swing")
    given = trial(PRESSED)
    followed = motion(base, given)
    stop = 0.05 if len(effects) == 1 else -0.035
    assert 0.1 < np.mean(followed.position[:, KNEE] < stop) < 0.6
    found = response(base, followed, columns(followed))[:, :, 0]
    assert error(found, difference(base, make(small, effects, "swing"), given, small)) < most


@pytest.mark.slow
def test_it_holds_for_other_robots() -> None:
    robot = random_morphology("branched", 3)
    base, small = Model(robot), 1e-6
    levels = np.array([[0.0, 0, 0], [3e3, 2e3, 9e3], [1e3, 6e3, 4e3]])
    given = trial(levels, 500.0, 2.4, np.array([0.3, 0.2, -0.1]))
    followed = motion(base, given)
    damped = Model(robot.with_parameters({"joint2.damping": robot.joints[2].damping + small}))
    torque = np.zeros((len(followed.between.time), 3, 1))
    torque[:, 2, 0] = -followed.between.velocity[:, 2]
    assert error(response(base, followed, torque)[:, :, 0], difference(base, damped, given, small)) < 2e-2


def test_what_sticks_does_not_answer() -> None:
    model = Model(LEG, (CoulombFriction("hip", 0.5), CoulombFriction("knee", 0.5)))
    given = trial(FREE[:1], until=1.0)
    followed = motion(model, given)
    assert np.abs(followed.velocity).max() < 1e-12
    found = response(model, followed, np.ones((len(given.times), 2, 1)))
    free = response(Model(LEG), motion(Model(LEG), given), np.ones((len(given.times), 2, 1)))
    assert np.abs(found).max() < 1e-3 * np.abs(free).max()


def test_torques_at_the_samples_are_linear_between_them_and_all_columns_are_alike() -> None:
    given = [trial(FREE, until=1.0), trial(FREE[::-1].copy(), until=2.0)]
    along = linearise(Model(LEG), [motion(Model(LEG), one) for one in given])
    rng = np.random.default_rng(1)
    torques = [rng.normal(size=(len(one.times), 2, 3)) for one in given]
    found = along.response(torques)
    middle = along.response([(t[1:] + t[:-1]) / 2 for t in torques])
    for a, b, one, torque in zip(found, middle, given, torques, strict=True):
        assert a.shape == (len(one.times), 2, 3) and np.array_equal(a, b)
        assert not a[0].any()
        alone = response(Model(LEG), motion(Model(LEG), one), torque[:, :, 1:2])
        assert alone[:, :, 0] == pytest.approx(a[:, :, 1], abs=1e-12)


def test_wrong_shapes_are_told() -> None:
    given = trial(FREE, until=1.0)
    followed = motion(Model(LEG), given)
    n = len(given.times)
    along = linearise(Model(LEG), [followed])
    with pytest.raises(ConfigError, match="for 2 trials, expected 1"):
        along.response([np.zeros((n, 2, 1))] * 2)
    for shape in ((n - 2, 2, 1), (n, 3, 1), (n, 2)):
        with pytest.raises(
            ConfigError, match=rf"have shape \({n - 2 if shape[0] < n else n}, .*expected \({n - 1}, 2, k\)"
        ):
            along.response([np.zeros(shape)])
    with pytest.raises(ConfigError, match=f"forces have 3 rows, expected {n} or {n - 1}"):
        along_actuator(followed, MAA, np.zeros((3, 1)))
    with pytest.raises(ConfigError, match="no motion"):
        linearise(Model(LEG), [])
