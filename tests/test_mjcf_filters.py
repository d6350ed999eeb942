"""Actuators of MuJoCo's XML that follow their commands through a first-order filter, or late."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from mjcf_models import corrected_xml

from equimus_ctrl import workflow
from equimus_ctrl.effects import FirstOrderLag, TransportDelay
from equimus_ctrl.effects.native import Draft
from equimus_ctrl.engines.mjcf import filled, joint_forces, simulate_mjcf
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.export import exported
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

MASS, TAU, DT = 2.0, 0.08, 1e-3
FORCE = f'<general name="motor" joint="way" dyntype="filterexact" dynprm="{TAU}"/>'
EULER = FORCE.replace("filterexact", "filter")
SERVO = f'<position name="motor" joint="way" kp="200" kv="30" timeconst="{TAU}"/>'
PLAIN, DELAY = '<motor name="motor" joint="way"/>', 0.03
LATE = f'<motor name="motor" joint="way" nsample="{round(DELAY / DT)}" delay="{DELAY}"/>'


def cart(drive: str = FORCE) -> MjcfRobot:
    return MjcfRobot(
        "cart",
        f"""<mujoco><option timestep="{DT}" gravity="0 0 0" integrator="implicitfast"/><worldbody>
        <body name="box"><joint name="way" type="slide" axis="1 0 0"/>
        <inertial mass="{MASS}" pos="0 0 0" diaginertia="0.1 0.1 0.1"/></body></worldbody>
        <actuator>{drive}</actuator></mujoco>""",
    )


def moved(robot: MjcfRobot, trial: Trial, *effects: object) -> Array:
    (found,) = simulate_mjcf([Model(robot, effects)], [trial], threads=1)  # type: ignore[arg-type]
    assert found.sound.all()
    return np.asarray(found.position[0, :, 0])


def square(seconds: float = 2.0, before: float = 0.0) -> Trial:
    time = np.arange(0, seconds, 0.01)
    command = np.sign(np.sin(2 * np.pi * 1.3 * time + 0.4))[:, None]
    return Trial("t", time, command, np.array([before]), 0.0, np.zeros(1), time, np.zeros(1))


@pytest.mark.parametrize("drive", [FORCE, EULER])
def test_a_force_builds_up_as_its_filter_does(drive: str) -> None:
    """m·x'' = 1 − exp(−t/τ) after a step, twice integrated."""
    time = np.arange(0, 1, 0.01)
    step = Trial("t", time, np.ones((len(time), 1)), np.zeros(1), 0.0, np.zeros(1), time, np.zeros(1))
    exact = (time**2 / 2 - TAU * time + TAU**2 * (1 - np.exp(-time / TAU))) / MASS
    assert np.abs(moved(cart(drive), step) - exact).max() < 2e-3 * exact[-1]
    settled = replace(step, before=np.ones(1))
    assert moved(cart(drive), settled)[-1] == pytest.approx(time[-1] ** 2 / 2 / MASS, rel=2e-3)


@pytest.mark.parametrize("drive", [FORCE, EULER, SERVO])
def test_a_window_begins_with_what_the_filter_came_to(drive: str) -> None:
    robot, whole = cart(drive), square()
    x = moved(robot, whole)
    fine = replace(whole, sample_times=np.array([0.0, 0.83 - 1e-3, 0.83, 0.83 + 1e-3]))
    near = moved(robot, fine)
    speed = (near[3] - near[1]) / 2e-3
    later = whole.times[whole.times > 0.831]
    window = replace(whole, start=0.83, position=near[2:3], velocity=np.array([speed]), sample_times=later)
    assert np.abs(moved(robot, window) - x[-len(later) :]).max() < 2e-3 * np.ptp(x)


def test_a_filter_sees_commands_as_they_arrive() -> None:
    own = realise(Model(cart(), [TransportDelay("motor", 0.05)]))
    time = np.arange(0, 1, 0.01)
    trial = Trial("t", time, np.ones((100, 1)), np.zeros(1), 0.4, np.zeros(1), time[41:], np.zeros(1))
    assert filled(own, trial)[0] == pytest.approx(1 - np.exp(-0.35 / TAU), abs=2e-3)
    drives, _ = joint_forces(own, np.zeros((1, 1)), np.zeros((1, 1)), np.array([[0.7]]))
    assert drives[0, 0] == pytest.approx(0.7)


def test_commands_beyond_their_range_fill_no_further() -> None:
    own = realise(Model(cart(FORCE.replace("/>", ' ctrllimited="true" ctrlrange="-0.5 0.5"/>'))))
    time = np.arange(0, 1, 0.01)
    trial = Trial("t", time, np.full((100, 1), 3.0), np.zeros(1), 0.9, np.zeros(1), time[91:], np.zeros(1))
    assert filled(own, trial)[0] == pytest.approx(0.5, rel=1e-3)


def recorded(robot: MjcfRobot, *effects: object) -> list[Recording]:
    rng, found = np.random.default_rng(0), []
    for k in range(3):
        time = np.arange(0, 3, 0.01)
        command = (0.1 * np.sin(2 * np.pi * (0.7 + 0.5 * k) * time + k) + 0.05 * np.sign(np.sin(5 * time)))[:, None]
        trial = Trial(f"t{k}", time, command, command[0], 0.0, np.zeros(1), time, np.zeros(1))
        x = moved(robot, trial, *effects)[:, None] + rng.normal(0, 1e-4, (300, 1))
        found.append(Recording(f"t{k}", time, command, x, ("motor",), ("way",)))
    return found


@pytest.mark.slow
def test_the_time_constant_is_a_number_that_is_identified_and_written() -> None:
    robot = cart(SERVO)
    assert robot.parameters()["motor.time_constant"] == TAU and robot.unit("motor.time_constant") == "s"
    model = Model(robot.with_parameters({"motor.time_constant": 0.03}))
    found = workflow.identify_recordings(recorded(robot), model, free=["motor.time_constant"], folds=0)
    assert found.fit.model.parameters()["motor.time_constant"] == pytest.approx(TAU, rel=0.02)
    robot = robot.with_parameters({"motor.time_constant": 0.05})
    again = mujoco.MjModel.from_xml_string(exported(robot, Draft(robot.mujoco_model())))
    assert again.actuator_dynprm[0, 0] == 0.05


@pytest.mark.slow
def test_a_lag_beside_the_filter_is_found() -> None:
    found = workflow.diagnose(recorded(cart(SERVO), FirstOrderLag("motor", 0.05)), Model(cart(SERVO)), most=1)
    names = {f.named.effect for f in found.findings} | {e.effect for f in found.findings for e in f.equivalent}
    assert found.verdict == "explained" and "first_order_lag" in names


# --- delays -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [0.0, 0.4])
def test_a_delay_of_the_xml_is_the_one_that_effects_know(start: float) -> None:
    trial = square(before=1.0)
    trial = replace(trial, start=start, sample_times=trial.times[trial.times >= start])
    late = moved(cart(LATE), trial)
    np.testing.assert_array_equal(late, moved(cart(PLAIN), trial, TransportDelay("motor", DELAY)))
    assert np.abs(late - moved(cart(PLAIN), trial)).max() > 0.05 * np.ptp(late)
    # Another on top of it.
    more = moved(cart(LATE), trial, TransportDelay("motor", 0.02))
    np.testing.assert_array_equal(more, moved(cart(PLAIN), trial, TransportDelay("motor", DELAY + 0.02)))


@pytest.mark.slow
def test_a_delay_of_the_xml_is_a_number_that_can_be_found() -> None:
    """Beyond what its buffer holds too."""
    robot = cart(LATE)
    assert robot.parameters()["motor.delay"] == DELAY and robot.unit("motor.delay") == "s"
    real = recorded(robot.with_parameters({"motor.delay": 0.07}))
    found = workflow.identify_recordings(real, Model(robot), free=["motor.delay", "box.mass"], folds=0, fit_start=True)
    assert found.fit.model.parameters()["motor.delay"] == pytest.approx(0.07, abs=1e-3)


def test_a_delay_of_the_xml_stays_one_where_it_is_written() -> None:
    robot = cart(LATE).with_parameters({"motor.delay": 0.0475})
    xml, left = corrected_xml(Model(robot, [TransportDelay("motor", 0.02)]))
    written = mujoco.MjModel.from_xml_string(xml)
    assert left == () and written.actuator_delay[0] == pytest.approx(0.0675) and written.actuator_history[0, 0] == 68
    trial = square()
    np.testing.assert_array_equal(moved(MjcfRobot("c", xml), trial), moved(robot, trial, TransportDelay("motor", 0.02)))


def test_models_and_trials_with_delays_of_their_own_run_side_by_side() -> None:
    robot, trials = (
        cart(LATE),
        [replace(square(before=b), settings=s) for b in (0.0, 1.0) for s in ({}, {"motor.delay": 0.1})],
    )
    models = [Model(robot.with_parameters({"motor.delay": late})) for late in (0.01, 0.04, 0.07)]
    found = simulate_mjcf(models, trials, threads=2)
    for k, model in enumerate(models):
        for trial, together in zip(trials, found, strict=True):
            (alone,) = simulate_mjcf([model], [trial], threads=1)
            np.testing.assert_array_equal(together.position[k], alone.position[0])
    assert len({predicted.position.tobytes() for predicted in found}) == len(trials)


def test_a_delay_of_the_file_that_is_shorter_than_a_step_is_written_as_it_is() -> None:
    """MuJoCo makes a step of it, in the file that it came from too."""
    model = Model(cart(LATE).with_parameters({"motor.delay": 0.7 * DT}))
    xml, left = corrected_xml(model)
    assert left == () and mujoco.MjModel.from_xml_string(xml).actuator_delay == pytest.approx([0.7 * DT])


def test_a_buffer_that_is_too_short_is_refused() -> None:
    with pytest.raises(ModelError, match="a delay of 0.03 s, and a buffer .nsample. that holds 0.01 s"):
        cart(LATE.replace('nsample="30"', 'nsample="10"'))


def test_a_lag_beside_the_filter_is_told_where_it_is_written() -> None:
    xml, left = corrected_xml(Model(cart(), [FirstOrderLag("motor", 0.02)]))
    assert left == ("first_order_lag at motor",)
    assert mujoco.MjModel.from_xml_string(xml).actuator_dynprm[0, 0] == TAU


def test_keyframes_fill_filters_that_are_new() -> None:
    own = '<general name="own" joint="way" dyntype="filterexact" dynprm="0.2"/>'
    robot = cart(PLAIN + own)
    keyed = replace(
        robot,
        xml=robot.xml.replace("</mujoco>", '<keyframe><key act="0.3" ctrl="0.1 0.3"/><key/></keyframe></mujoco>'),
    )
    written = mujoco.MjModel.from_xml_string(corrected_xml(Model(keyed, [FirstOrderLag("motor", 0.1)]))[0])
    assert written.key_act.tolist() == [[0.1, 0.3], [0.0, 0.0]]
    assert mujoco.MjModel.from_xml_string(corrected_xml(Model(keyed))[0]).key_act.tolist() == [[0.3], [0.0]]
