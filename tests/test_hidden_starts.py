"""What no sensor shows where a shooting interval begins: what the recorded motion before it left."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from mjcf_models import pendulum

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.effects import Backlash, DahlFriction, DriveCompliance, Effect, SensorDelay, SensorOffset, SensorScale
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.choice import ReducedEngine
from equimus_ctrl.engines.limits import REMEMBERED
from equimus_ctrl.engines.mjcf import parted, simulate_mjcf
from equimus_ctrl.engines.motion import motion
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import Segment, cut, led_along
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.smoothing import recorded_motion
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow import identify_recordings

ROBOT = MjcfRobot("pendulum", pendulum("damping='0.1'"), source="pendulum.xml")
SOFT = DriveCompliance("pivot", 25.0, 0.1)
DAHL = DahlFriction("pivot", 0.4, 0.2)
TIME = np.arange(0, 4.001, 0.01)
FINE = 2.5e-4
Engine = Callable[[Model, list[Trial], list[Array] | None], list[Predicted]]


def reduced(model: Model, trials: list[Trial], starts: list[Array] | None = None) -> list[Predicted]:
    return simulate([model], trials, starts=starts, dt=1e-3, threads=1, check=False)


def stepped(model: Model, trials: list[Trial], starts: list[Array] | None = None) -> list[Predicted]:
    return simulate_mjcf([model], trials, starts=starts, dt=FINE, threads=1)


ENGINES = pytest.mark.parametrize(
    "simulated", [pytest.param(reduced, marks=pytest.mark.slow), stepped], ids=["reduced", "mujoco"]
)


def whole(robot: MjcfRobot, command: Array) -> Trial:
    return Trial("t", TIME, command, command[0], 0.0, np.array([0.3]), TIME, np.zeros(1), inner=True)


def torque() -> Array:
    return (1.1 * np.sin(5.0 * TIME) + 0.5 * np.sin(13.0 * TIME + 1.0))[:, None]


def recording(trial: Trial, position: Array) -> Recording:
    robot = ROBOT
    return Recording("t", TIME, trial.commands, position, robot.actuator_names, robot.joint_names)


def intervals(model: Model, shown: Recording, length: float = 0.5) -> list[Segment]:
    """Those that begin inside of the recording."""
    return cut(model, [shown], shoot=length)[1:]


def farthest(simulated: Engine, model: Model, segments: list[Segment], true: Array, led: bool = True) -> float:
    """How far predictions from the true positions and rates get from the true motion (n, 2) [rad]."""
    trials = [s.trial if led else replace(s.trial, recorded=None) for s in segments]
    starts = [true[None, round(trial.start / 0.01)] for trial in trials]
    found = simulated(model, trials, starts)
    errors = [
        np.abs(f.motion[0, :, 0] - true[np.round(t.sample_times / 0.01).astype(int), 0]).max()
        for f, t in zip(found, [replace(t, inner=True) for t in trials], strict=True)
        if f.motion is not None
    ]
    return float(max(errors))


@ENGINES
@pytest.mark.parametrize("effect", [SOFT, DAHL], ids=lambda e: e.name)
def test_an_interval_goes_on_as_the_whole_trial_did(simulated: Engine, effect: Effect) -> None:
    model, trial = Model(ROBOT, (effect,)), whole(ROBOT, torque())
    (found,) = simulated(model, [trial], None)
    assert found.motion is not None
    segments = intervals(model, recording(trial, found.position[0]))
    segments = [replace(s, trial=replace(s.trial, inner=True)) for s in segments]
    led, rested = (farthest(simulated, model, segments, found.motion[0], led) for led in (True, False))
    assert rested > 3e-3
    assert led < 0.1 * rested


@ENGINES
def test_noise_of_the_recording_is_smoothed_first(simulated: Engine) -> None:
    model, trial = Model(ROBOT, (SOFT,)), whole(ROBOT, torque())
    (found,) = simulated(model, [trial], None)
    assert found.motion is not None
    noisy = found.position[0] + np.random.default_rng(3).normal(0, 1e-3, found.position[0].shape)
    segments = intervals(model, recording(trial, noisy))
    segments = [replace(s, trial=replace(s.trial, inner=True)) for s in segments]
    led, rested = (farthest(simulated, model, segments, found.motion[0], led) for led in (True, False))
    assert led < 0.5 * rested


@ENGINES
@pytest.mark.parametrize(
    "sensor", [SensorOffset("pivot", 0.2), SensorScale("pivot", 1.2), SensorDelay("pivot", 0.05)], ids=lambda e: e.name
)
def test_the_motion_is_that_behind_the_sensors(simulated: Engine, sensor: Effect) -> None:
    """A servo pulls on the drive by where it is, so that an offset counts, too."""
    robot = MjcfRobot("held", pendulum(drive='<position name="motor" joint="pivot" kp="15"/>'))
    bare, model = Model(robot, (SOFT,)), Model(robot, (SOFT, sensor))
    trial = whole(robot, torque())
    (found,) = simulated(model, [trial], None)
    assert found.motion is not None
    shown = recording(trial, found.position[0])
    errors = []
    for own in (model, bare):
        segments = [s for s in intervals(own, shown) if s.trial.start > 1.0]
        segments = [replace(s, trial=replace(s.trial, inner=True)) for s in segments]
        errors.append(farthest(simulated, own, segments, found.motion[0]))
    assert errors[0] < 0.2 * errors[1]


@ENGINES
def test_an_interval_of_a_sensor_with_play_goes_on_as_the_whole_trial_did(simulated: Engine) -> None:
    """A joint that moves has the play behind it, and one that crosses the play is not seen to move."""
    model, trial = Model(ROBOT, (Backlash("pivot", 0.05),)), whole(ROBOT, torque())
    (found,) = simulated(model, [trial], None)
    assert found.motion is not None
    true = found.motion[0]
    for segment in intervals(model, recording(trial, found.position[0])):
        (led,) = simulated(model, [segment.trial], [true[None, round(segment.trial.start / 0.01)]])
        assert np.abs(led.position[0] - segment.measured).max() < 1e-3


def test_a_start_inside_a_recording_has_the_play_behind_it() -> None:
    model, trial = Model(ROBOT, (Backlash("pivot", 0.05),)), whole(ROBOT, torque())
    (found,) = stepped(model, [trial])
    assert found.motion is not None
    position, rate = found.motion[0].T
    for segment in intervals(model, recording(trial, found.position[0])):
        k = round(segment.trial.start / 0.01)
        if abs(rate[k]) > 1.0:  # else it may be crossing the play
            assert segment.trial.position[0] == pytest.approx(position[k], abs=2e-3)


@pytest.mark.slow
def test_hidden_states_themselves_are_those_of_the_whole_trial() -> None:
    """How far the drive is ahead, and how fast it turns; with noise to what the noise makes of it."""
    model, trial = Model(ROBOT, (SOFT,)), whole(ROBOT, torque())
    true = motion(model, trial, dt=1e-3)
    usual = true.state.std(axis=0)
    usual[1] = (true.state[:, 1] - true.velocity[:, 0]).std()
    for noise, share in ((0.0, 0.02), (1e-3, 0.5)):
        shown = true.position + np.random.default_rng(4).normal(0, 1.0, true.position.shape) * noise
        for segment in intervals(model, recording(trial, shown)):
            k = round(segment.trial.start / 0.01)
            start = np.array([true.position[k, 0], true.velocity[k, 0]])
            found = motion(model, segment.trial, start, dt=1e-3)
            assert np.all(np.abs(found.state[0] - true.state[k]) < share * usual), (noise, segment.trial.name)


@pytest.mark.slow
def test_a_stiffness_is_right_where_intervals_that_begin_without_it_are_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    real = Model(ROBOT, (SOFT,))
    (found,) = reduced(real, [whole(ROBOT, torque())])
    noisy = found.position[0] + np.random.default_rng(5).normal(0, 5e-4, found.position[0].shape)
    shown = recording(whole(ROBOT, torque()), noisy)
    begun = Model(ROBOT, (DriveCompliance("pivot", 40.0, 0.1),))
    name = "pivot.joint_compliance.stiffness"

    def error() -> float:
        found = identify_recordings([shown], begun, free=[name], shoot=0.3, folds=0)
        return abs(found.fit.model.parameters()[name] - 25.0)

    led = error()
    assert led < 0.5
    monkeypatch.setattr(Trial, "led", None)
    assert error() > 5.0


def coloured(seed: int) -> Array:
    """Noise of 2 mrad that lasts for 30 ms, so that smoothing leaves it."""
    white, kept = np.random.default_rng(seed).normal(0, 2e-3, (len(TIME), 1)), np.exp(-0.01 / 0.03)
    found = np.zeros_like(white)
    for k in range(1, len(TIME)):
        found[k] = kept * found[k - 1] + np.sqrt(1 - kept**2) * white[k]
    return found


def fitted_to(model: Model, shown: Recording, names: list[str], length: float) -> tuple[Data, Fitted]:
    segments = cut(model, [shown], shoot=length)
    data = Data(free_parameters(model, names), segments, Simulator(ReducedEngine(1e-3), threads=1))
    return data, data.base()


def left_by(data: Data, fitted: Fitted) -> Array:
    """(m, 1) residuals of a fit on some data."""
    starts = [start[None] for start in fitted.fit.starts]
    predicted = data.simulator([fitted.fit.model], data.segments, starts)
    return np.concatenate([s.measured - p.position[0] for s, p in zip(data.segments, predicted, strict=True)])


@pytest.mark.slow
def test_the_fitted_motion_leads_to_starts_without_the_noise_of_the_measured_one() -> None:
    """Whose noise at starts is in no interval: with it the truth is farther off than the intervals say."""
    (found,) = reduced(Model(ROBOT, (SOFT,)), [whole(ROBOT, torque())])
    off, others = [], []
    for seed in range(2, 8):
        shown = recording(whole(ROBOT, torque()), found.position[0] + coloured(seed))
        data, measured = fitted_to(Model(ROBOT, (SOFT,)), shown, ["pivot.joint_compliance.stiffness"], 0.3)
        own, led = data.led_by_fit(measured)
        assert led.deviance <= measured.deviance
        residuals = np.concatenate(led.fit.residuals)
        assert np.allclose(left_by(own, led), residuals, rtol=0, atol=1e-12)
        assert (own is data) is (led is measured)
        others.append(float(np.abs(left_by(data, led) - residuals).max()))
        off.append([f.fit.uncertainty.statistic([0], f.fit.theta - 25.0) for f in (measured, led)])
    assert max(others) > 1e-4  # which is not what was fitted before
    by_measured, by_fit = np.sum(off, axis=0)
    assert by_fit < 0.6 * by_measured


def test_a_fit_without_hidden_states_is_led_by_nothing() -> None:
    (found,) = stepped(Model(ROBOT), [whole(ROBOT, torque())])
    shown = recording(whole(ROBOT, torque()), found.position[0] + coloured(1))
    data, plain = fitted_to(Model(ROBOT), shown, ["arm.mass", "pivot.damping"], 0.5)
    assert data.led_by_fit(plain) == (data, plain)


def test_what_is_predicted_leads_where_it_was_predicted() -> None:
    (found,) = stepped(Model(ROBOT), [whole(ROBOT, torque())])
    segments = cut(Model(ROBOT), [recording(whole(ROBOT, torque()), found.position[0])], shoot=1.0)
    led = led_along(segments[1:], [np.full(s.measured.shape, 0.1) for s in segments[1:]])
    (recorded,) = {s.trial.recorded for s in led}
    assert recorded is not None and segments[0].trial.recorded is not None
    off = segments[0].trial.recorded.position - recorded.position
    assert np.all(off[TIME < 1.0] == 0) and off[TIME >= 1.0] == pytest.approx(0.1)


@ENGINES
def test_what_an_interval_starts_with_depends_on_no_other(simulated: Engine) -> None:
    model, trial = Model(ROBOT, (SOFT,)), whole(ROBOT, torque())
    (found,) = simulated(model, [trial], None)
    trials = [s.trial for s in intervals(model, recording(trial, found.position[0]))]
    together = simulated(model, trials, None)
    for own, beside in zip(trials[::3], together[::3], strict=True):
        assert np.array_equal(simulated(model, [own], None)[0].position, beside.position)


@ENGINES
def test_late_in_a_long_recording_its_last_part_leads_to_a_start(simulated: Engine) -> None:
    model, time = Model(ROBOT, (SOFT,)), np.arange(0, 64.001, 0.01)
    command = (1.1 * np.sin(5.0 * time) + 0.5 * np.sin(13.0 * time + 1.0))[:, None]
    trial = Trial("t", time, command, command[0], 0.0, np.array([0.3]), time, np.zeros(1), inner=True)
    (found,) = simulated(model, [trial], None)
    shown = Recording("t", time, command, found.position[0], ROBOT.actuator_names, ROBOT.joint_names)
    late = [replace(s, trial=replace(s.trial, inner=True)) for s in intervals(model, shown)[-5:]]
    assert found.motion is not None and late[0].trial.start > 2 * REMEMBERED
    led, rested = (farthest(simulated, model, late, found.motion[0], led) for led in (True, False))
    assert led < 0.1 * rested


def test_a_start_bends_the_motion_smoothly_to_itself() -> None:
    """Predictions follow small changes of a start in proportion, from a start that noise has put elsewhere."""
    model, trial = Model(ROBOT, (SOFT,)), whole(ROBOT, torque())
    shown = recording(trial, stepped(model, [trial])[0].position[0])
    (segment,) = intervals(model, shown, 2.0)
    begin = segment.start + np.array([2e-3, 0.05])

    def slope(by: float) -> Array:
        rows = [
            stepped(model, [segment.trial], [(begin + change)[None]])[0].position[0] for change in ([0, by], [0, 0])
        ]
        return (rows[0] - rows[1]) / by

    assert np.abs(slope(1e-2) - slope(1e-3)).max() < 0.02 * np.abs(slope(1e-3)).max()


INTEGRATING = MjcfRobot(
    "integrating", pendulum(drive='<intvelocity name="motor" joint="pivot" kp="15" kv="1" actrange="-3 3"/>')
)


@ENGINES
def test_what_integrates_commands_goes_on_from_what_it_came_to(simulated: Engine) -> None:
    model, trial = Model(INTEGRATING), whole(INTEGRATING, torque())
    (found,) = simulated(model, [trial], None)
    assert found.motion is not None
    segments = intervals(model, recording(trial, found.position[0]))
    segments = [replace(s, trial=replace(s.trial, inner=True)) for s in segments]
    led, rested = (farthest(simulated, model, segments, found.motion[0], led) for led in (True, False))
    assert rested > 0.05
    assert led < 0.02 * rested


@ENGINES
def test_what_integrates_commands_adds_up_all_of_a_long_recording(simulated: Engine) -> None:
    """The joint is pulled to one side at first, which nothing tells later but the commands."""
    model, time = Model(INTEGRATING), np.arange(0, 56.001, 0.01)
    command = (0.9 * np.sin(3.0 * time) * (time > 4.0) + 0.4 * (time < 2.0))[:, None]
    trial = Trial("t", time, command, command[0], 0.0, np.array([0.3]), time, np.zeros(1), inner=True)
    (found,) = simulated(model, [trial], None)
    shown = Recording("t", time, command, found.position[0], INTEGRATING.actuator_names, INTEGRATING.joint_names)
    late = [replace(s, trial=replace(s.trial, inner=True)) for s in intervals(model, shown)[-3:]]
    assert found.motion is not None and late[0].trial.start > 2 * REMEMBERED
    assert farthest(simulated, model, late, found.motion[0]) < 2e-3


def test_what_diverges_on_the_way_to_a_start_has_diverged() -> None:
    """A drive that its own spring throws about while its joint is put where it was recorded to be."""
    wild = Model(ROBOT, (DriveCompliance("pivot", 1e6, 0.0),))
    shown = recording(whole(ROBOT, torque()), 0.3 * np.sin(3.0 * TIME)[:, None])
    (trial,) = (s.trial for s in intervals(wild, shown, 2.0))
    (found,) = simulate_mjcf([wild], [trial], dt=0.05, threads=1)
    assert found.reached[0] == 0 and not found.sound[0]


def test_parts_of_a_recording_are_simulated_one_after_the_other() -> None:
    model, trial = Model(ROBOT), whole(ROBOT, torque())
    one, other = (
        [s.trial for s in cut(model, [recording(trial, by * np.sin(TIME)[:, None])], shoot=0.5)] for by in (1.0, 2.0)
    )
    mixed = [t for pair in zip(one, other, strict=True) for t in pair]
    chunks = parted(mixed, 4)
    assert sorted(i for chunk in chunks for i in chunk) == list(range(len(mixed))) and len(chunks) == 4
    for chunk in chunks:
        assert len({mixed[i].history for i in chunk}) == 1
        assert np.allclose(np.diff([mixed[i].start for i in chunk]), 0.5)


def test_a_recorded_motion_goes_with_its_recording() -> None:
    shown = recording(whole(ROBOT, torque()), np.sin(TIME)[:, None])
    kept = weakref.ref(recorded_motion(shown, 0.02))
    assert kept() is recorded_motion(shown, 0.02)
    del shown
    gc.collect()
    assert kept() is None


def test_without_hidden_states_nothing_is_smoothed() -> None:
    model, trial = Model(ROBOT), whole(ROBOT, torque())
    shown = recording(trial, stepped(model, [trial])[0].position[0])
    segments = intervals(model, shown)
    plain = [replace(s.trial, recorded=None) for s in segments]
    for led, rested in zip(stepped(model, [s.trial for s in segments]), stepped(model, plain), strict=True):
        assert np.array_equal(led.position, rested.position)
    for segment in segments:
        assert segment.trial.recorded is not None and "motion" not in vars(segment.trial.recorded)


def test_intervals_of_a_recording_share_its_motion_however_they_are_cut() -> None:
    model, trial = Model(ROBOT), whole(ROBOT, torque())
    shown = recording(trial, np.sin(TIME)[:, None])
    first, second = (cut(model, [shown], shoot=length)[-1].trial for length in (0.5, 1.0))
    assert first.recorded is second.recorded is recorded_motion(shown, first.recorded.reading)
    assert cut(model, [shown], shoot=0.5)[0].trial.led is None
