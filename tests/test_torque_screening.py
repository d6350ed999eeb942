"""Inverse dynamics along measured motions, and the laws that the missing forces ask for."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mjcf_models import ARM
from pendulum_runs import FINE, MOTOR, PENDULUM, SERVO, recorded

from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import Part, default_free_parameters, parameters_of
from equimus_ctrl.diagnosis.torque_agreement import more_beside, share_in_torques, shown_in_torques
from equimus_ctrl.diagnosis.torque_columns import columns_of
from equimus_ctrl.diagnosis.torque_screening import _inverse_of as inverse_of
from equimus_ctrl.diagnosis.torque_screening import torque_domain, torque_screen
from equimus_ctrl.diagnosis.torque_start import laws_asked_for, worth_simulating
from equimus_ctrl.effects import (
    CoulombFriction,
    Effect,
    FirstOrderLag,
    ParallelSpring,
    PayloadMass,
    PositionDependentFriction,
    SensorDelay,
    SensorOffset,
    TransportDelay,
    ViscousFriction,
)
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.mjcf_inverse import MeasuredMotion, inverse_dynamics, law_slopes, motions_of
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

ROBOT = MjcfRobot("arm", PENDULUM.format(drive=MOTOR))
SERVOED = MjcfRobot("arm", PENDULUM.format(drive=SERVO))


def motion(recording: Recording, noise: float = 1e-6) -> MeasuredMotion:
    trial = Trial.of(recording, recording.position[0])
    return MeasuredMotion(trial, recording.time, recording.position, np.array([noise]))


def data_of(robot: MjcfRobot, recordings: list[Recording]) -> Data:
    model = Model(robot)
    parts = split(model, recordings, shoot=1.0)
    free = default_free_parameters(model)
    return Data(free, parts.train, Simulator(engine_for(model), 1))


@pytest.mark.parametrize(
    ("robot", "effects"),
    [
        (ROBOT, ()),
        (SERVOED, ()),
        (ROBOT, (ViscousFriction("hinge", 0.2),)),
        (ROBOT, (CoulombFriction("hinge", 0.1), ParallelSpring("hinge", 1.0, 0.3))),
        (ROBOT, (TransportDelay("drive", 0.03),)),
        (ROBOT, (FirstOrderLag("drive", 0.05),)),
        (ROBOT, (PayloadMass("tip", 0.2), SensorOffset("hinge", 0.1))),
        (ROBOT, (SensorDelay("hinge", 0.02),)),
    ],
)
def test_a_model_lacks_no_force_along_a_motion_of_its_own(robot: MjcfRobot, effects: tuple[Effect, ...]) -> None:
    model = Model(robot, effects)
    one = recorded(model, count=1, seed=2, noise=0.0)[0]
    at = inverse_dynamics(model, [motion(one)], 3)[0]
    missing, drives = (at.weighted(values)[:, 0][at.counts[:, 0]] for values in (at.missing, at.drives))
    assert len(missing) > 50
    # Dry friction jumps within what a test function weighs; all else is left to the smoothing alone.
    most = 0.05 if any(e.rubs for e in effects) else 0.015
    assert np.sqrt(np.mean(missing**2)) < most * np.sqrt(np.mean(drives**2))


def test_what_a_model_lacks_is_the_law_that_it_lacks() -> None:
    one = recorded(Model(ROBOT, (ViscousFriction("hinge", 0.3),)), count=1, seed=4, noise=0.0)[0]
    at = inverse_dynamics(Model(ROBOT), [motion(one)], 3)[0]
    missing, rate = at.weighted(at.missing)[:, 0], at.weighted(at.rate)[:, 0]
    assert np.polyfit(rate, missing, 1)[0] == pytest.approx(-0.3, rel=0.01)


def test_noise_of_accelerations_falls_with_the_width() -> None:
    one = recorded(Model(ROBOT), count=1, seed=5, noise=1e-3)[0]
    sizes = []
    for width in (2, 4, 8):
        at = inverse_dynamics(Model(ROBOT), [motion(one, 1e-3)], width)[0]
        sizes.append(float(at.weighted(at.missing).std()))
    assert sizes[0] / sizes[1] == pytest.approx(2**2.5, rel=0.4)
    assert sizes[2] < sizes[1] / 1.8


def test_slopes_of_laws_are_their_derivatives() -> None:
    x, v, load = (np.array(values) for values in ([0.1, -0.4], [0.7, -0.2], [1.5, -0.3]))
    slopes = law_slopes(ParallelSpring, {"stiffness": 2.0, "rest": 0.3}, x, v, load)
    assert slopes == pytest.approx(np.column_stack([-(x - 0.3), [2.0, 2.0]]))
    assert law_slopes(CoulombFriction, {"friction": 0.5}, x, v, load).ravel() == pytest.approx([-1.0, 1.0])


def test_intervals_of_a_recording_are_one_motion_again() -> None:
    recordings = recorded(Model(ROBOT), count=2, seconds=3.0)
    parts = split(Model(ROBOT), recordings, validation=["t1"], shoot=0.5)
    segments = parts.train
    assert len(segments) == 6
    (whole,) = motions_of([s.trial for s in segments], [s.measured for s in segments], np.array([1e-3]))
    assert np.allclose(whole.time, recordings[0].time) and np.allclose(whole.position, recordings[0].position)


def test_uneven_samples_become_even() -> None:
    time = np.sort(np.random.default_rng(0).uniform(0, 2, 200))
    trial = Trial("t", time, np.zeros((200, 1)), np.zeros(1), time[0], np.zeros(1), time)
    (whole,) = motions_of([trial], [np.sin(time)[:, None]], np.array([1e-3]))
    assert np.ptp(np.diff(whole.time)) < 1e-12
    assert np.abs(whole.position[:, 0] - np.sin(whole.time)).max() < 2e-3


def test_integrators_and_equalities_leave_no_torque_domain() -> None:
    assert ROBOT.has_torque_domain and SERVOED.has_torque_domain
    drive = '<intvelocity name="drive" joint="hinge" kp="12"/>'
    assert not MjcfRobot("arm", PENDULUM.format(drive=drive)).has_torque_domain


@pytest.mark.parametrize(
    ("effect", "labels", "size"),
    [
        (CoulombFriction("hinge", 0.08), {"coulomb_friction:hinge"}, 0.08),
        (ViscousFriction("hinge", 0.1), {"viscous_friction:hinge"}, 0.1),
        # What is slow moves alike when it is late and when it lags.
        (TransportDelay("drive", 0.05), {"transport_delay:drive", "first_order_lag:drive"}, 0.05),
    ],
)
def test_a_search_begins_with_the_missing_law(effect: Effect, labels: set[str], size: float) -> None:
    data = data_of(ROBOT, recorded(Model(ROBOT, (effect,)), seed=1, seconds=8.0))
    pool = candidates(Model(ROBOT), data.segments)
    domain = torque_domain(data, pool)
    assert domain is not None
    found = laws_asked_for(data, domain, pool, 3)
    assert found is not None
    (part,) = found[0]
    assert part.candidate.label in labels and next(iter(part.values.values())) == pytest.approx(size, rel=0.25)


def test_a_search_begins_with_nothing_where_nothing_is_missing() -> None:
    """Parameters that are off are none of the laws."""
    off = ROBOT.with_parameters({"arm.mass": 0.66, "hinge.armature": 0.005})
    data = data_of(ROBOT, recorded(Model(off), seed=3, seconds=8.0))
    pool = candidates(Model(ROBOT), data.segments)
    domain = torque_domain(data, pool)
    assert domain is not None and laws_asked_for(data, domain, pool, 3) is None


def test_the_torque_domain_tells_a_law_that_is_there_from_one_that_is_not() -> None:
    """A ripple that simulation had found beside true viscous friction; dry friction is not asked for."""
    data = data_of(ROBOT, recorded(Model(ROBOT, (ViscousFriction("hinge", 0.1),)), seed=1, seconds=8.0))
    pool = {c.label: c for c in candidates(Model(ROBOT), data.segments)}
    domain = torque_domain(data, tuple(pool.values()))
    assert domain is not None
    parts = (
        Part(pool["viscous_friction:hinge"], {"damping": 0.1}),
        Part(pool["torque_ripple:hinge"], {"sine": 0.05, "cosine": 0.02, "period": 0.7}),
        Part(pool["coulomb_friction:hinge"], {"friction": 0.05}),
        Part(pool["quadratic_damping:hinge"], {"drag": 1e-6}),  # too little to be seen
    )
    theta = np.append(data.free.start, [value for part in parts for value in part.values.values()])
    fitted: Any = SimpleNamespace(hypothesis=parts[:2], fit=SimpleNamespace(theta=theta))
    there, not_there = (share_in_torques(data, domain, fitted, k) for k in (0, 1))
    assert there == pytest.approx(1.0, abs=0.25) and not_there < 0.1
    assert [shown_in_torques(data, domain, fitted, k) for k in (0, 1)] == [True, False]
    fitted = SimpleNamespace(hypothesis=(parts[0], *parts[2:]), fit=SimpleNamespace(theta=theta))
    assert [share_in_torques(data, domain, fitted, k) for k in (1, 2)] == [np.inf, np.inf]


@pytest.mark.parametrize(
    ("missing", "more"),
    [(CoulombFriction("hinge", 0.08), False), (PositionDependentFriction("hinge", 0.02, 0.15, 1.57), True)],
)
def test_the_torque_domain_tells_whether_friction_depends_on_the_angle(missing: Effect, more: bool) -> None:
    data = data_of(ROBOT, recorded(Model(ROBOT, (missing,)), seed=1, seconds=8.0))
    pool = {c.label: c for c in candidates(Model(ROBOT), data.segments)}
    domain = torque_domain(data, tuple(pool.values()))
    assert domain is not None
    other = pool["position_dependent_friction:hinge"]
    friction = Part(pool["coulomb_friction:hinge"], {"friction": 0.08})
    there = {"friction": 0.02, "more": 0.15, "angle": 1.57}
    shares = more_beside(data, domain, (friction,), [replace(other, guesses=(there,))])
    assert (shares[0] > 0.05) is more


@pytest.mark.parametrize(("interpolation", "least"), [("hold", 0.0), ("linear", 0.5)])
def test_where_commands_go_along_lines_no_delay_of_less_than_half_a_row_is_looked_for(
    interpolation: str, least: float
) -> None:
    one = recorded(Model(ROBOT), count=1, seed=3, seconds=4.0)[0]
    data = data_of(ROBOT, [replace(one, notes={"interpolation": interpolation})])
    pool = [
        c for c in candidates(Model(ROBOT), data.segments) if c.effect in (TransportDelay, FirstOrderLag, SensorDelay)
    ]
    between = float(np.median(np.diff(one.time)))
    assert len(pool) == 3
    for candidate in pool:
        (guess, *_) = candidate.guesses
        own = parameters_of(data.free, (Part(candidate, dict.fromkeys(guess, 0.0)),)).free[-1]
        assert own.low == pytest.approx(least * between) and own.start == own.low


def two_joints(damping: float = 0.0) -> MjcfRobot:
    """The crane of other tests with a motor at each joint, and no friction of its own."""
    xml = (
        ARM.replace('damping="0.1"', f'damping="{damping}"')
        .replace('frictionloss="0.05"', "")
        .replace('frictionloss="0.4"', "")
    )
    head, _, _ = xml.partition("<actuator>")
    drives = '<actuator><motor name="turn" joint="shoulder"/><motor name="push" joint="reach"/></actuator></mujoco>'
    return MjcfRobot("crane", head + drives)


@pytest.mark.slow
def test_friction_of_all_joints_is_one_law_with_its_own_size_at_each() -> None:
    robot = two_joints()
    real = Model(robot, (CoulombFriction("shoulder", 0.4), CoulombFriction("reach", 2.0)))
    data = data_of(robot, recorded(real, seed=6, seconds=8.0, size=6.0, noise=2e-4, dt=FINE))
    pool = candidates(Model(robot), data.segments)
    domain = torque_domain(data, pool)
    assert domain is not None
    found = laws_asked_for(data, domain, pool, 3)
    assert found is not None
    (part,) = (p for p in found[0] if p.candidate.effect is CoulombFriction)
    assert part.candidate.label == "coulomb_friction:shoulder,reach"
    assert part.values == pytest.approx({"shoulder.friction": 0.4, "reach.friction": 2.0}, rel=0.2)


@pytest.mark.slow
def test_what_is_far_behind_is_not_simulated() -> None:
    """A friction that is there is kept with its size as a guess; the pool is smaller, and what cannot be seen stays."""
    robot = two_joints()
    data = data_of(robot, recorded(Model(robot, (CoulombFriction("reach", 2.0),)), seed=7, seconds=8.0, size=6.0))
    pool = candidates(Model(robot), data.segments)
    domain = torque_domain(data, pool)
    assert domain is not None
    base = data.nominal_fit()
    kept = worth_simulating(data, domain, base, pool)
    labels = {candidate.label for candidate in kept}
    assert "coulomb_friction:reach" in labels and len(kept) < 0.7 * len(pool)
    unseen = {c.label for c in pool if not c.effect.in_torques}
    assert unseen and unseen <= labels
    friction = next(c for c in kept if c.label == "coulomb_friction:reach")
    assert friction.guesses[-1]["friction"] == pytest.approx(2.0, rel=0.25)


def test_gains_are_those_of_least_squares() -> None:
    """The Gram matrix gives what fitting the columns gives, beside parameters that are known within their bounds."""
    data = data_of(ROBOT, recorded(Model(ROBOT, (ViscousFriction("hinge", 0.1),)), seed=8, seconds=6.0))
    pool = [c for c in candidates(Model(ROBOT), data.segments) if c.label in ("viscous_friction:hinge",)]
    domain = torque_domain(data, pool)
    assert domain is not None
    screen = torque_screen(data, domain, None, pool)
    (own,) = screen.columns
    p = len(screen.theta)
    inverse = np.linalg.inv(screen.gram[: p + 1, : p + 1])
    aim = screen.gram[: p + 1, -1]
    whole = screen.gram[-1, -1] - aim @ inverse @ aim
    assert screen.fitted([own])[0] == pytest.approx(whole, rel=1e-6)
    assert screen.fitted([own])[1][0][0] == pytest.approx((inverse @ aim)[p], rel=1e-6)
    assert screen.alone()[pool[0]].gain == pytest.approx(screen.missing - whole, rel=1e-6)
    negative = replace(
        screen,
        gram=np.where(np.arange(p + 2) == p, -1.0, 1.0)[:, None]
        * screen.gram
        * np.where(np.arange(p + 2) == p, -1.0, 1.0),
    )
    chi2, sizes = negative.fitted([own])  # its size would be below 0, which it cannot be
    assert chi2 == pytest.approx(screen.missing) and sizes == [[0.0]]


def test_stiffnesses_of_servos_are_held() -> None:
    """All that a drive exerts grows with its gain, its noise too; so least squares would shrink it."""
    model = Model(SERVOED)
    parts = split(model, recorded(model, seed=10, seconds=6.0, noise=2e-3))
    freed = [default_free_parameters(model, ["arm.*", *more]) for more in ((), ("drive.kp",))]
    gains, moved = [], []
    for free in freed:
        data = Data(free, parts.train, Simulator(engine_for(model), 1))
        pool = [
            c for c in candidates(model, data.segments) if c.label in ("constant_force:hinge", "viscous_friction:hinge")
        ]
        domain = torque_domain(data, pool)
        assert domain is not None
        screen = torque_screen(data, domain, None, pool)
        gains.append([fit.gain for fit in screen.alone().values()])
        moved.append(dict(zip(free.names, screen.moved([], []), strict=True)))
    assert gains[1] == pytest.approx(gains[0], rel=1e-6)
    assert moved[1].pop("drive.kp") == 12.0 and moved[1] == pytest.approx(moved[0], rel=1e-6)


def test_it_does_not_matter_where_parameters_are_that_forces_are_linear_in() -> None:
    """What is known of them included: the minimum of a quadratic function does not depend on where it is expanded."""
    data = data_of(ROBOT, recorded(Model(ROBOT, (ViscousFriction("hinge", 0.1),)), seed=8, seconds=6.0))
    pool = [c for c in candidates(Model(ROBOT), data.segments) if c.label == "viscous_friction:hinge"]
    domain = torque_domain(data, pool)
    assert domain is not None and [p.name for p in data.free.free] == ["arm.mass", "arm.inertia"]
    off: Any = SimpleNamespace(fit=SimpleNamespace(parameters=data.free, theta=data.free.start * [1.4, 0.7]))
    here, there = (torque_screen(data, domain, fitted, pool) for fitted in (None, off))
    assert there.gram[-1, -1] > 1.1 * here.gram[-1, -1], "at others more is missing"
    assert there.missing == pytest.approx(here.missing, abs=1e-3)
    assert there.alone()[pool[0]].gain == pytest.approx(here.alone()[pool[0]].gain, abs=1e-3)
    own = here.columns[:1]
    moved = [screen.moved(own, screen.fitted(own)[1]) for screen in (here, there)]
    assert moved[1] == pytest.approx(moved[0], rel=1e-6)
    assert moved[0][0] == pytest.approx(0.6, rel=0.02), "the mass that it has"
    nothing = here.moved(own, [[0.0]])
    assert nothing == pytest.approx(here.moved([], [])) and nothing != pytest.approx(moved[0], rel=1e-3)
    once = replace(own[0], scaled=())  # a law without a size to scale counts once, as it does in ``fitted``
    assert once.fixed and here.moved([once], [[]]) == pytest.approx(here.moved(own, [[own[0].unit("friction")]]))
    assert here.fitted([once])[0] == pytest.approx(here.missing + here.beyond[0, 0] - 2 * here.beyond[0, -1], rel=1e-9)


def test_nothing_is_asked_for_by_a_robot_that_is_held() -> None:
    """Where nothing moves but the sensors' noise no law explains anything, none more than another: all stay."""
    rng = np.random.default_rng(0)
    still = [replace(r, position=rng.normal(0, 1e-3, r.position.shape)) for r in recorded(Model(ROBOT))]
    data = data_of(ROBOT, still)
    pool = candidates(Model(ROBOT), data.segments)
    domain = torque_domain(data, pool)
    assert domain is not None and laws_asked_for(data, domain, pool, 3) is None
    kept = worth_simulating(data, domain, data.nominal_fit(), pool)
    assert {c.label for c in kept} == {c.label for c in pool}


