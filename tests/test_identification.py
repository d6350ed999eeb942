"""Identification: what was put into simulated recordings is found again, with intervals that hold what they promise."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from morphologies import pendulum

from equimus_ctrl.effects import TransportDelay
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.errors import ConfigError, EquimusError, SimulationDiverged
from equimus_ctrl.identification import statics
from equimus_ctrl.identification.crosscheck import cross_check
from equimus_ctrl.identification.fit import Fit, FitSettings, fit
from equimus_ctrl.identification.parameters import default_names, free_parameters, unit_of
from equimus_ctrl.identification.problem import Point, Problem
from equimus_ctrl.identification.residuals import joint_rmse
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import simulator_for
from equimus_ctrl.identification.statics import rest_poses, static_names
from equimus_ctrl.identification.step_error import with_step_error
from equimus_ctrl.identification.uncertainty import correlation_time, uncertainty
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.recordings import StaticPoses, read_set
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow import identify_poses, identify_recordings, simulator_of

NOMINAL = nominal_model()
TRUE = NOMINAL.with_parameters(
    {
        "maa.stiffness": 300.0,
        "baa.stiffness": 95.0,
        "maa.area": 3.7e-4,
        "baa.area": 4.7e-4,
        "maa.rest_length": 0.185,
        "baa.rest_length": 0.25,
        "maa.damping": 15.0,
        "baa.damping": 20.0,
        "hip.damping": 0.4,
        "knee.damping": 0.08,
    }
)
STEPS = (
    ((10e3, 5e3), (25e3, 5e3), (5e3, 12e3)),
    ((20e3, 3e3), (8e3, 10e3), (30e3, 2e3)),
    ((5e3, 15e3), (18e3, 8e3), (28e3, 4e3)),
)
FEW = ("knee.damping", "maa.stiffness", "baa.area")


def trial(
    steps: Sequence[tuple[float, float]],
    model: Model = TRUE,
    noise: float = 0.0,
    seed: int = 0,
    engine: EngineName = "reduced",
    duration: float = 2.0,
    **more: Any,
) -> Recording:
    """What a model does under commands of equal length, from rest under the first of them."""
    time = np.arange(round(60 * duration)) / 60
    command = np.array(steps, dtype=float)[np.minimum((time / duration * len(steps)).astype(int), len(steps) - 1)]
    start = Kinematics(model.morphology).equilibrium(steps[0])
    m = model.morphology
    name = f"trial_{round(steps[0][0])}_{round(steps[0][1])}"
    bare = Recording(name, time, command, np.tile(start, (len(time), 1)), m.actuator_names, m.joint_names, **more)
    angles = predict(model, bare, engine=engine)
    return replace(bare, position=angles + np.random.default_rng(seed).normal(0, 1, angles.shape) * noise)


@lru_cache
def trials(noise: float = 0.0, engine: EngineName = "reduced") -> tuple[Recording, ...]:
    return tuple(trial(steps, noise=noise, seed=k, engine=engine) for k, steps in enumerate(STEPS))


def values(model: Model, names: Sequence[str]) -> Array:
    return np.array([model.parameters()[name] for name in names])


# Recovery.


@pytest.fixture(scope="module")
def found() -> Any:
    """All ten default parameters from three noisy trials."""
    return identify_recordings(trials(0.001), folds=3, heldout=[trial(((15e3, 9e3), (22e3, 2e3)), noise=0.001, seed=9)])


def test_ten_parameters_are_found_again(found: Any) -> None:
    names = found.fit.parameters.names
    assert sorted(names) == sorted(default_names(NOMINAL)) and len(names) == 10
    error = np.abs(found.fit.theta - values(TRUE, names))
    assert np.all(error <= 2.0 * found.fit.uncertainty.half_width)
    sure = found.fit.uncertainty.half_width < 0.2 * values(TRUE, names)
    assert sure.sum() >= 8 and np.all(error[sure] <= 0.05 * values(TRUE, names)[sure])
    assert found.fit.rmse == pytest.approx([0.001, 0.001], rel=0.1)
    assert np.all(found.fit.rmse_before > 0.01) and found.fit.converged and not found.fit.at_bound.any()


def test_trials_left_out_and_held_out_are_predicted_about_as_well(found: Any) -> None:
    assert found.check.folds == 3
    assert np.all(found.check.rmse > found.fit.rmse) and np.all(found.check.rmse < 0.0015)
    assert found.check.rmse_before == pytest.approx(found.fit.rmse_before, rel=1e-9)
    (judged,) = found.heldout
    assert judged.name == "trial_15000_9000"
    assert np.all(joint_rmse([judged.after]) < 0.0015) and joint_rmse([judged.before]).max() > 0.01


def test_exact_data_give_exact_parameters() -> None:
    done = identify_recordings(trials(), free=(*FEW, "baa.rest_length"), model=TRUE.with_parameters(
        {"maa.stiffness": 200.0, "baa.area": 3.5e-4, "knee.damping": 0.2, "baa.rest_length": 0.26}
    ), folds=0, settings=FitSettings(tolerance=1e-12), dt=1e-3)  # fmt: skip
    assert done.fit.theta == pytest.approx(values(TRUE, done.fit.parameters.names), rel=1e-5)
    assert np.all(done.fit.rmse < 1e-7)


def test_what_mujoco_recorded_is_found_by_the_reduced_engine_and_by_mujoco() -> None:
    """Both engines see the same parameters in the same data, to the little that they differ by."""
    start = TRUE.with_parameters({"maa.stiffness": 250.0, "knee.damping": 0.12})
    recorded = trials(engine="mujoco")
    both = [
        identify_recordings(recorded[:n], start, free=["maa.stiffness", "knee.damping"], engine=engine, folds=0)
        for engine, n in (("reduced", 3), ("mujoco", 1))
    ]
    for done in both:
        assert done.fit.theta == pytest.approx(values(TRUE, done.fit.parameters.names), rel=5e-3)
    assert both[0].fit.theta == pytest.approx(both[1].fit.theta, rel=5e-3)


def test_an_effects_parameters_are_free_by_default() -> None:
    late = replace(TRUE, effects=(TransportDelay("baa", delay=0.08),))
    recorded = [trial(steps, late) for steps in STEPS[:2]]
    start = replace(TRUE, effects=(TransportDelay("baa", delay=0.03),))
    done = identify_recordings(recorded, start, free=["baa.transport_delay.delay"], folds=0)
    assert done.fit.theta == pytest.approx([0.08], abs=1e-4)
    assert "baa.transport_delay.delay" in default_names(start) and unit_of(start, "baa.transport_delay.delay") == "s"


def test_the_real_leg(leg_dir: Path) -> None:
    """13 groups, ten parameters, 5 to 9 s: published is 0.03253 rad over both joints on the same data."""
    pressures = np.loadtxt(leg_dir / "static_poses_13.csv", delimiter=",", skiprows=1)[:, :2].astype(int)
    select = [f"step_release_p{a}_{b}" for a, b in pressures]
    done = identify_recordings(
        leg_dir / "step_release.csv", select=select, window=(5, 9), folds=0, settings=FitSettings(steps=9)
    )
    assert len(done.recordings) == 13
    assert np.sqrt((done.fit.rmse**2).mean()) <= 0.0305


# Intervals.


@lru_cache
def small_problem() -> tuple[Model, tuple[Segment, ...]]:
    start = TRUE.with_parameters(dict(zip(FEW, 1.03 * values(TRUE, FEW), strict=True)))
    return start, tuple(cut(start, [trial(steps[:2], duration=1.5) for steps in STEPS[:2]]))


def refit(noise: list[Array]) -> Fit:
    start, segments = small_problem()
    noisy = [replace(s, measured=s.measured + n) for s, n in zip(segments, noise, strict=True)]
    return fit(free_parameters(start, FEW), noisy)


def coloured(rng: np.random.Generator, shape: tuple[int, int], memory: float) -> Array:
    """Noise of 2 mrad whose neighbours correlate by ``memory``."""
    white = rng.normal(0, 1, shape)
    out = white.copy()
    for k in range(1, len(out)):
        out[k] = memory * out[k - 1] + np.sqrt(1 - memory**2) * white[k]
    return 0.002 * out


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "each", "all_together"), [(0.0, 34, 107), (0.8, 30, 96)])
def test_intervals_hold_what_they_promise(memory: float, each: int, all_together: int) -> None:
    """Of 40 draws Binomial(40, 0.95) covers fewer than 34 in less than 1 % of cases; colour costs a little."""
    rng = np.random.default_rng(17)
    _, segments = small_problem()
    inside, widths = [], []
    for _ in range(40):
        done = refit([coloured(rng, s.measured.shape, memory) for s in segments])
        inside.append(np.abs(done.theta - values(TRUE, FEW)) <= done.uncertainty.half_width)
        widths.append(done.uncertainty.half_width / np.std(done.residuals[0]))
        samples = sum(r.size for r in done.residuals)
        share = done.uncertainty.effective_samples / samples
        assert share > 0.6 if memory == 0 else share < 0.4
    count = np.sum(inside, axis=0)
    assert count.min() >= each and count.sum() >= all_together, count
    assert np.all(np.array(widths) < np.inf)


def test_correlation_time_of_an_autoregression() -> None:
    rng = np.random.default_rng(3)
    for memory in (0.0, 0.5, 0.8):
        series = [coloured(rng, (4000, 2), memory) for _ in range(3)]
        assert correlation_time(series) == pytest.approx((1 + memory) / (1 - memory), rel=0.15)


def test_the_interval_of_a_mean_is_students() -> None:
    """One parameter that shifts everything: the textbook's interval of a mean."""
    rng = np.random.default_rng(1)
    x = rng.normal(0, 1, (400, 1))
    known = uncertainty([np.ones((400, 1, 1))], [x - x.mean()], [np.zeros((400, 1, 0))], ["a"], np.ones(1), np.ones(1))
    assert known.half_width[0] == pytest.approx(1.966 * x.std(ddof=1) / 20, rel=0.02)


