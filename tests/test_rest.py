"""Where a robot rests with all its effects, and that plants and recordings begin there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from morphologies import pendulum
from test_catalogue import CASES, LEG, effect_of

from equimus_ctrl import recordings
from equimus_ctrl.cli.main import main
from equimus_ctrl.effects import (
    Effect,
    ForceEffect,
    GravityTilt,
    NonlinearStiffness,
    ParallelSpring,
    make,
    parameter,
    register,
)
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.tuning.ensemble import make_ensemble
from equimus_ctrl.tuning.study import EnsembleSettings
from equimus_ctrl.types import Array, Start

COMMAND = np.array([15e3, 9e3])


@dataclass(frozen=True)
class Push(ForceEffect):
    name = "constant_push"
    sits_at = ("joint", "actuator")
    summary = "pushes always alike"
    neutral = {"size": 0.0}  # noqa: RUF012
    size: float = parameter("N·m | N", -100.0, 100.0, "of the push")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Any, p: Any) -> ca.SX:
        return p["size"]


TOGETHER = (
    ParallelSpring("hip", stiffness=0.4, rest=0.9),
    ParallelSpring("knee", stiffness=0.2, rest=0.1),
    NonlinearStiffness("maa", cubic=3e4, centre=0.21),
    make("narrowing_area", "baa", {"loss": 0.5}),
    make("dead_zone", "maa", {"threshold": 2e3}),
    make("supply_coupling", "baa", {"share": 0.2}),
    make("cutoff", "maa", {"least": 1e3}),
    make("filling_flow", "baa", {"rate": 2e4, "power": 1.0}),
    make("creep", "baa", {"stiffness": 100.0, "time_constant": 0.5}),
    make("hysteresis", "maa", {"size": 1.0, "width": 0.01}),
    make("payload_mass", "foot", {"mass": 0.05}),
    GravityTilt("base", angle=0.1),
)


def moved(model: Model, command: Array) -> float:
    """How far a plant strays from where its reset put it, within 2 s under a constant command [rad]."""
    plant = MujocoPlant(model)
    plant.reset(Start(command=command))
    first, farthest = plant.position, 0.0
    for _ in range(240):
        plant.step(command)
        farthest = max(farthest, float(np.abs(plant.position - first).max()))
    return farthest


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_a_plant_begins_at_rest_with_every_effect(name: str, kind: str) -> None:
    assert moved(Model(LEG, (effect_of(name, kind),)), COMMAND) < 1e-5


def test_a_leg_that_stands_by_its_springs_alone() -> None:
    command = COMMAND / 5
    with pytest.raises(ModelError, match="no pose at rest"):
        rest_pose(Model(LEG, phase="stance"), command)
    springs = tuple(ParallelSpring(joint, stiffness=40.0, rest=rest) for joint, rest in (("hip", 1.6), ("knee", 0.2)))
    assert moved(Model(LEG, springs, "stance"), command) < 1e-5


@pytest.mark.parametrize("command", [(0.0, 0.0), (15e3, 9e3), (30e3, 20e3)])
def test_and_with_many_at_once(command: tuple[float, float]) -> None:
    register(Push)
    effects = (*TOGETHER, Push("knee", size=0.1), Push("baa", size=-1.0))
    assert moved(Model(LEG, effects), np.array(command)) < 1e-5


def test_a_pendulum_on_a_spring_by_hand() -> None:
    """m g l cos q (gravity pulls towards q = π/2) against −k (q − rest)."""
    robot = pendulum()
    spring = ParallelSpring(robot.joint_names[0], stiffness=0.7, rest=0.4)
    (q,) = rest_pose(Model(robot, (spring,)), np.zeros(len(robot.actuators)))
    torque, _ = Kinematics(robot).rest_torque([q], np.zeros(len(robot.actuators)))
    assert torque[0] == pytest.approx(0.7 * (q - 0.4), abs=1e-9)
    assert abs(q - 0.4) > 0.01


def test_where_a_leg_rests_each_area_is_that_of_its_length() -> None:
    losses = np.array([1.0, -0.5])
    q = rest_pose(
        Model(LEG, tuple(make("narrowing_area", n, {"loss": x}) for n, x in zip(("maa", "baa"), losses, strict=True))),
        COMMAND,
    )
    kinematics = Kinematics(LEG)
    gained = kinematics.lengths(q) / [a.rest_length for a in LEG.actuators] - 1
    np.testing.assert_allclose(kinematics.rest_torque(q, COMMAND / (1 + losses * gained))[0], 0.0, atol=1e-9)
    assert np.abs(kinematics.rest_torque(q, COMMAND)[0]).max() > 0.01


def test_nothing_is_left_to_move_the_joints() -> None:
    register(Push)
    model = Model(LEG, (ParallelSpring("knee", stiffness=0.3, rest=0.9), Push("maa", size=2.0)))
    q = rest_pose(model, COMMAND)
    kinematics = Kinematics(LEG)
    left = kinematics.rest_torque(q, COMMAND)[0] + kinematics.jacobian(q).T @ [2.0, 0.0]
    np.testing.assert_allclose(left + np.array([0.0, -0.3 * (q[1] - 0.9)]), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (make("coulomb_friction", "knee", {"friction": 0.1}),),
        (make("creep", "baa", {"stiffness": 100.0, "time_constant": 0.5}),),
        (make("hysteresis", "maa", {"size": 1.0, "width": 0.01}), make("sensor_offset", "hip", {"offset": 0.1})),
        (ParallelSpring("knee", stiffness=0.0, rest=0.9),),
    ],
)
def test_what_does_not_push_changes_no_bit(effects: tuple[Effect, ...]) -> None:
    assert rest_pose(Model(LEG, effects), COMMAND).tobytes() == Kinematics(LEG).equilibrium(COMMAND).tobytes()


@dataclass(frozen=True)
class Snap(ForceEffect):
    name = "snap_spring"
    sits_at = ("joint",)
    summary = "a spring that is at rest on either side of its middle"
    neutral = {"stiffness": 0.0}  # noqa: RUF012
    stiffness: float = parameter("N·m/rad", 0.0, 100.0, "in the middle, where it pushes away")
    middle: float = parameter("rad", -6.3, 6.3, "where it pushes nowhere")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Any, p: Any) -> ca.SX:
        away = x - p["middle"]
        return p["stiffness"] * (away - 10 * away**3)


def test_where_there_are_several_it_is_a_stable_one() -> None:
    """The pose nearest to where the leg would hang is where the spring pushes away."""
    register(Snap)
    knee = float(Kinematics(LEG).equilibrium(COMMAND)[1])
    for off in (0.02, -0.02):
        model = Model(LEG, (Snap("knee", stiffness=5.0, middle=knee + off),))
        assert abs(rest_pose(model, COMMAND)[1] - knee) > 0.1
        assert moved(model, COMMAND) < 1e-5


def test_where_there_is_none_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("equimus_ctrl.engines.rest.SINKING", 1.0)  # it turns ever faster, for a minute otherwise
    register(Push)
    robot = pendulum()
    pushed = Model(robot, (Push(robot.joint_names[0], size=100.0),))
    with pytest.raises(ModelError) as caught:
        rest_pose(pushed, np.zeros(len(robot.actuators)))
    assert str(caught.value).startswith(f"{robot.name}: no pose at rest was found under pressures of ")
    assert str(caught.value).endswith(" kPa and its force effects")


def test_legs_of_an_ensemble_rest_with_their_effects() -> None:
    model = Model(LEG, TOGETHER)
    for leg in make_ensemble(model, EnsembleSettings(), 4, 1):
        q = leg.rest(COMMAND, "swing")
        assert moved(Model(leg.morphology, leg.effects), COMMAND) < 1e-5
        np.testing.assert_allclose(rest_pose(Model(leg.morphology, leg.effects), COMMAND), q, atol=1e-12)
    own = make_ensemble(model, EnsembleSettings(), 1, 1)[0]
    np.testing.assert_allclose(own.rest(COMMAND, "swing"), rest_pose(model, COMMAND), atol=1e-12)


@pytest.mark.parametrize(
    "effect",
    ["parallel_spring:knee:stiffness=0.1,rest=0.5", "nonlinear_stiffness:maa:cubic=3e4,centre=0.2"],
)
def test_a_recorded_run_begins_at_rest(effect: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["run", "chirp", "--effect", effect, "--record", "rec", "--no-figures", "--set", "duration=4"]) == 0
    (trial,) = recordings.read_set([Path("rec")])
    # The sweep begins slowly: what is not at rest moves a hundred times as far within the first period.
    assert np.abs(trial.position[1] - trial.position[0]).max() < 1e-7
    assert np.ptp(trial.position, axis=0).min() > 0.1