def test_of_a_group_of_trials_a_law_adds_nothing_where_it_is_absent() -> None:
    data = data_of(ROBOT, recorded(Model(ROBOT, (ViscousFriction("hinge", 0.1),)), count=2, seconds=4.0))
    plain = next(c for c in candidates(Model(ROBOT), data.segments) if c.label == "viscous_friction:hinge")
    noise = np.array([1e-3])
    motions = [m for s in data.segments for m in motions_of([s.trial], [s.measured], noise)]
    groups = ["A" if k % 2 else "B" for k in range(len(motions))]
    assert len(set(groups)) == 2
    pool = [plain, replace(plain, absent=("B",)), replace(plain, absent=("A",))]
    assert torque_domain(data, pool[1:]) is not None
    free = data.free
    found, columns, _, _ = columns_of(free, free.start, motions, 3, pool, lambda: None, groups=groups)
    everywhere, in_a, in_b = (columns[:, 0, len(free.free) + one.place[0]] for one in found)
    assert np.array_equal(in_a + in_b, everywhere) and np.any(in_a) and np.any(in_b) and not np.any(in_a * in_b)


def test_a_part_narrows_to_places_that_need_it() -> None:
    robot = two_joints()
    data = data_of(robot, recorded(Model(robot), seed=9, seconds=4.0, size=6.0))
    both = next(c for c in candidates(Model(robot), data.segments) if c.label == "viscous_friction:shoulder,reach")
    part = Part(both, {"shoulder.damping": 0.3, "reach.damping": 4.0})
    alone = part.narrowed(("reach",))
    assert alone.candidate.label == "viscous_friction:reach" and alone.values == {"damping": 4.0}
    assert [(e.location, e.parameters()) for e in part.effects] == [
        ("shoulder", {"damping": 0.3}),
        ("reach", {"damping": 4.0}),
    ]


def test_a_column_of_which_rounding_leaves_no_square_counts_as_none() -> None:
    """What parameters undo whole is a direction of nothing; scaled by its square it would outgrow all others."""
    left = np.array([[4.0, 1e-9, -2e-8], [1e-9, -1e-12, 1e-8], [-2e-8, 1e-8, -1e-13]])
    assert inverse_of(left) == pytest.approx(np.diag([0.25, 0.0, 0.0]))
    assert inverse_of(left[1:, 1:]) == pytest.approx(np.zeros((2, 2)))
