"""Recordings that MuJoCo made: its step's error is told from physics; recordings of finer steps are left alone."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis import simulated as simulated_module
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, with_default_engine
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.simulated import _shown as shown_of
from equimus_ctrl.effects import CoulombFriction
from equimus_ctrl.engines.choice import simulation_of
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow import load_model

XML = PENDULUM.format(drive=MOTOR)
ARM = Model(MjcfRobot("arm", XML, source="arm.xml"))
TWO_JOINTS = Path(__file__).parents[1] / "benchmarks" / "two_joint_arm.xml"
HEAVIER = 1.07
CONTROL = 5
"""Physics steps of the XML between two samples, and between two commands."""


def recorded(noise: float = 0.0, friction: float = 0.0, divided: int = 1, count: int = 3) -> list[Recording]:
    """What MuJoCo does with a heavier arm under sums of two sines, its step divided, by nothing but ``mj_step``."""
    found = []
    for k in range(count):
        rng = np.random.default_rng(k)
        model = mujoco.MjModel.from_xml_string(XML)
        step, model.opt.timestep = model.opt.timestep, model.opt.timestep / divided
        model.body_mass[1] *= HEAVIER
        model.body_inertia[1] *= HEAVIER
        model.dof_frictionloss[0] = friction
        data = mujoco.MjData(model)
        data.qpos[0] = rng.uniform(-0.5, 0.5)
        time = np.arange(400) * CONTROL * step
        command = rng.uniform(0.5, 1.0) * np.sin(2 * np.pi * rng.uniform(0.4, 0.9) * time + rng.uniform(0, 6))
        angle = np.empty_like(time)
        for i, drive in enumerate(command):
            angle[i], data.ctrl[0] = data.qpos[0], drive
            mujoco.mj_step(model, data, CONTROL * divided)
        measured = angle + noise * rng.normal(size=len(angle))
        found.append(Recording(f"t{k}", time, command[:, None], measured[:, None], ("drive",), ("hinge",)))
    return found


@cache
def refitted(divided: int, noise: float) -> tuple[float, float]:
    """λ of the model alone, refitted, and its standard error."""
    parts = split(ARM, recorded(noise, divided=divided), validation=["t2"])
    data = with_default_engine(default_free_parameters(ARM), parts, DiagnosisSettings(threads=1))
    base = data.base()
    engine = simulation_of(ARM)
    assert engine is not None
    found = shown_of(data, base, engine)
    assert found is not None
    return found.share, found.size**-0.5


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_recordings_show_the_step_s_error_once_where_mujoco_made_them(noise: float) -> None:
    shown, error = refitted(1, noise)
    assert abs(shown - 1.0) < 0.01 + 3 * error and (noise == 0.0 or error < 0.2)


@pytest.mark.slow
def test_recordings_of_a_finer_step_show_as_much_of_it_as_their_own_step_has() -> None:
    # A step of first order has an error in proportion to it.
    for divided in (2, 8):
        shown, _ = refitted(divided, 0.0)
        assert shown == pytest.approx(1 / divided, abs=0.02)
    shown, error = refitted(32, 1e-3)
    assert abs(shown) < 1 / 32 + 3 * error


def test_a_hypothesis_that_diverges_where_the_error_is_taken_off_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = split(ARM, recorded(1e-3), validation=["t2"])
    data = with_default_engine(default_free_parameters(ARM), parts, DiagnosisSettings(threads=1))
    search, base = Search(data, ()), data.base()
    made = simulated_module.simulated(search, SearchState(base, base))
    assert made is not None

    def diverges(*args: object) -> None:
        raise SimulationDiverged("it diverges")

    for error in ("_error", "_error_at"):
        monkeypatch.setattr(simulated_module, error, diverges)
    assert simulated_module.simulated(search, SearchState(base, base)) is None
    assert made.settled() is made
    held_out = made.without_error(parts).validation
    assert [own.measured.tolist() for own in held_out] == [own.measured.tolist() for own in parts.validation]


def diagnosed(*args: float, **options: float) -> Diagnosis:
    return workflow.diagnose(recorded(*args, **options), ARM, threads=2)  # type: ignore[arg-type]


def looks_simulated(found: Diagnosis) -> bool:
    return any("look as if MuJoCo had simulated them with a physics step" in n for n in found.notes)


@pytest.mark.slow
def test_of_a_simulation_without_noise_nothing_is_missing_and_its_numbers_are_found() -> None:
    found = diagnosed()
    assert found.verdict == "consistent" and looks_simulated(found)
    assert found.corrected.robot.parameters()["arm.mass"] == pytest.approx(0.6 * HEAVIER, rel=1e-5)
    assert np.all(found.rmse("corrected", "validation") < 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_soft_friction_of_a_simulation_is_dry_friction_and_nothing_beside_it(noise: float) -> None:
    found = diagnosed(noise, 0.05)
    assert found.verdict == "explained" and looks_simulated(found)
    (finding,) = found.findings
    assert str(finding.named) == "coulomb_friction at hinge"
    assert finding.parameters["friction"].value == pytest.approx(0.05, rel=0.01)


@pytest.mark.slow
def test_a_finer_step_than_the_xml_s_is_found_where_there_is_no_noise() -> None:
    found = diagnosed(divided=3)
    assert found.verdict == "consistent" and looks_simulated(found)
    assert found.corrected.robot.parameters()["arm.mass"] == pytest.approx(0.6 * HEAVIER, rel=1e-4)


@pytest.mark.long
@pytest.mark.slow
def test_friction_creeps_in_mujoco_however_short_the_step() -> None:
    found = diagnosed(1e-3, 0.05, divided=32)
    assert [str(f.named) for f in found.findings] == ["coulomb_friction at hinge"] and looks_simulated(found)


@pytest.mark.slow
def test_recordings_without_friction_and_with_hardly_a_step_s_error_are_no_simulation_s() -> None:
    found = diagnosed(1e-3, divided=32)
    assert found.verdict == "consistent" and not looks_simulated(found)


def held(model: Model, friction: float, runs: list[Recording], noise: float = 5e-4) -> list[Recording]:
    """The same commands as plants of this package simulate them, at the XML's own step, with friction that holds."""
    joint = model.robot.joint_names[-1]
    real, engine = replace(model, effects=(CoulombFriction(joint, friction=friction),)), simulation_of(model)
    assert engine is not None
    trials = [Trial(run.name, run.time, run.command, run.command[0], 0.0, run.position[0], run.time) for run in runs]
    starts = [np.concatenate([t.position, np.zeros_like(t.position)])[None] for t in trials]
    made, rng = replace(engine, hard_friction=True).simulate([real], trials, starts), np.random.default_rng(5)
    return [
        replace(run, position=own.position[0] + rng.normal(0, noise, own.position[0].shape))
        for run, own in zip(runs, made, strict=True)
    ]


