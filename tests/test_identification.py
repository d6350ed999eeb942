"""Identification: what was put into simulated recordings is found again."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identified_leg import FEW, NOMINAL, STEPS, TRUE, small_problem, trial, trials, values
from morphologies import pendulum

from equimus_ctrl.effects import TransportDelay
from equimus_ctrl.errors import ConfigError, EquimusError, SimulationDiverged
from equimus_ctrl.identification.crosscheck import cross_check
from equimus_ctrl.identification.fit import FitSettings, fit
from equimus_ctrl.identification.parameters import default_names, free_parameters, unit_of
from equimus_ctrl.identification.problem import Point, Problem
from equimus_ctrl.identification.residuals import joint_rmse
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import simulator_for
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import read_set
from equimus_ctrl.workflow import identify_recordings, simulator_of


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
    # Costs never rise; their share that is no distance of starts from measured ones may, by a little.
    assert max(after - before for before, after in pairwise(best)) < 1e-4 * best[0]


def test_fewer_than_two_recordings_or_folds_are_not_cross_checked() -> None:
    segments = cut(TRUE, trials()[:1])
    simulator = simulator_of("reduced")
    done = fit(free_parameters(TRUE, ["maa.stiffness"]), segments, simulator=simulator)
    assert cross_check(done, segments, simulator, 4) is None


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
