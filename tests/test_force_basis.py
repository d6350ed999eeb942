"""What flexible torques can express, and whether missing physics is found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from morphologies import random_morphology
from threadpoolctl import threadpool_limits

from equimus_ctrl.diagnosis.coordinates import Coordinate, read, written
from equimus_ctrl.diagnosis.explained_variance import explained
from equimus_ctrl.diagnosis.force_basis import (
    AT_ACTUATORS,
    AT_JOINTS,
    AT_ONCE,
    MEMORIES,
    Axis,
    ForceFamily,
    batches,
    families,
    harmonics,
    responses,
)
from equimus_ctrl.diagnosis.linear_response import Linearised, along_actuator, linearise
from equimus_ctrl.diagnosis.residual_force import frequencies
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.engines.motion import Motion, motion
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.fit import Fit, fit
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.proof.leg_simulation import recordings, simulate
from equimus_ctrl.proof.legs import draw
from equimus_ctrl.proof.outside import (
    Fade,
    Leak,
    PeriodicTorque,
    PressureDamping,
    PressureGrowth,
    RoughSpot,
    SquareDrag,
    StiffnessDrift,
)
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array

LEG = nominal_leg()
NOISE = 1e-3


@lru_cache(maxsize=1)
def moved() -> tuple[Motion, ...]:
    """Two trials of the nominal leg."""
    rng = np.random.default_rng(2)
    found = []
    for k in range(2):
        times = np.arange(300) / 100.0 + 0.3
        levels = rng.uniform([5e3, 3e3], [25e3, 12e3], (6, 2))
        held = levels[(times / 0.6).astype(int) % 6]
        start = Kinematics(LEG).equilibrium(held[0])
        found.append(motion(Model(LEG), Trial(f"t{k}", times, held, held[0], 0.3, start, times)))
    return tuple(found)


@lru_cache(maxsize=1)
def along() -> Linearised:
    return linearise(Model(LEG), moved())


@lru_cache(maxsize=1)
def everything() -> tuple[ForceFamily, ...]:
    return tuple(families(Model(LEG), moved()))


def family(location: str, depends_on: str, size: int | None = None) -> ForceFamily:
    (found,) = [
        g for g in everything() if (g.location, g.depends_on) == (location, depends_on) and size in (None, g.size)
    ]
    return found


def centres(axis: Axis) -> Array:
    """(k,) the middles of cubic B-splines: their Greville abscissae, the means of three inner knots each."""
    return np.array([axis.knots[i + 1 : i + 4].mean() for i in range(len(axis.knots) - 4)])


# --- basis functions ---------------------------------------------------------------------------------------------


def test_an_axis_has_smooth_functions_that_add_up_to_one() -> None:
    rng = np.random.default_rng(0)
    values = [rng.normal(size=300) ** 3, rng.normal(size=200)]
    axis = Axis.over(read("pos.hip")[0], "rad", values, 9)
    x = np.linspace(*axis.range, 400)
    basis = axis.basis(x)
    assert basis.shape == (400, 9) and len(centres(axis)) == 9
    assert basis.sum(axis=1) == pytest.approx(np.ones(400)) and basis.min() >= 0
    assert axis.range == (np.concatenate(values).min(), np.concatenate(values).max())
    # Cubic polynomials are among them, and a straight line has the centres as its coefficients.
    assert basis @ centres(axis) == pytest.approx(x)
    small = 1e-6 * np.ptp(x)
    rise = (axis.basis(x[1:-1] + small) - axis.basis(x[1:-1] - small)) / (2 * small)
    assert axis.slopes(x[1:-1]) == pytest.approx(rise, abs=1e-6)
    assert np.array_equal(axis.basis(np.array([-1e9, 1e9])), axis.basis(np.array(axis.range)))


def test_knots_are_where_the_data_are_and_nowhere_too_far_apart() -> None:
    dense = np.concatenate([np.full(300, 2.0), np.linspace(-1, 9, 100)])
    inner = np.unique(Axis.over(read("vel.hip")[0], "rad/s", [dense], 11).knots)
    assert len(inner) == 9
    even = 10 / 8
    assert np.diff(inner).min() > 0.49 * even
    near = np.abs(inner - 2.0).argmin()
    assert np.diff(inner)[near] < 0.6 * even < even < np.diff(inner)[-1]
    still = Axis.over(read("cmd.maa")[0], "Pa", [np.full(50, 2e4)])
    assert np.all(np.isfinite(still.basis(np.full(3, 2e4))))


# --- coordinates -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "coordinates"),
    [
        ("", ()),
        ("pos.hip·sign(vel.hip)", (Coordinate("pos", "hip"), Coordinate("vel", "hip", sign=True))),
        ("cmd.maa−cmd.baa", (Coordinate("cmd", "maa", less="baa"),)),
        ("time at 0.5 Hz", (Coordinate("time", frequency=0.5),)),
        ("time·len.left.knee", (Coordinate("time"), Coordinate("len", "left.knee"))),
    ],
)
def test_coordinates_are_written_as_they_are_read(text: str, coordinates: tuple[Coordinate, ...]) -> None:
    assert read(text) == coordinates and written(coordinates) == text


def test_what_is_no_coordinate_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"'angle\.hip' is no coordinate; expected one such as pos\.hip"):
        read("vel.hip·angle.hip")


# --- families ------------------------------------------------------------------------------------------------------


def unexplained(g: ForceFamily, torques: Sequence[Array]) -> float:
    """What is left of joint torques (n, nj) when the family's own are fitted to them, as a share."""
    nj = torques[0].shape[1]
    columns = np.concatenate([t.reshape(-1, g.size) for t in g.torques(moved())])
    wanted = np.concatenate([t.reshape(-1) for t in torques])
    assert columns.shape == (len(wanted), g.size) and len(wanted) == nj * sum(len(m.between.time) for m in moved())
    left = wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return float(np.linalg.norm(left) / np.linalg.norm(wanted))