@pytest.mark.slow
def test_friction_that_holds_is_dry_friction_and_its_step_no_physics() -> None:
    """As plants of this package simulate it, at the XML's own step."""
    found = workflow.diagnose(held(ARM, 0.1, recorded()), ARM, threads=2)
    assert [str(f.named) for f in found.findings] == ["coulomb_friction at hinge"] and looks_simulated(found)
    (finding,) = found.findings
    assert finding.parameters["friction"].value == pytest.approx(0.1, rel=0.01) and not finding.equivalent


@pytest.mark.slow
def test_whether_friction_holds_or_creeps_is_seen_once_there_is_some() -> None:
    """A hypothesis without friction tells a simulation's step error, but not how friction in it stops a joint."""
    arm = load_model(TWO_JOINTS)
    robot, times, runs = arm.robot, np.arange(600) * 0.01, []
    for k in range(2):
        levels = np.random.default_rng(k).uniform(-0.3, 0.3, (8, 2))
        rows = np.repeat(levels - levels[0], 80, axis=0)[:600]
        runs.append(Recording(f"t{k}", times, rows, 0 * rows, robot.actuator_names, robot.joint_names))
    found = workflow.diagnose(held(arm, 0.05, runs), arm, threads=2)
    assert [str(f.named) for f in found.findings] == ["coulomb_friction at elbow"] and looks_simulated(found)
    (finding,), rivals = found.findings, found.rivals
    assert finding.parameters["friction"].value == pytest.approx(0.05, rel=0.02)
    first, *others = (rival.score(rivals.n) for rival in rivals.rivals)
    assert (
        others and min(others) > first - 6
    )  # richer friction laws fit the noise better, by as much as noise lets them