def test_the_interval_of_a_common_slope_beside_an_intercept_for_each_run_is_students() -> None:
    """Two runs of five and four samples, a line through each: 9 − 1 − 2 degrees of freedom (Draper & Smith, 1998)."""
    size, runs = 0.01, [np.array([0.0, 1.0, 2.0, 4.0, 7.0]), np.array([0.0, 3.0, 4.0, 5.0])]
    found = uncertainty(
        [x[:, None, None] for x in runs],
        # Of one size and alternating: the sandwich is the textbook's s²(XᵀX)⁻¹, and each residual counts as one.
        [size * (-1.0) ** np.arange(len(x))[:, None] for x in runs],
        [np.ones((len(x), 1, 1)) for x in runs],
        ["slope"], np.ones(1), np.ones(1),
    )  # fmt: skip
    spread = sum(((x - x.mean()) ** 2).sum() for x in runs)
    error = np.sqrt(9 * size**2 / 6 / spread)
    assert found.effective_samples == 9
    assert found.standard_error[0] == pytest.approx(error, rel=1e-9)
    assert found.half_width[0] == pytest.approx(2.446912 * error, rel=1e-6), "Student's t at 0.975 for 6"


def test_the_steps_error_widens_intervals_by_what_parameters_would_make_good_of_it() -> None:
    """An engine whose coarser step does what another stiffness does, and one whose coarser step diverges."""
    start, segments = small_problem()
    found = fit(free_parameters(start, FEW), segments)
    own, change, ratio = simulator_for(start), 0.02, 3.0

    def coarser(models: Sequence[Model], given: Sequence[Segment], starts: Sequence[Array]) -> list[Predicted]:
        stiffness = models[0].parameters()["maa.stiffness"] + change
        return own([models[0].with_parameters({"maa.stiffness": stiffness})], given, starts)

    def diverging(models: Sequence[Model], given: Sequence[Segment], starts: Sequence[Array]) -> list[Predicted]:
        found = own(models, given, starts)  # numbers after a divergence mean nothing
        return [replace(p, position=p.position + 1.0, reached=np.full_like(p.reached, 3)) for p in found]

    more = {
        name: with_step_error(found, segments, own, other, ratio).uncertainty.half_width - found.uncertainty.half_width  # type: ignore[arg-type]
        for name, other in (("coarser", coarser), ("diverging", diverging))
    }
    # By C·h of its own step, half of C·h·(3 − 1), it may be wrong.
    assert more["coarser"] / found.parameters.scale == pytest.approx(
        np.array([0.0, change / 2, 0.0]) / found.parameters.scale, abs=0.02 * change / found.parameters.scale[1]
    )
    assert not more["diverging"].any()


