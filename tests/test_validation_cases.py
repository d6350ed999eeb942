"""The cases of the validation: they pass for a right engine, and a wrong one does not get by."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from equimus_ctrl.effects import PayloadMass, TransportDelay
from equimus_ctrl.engines import mujoco_batch
from equimus_ctrl.engines.mujoco_batch import MujocoBatch
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import place
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.presets import json_text
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.validation import conservation, static
from equimus_ctrl.validation import validate as whole
from equimus_ctrl.validation.conservation import conservation_case
from equimus_ctrl.validation.engines import finer, mujoco_equilibrium, mujoco_runs, native_runs
from equimus_ctrl.validation.experiment import Experiment, any_force
from equimus_ctrl.validation.plan import ACCURACY_GOALS, QUICK, STAGES, Errors, Plan
from equimus_ctrl.validation.poses import holding_pressure, workspace
from equimus_ctrl.validation.reference import integrate
from equimus_ctrl.validation.responses import stance_case
from equimus_ctrl.validation.static import native_static, static_case
from equimus_ctrl.validation.validate import Validation, validate

TINY = Plan(
    poses=12, pairs=40, duration=0.5, stance_runs=3, three_dof_robots=1, robots_per_shape=1,
    runs_per_robot=1, robot_duration=0.25, more_kernels=False, conserving=1.0, checked=2, checked_robots=0, front=0,
    timed=4, timed_on_stops=2, repeats=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def found() -> Validation:
    return validate(nominal_model(), TINY, 3)


def steps(m: Morphology, n: int = 8, duration: float = 0.5) -> tuple[Experiment, np.ndarray]:
    low, high = workspace(m)
    start = np.random.default_rng(1).uniform(low + 0.2, high - 0.2, (n, 2))
    pressure, _ = holding_pressure(m, start[::-1])
    runs = Experiment((any_force(m.without_stops()),), "swing", start, np.zeros(1), pressure[:, None], duration)
    return runs, integrate(runs)[0]


def heavier(m: Morphology, share: float = 0.01) -> Morphology:
    return m.with_parameters({key: (1 + share) * v for key, v in m.parameters().items() if key == "baa.mass"})


def test_a_mass_wrong_by_one_percent_is_an_error_above_every_goal() -> None:
    m = nominal_leg()
    runs, exact = steps(m)
    right = Errors.of(mujoco_runs(runs) - exact)
    assert right.rmse.max() < ACCURACY_GOALS["swing"]
    wrong = replace(runs, morphologies=(heavier(runs.morphologies[0]),))
    assert Errors.of(mujoco_runs(wrong) - exact).rmse.max() > ACCURACY_GOALS["swing"]


def test_static_catches_a_wrong_mass_too(monkeypatch: pytest.MonkeyPatch) -> None:
    m = nominal_leg()
    right = static_case(m, 8, np.random.default_rng(0))
    assert right.errors.rmse.max() < ACCURACY_GOALS["static"]
    assert right.counts["scored"] == 8 and right.moving < static.RESTING
    monkeypatch.setattr(static, "holding_pressure", lambda robot, poses: holding_pressure(heavier(robot), poses))
    wrong = static_case(m, 8, np.random.default_rng(0))
    assert wrong.errors.rmse.max() > 10 * ACCURACY_GOALS["static"]


def test_an_engine_that_stands_still_does_not_pass_the_static_case(monkeypatch: pytest.MonkeyPatch) -> None:
    def stand(self: MujocoBatch, q0: np.ndarray, v0: np.ndarray, pressure: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        still = np.repeat(q0[:, None], pressure.shape[1] + 1, axis=1)
        return still, np.zeros_like(still)

    monkeypatch.setattr(MujocoBatch, "run", stand)
    assert static_case(nominal_leg(), 4, np.random.default_rng(0)).errors.rmse.min() > 0.005


def test_poses_that_a_simulation_would_leave_are_found_by_newton(monkeypatch: pytest.MonkeyPatch) -> None:
    """With every pose counted as unstable: the same resting angles as by waiting."""
    m = nominal_leg()
    waited = static_case(m, 4, np.random.default_rng(0))
    monkeypatch.setattr(static, "SLOWEST", 1e9)
    solved = static_case(m, 4, np.random.default_rng(0))
    assert solved.counts["unstable_by_newton"] == 4
    np.testing.assert_allclose(solved.resting, waited.resting, atol=2 * static.RESTING)
    assert not np.array_equal(solved.resting, waited.resting)


def test_newton_holds_an_upright_pendulum_that_falls_when_simulated() -> None:
    m = replace(any_force(nominal_leg().without_stops()), gravity=30.0)
    m = m.with_parameters({"maa.stiffness": 0.0, "baa.stiffness": 0.0})
    pose = np.array([[-1.2, 0.3]])  # both links point up
    pressure, _ = holding_pressure(m, pose)
    batch = MujocoBatch(m)
    data = mujoco.MjData(batch.mujoco_model)
    place(batch.mujoco_model, data, Kinematics(m), pose[0] + 1e-3)
    assert mujoco_equilibrium(batch, data, pressure[0]) < 1e-4
    found = [data.joint(name).qpos[0] for name in m.joint_names]
    np.testing.assert_allclose(found, pose[0], atol=1e-6)
    q, _ = batch.run(pose + 1e-3, np.zeros((1, 2)), np.repeat(pressure[:, None], 360, axis=1))
    assert not np.abs(q[0, -1] - pose[0]).max() < 0.1


def test_a_robot_that_cannot_hold_a_pose_is_refused_in_a_sentence() -> None:
    m = nominal_leg()
    with pytest.raises(ConfigError, match="none of 5 random poses can be held by its 1 actuators on 2 joints"):
        static_case(replace(m, actuators=m.actuators[:1]), 5, np.random.default_rng(0))


def test_the_baseline_differs_from_the_element_by_its_mass_alone() -> None:
    """With nearly no mass in the actuators it is as good as any; with their mass it is not."""
    m = nominal_leg()
    light = m.with_parameters({"maa.mass": 1e-7, "baa.mass": 1e-7, "maa.damping": 2.0, "baa.damping": 2.0})
    runs, exact = steps(light)
    assert Errors.of(native_runs(runs) - exact).rmse.max() < ACCURACY_GOALS["swing"]
    runs, exact = steps(m)
    assert Errors.of(native_runs(runs) - exact).rmse.max() > 0.03
    assert native_static(static_case(m, 4, np.random.default_rng(0)), m, 4).rmse.max() > 0.05


def test_the_baseline_has_the_same_stops() -> None:
    m = nominal_leg().with_parameters({"maa.mass": 1e-7, "baa.mass": 1e-7, "maa.damping": 2.0, "baa.damping": 2.0})
    runs = Experiment((m,), "swing", np.array([[1.5, 0.05]]), np.zeros(1), np.array([[[0.0, 4e4]]]), 1.0)
    q = native_runs(runs, finer(10))  # a stop is stiffer than the usual step resolves
    exact, _ = integrate(runs, rtol=1e-8, atol=1e-10)
    assert exact[..., 1].min() < -0.036  # pressed
    np.testing.assert_allclose(q[0], exact[0], atol=5e-4)


@pytest.mark.slow
def test_conservation_sees_damping_that_should_not_be_there(monkeypatch: pytest.MonkeyPatch) -> None:
    m, plan = nominal_leg(), replace(TINY, conserving=2.0, more_kernels=True)
    kept = conservation_case(m, plan, np.random.default_rng(0))
    for drifts in (kept.energy, kept.momentum, kept.work):
        assert drifts["mujoco"].largest < 2e-3
        assert drifts["reduced"].largest < 1e-6
    leaky = {"hip.damping": 1e-4}
    monkeypatch.setattr(conservation, "undamped", lambda robot: whole_undamped(robot).with_parameters(leaky))
    lost = conservation_case(m, plan, np.random.default_rng(0))
    assert lost.energy["reduced"].largest > 1e-4


def whole_undamped(robot: Morphology) -> Morphology:
    from equimus_ctrl.validation.experiment import undamped

    return undamped(robot)


def test_errors_do_not_hide_a_divergence() -> None:
    error = np.full((3, 5, 2), 1e-5)
    error[1, 3:, 0] = np.nan
    found = Errors.of(error)
    assert found.rmse[0] == np.inf and found.rmse[1] == pytest.approx(1e-5)
    assert np.isnan(Errors.of(error[:0]).rmse).all()


@pytest.mark.slow
def test_a_whole_validation_meets_the_goals(found: Validation) -> None:
    assert found.accurate
    assert not found.swing.touching.any()
    none = {"swing_on_stops", "reduced_swing_on_stops", "reduced_stance"}
    assert [goal.name for goal in found.accuracy] == [name for name in ACCURACY_GOALS if name not in none]
    assert found.baseline.static.rmse.max() > 100 * found.static.errors.rmse.max()
    assert found.swing.reference_error < 1e-8
    counts = found.swing.counts
    assert counts["pairs"] == 40 and counts["scored"] > 0
    assert sum(counts[key] for key in ("pressure_out_of_range", "actuator_too_short", "scored")) == 40
    stance = found.stance.robot
    assert stance.counts == {"runs": 3, "actuator_too_short": 0, "scored": 3, "touching_a_stop": 3}
    assert stance.reference_error < 1e-6


@pytest.mark.slow
def test_a_goal_that_is_missed_is_said(found: Validation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ACCURACY_GOALS, "stance", 1e-12)
    assert not found.accurate
    assert [goal.name for goal in found.accuracy if not goal.met] == ["stance"]


@pytest.mark.slow
def test_runs_that_touch_a_stop_are_judged_apart_too(found: Validation) -> None:
    """One bad run among many that are good meets the goal of all together, but not that of its kind."""
    case = found.swing
    touching = np.cumsum(case.scored) == 1
    off = case.exact + np.where(touching & case.scored, 3e-4, 0.0)[:, None, None]
    hit = replace(found, swing=replace(case, touching=touching, found={**case.found, "mujoco": off}))
    missed = {goal.name: goal.value for goal in hit.accuracy if not goal.met}
    assert missed == {"swing_on_stops": pytest.approx(3e-4, rel=1e-6)}
    assert hit.swing.clear.sum() == case.scored.sum() - 1
    record = hit.to_dict()["swing"]
    assert record["on_stops"]["mujoco"]["runs"] == 1 and record["runs"] == case.scored.sum()


@pytest.mark.slow
def test_an_engine_whose_steps_do_not_follow_stops_misses_the_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    right = stance_case(nominal_leg(), TINY, np.random.default_rng(0), 4e-3)
    assert right.errors.rmse.max() < ACCURACY_GOALS["stance"]
    monkeypatch.setattr(mujoco_batch, "near_stop", lambda robots, q, v, dt: np.zeros(len(q), dtype=bool))
    wrong = stance_case(nominal_leg(), TINY, np.random.default_rng(0), 4e-3)
    assert wrong.errors.rmse.max() > ACCURACY_GOALS["stance"]
    assert wrong.published().errors("mujoco").rmse.max() > ACCURACY_GOALS["stance_published"]
    np.testing.assert_array_equal(wrong.free.found["mujoco"], right.free.found["mujoco"])


@pytest.mark.slow
def test_nothing_scored_meets_no_goal(found: Validation) -> None:
    none = replace(found, three_dof=replace(found.three_dof, scored=np.zeros(1, dtype=bool)))
    assert not none.accurate


def without_timings(record: dict[str, Any]) -> str:
    goals = [goal for goal in record["goals"] if goal["name"] in ACCURACY_GOALS]
    return json.dumps({**record, "speed": None, "goals": goals})


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_on_any_number_of_threads(found: Validation) -> None:
    told: list[tuple[str, float, float | None]] = []
    again = validate(nominal_model(), TINY, 3, threads=1, notify=lambda *what: told.append(what))
    assert without_timings(again.to_dict()) == without_timings(found.to_dict())
    assert list(dict.fromkeys(stage for stage, _, _ in told)) == list(STAGES)
    for stage in STAGES:
        shares = [share for name, share, _ in told if name == stage]
        assert shares[0] == 0.0 and shares[-1] == 1.0 and shares == sorted(shares)


@pytest.mark.slow
def test_another_seed_gives_other_poses(found: Validation) -> None:
    other = static_case(nominal_leg(), 12, np.random.default_rng(4))
    assert not np.array_equal(other.poses, found.static.poses)


@pytest.mark.slow
def test_the_record_is_plain_json_with_the_figures_in_their_places(found: Validation) -> None:
    record = json.loads(json_text(found.to_dict()))
    for case, joints in (("static", 2), ("swing", 2), ("stance", 2), ("three_dof", 3)):
        assert len(record[case]["rmse_rad"]) == joints
        assert len(record[case]["max_abs_rad"]) == joints
        assert record[case]["counts"]
    assert record["schema"] == "equimus-ctrl/validation/1"
    assert record["morphologies"]["worst_rmse_rad"] < ACCURACY_GOALS["morphologies"]
    for key in ("mujoco_x_realtime", "mujoco_on_stops_x_realtime", "reduced_x_realtime", "reduced_steps_per_s"):
        assert record["speed"][key] > 0
    assert record["stance"]["published_run"]["runs"] == record["stance"]["without_stops"]["published_run"]["runs"] == 1
    assert set(record["conservation"]) == {"energy", "momentum", "work"}
    assert record["swing"]["engines"]["reduced"]["rmse_rad"]
    assert record["settings"]["mujoco"]["integrator"] == "RK4"


@pytest.mark.slow
def test_effects_on_bodies_take_part_and_others_are_said_to_be_left_out(found: Validation) -> None:
    model = Model(nominal_leg(), (TransportDelay("baa", 0.1), PayloadMass("foot", 0.05)))
    loaded = validate(model, TINY, 3)
    assert loaded.effects_omitted == ("transport_delay at baa",)
    assert loaded.accurate
    assert not np.allclose(loaded.static.pressure, found.static.pressure)


def test_a_seed_below_zero_is_refused() -> None:
    with pytest.raises(ConfigError, match="seed is -1, expected at least 0"):
        validate(nominal_model(), TINY, -1)


def test_the_quick_plan_is_smaller_in_everything() -> None:
    full = Plan()
    assert QUICK.poses < full.poses and QUICK.pairs < full.pairs and QUICK.front == 0
    assert QUICK.robots_per_shape * len(whole.ACCURACY_GOALS) >= 20