def physics(kind: str) -> list[Array]:
    """Joint torques of known physics along the motions."""
    found = []
    for m in moved():
        b = m.between
        q, v, p, length, rate, t = b.position, b.velocity, b.pressure, b.length, b.rate, b.time - m.start
        joint: dict[str, Array] = {
            "hip spring": np.column_stack([-(q[:, 0] - 1.2), 0 * t]),
            "knee drag": np.column_stack([0 * t, -np.abs(v[:, 1]) * v[:, 1]]),
            "hip by knee": np.column_stack([q[:, 1] ** 2, 0 * t]),
            "knee by both": np.column_stack([0 * t, q[:, 0] ** 2 * q[:, 1]]),
            "cross spring": -np.column_stack([q[:, 0] * q[:, 1] ** 2, q[:, 0] ** 2 * q[:, 1]]),
            "hip damping by angle": np.column_stack([-((q[:, 0] - 1.4) ** 2) * v[:, 0], 0 * t]),
            "knee rough spot": np.column_stack([0 * t, -np.tanh(v[:, 1] / 1e-3) * (1 + q[:, 1])]),
            "hip drift": np.column_stack([t**2, 0 * t]),
        }
        actuator = {
            "growth": (1, p[:, 1] ** 2),
            "maa cubic": (0, (length[:, 0] - 0.2) ** 3),
            "maa damper": (0, rate[:, 0] * (rate[:, 0] ** 2 + 1e-3)),
            "baa damping by pressure": (1, p[:, 1] * rate[:, 1]),
            "baa fade": (1, p[:, 1] * (3.0 - t) ** 2),
            "maa stiffness drift": (0, (length[:, 0] - LEG.actuators[0].rest_length) * t),
            "baa by maa": (1, p[:, 0]),
            "baa area by length": (1, p[:, 1] * (length[:, 1] - 0.25) ** 2),
        }
        if kind in joint:
            found.append(joint[kind])
        elif kind == "leak":
            moves = 0.02 * (p[:, 0] - p[:, 1])
            areas = [a.area for a in LEG.actuators]
            found.append(
                along_actuator(m, 0, -areas[0] * moves[:, None])[:, :, 0]
                + along_actuator(m, 1, areas[1] * moves[:, None])[:, :, 0]
            )
        else:
            index, force = actuator[kind]
            found.append(along_actuator(m, index, force[:, None])[:, :, 0])
    return found