def test_without_pressure_the_areas_cannot_be_seen() -> None:
    recorded = trial(((0, 0),), notes={"settled": "no"})
    moved = replace(recorded, position=recorded.position + np.array([0.1, -0.1]))
    moving = replace(moved, position=predict(TRUE, moved))
    done = identify_recordings([moving], TRUE, free=["maa.area", "maa.stiffness", "baa.area"], folds=0)
    width = dict(zip(done.fit.parameters.names, done.fit.uncertainty.half_width, strict=True))
    assert np.isinf(width["maa.area"]) and np.isinf(width["baa.area"]) and np.isfinite(width["maa.stiffness"])
    blind = [t for t in done.fit.uncertainty.trade_offs if t.correlation is None]
    assert sorted(name for t in blind for name in t.weights) == ["baa.area", "maa.area"] and len(blind) == 2
    assert str(blind[0]).endswith("is not identifiable from these data")
    assert done.fit.theta == pytest.approx(values(TRUE, done.fit.parameters.names), rel=1e-6), "they stay"
    rows = {row["name"]: row for row in done.to_dict()["parameters"]}
    assert rows["maa.area"]["low"] is None and rows["maa.stiffness"]["low"] is not None
    nan = np.isnan(done.fit.uncertainty.correlation)
    assert nan.sum() == 8, "all but the stiffness with itself"


