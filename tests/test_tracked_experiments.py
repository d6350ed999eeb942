"""Experiments with robots that rest under no constant command: their joints track references by feedback."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mjcf_models import cart, refusal
from pendulum_runs import PENDULUM, SERVO
from tracked_arms import ARM, POSE, arm_delays, arm_frictions, arm_limits

import equimus_ctrl as eq
from equimus_ctrl.effects import (
    Backlash,
    CoulombFriction,
    FirstOrderLag,
    MotorDeadZone,
    SensorDelay,
    SensorScale,
    TransportDelay,
)
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.engines.mjcf_tracked import simulate_tracked
from equimus_ctrl.engines.mjcf_tracking import balanced, fed_forward, inertia_and_gains, law_at
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.design import designed
from equimus_ctrl.experiments.families import families
from equimus_ctrl.experiments.first import first_trial
from equimus_ctrl.experiments.ground import Ground
from equimus_ctrl.experiments.predicted import Commands, predicted_recordings, predicted_trials
from equimus_ctrl.experiments.refitting import Target, refitted
from equimus_ctrl.experiments.results import Designed
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import CommandFile, read_commands, write_commands
from equimus_ctrl.report.experiment_figures import design_drawings
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, FeedbackLaw
from equimus_ctrl.workflow.experiments import write_design

PERIOD = 1 / 125


def swing(seconds: float = 1.6) -> tuple[Array, Array]:
    """Instants, and a reference of both joints from the pose and back."""
    times = np.arange(round(seconds / PERIOD)) * PERIOD
    share = np.sin(np.pi * times / times[-1])[:, None] ** 4
    return times, POSE + share * np.array([0.5, -0.4])


def file_of(tmp_path: Path, law: FeedbackLaw) -> tuple[Path, Array, Array]:
    times, reference = swing()
    feed = fed_forward(ARM, times, reference)
    path = tmp_path / "swing.csv"
    own = CommandFile(times, feed, feed[0], POSE, False, {}, reference, law)
    write_commands(path, ARM.robot.actuator_names, own, ARM.robot.joint_names)
    return path, feed, reference


@pytest.mark.slow
def test_joints_go_back_as_critically_damped_systems_do() -> None:
    """A mass under no gravity: e(t) = e₀ (1 + ωt) exp(−ωt), but for samples and the filter."""
    robot, omega = Model(cart()), 2 * np.pi * 0.5
    law = law_at(robot, np.zeros(1), 0.5, 1e-3)
    assert law.stiffness == pytest.approx(2.0 * omega**2) and law.damping == pytest.approx(2 * 2.0 * omega)
    law = replace(law, smoothing=2e-3)
    times = np.arange(2000) * 1e-3
    trial = Trial("back", times, np.zeros((2000, 1)), np.zeros(1), 0.0, np.array([0.1]), times)
    found = simulate_tracked([robot], trial, np.zeros((2000, 1)), law, threads=1)
    wanted = 0.1 * (1 + omega * times) * np.exp(-omega * times)
    assert np.abs(found.predicted.position[0, :, 0] - wanted).max() < 1e-3
    # The first error has no rate, and the command opposes it.
    assert found.command[0, 0, 0] == pytest.approx(-0.1 * law.stiffness[0, 0])


def test_gains_undo_inertia_and_gears() -> None:
    law = law_at(ARM, POSE, 2.0, PERIOD)
    inertia, by_command = inertia_and_gains(realise(ARM), POSE)
    np.testing.assert_allclose(np.linalg.solve(inertia, by_command @ law.stiffness), (4 * np.pi) ** 2 * np.eye(2),
                               atol=1e-6)  # fmt: skip
    np.testing.assert_allclose(by_command, np.diag([1.0, 2.0]), atol=1e-9)


def test_what_is_fed_forward_moves_the_nominal_robot_along_the_reference() -> None:
    times, reference = swing()
    trial = Trial("open", times, fed_forward(ARM, times, reference), np.zeros(2), 0.0, POSE, times)
    none = FeedbackLaw(np.zeros((2, 2)), np.zeros((2, 2)), 0.0)
    moved = simulate_tracked([ARM], trial, reference, none, threads=1).predicted.position[0]
    assert np.ptp(reference, axis=0).min() > 0.35 and np.abs(moved - reference).max() < 0.03


EFFECTS: dict[str, tuple[Effect, ...]] = {
    "none": (),
    "friction": (CoulombFriction("elbow", friction=0.2),),
    "late": (TransportDelay("bend", delay=0.011), FirstOrderLag("lift", time_constant=0.02)),
    "shaped": (MotorDeadZone("bend", threshold=0.1),),
    "sensors": (SensorDelay("elbow", delay=0.013), SensorScale("shoulder", scale=1.02)),
    "play": (Backlash("elbow", play=0.02),),
}


@pytest.mark.parametrize("name", EFFECTS)
def test_the_closed_loop_of_designs_is_that_of_runs(name: str, tmp_path: Path) -> None:
    """The same law, robot and effects in the plant, through a file of references."""
    law = law_at(ARM, POSE, 2.0, PERIOD)
    path, feed, reference = file_of(tmp_path, law)
    done = eq.run_scenario("commands", model=ARM, effects=EFFECTS[name], nominal=ARM, options={"file": str(path)})
    assert done.controller == "tracking" and done.run.reference == pytest.approx(reference[: len(done.run.time)])
    times = swing()[0]
    trial = Trial("closed", times, feed, feed[0], 0.0, POSE, times)
    found = simulate_tracked([replace(ARM, effects=EFFECTS[name])], trial, reference, law, threads=1)
    n = len(done.run.time)
    assert n >= len(times) - 1
    np.testing.assert_allclose(found.command[0, :n], done.run.command, atol=1e-6)
    np.testing.assert_allclose(found.predicted.position[0, :n], done.run.position, atol=1e-7)
    assert np.abs(done.run.position - done.run.reference).max() < 0.2


def test_a_robot_that_begins_elsewhere_does_not_jump(tmp_path: Path) -> None:
    law = law_at(ARM, POSE, 2.0, PERIOD)
    path, *_ = file_of(tmp_path, law)
    text = path.read_text()
    path.write_text(text.replace("start.pos.elbow = -0.7", "start.pos.elbow = 0.9"))
    said = refusal(lambda: eq.run_scenario("commands", model=ARM, options={"file": str(path)}))
    assert "elbow is at 51.57° and its reference begins at -40.11°" in said and "would jump there" in said


def test_a_file_says_the_law_to_the_bit_and_what_it_lacks(tmp_path: Path) -> None:
    law = law_at(ARM, POSE, 2.0, PERIOD)
    path, feed, reference = file_of(tmp_path, law)
    robot = ARM.robot
    found = read_commands(path, robot.actuator_names, robot.joint_names, *robot.command_limits)
    assert found.law is not None and found.reference is not None
    for key in ("stiffness", "damping", "smoothing"):
        assert np.array_equal(getattr(found.law, key), getattr(law, key))
    assert np.array_equal(found.reference, reference) and np.array_equal(found.values, feed)
    text = path.read_text()

    def told(old: str, new: str) -> str:
        assert old in text
        path.write_text(text.replace(old, new, 1))
        return refusal(lambda: read_commands(path, robot.actuator_names, robot.joint_names, *robot.command_limits))

    assert "there is no column 'ref.elbow', though notes track." in told("ref.elbow", "elbow")
    assert "'lift.sholder'; did you mean 'lift.shoulder'?" in told(
        "track.damping.lift.shoulder", "track.damping.lift.sholder"
    )
    assert "did you mean 'track.smoothing'?" in told("track.smoothing", "track.smothing")
    assert "is '-1', expected" not in (said := told(f"smoothing = {law.smoothing!r}", "smoothing = -1"))
    assert "the smoothing of a feedback law is -1 s" in said
    assert "expected a finite number" in told(f"smoothing = {law.smoothing!r}", "smoothing = soon")
    assert "expected both or none" in refusal(lambda: CommandFile(np.zeros(1), feed, feed[0], reference=reference))
    assert "expected both or none" in refusal(lambda: Commands(np.arange(2.0), feed[:2], 3.0, reference=reference[:2]))


def test_what_cannot_be_tracked_is_one_sentence() -> None:
    servo = Model(MjcfRobot("arm", PENDULUM.format(drive=SERVO)))
    assert "is a servo, which tracks by itself" in refusal(lambda: law_at(servo, np.zeros(1), 1.0, PERIOD))
    wide = replace(arm_limits(), joint_low=np.array([-np.inf, -1.0]))
    assert "shoulder, which is to track a reference, has no range of its own; expected shoulder.low" in refusal(
        lambda: wide.reference_bounds(POSE, np.ones(2))
    )


def test_an_acrobot_is_balanced_while_its_driven_joint_follows() -> None:
    """The shoulder has no drive; the pose is upside down."""
    drives = '<actuator><motor name="bend" joint="elbow" gear="2" ctrlrange="-9 9"/></actuator></mujoco>'
    xml = ARM.robot.xml.partition("<actuator>")[0].replace('range="-2.5 2.5"', 'range="-3 3"') + drives  # type: ignore[attr-defined]
    robot = Model(MjcfRobot("acrobot", xml))
    times = np.arange(1500) * 0.004
    reference = np.tile([-np.pi / 2, 0.0], (1500, 1))
    reference[:, 1] = 0.15 * np.sin(np.pi * np.minimum(times / 4.0, 1.0)) ** 2
    reference = balanced(robot, reference)
    assert reference[0, 0] == pytest.approx(-np.pi / 2) and 0.02 < np.ptp(reference[:, 0]) < 0.15
    law = law_at(robot, reference[0], 1.0, 0.004)
    feed = fed_forward(robot, times, reference)
    starts = np.array([[-np.pi / 2 + 0.002, 0.0, 0.0, 0.0]])
    trial = Trial("up", times, feed, feed[0], 0.0, reference[0], times)
    found = simulate_tracked([robot], trial, reference, law, starts=starts, threads=1)
    assert found.predicted.sound.all()
    away = np.abs(found.predicted.position[0] - reference)
    assert away[-100:].max() < 0.005 < 0.15 > away.max()


def test_an_arm_that_rests_nowhere_is_held_by_feedback() -> None:
    rivals = arm_delays()
    ground = Ground.of(rivals, arm_limits(), KnownCondition(), rivals.simulator(1))
    assert ground.law is not None and np.array_equal(ground.rest, POSE)
    (motions,) = ground.crowd([own.model for own in rivals.rivals]).motions([ground.trial(np.tile(POSE, (300, 1)))])
    assert motions.command is not None and motions.command.shape == (2, 300, 2)
    assert np.abs(motions.position - POSE).max() < 0.05
    slower = Ground.of(rivals, arm_limits(), KnownCondition(), rivals.simulator(1), track=1.0)
    assert slower.law is not None and np.all(np.abs(slower.law.stiffness) < np.abs(ground.law.stiffness))


def test_commands_that_feedback_asks_for_are_limits_too() -> None:
    rivals = arm_frictions()
    ground = Ground.of(rivals, arm_limits(), KnownCondition(), rivals.simulator(1), track=2.0)
    crowd = ground.crowd([own.model for own in rivals.rivals])
    jump = np.tile(POSE, (300, 1))
    jump[150:] += 1.0
    (motions,) = crowd.motions([ground.trial(jump)])
    found = arm_limits().excess(motions)
    assert found.left and "command of " in str(found)
    assert any(name == "command of bend too fast" for name in found.names)
    share, excess = crowd.within(jump)
    assert 0 < share < 1 and not excess.left
    narrow = arm_limits(bend_rate="1")
    assert "command of bend too fast" in str(narrow.excess(motions)) or narrow.excess(motions).worst > found.worst


def test_models_are_compared_under_the_commands_that_the_true_one_was_given() -> None:
    rivals = arm_frictions()
    simulator = rivals.simulator(1)
    ground = Ground.of(rivals, arm_limits(), KnownCondition(), simulator, track=2.0)
    own = ground.commands(families(["steps"])[0], np.full(14, 0.7), 0.5)
    truth = rivals.rivals[0].model
    (recording,) = predicted_recordings(rivals, truth, [own], simulator)
    other = predicted_recordings(rivals, rivals.rivals[1].model, [own], simulator)[0]
    assert np.abs(recording.command - own.commands).max() > 0.01  # feedback has added to what was fed forward
    assert np.abs(recording.command - other.command).max() > 0.01
    (segments,) = predicted_trials(rivals, truth, [own], simulator)
    assert len(segments) == 5 and all(np.array_equal(s.trial.commands, recording.command) for s in segments)
    target = Target.of(rivals, truth, segments, simulator)
    for segment, values in zip(segments, target.values, strict=True):
        assert (
            np.abs(values - segment.measured).max() < 0.01 < np.ptp(recording.position, axis=0).min()
        )  # another engine, and starts that were read off
    first, second = (refitted(rival, target).cost for rival in rivals.rivals)
    assert first < 0.5 < 5 < second


@cache
def design() -> Designed:
    rivals = arm_frictions()
    return designed(
        rivals, arm_limits(), over_families=families(["steps", "multisine"]), evaluations=40, draws=19, refits=8,
        track=2.0, simulator=rivals.simulator(1),
    )  # fmt: skip


@pytest.mark.slow
def test_a_design_of_references_decides_within_the_limits(tmp_path: Path) -> None:
    found, rivals = design(), arm_frictions()
    (pair,) = found.pairs
    assert pair.ending in ("one trial", "repeats") and found.commands.law is not None
    reference = found.commands.course
    assert np.all(reference[0] == POSE) and np.all(reference[-1] == POSE) and np.ptp(reference, axis=0).max() > 0.05
    ground = Ground.of(rivals, found.limits, found.condition, rivals.simulator(1), track=2.0)
    models = [own.model_at(t) for own in rivals.rivals for t in own.draws(np.random.default_rng(9), 25)]
    (motions,) = ground.crowd(models).motions([found.commands])
    assert motions.command is not None
    inside = [
        not found.limits.excess(
            replace(
                motions, position=motions.position[k : k + 1], rate=motions.rate[k : k + 1],
                rest=motions.rest[k : k + 1], command=motions.command[k : k + 1],
            )
        ).left
        for k in range(50)
    ]  # fmt: skip
    assert sum(inside) >= 45
    files = write_design(found, tmp_path / "next", figures=False)
    done = eq.run_scenario("commands", model=rivals.rivals[0].model, nominal=ARM, options={"file": str(files.commands)})
    assert done.controller == "tracking" and not done.run.clipped.any()
    for draw in design_drawings(found).values():
        assert draw().axes
    again = found.to_dict()
    assert again["law"]["stiffness"] == found.commands.law.stiffness.tolist()


@pytest.mark.slow
def test_the_first_trial_of_an_unknown_arm_tracks_a_reference() -> None:
    commands, amplitude, excess = first_trial(ARM, arm_limits(), 0, 9, track=2.0)
    assert commands.law is not None and amplitude > 0 and not excess.left
    assert np.ptp(commands.course, axis=0).min() > 0.01