@pytest.mark.parametrize(
    ("kind", "location", "depends_on", "size", "most"),
    [
        ("hip spring", "hip", "pos.hip", 8, 1e-9),
        ("hip spring", "hip", "pos.hip", 40, 1e-9),
        ("knee drag", "knee", "vel.knee", 8, 0.1),
        ("hip by knee", "hip", "pos.knee", 8, 1e-9),
        ("knee by both", "knee", "pos.knee·pos.hip", 25, 1e-9),
        ("cross spring", "hip+knee", "pos.hip·pos.knee", 25, 1e-9),
        ("hip damping by angle", "hip", "pos.hip·vel.hip", 8, 1e-9),
        ("knee rough spot", "knee", "pos.knee·sign(vel.knee)", 16, 1e-9),
        ("hip drift", "hip", "time", 8, 1e-9),
        ("growth", "baa", "cmd.baa", 8, 1e-9),
        ("maa cubic", "maa", "len.maa", 8, 1e-9),
        ("maa damper", "maa", "rate.maa", 8, 1e-9),
        ("baa damping by pressure", "baa", "cmd.baa·rate.baa", 8, 1e-9),
        ("baa fade", "baa", "time·cmd.baa", 8, 1e-9),
        ("maa stiffness drift", "maa", "time·len.maa", 8, 1e-9),
        ("baa by maa", "baa", "cmd.maa", 8, 1e-9),
        ("leak", "maa+baa", "cmd.maa−cmd.baa", 8, 1e-9),
        ("baa area by length", "baa", "len.baa·cmd.baa", 8, 1e-9),
    ],
)
def test_each_group_can_express_its_physics(kind: str, location: str, depends_on: str, size: int, most: float) -> None:
    own = unexplained(family(location, depends_on, size), physics(kind))
    assert own < most
    other = family("hip" if location == "knee" else "knee", "time")
    assert unexplained(other, physics(kind)) > 0.1


def test_groups_name_the_joints_they_act_on_and_each_is_there_once() -> None:
    names = [(g.location, g.depends_on, g.size) for g in everything()]
    assert len(set(names)) == len(names)
    assert family("maa", "cmd.maa").joints == ("hip",)
    assert family("baa", "cmd.baa").joints == ("hip", "knee")
    assert family("hip+knee", "pos.hip·pos.knee").joints == ("hip", "knee")
    for g in everything():
        for torque in g.torques(moved()):
            acted = [LEG.joint_names[j] for j in range(2) if torque[:, j].any()]
            assert acted == list(g.joints)


def test_a_curve_is_the_function_without_its_factor() -> None:
    g = family("hip", "pos.hip·vel.hip")
    wanted = (centres(g.axes[0]) - 1.0) * 0.3
    x = np.linspace(*g.axes[0].range, 30)
    assert (g.factor, g.axes[0].coordinate) == (Coordinate("vel", "hip"), Coordinate("pos", "hip"))
    assert g.axes[0].unit == "rad"
    assert g.curve(wanted, x) == pytest.approx((x - 1.0) * 0.3)
    both = family("knee", "pos.knee·pos.hip")
    a, b = both.axes
    assert (a.coordinate, b.coordinate) == read("pos.knee·pos.hip")
    coefficients = np.outer(centres(a), centres(b)).ravel()
    y = np.linspace(*b.range, 30)
    x = np.linspace(*a.range, 30)
    assert both.curve(coefficients, x, y) == pytest.approx(x * y)