def test_forces_are_known_up_to_a_common_factor_only() -> None:
    """Poses at rest do not change when every stiffness, area and weight is doubled."""
    names = ["maa.stiffness", "baa.stiffness", "maa.area", "baa.area", "gravity"]
    done = identify_poses(poses_of(TRUE), TRUE, free=names)
    assert np.all(np.isinf(done.fit.uncertainty.half_width))
    (blind,) = [t for t in done.fit.uncertainty.trade_offs if t.correlation is None]
    assert set(blind.weights) == set(names)
    assert list(blind.weights.values()) == pytest.approx([1.0] * 5, rel=1e-3)
    assert "at once makes no difference at all" in str(blind) and "+10 %" in str(blind)


def test_a_strong_trade_off_is_told_with_its_direction() -> None:
    """Stiffness and rest length of a spring whose length hardly changes: k·(l − l0) is what is seen."""
    small = [trial(((10e3, 5e3), (10.5e3, 5.2e3)), noise=1e-4)]
    done = identify_recordings(small, TRUE, free=["maa.stiffness", "maa.rest_length"], folds=0)
    (trade,) = done.fit.uncertainty.trade_offs
    assert trade.correlation is not None and abs(trade.correlation) > 0.9
    kinematics = Kinematics(TRUE.morphology)
    length = kinematics.lengths(small[0].position.mean(axis=0))[0]
    spring = TRUE.parameters()["maa.rest_length"]
    expected = (length - spring) / spring  # d l0 / l0 for d k / k = 1 at a constant k·(l − l0)
    ratio = trade.weights["maa.rest_length"] / trade.weights["maa.stiffness"]
    assert ratio == pytest.approx(expected, rel=0.1)
    assert "makes hardly any difference (correlation" in str(trade)


# Bounds, windows, starts.


def test_bounds_hold_and_are_marked() -> None:
    done = identify_recordings(
        trials(),
        TRUE.with_parameters({"maa.stiffness": 250.0}),
        free=["maa.stiffness", "maa.area"],
        bounds={"maa.stiffness": (200, 280)},
        folds=0,
    )
    assert done.fit.theta[0] == 280 and done.fit.at_bound.tolist() == [1, 0]
    stiffness, area = done.to_dict()["parameters"]
    assert stiffness["at_bound"] == "high" and stiffness["bounds"] == [200, 280] and area["at_bound"] is None


def test_shooting_windows_need_no_common_start() -> None:
    done = identify_recordings(trials(1e-4), TRUE.with_parameters({"maa.stiffness": 250.0}), free=["maa.stiffness"],
                               shoot=0.5, folds=0)  # fmt: skip
    assert len(done.segments) == 3 * 4 and all(s.free_start == 4 for s in done.segments)
    assert done.fit.theta == pytest.approx([300.0], rel=0.02)
    assert sum(len(s.measured) for s in done.segments) == sum(len(r.time) for r in trials())


def test_a_wrong_first_measurement_is_mended_by_a_free_start() -> None:
    """The motion began elsewhere than where the first sample says."""
    moved = trial(STEPS[0], noise=1e-4, notes={"settled": "no"})
    wrong = replace(moved, position=np.vstack([moved.position[0] + [0.05, -0.05], moved.position[1:]]))
    fixed, free = (
        identify_recordings([wrong], TRUE, free=["maa.stiffness"], fit_start=start, folds=0) for start in (False, True)
    )
    assert free.fit.rmse[0] < fixed.fit.rmse[0]
    assert np.abs(free.fit.starts[0][:2] - moved.position[0]).max() < 0.5 * 0.05
    assert abs(free.fit.theta[0] - 300) < abs(fixed.fit.theta[0] - 300)


@pytest.mark.parametrize("damping", [1e-3, 0.3])
def test_damped_starts_are_eliminated_as_in_one_large_least_squares_problem(damping: float) -> None:
    """min over β of ‖[r − J δ, w (s − β)] − N β‖² + λ‖D β‖², D the norms of the columns of N, derivatives at random."""
    rng, (start, few) = np.random.default_rng(4), small_problem()
    segments = [replace(s, free_start=4, trust=np.array([0.0, 3.0, 0.5, 1.0])) for s in few]
    problem = Problem(free_parameters(start, FEW), segments, simulator_for(start))
    scale, p = problem.parameters.scale, len(FEW)
    shape = segments[0].measured.shape
    by_theta, by_start = ([rng.normal(size=(*shape, k)) for _ in segments] for k in (p, 4))
    by_theta = [j / scale for j in by_theta]
    off = [s.start + 0.1 * rng.normal(size=4) for s in segments]
    point = Point(problem.parameters.start, off, [rng.normal(size=shape) for _ in segments], 0.0, [])
    slopes = problem.slopes(point, (by_theta, by_start))
    factor, aim = slopes.damped(damping)
    told, wanted = [], []
    for change in rng.normal(size=(3, p)):
        least, moved = 0.0, problem.moved_starts(point, slopes, change, damping)[0]
        for k, segment in enumerate(segments):
            weights = np.diag(segment.start_weights)
            n = np.vstack([by_start[k].reshape(-1, 4), weights])
            left = (point.residuals[k] - by_theta[k] * scale @ change).ravel()
            r = np.concatenate([left, weights @ (segment.start - off[k])])
            system = np.vstack([n, np.sqrt(damping) * np.diag(np.linalg.norm(n, axis=0))])
            target = np.append(r, np.zeros(4))
            best = np.linalg.lstsq(system, target, rcond=None)[0]
            least += float(((target - system @ best) ** 2).sum())
            assert moved[k] - off[k] == pytest.approx(best, rel=1e-9)
        told.append(float(((aim - factor @ change) ** 2).sum()))
        wanted.append(least)
    # But for what neither parameters nor starts can change.
    assert np.diff(told) == pytest.approx(np.diff(wanted), rel=1e-9)