def test_a_path_follows_the_length_until_it_slips() -> None:
    g = family("baa", "path.baa")
    assert not g.axes
    for columns, m in zip(g.forces["actuator", 1], moved(), strict=True):
        way = np.diff(m.between.length[:, 1])
        change = np.diff(columns, axis=0)
        assert not columns[0].any() and np.abs(columns).max() <= 1.0
        assert np.all(change * way[:, None] >= 0)
        slipped = []
        for column, step in zip(columns.T, change.T, strict=True):
            sticks = (np.abs(column[1:]) < 1) & (np.abs(column[:-1]) < 1)
            each = (step[sticks] @ way[sticks]) / (way[sticks] @ way[sticks])
            assert step[sticks] == pytest.approx(each * way[sticks])
            slipped.append(1 - sticks.mean())
        assert slipped == sorted(slipped, reverse=True) and slipped[0] > 1.5 * slipped[-1] > 0


def test_a_memory_is_a_spring_that_relaxes() -> None:
    g = family("baa", "past.baa")
    for columns, m in zip(g.forces["actuator", 1], moved(), strict=True):
        length, time = m.between.length[:, 1], m.between.time
        for column, constant in zip(columns.T, MEMORIES, strict=True):
            relaxed = np.concatenate([[0.0], np.cumsum(np.diff(time) * (column[1:] + column[:-1]) / 2)]) / constant
            assert column + relaxed == pytest.approx(length - length[0], abs=0.05 * np.ptp(length))


@pytest.mark.slow
def test_other_robots_have_groups_too() -> None:
    robot = random_morphology("branched", 1)
    times = np.arange(60) / 100.0
    trial = Trial("t", times, np.full((60, 3), 5e3), np.zeros(3), 0.0, np.array([0.2, 0.1, 0.1]), times)
    model = Model(robot)
    one = motion(model, trial)
    found = families(model, [one])
    assert {g.location for g in found} >= {*robot.joint_names, *robot.actuator_names}
    assert all(np.all(np.isfinite(g.torques([one])[0])) for g in found)
    assert len(AT_JOINTS) * 3 + len(AT_ACTUATORS) * 3 <= len(found)


@pytest.mark.slow
def test_answers_in_batches_are_those_one_by_one() -> None:
    some = [*everything(), *harmonics(Model(LEG), moved(), np.linspace(0.5, 4.0, 50))]
    assert sum(g.size for g in some) > AT_ONCE
    found = [(batch, responses(along(), batch)) for batch in batches(some)]
    assert len(found) > 1 and [g for batch, _ in found for g in batch] == some
    for batch, changes in found:
        ends = np.cumsum([g.size for g in batch])
        for trial, whole in enumerate(changes):
            assert whole.shape[2] == ends[-1]
            for g, own in zip(batch, np.split(whole, ends[:-1], axis=2), strict=True):
                alone = along().response(g.torques(moved()))[trial]
                assert own.shape[2] == g.size and own == pytest.approx(alone, abs=1e-12)


@pytest.mark.parametrize(
    ("seconds", "step", "slowest", "fastest", "apart"),
    [(2.0, 0.01, 0.5, 3.75, 0.25), (4.0, 0.2, 0.25, 0.875, 0.125), (60.0, 0.01, 0.2, 4.0 - 0.008333, 1 / 24)],
    ids=["short", "few samples", "long"],
)
def test_frequencies_are_those_that_recordings_tell_apart(
    seconds: float, step: float, slowest: float, fastest: float, apart: float
) -> None:
    times = [3.0 + np.arange(0, length + step / 2, step) for length in (seconds / 2, seconds)]
    motions: Any = [SimpleNamespace(time=time, start=time[0]) for time in times]
    found = frequencies(motions)
    assert (found[0], found[-1]) == pytest.approx((slowest, fastest), abs=0.6 * apart)
    assert found[0] == pytest.approx(slowest) and np.diff(found) == pytest.approx(apart)


def test_harmonics_are_waves_from_the_trials_start() -> None:
    found = harmonics(Model(LEG), moved(), [0.5, 2.0])
    assert [(g.location, g.depends_on) for g in found] == [
        (name, f"time at {f} Hz") for name in ("hip", "knee") for f in ("0.5", "2")
    ]
    m = moved()[0]
    t = 2 * np.pi * 2.0 * (m.between.time - 0.3)
    assert found[1].torques(moved())[0][:, 0] == pytest.approx(np.column_stack([np.sin(t), np.cos(t)]))