def test_only_the_window_counts_but_the_motion_is_simulated_from_the_beginning() -> None:
    spoiled = trials()[0]
    position = np.array(spoiled.position)
    position[(spoiled.time > 0.3) & (spoiled.time < 0.7)] += 0.5
    start = TRUE.with_parameters({"maa.stiffness": 280.0})
    done = identify_recordings([replace(spoiled, position=position)], start, free=["maa.stiffness"], window=(0.8, 2))
    assert done.fit.theta == pytest.approx([300.0], rel=1e-4) and done.check is None


def test_trials_are_chosen_by_name_and_those_fitted_are_not_held_out() -> None:
    done = identify_recordings(
        trials(), TRUE, free=["maa.stiffness"], select=["trial_1*", "trial_5000_*"], heldout=trials(), folds=0
    )
    assert [r.name for r in done.recordings] == ["trial_10000_5000", "trial_5000_15000"]
    assert [h.name for h in done.heldout] == ["trial_20000_3000"]


# The same every time.


def test_the_same_bits_whatever_the_threads() -> None:
    settings = FitSettings(steps=3)
    runs = [
        identify_recordings(trials(0.001), free=FEW, threads=threads, folds=2, settings=settings)
        for threads in (1, 2, 2)
    ]
    for other in runs[1:]:
        assert np.array_equal(runs[0].fit.theta, other.fit.theta)
        assert np.array_equal(runs[0].fit.uncertainty.half_width, other.fit.uncertainty.half_width)
        assert runs[0].check is not None and other.check is not None
        assert np.array_equal(runs[0].check.rmse, other.check.rmse)


def test_progress_goes_up_through_its_stages() -> None:
    told: list[tuple[str, float, float]] = []
    identify_recordings(trials(0.001), free=FEW, folds=2, progress=lambda *step: told.append(step))
    shares = [share for _, share, _ in told]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 1
    assert list(dict.fromkeys(stage for stage, _, _ in told)) == ["compiling", "search", "cross-check", "done"]
    best = [b for _, _, b in told if b == b]
    assert (
        max(after - before for before, after in pairwise(best)) < 1e-12 * best[0]
    )  # costs never rise, but are rounded


def test_fewer_than_two_recordings_or_folds_are_not_cross_checked() -> None:
    segments = cut(TRUE, trials()[:1])
    simulator = simulator_of("reduced")
    done = fit(free_parameters(TRUE, ["maa.stiffness"]), segments, simulator=simulator)
    assert cross_check(done, segments, simulator, 4) is None


# Poses at rest.


def poses_of(model: Model, noise: float = 0.0) -> StaticPoses:
    grid = np.array([(a, b) for a in (0, 8e3, 16e3, 24e3) for b in (0, 5e3, 10e3)])
    kinematics = Kinematics(model.morphology)
    angles = np.array([kinematics.equilibrium(p) for p in grid])
    low, high = model.morphology.joint_range
    clear = np.all((angles > low + 0.1) & (angles < high - 0.1), axis=1)
    assert clear.sum() >= 9
    spread = np.random.default_rng(2).normal(0, noise, angles.shape) if noise else 0.0
    return StaticPoses("made_up", grid[clear], (angles + spread)[clear])


def test_poses_at_rest_give_stiffness_area_and_rest_length() -> None:
    done = identify_poses(poses_of(TRUE))
    assert done.fit.parameters.names and set(done.fit.parameters.names) == set(static_names(NOMINAL))
    assert done.fit.theta == pytest.approx(values(TRUE, done.fit.parameters.names), rel=1e-4)
    assert np.abs(done.fit.residuals).max() < 1e-6 and np.abs(done.fit.heldout).max() < 1e-4
    assert np.abs(done.fit.pressure_error).max() < 1.0
    data = done.to_dict()
    assert data["rmse_rad"]["after_together"] < 1e-6 < data["rmse_rad"]["before_together"]


@pytest.mark.parametrize(("bounds", "end", "side"), [((320.0, 400.0), 320.0, -1), ((200.0, 280.0), 280.0, 1)])
def test_a_bound_that_holds_poses_back_is_marked(bounds: tuple[float, float], end: float, side: int) -> None:
    """The truth is 300 N/m; of 280 to 320 it is inside."""
    start = TRUE.with_parameters({"maa.stiffness": sum(bounds) / 2})
    done = identify_poses(poses_of(TRUE), start, free=["maa.stiffness"], bounds={"maa.stiffness": bounds}, folds=0)
    assert done.fit.theta[0] == pytest.approx(end, rel=1e-6) and done.fit.at_bound.tolist() == [side]
    free = identify_poses(poses_of(TRUE), TRUE, free=["maa.stiffness"], bounds={"maa.stiffness": (280, 320)}, folds=0)
    assert free.fit.at_bound.tolist() == [0]


@pytest.mark.slow
def test_noisy_poses_are_explained_to_the_noise_and_the_truth_is_inside() -> None:
    done = identify_poses(poses_of(TRUE, 0.002), heldout=[poses_of(TRUE)])
    assert np.all(done.fit.rmse < 0.003)
    assert np.all(
        np.abs(done.fit.theta - values(TRUE, done.fit.parameters.names)) <= 1.5 * done.fit.uncertainty.half_width
    )
    assert joint_rmse([done.fit.heldout]).max() > joint_rmse([done.fit.residuals]).max()
    assert np.all(joint_rmse([done.heldout[0].after]) < 0.004)


@pytest.mark.slow
def test_the_real_poses(leg_dir: Path) -> None:
    """Published: 0.0203 and 0.0416 rad over 36 poses, 0.0170 and 0.0566 over 13."""
    for count, limits in ((36, (0.0203, 0.0416)), (13, (0.0170, 0.0566))):
        done = identify_poses(leg_dir / f"static_poses_{count}.csv")
        assert len(done.poses.pressure) == count and np.all(done.fit.rmse < limits)
        assert np.isnan(done.fit.pressure_error).any() == (count == 36), "some of the 36 lean on the knee's stop"


def test_rest_poses_are_those_of_the_kinematics() -> None:
    pressure = np.array([[0, 0], [12e3, 6e3], [30e3, 2e3], [50e3, 50e3]])
    found = rest_poses(TRUE, pressure, np.tile([1.4, 0.5], (4, 1)))
    kinematics = Kinematics(TRUE.morphology)
    assert found.found.all() and not found.unstable.any()
    assert found.angles == pytest.approx(np.array([kinematics.equilibrium(p) for p in pressure]), abs=1e-8)


def test_the_slope_of_rest_poses_by_parameters() -> None:
    pressure = np.array([[12e3, 6e3], [30e3, 2e3]])
    guess = rest_poses(TRUE, pressure, np.tile([1.4, 0.5], (2, 1)))
    free = free_parameters(TRUE, ["maa.stiffness", "baa.rest_length"])
    slopes = statics._by_theta(free, free.start, guess)
    for k, step in enumerate((1e-2, 1e-6)):
        ends = [
            rest_poses(free.model_at(free.start + sign * step * np.eye(2)[k]), pressure, guess.angles).position
            for sign in (-1, 1)
        ]
        assert slopes[:, :, k] == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-4, abs=1e-9)