# --- concealed physics -------------------------------------------------------------------------------------------


def concealed(outside: Effect) -> tuple[Fit, list[Motion]]:
    """The best that the nominal model can do on four short trials of a leg with something else about it."""
    drawn = draw(8, 1, kind="none", trials=4, duration=6.0)
    ground_truth = replace(drawn, outside=(outside,), noise=(NOISE, NOISE), correlation=0.0)
    model = nominal_model()
    measured = recordings(ground_truth, simulate(ground_truth, 480.0))
    segments = cut(model, measured, fit_start=True)
    found = fit(free_parameters(model), segments, simulator=reduced_simulator(threads=1))
    starts = zip(segments, found.starts, strict=True)
    return found, [motion(found.model, segment.trial, start, 2e-3) for segment, start in starts]


@pytest.mark.parametrize(
    ("outside", "location", "depends_on"),
    [
        (RoughSpot("knee", 0.015, 0.5, 0.15), "knee", "pos.knee·sign(vel.knee)"),
        (PeriodicTorque("hip", 0.02, 1.0), "hip", "time at 1 Hz"),
        pytest.param(PressureDamping("maa", 8.0), "maa", "cmd.maa·rate.maa", marks=pytest.mark.slow),
        (Leak("maa", 0.02), "maa+baa", "cmd.maa−cmd.baa"),
        pytest.param(SquareDrag("knee", 0.04), "knee", "vel.knee", marks=pytest.mark.slow),
        pytest.param(StiffnessDrift("baa", 0.01), "baa", "time·len.baa", marks=pytest.mark.slow),
        pytest.param(PressureGrowth("baa", 3e-3), "baa", "cmd.baa", marks=pytest.mark.slow),
        pytest.param(Fade("maa", 0.1, 4.0), "maa", "time·cmd.maa", marks=pytest.mark.slow),
    ],
    ids=lambda value: value.name if isinstance(value, Effect) else "",
)
def test_concealed_physics_is_found_where_it_is(outside: Effect, location: str, depends_on: str) -> None:
    with threadpool_limits(limits=1, user_api="blas"):  # the matrices are small
        check_concealed(outside, location, depends_on)


def check_concealed(outside: Effect, location: str, depends_on: str) -> None:
    found, motions = concealed(outside)
    residual = np.concatenate([r.ravel() for r in found.residuals]) / NOISE
    edges = np.cumsum([0] + [r.size for r in found.residuals])
    trials = [slice(a, b) for a, b in pairwise(edges)]
    linear = linearise(found.model, motions)
    nuisances = [np.concatenate([j.reshape(-1, j.shape[2]) for j in found.jacobians])]
    for rows, start in zip(trials, found.start_jacobians, strict=True):
        own = np.zeros((len(residual), 2))
        own[rows] = start[:, :, :2].reshape(-1, 2)
        nuisances.append(own)
    columns = np.hstack(nuisances)
    basis, strength, _ = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), full_matrices=False)
    beside = Nuisance.of(basis[:, strength > 1e-6 * strength[0]])
    candidates = [*families(found.model, motions), *harmonics(found.model, motions, np.arange(0.25, 3.1, 0.25))]
    scores = []
    answers = {
        g: [whole[..., end - g.size : end] for whole in changes]
        for batch in batches(candidates)
        for changes in [responses(linear, batch)]
        for g, end in zip(batch, np.cumsum([own.size for own in batch]), strict=True)
    }
    for g in candidates:
        flat = np.concatenate([a.reshape(-1, g.size) for a in answers[g]]) / NOISE
        scores.append(explained(residual, beside, flat, folds=[[rows] for rows in trials]))
    best = max(range(len(scores)), key=lambda i: scores[i].held_out)
    assert (candidates[best].location, candidates[best].depends_on) == (location, depends_on)
    excess = scores[best].total - (len(residual) - beside.basis.shape[1])
    assert scores[best].total > 1.5 * len(residual) and scores[best].gain > 0.8 * excess