def test_an_equilibrium_that_does_not_last_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pendulum standing upright rests until it is touched; one on its way rests nowhere yet."""
    model = Model(pendulum())
    found = rest_poses(model, np.zeros((2, 1)), np.array([[-np.pi / 2], [1.3]]))
    assert found.found.tolist() == [False, True] and found.unstable.tolist() == [True, False]
    assert found.angles[1] == pytest.approx(np.pi / 2) and np.all(found.by_parameter[0] == 0)
    monkeypatch.setattr(statics, "NEWTON_STEPS", 1)
    stopped = rest_poses(model, np.zeros((1, 1)), np.array([[0.3]]))
    assert not stopped.found.any() and not stopped.unstable.any()


# What cannot be.


CASES: list[tuple[dict[str, Any], str]] = [
    ({"free": ["maa.stifness"]}, "there is no parameter 'maa.stifness'; did you mean 'maa.stiffness'?"),
    ({"fix": ["*"]}, "nominal_leg: no parameter is free, so there is nothing to identify"),
    ({"fix": ["maa.stifness"]}, "there is no parameter 'maa.stifness'"),
    ({"free": FEW, "bounds": {"maa.area": (1e-4, 1e-3)}}, "bounds: there is no free parameter 'maa.area'"),
    ({"bounds": {"maa.area": (1e-3, 1e-4)}}, "bounds of maa.area are 0.001 to 0.0001, expected the lower one first"),
    ({"bounds": {"maa.area": (1e-3, 2e-3)}}, "maa.area is 0.000403 m² in the model, outside its bounds 0.001 to 0.002"),
    ({"bounds": {"maa.area": (0, np.inf)}}, "bounds of maa.area are 0 to inf, expected finite numbers"),
    ({"window": (1.9, 2.0)}, "has 6 samples between 1.9 and 2 s, too few to identify from; expected at least 10"),
    ({"window": (5, 1)}, "has 0 samples between 5 and 1 s"),
    ({"shoot": 0.01}, "shooting intervals of 0.01 s are too short"),
    ({"shoot": 0.1}, "no shooting interval of 0.1 s holds 10 samples; expected at least 0.33 s"),
    ({"engine": "mujoko"}, "there is no engine 'mujoko'; did you mean 'mujoco'?"),
    ({"dt": 0.0}, "the physics step is 0 s, expected more than 0"),
    ({"select": ["trial_9*"]}, "there is no trial 'trial_9*'"),
    ({"heldout": trials()[:1]}, "every trial held out takes part in the fit too"),
]


@pytest.mark.parametrize(("options", "said"), CASES, ids=[str(o)[:60] for o, _ in CASES])
def test_one_sentence_says_what_cannot_be(options: dict[str, Any], said: str) -> None:
    with pytest.raises(EquimusError) as caught:
        identify_recordings(trials()[:1], **options)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_more_unknowns_than_angles() -> None:
    short = cut(TRUE, trials()[:1], window=(0.0, 0.16))
    with pytest.raises(ConfigError, match="20 measured angles are too few for 21 unknowns"):
        fit(free_parameters(TRUE, list(TRUE.parameters())[:21]), short)


def test_too_few_poses() -> None:
    few = poses_of(TRUE)
    with pytest.raises(ConfigError, match="3 poses are too few to identify 6 parameters from; expected more than 3"):
        identify_poses(StaticPoses("few", few.pressure[:3], few.position[:3]))


def test_a_model_that_diverges_everywhere() -> None:
    stiff = NOMINAL.with_parameters({"hip.damping": 1e4})
    with pytest.raises(SimulationDiverged, match="diverges on every trial with the initial model"):
        identify_recordings(trials()[:1], stiff, free=["knee.damping"])


def test_recordings_of_another_robot() -> None:
    with pytest.raises(ConfigError, match="has joints hip, knee and actuators maa, baa, but the model pendulum"):
        identify_recordings(trials()[:1], Model(pendulum()))


def test_files_of_the_leg_are_read(leg_dir: Path) -> None:
    names = [trial.name for trial in read_set(leg_dir / "step_release.csv")]
    assert "step_release_p30_20" in names


# --- the comparison with differential evolution -----------------------------------------------------------------


def test_the_evolution_of_the_benchmark_goes_downhill() -> None:
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "identify.py"
    spec = importlib.util.spec_from_file_location("benchmark_identify", path)
    assert spec is not None and spec.loader is not None
    benchmark = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = benchmark
    spec.loader.exec_module(benchmark)
    some = trials()[:2]
    parameters = free_parameters(NOMINAL, ["knee.damping", "baa.stiffness"])
    segments = cut(NOMINAL, some)
    found = benchmark.evolution(parameters, segments, 0.3, 0)
    assert found.evaluations[-1] >= 10
    assert np.isfinite(found.cost[-1]) and found.cost[-1] <= found.cost[0]
