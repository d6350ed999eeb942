"""MJCF robots simulated: what moves freely is known in closed form, and what must not matter does not."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjcf_models import DT, RIG, RK4, M, Ran, cart, run, swinging, trial_of

from equimus_ctrl.diagnosis.intervals import intervals_of, longest_interval
from equimus_ctrl.effects import (
    ActuatorGain,
    AsymmetricDamping,
    ConstantForce,
    CoulombFriction,
    DriveCompliance,
    Effect,
    FirstOrderLag,
    LoadFriction,
    ParallelSpring,
    PayloadMass,
    SensorDelay,
    SensorOffset,
    SensorScale,
    StribeckFriction,
    TorqueSaturation,
    TransportDelay,
    ViscousFriction,
)
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.mjcf import joint_forces, simulate_mjcf
from equimus_ctrl.engines.mjcf_motion import mjcf_motion, simulated_response
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording


def hung(joint: str = "", *, head: str = "", option: str = "") -> MjcfRobot:
    """A pendulum of 1 kg at 0.3 m, 0.1 kg·m² about its pivot."""
    return MjcfRobot(
        "pendulum",
        f"""<mujoco>{head}<option timestep="{DT}" {option}/><worldbody><body name="arm">
        <joint name="pivot" axis="0 1 0" {joint}/>
        <inertial mass="1" pos="0 0 -0.3" diaginertia="0.01 0.01 0.01"/><site name="tip" pos="0 0 -0.5"/></body>
        </worldbody><actuator><motor name="motor" joint="pivot"/></actuator></mujoco>""",
    )


WEIGHT = 0.3 * 9.81


# --- what moves freely ------------------------------------------------------------------------------------------


def test_a_constant_force_accelerates_a_mass() -> None:
    """Euler's semi-implicit steps sum up to an arithmetic series, which is half a step ahead."""
    force = 3.0
    found = run(cart(), u=force)
    n = np.arange(len(found.t))
    np.testing.assert_allclose(found.x, force / M * DT**2 * n * (n + 1) / 2, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found.x, force / M * found.t**2 / 2, rtol=0, atol=1.01 * force / M * DT / 2)


def test_the_integrator_is_the_one_that_the_file_asks_for() -> None:
    found = run(cart(option=RK4), u=3.0, q=0.2, v=-1.0)
    np.testing.assert_allclose(found.x, 0.2 - found.t + 0.75 * found.t**2, rtol=0, atol=1e-12)


def test_between_physics_steps_the_path_is_a_cubic() -> None:
    """Of constant acceleration that is the path itself, wherever it is sampled."""
    found = run(cart(option=RK4), u=3.0, v=-1.0, until=0.9, every=0.00037)
    np.testing.assert_allclose(found.x, -found.t + 0.75 * found.t**2, rtol=0, atol=1e-12)


def crossings(found: Ran, level: float = 0.0) -> Array:
    """When it passes a level, by straight lines between samples."""
    x = found.x - level
    k = np.flatnonzero(x[:-1] * x[1:] < 0)
    return np.asarray(found.t[k] + (found.t[k + 1] - found.t[k]) * x[k] / (x[k] - x[k + 1]))


def test_a_torsion_pendulum_has_the_period_of_its_inertia_and_stiffness() -> None:
    inertia, stiffness, rest = 0.1, 8.0, 0.3
    robot = MjcfRobot(
        "torsion",
        f"""<mujoco><compiler angle="radian"/><option timestep="{DT}" gravity="0 0 0"/><worldbody><body name="disc">
        <joint name="wire" axis="0 0 1" stiffness="{stiffness}" springref="{rest}"/>
        <inertial mass="1" pos="0 0 0" diaginertia="0.05 0.05 {inertia}"/></body></worldbody>
        <actuator><motor name="m" joint="wire"/></actuator></mujoco>""",
    )
    found = run(robot, q=rest + 0.5, until=8.0)
    times, omega = crossings(found, rest), math.sqrt(stiffness / inertia)
    assert len(times) > 20
    # cos(ω'·dt) = 1 − (ω·dt)²/2 is what the steps make of it.
    slack = 2 * (omega * DT) ** 2 / 24 * math.pi / omega
    np.testing.assert_allclose(np.diff(times), math.pi / omega, rtol=0, atol=slack + 1e-6)
    assert np.ptp(found.x) == pytest.approx(1.0, abs=omega * DT)


def test_a_spring_beside_a_joint_is_one_in_it() -> None:
    own = run(cart('stiffness="50" springref="0.1"'), q=0.3)
    beside = run(cart(), ParallelSpring("way", 50.0, 0.1), q=0.3)
    np.testing.assert_allclose(beside.x, own.x, rtol=0, atol=1e-12)
    exact = 0.1 + 0.2 * np.cos(5.0 * own.t)
    np.testing.assert_allclose(own.x, exact, rtol=0, atol=0.2 * 5.0 * DT)


def test_a_constant_push_is_a_motor_that_pushes_all_the_time() -> None:
    np.testing.assert_allclose(run(cart(), ConstantForce("way", -2.0)).x, run(cart(), u=-2.0).x, rtol=0, atol=1e-13)
    assert run(cart(), ConstantForce("way", -2.0)).x[-1] == pytest.approx(-0.5, abs=2 * DT)


def test_a_trial_may_begin_at_any_time() -> None:
    rows = [(0.1, 2.0), (0.4, -3.0)]
    plain = trial_of(rows, q=0.1, v=0.2)
    later = replace(plain, times=plain.times + 7.0, start=7.0, sample_times=plain.sample_times + 7.0)
    np.testing.assert_allclose(run(cart(), trial=later).x, run(cart(), trial=plain).x, rtol=0, atol=1e-9)


def test_starts_may_be_given_beside_the_trials() -> None:
    model, one = Model(cart()), trial_of(1.0)
    both = simulate_mjcf([model, model], [one], starts=[np.array([[0.5, 2.0], [0.3, 0.0]])], threads=1)[0]
    still = simulate_mjcf([model, model], [one], starts=[np.array([[0.5], [0.3]])], threads=1)[0]
    expected = [run(cart(), u=1.0, q=q, v=v).x for q, v in ((0.5, 2.0), (0.3, 0.0), (0.5, 0.0))]
    np.testing.assert_array_equal(both.position[0, :, 0], expected[0])
    np.testing.assert_array_equal(both.position[1, :, 0], expected[1])
    np.testing.assert_array_equal(still.position[0, :, 0], expected[2])


@pytest.mark.parametrize("dt", [0.0, -1e-3, math.nan, math.inf])
def test_a_step_that_is_none_is_refused(dt: float) -> None:
    with pytest.raises(ConfigError, match=r"the physics step is .* s, expected more than 0"):
        simulate_mjcf([Model(cart())], [trial_of()], dt=dt)


def test_another_physics_step_can_be_asked_for() -> None:
    found = run(cart(), u=3.0, dt=5e-3, every=5e-3)
    n = np.arange(len(found.t))
    np.testing.assert_allclose(found.x, 1.5 * 25e-6 * n * (n + 1) / 2, rtol=1e-12, atol=1e-15)


# --- what must not matter ---------------------------------------------------------------------------------------

VARIED: tuple[tuple[Effect, ...], ...] = (
    (),
    (CoulombFriction("shoulder", 0.4), TransportDelay("lift", 0.05)),
    (PayloadMass("tip", 0.4), StribeckFriction("reach", 1.0, 1.0, 0.05)),
    (DriveCompliance("shoulder", 80.0, 0.2), LoadFriction("reach", 0.3), SensorDelay("reach", 0.03)),
    (DriveCompliance("reach", 900.0, 1.0), ActuatorGain("lift", 0.7)),
)


def test_results_do_not_depend_on_threads_or_on_what_is_simulated_beside() -> None:
    models = [Model(RIG, effects) for effects in VARIED]
    trials = [swinging(k) for k in range(3)]
    together = simulate_mjcf(models, trials, threads=1)
    assert all(found.sound.all() for found in together)
    for threads in (2, 5):
        for one, two in zip(together, simulate_mjcf(models, trials, threads=threads), strict=True):
            np.testing.assert_array_equal(one.position, two.position)
    for k, model in enumerate(models):
        for i, trial in enumerate(trials):
            alone = simulate_mjcf([model], [trial], threads=2)[0]
            np.testing.assert_array_equal(alone.position[0], together[i].position[k])
    backwards = simulate_mjcf(models[::-1], trials[::-1], threads=2)
    for one, two in zip(together, backwards[::-1], strict=True):
        np.testing.assert_array_equal(one.position, two.position[::-1])
    spread = [np.abs(found.position - found.position[:1]).max(axis=(1, 2)) for found in together]
    assert np.min([row[1:] for row in spread]) > 1e-3, "the models should differ"


HUGE = cart(mass=1e-9)
"""What pushes it makes accelerations that MuJoCo warns of."""


@pytest.mark.parametrize("threads", [1, 2])
def test_a_model_that_diverges_says_how_far_it_came(
    threads: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    sound, wild = Model(HUGE), Model(HUGE, (ConstantForce("way", 1e3),))
    one = trial_of(until=0.1, every=0.01)
    found, again = simulate_mjcf([sound, wild, sound], [one, one], threads=threads)
    assert found.reached.tolist() == [11, 1, 11] == again.reached.tolist()
    assert found.sound.tolist() == [True, False, True]
    np.testing.assert_array_equal(found.position[[0, 2]], 0.0)
    assert list(tmp_path.iterdir()) == []
    out, err = capfd.readouterr()
    assert out == "" and err == ""


def test_a_divergence_is_found_where_speeds_mean_nothing_any_more() -> None:
    """After two seconds at 500 m/s²."""
    one = trial_of(until=4.0, every=0.25)
    (found,) = simulate_mjcf([Model(cart(), (ConstantForce("way", 1e3),))], [one], threads=1)
    assert found.reached.tolist() == [8]
    np.testing.assert_allclose(found.position[0, :8, 0], 250 * one.sample_times[:8] ** 2, atol=500 * 2 * DT)


def test_warnings_of_mujoco_are_heard_again_after_a_simulation() -> None:
    heard: list[str] = []
    mujoco.set_mju_user_warning(heard.append)
    try:
        simulate_mjcf([Model(HUGE, (ConstantForce("way", 1e3),))], [trial_of()], threads=1)
        assert heard == []
        assert mujoco.get_mju_user_warning() is not None
        data = mujoco.MjData(HUGE.plan.base)
        data.qfrc_applied[0] = 1e3
        mujoco.mj_step(HUGE.plan.base, data)
        assert len(heard) > 0
    finally:
        mujoco.set_mju_user_warning(None)


def test_trials_may_have_other_numbers() -> None:
    """Each from the same model, and none with what another was given."""
    model = Model(RIG.with_parameters({"arm.mass": 1.8}), (CoulombFriction("shoulder", 0.1),))
    plain = swinging()
    given: list[tuple[dict[str, float], dict[str, float], dict[str, float]]] = [
        ({}, {}, {}),
        ({"arm.mass": 2.5}, {}, {"arm.mass": 2.5}),
        ({}, {"arm.mass": 1.5}, {"arm.mass": 1.8 * 1.5}),
        ({"shoulder.damping": 1.0}, {"rod.mass": 2.0, "reach.stiffness": 0.5},
         {"shoulder.damping": 1.0, "rod.mass": 1.0, "reach.stiffness": 60.0}),
        ({"shoulder.frictionloss": 0.5}, {}, {"shoulder.frictionloss": 0.5}),
        ({"tilt": 0.3}, {"gravity": 0.5}, {"tilt": 0.3, "gravity": 0.5 * 9.81}),
        ({}, {}, {}),
    ]  # fmt: skip
    trials = [replace(plain, settings=settings, factors=factors) for settings, factors, _ in given]
    for threads in (1, 2):
        together = simulate_mjcf([model, model], trials, threads=threads)
        for found, (_, _, values) in zip(together, given, strict=True):
            alone = simulate_mjcf([model.with_parameters(values)], [plain], threads=1)[0]
            np.testing.assert_allclose(found.position[0], alone.position[0], rtol=0, atol=1e-12)
            np.testing.assert_array_equal(found.position[0], found.position[1])
    spread = [np.abs(found.position[0] - together[0].position[0]).max() for found in together]
    assert min(spread[1:-1]) > 1e-3 and spread[-1] == 0.0


# --- the motion inside, and small pushes ------------------------------------------------------------------------


def test_the_motion_inside_is_what_is_simulated() -> None:
    trial = swinging()
    model = Model(RIG, (SensorOffset("shoulder", 0.2), FirstOrderLag("lift", 0.05)))
    start = np.concatenate([trial.position, trial.velocity])
    motion = mjcf_motion(model, trial, start)
    seen = simulate_mjcf([model], [trial], threads=1)[0].position[0]
    np.testing.assert_allclose(motion.position, seen - [0.2, 0.0], rtol=0, atol=1e-12)
    slopes = np.diff(motion.position, axis=0) / np.diff(trial.sample_times)[:, None]
    np.testing.assert_allclose(motion.between.velocity, slopes, rtol=0, atol=0.02 * np.abs(slopes).max())
    np.testing.assert_allclose(motion.between.time, trial.sample_times[:-1] + 0.005)
    steady = mjcf_motion(Model(RIG), trial, start).between.pressure
    held = trial.commands[np.searchsorted(trial.times, trial.sample_times[:-1] + 0.005) - 1]
    np.testing.assert_allclose(steady, held, rtol=0, atol=1e-9)


def test_a_motion_that_diverges_is_told() -> None:
    with pytest.raises(SimulationDiverged, match="t: the simulation of cart diverged"):
        mjcf_motion(Model(cart(), (ConstantForce("way", 1e3),)), trial_of(until=3.0), np.zeros(2))


def test_the_answer_to_a_push_of_a_free_mass_is_known() -> None:
    one = trial_of(until=1.0, every=0.01)
    push = np.ones((100, 1, 2))
    push[:, 0, 1] = np.where(np.arange(100) < 30, -2.0, 0.0)
    (found,) = simulated_response(Model(cart()), [one], [np.array([0.1, 0.5])], np.array([1.0])).response([push])
    t = one.sample_times
    np.testing.assert_allclose(found[:, 0, 0], t**2 / 2 / M, rtol=0, atol=DT / M)
    later = np.maximum(t - 0.3, 0)
    np.testing.assert_allclose(found[:, 0, 1], -2 / M * (t**2 - later**2) / 2, rtol=0, atol=2 * DT / M)


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (SensorDelay("shoulder", 0.04), SensorScale("reach", 2.0)),
        (DriveCompliance("shoulder", 80.0, 0.3), ViscousFriction("reach", 3.0)),
    ],
    ids=["plain", "sensors", "compliance"],
)
def test_the_answer_to_a_push_is_the_difference_of_two_simulations(effects: tuple[Effect, ...]) -> None:
    """Also where trials have numbers of their own; columns that push nothing answer nothing."""
    trials = [swinging(), replace(swinging(1), settings={"arm.mass": 2.5})]
    starts = [np.concatenate([t.position, t.velocity]) for t in trials]
    push = np.zeros((len(trials[0].sample_times) - 1, 2, 3))
    push[:, 0, 0], push[:, 1, 2] = 1.0, 1.0
    model = Model(RIG, effects)
    found = simulated_response(model, trials, starts, np.array([1.0, 1.0])).response([push, push])
    h = 1e-3
    for k, trial in enumerate(trials):
        for joint, column in (("shoulder", 0), ("reach", 2)):
            either = [Model(RIG, (*effects, ConstantForce(joint, sign * h))) for sign in (1, -1)]
            more, without_parts = simulate_mjcf(either, [trial], threads=1)[0].position
            slope = (more - without_parts) / (2 * h)
            # One side alone is off by the curvature: a thousandth of a push, on an answer of some tenths.
            np.testing.assert_allclose(found[k][:, :, column], slope, rtol=0, atol=2e-3 * np.abs(slope).max())
            assert np.abs(slope).max() > 1e-3
        np.testing.assert_array_equal(found[k][:, :, 1], 0.0)


def test_pushes_belong_to_trials() -> None:
    one = trial_of(until=0.5, every=0.1)
    with pytest.raises(ConfigError, match="torques are for 2 trials, expected 1"):
        simulated_response(Model(cart()), [one], [np.zeros(2)], np.ones(1)).response([np.ones((5, 1, 1))] * 2)


def test_what_drives_and_gravity_push_is_told() -> None:
    own = realise(Model(hung(), (ActuatorGain("motor", 2.0), TorqueSaturation("motor", 5.0))))
    angles = np.array([[0.0], [math.pi / 2], [-0.4]])
    drives, weights = joint_forces(own, angles, np.zeros((3, 1)), np.array([[1.0], [-2.0], [4.0]]))
    np.testing.assert_allclose(drives[:, 0], [2.0, -4.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(weights[:, 0], WEIGHT * np.sin(angles[:, 0]), atol=1e-9)


# --- recordings of MJCF robots -------------------------------------------------------------------------------------


def recorded(robot: MjcfRobot, *effects: Effect, until: float = 3.0) -> Recording:
    one = trial_of([(0.0, 0.0), (0.5, 1.0), (1.5, -1.0)], q=0.4, until=until, every=0.01)
    found = run(robot, *effects, trial=one)
    command = np.array([0.0 if t < 0.5 else 1.0 if t < 1.5 else -1.0 for t in one.sample_times])[:, None]
    return Recording("r", found.t, command, found.x[:, None], robot.actuator_names, robot.joint_names)


def test_a_recording_is_predicted_from_where_and_how_fast_it_begins() -> None:
    robot = hung('damping="0.1"')
    recording = recorded(robot)
    found = predict(Model(robot), recording, engine="mujoco")
    np.testing.assert_allclose(found, recording.position, rtol=0, atol=5e-3)
    exact = predict(Model(robot), recording, engine="mujoco", start=np.array([0.4, 0.0]))
    np.testing.assert_allclose(exact, recording.position, rtol=0, atol=1e-12)
    late = replace(
        recording, time=recording.time[40:], command=recording.command[40:], position=recording.position[40:]
    )
    for engine in ("mujoco", "reduced"):
        np.testing.assert_allclose(predict(Model(robot), late, engine=engine), late.position, rtol=0, atol=0.02)


@pytest.mark.slow
def test_a_window_of_a_late_sensor_begins_in_motion() -> None:
    """What a sensor shows at first is what was before the window, when the joint moved already."""
    robot, effect = cart(), SensorDelay("way", 0.1)
    time = np.arange(0, 2.001, 0.01)
    rolled = 0.8 * np.maximum(time - 0.1, 0.0)
    recording = Recording("r", time, np.zeros((len(time), 1)), rolled[:, None], ("motor",), ("way",))
    model = Model(robot, (effect,))
    segments = cut(model, [recording], window=(0.5, 2.0), shoot=0.5)
    assert len(segments) == 3
    both = [Simulator(engine_for(model, name), 1) for name in ("reduced", "mujoco")]
    found = [p for own in both for p in own([model], segments, [s.start[None, :] for s in segments])]
    for segment, predicted in zip(segments * 2, found, strict=True):
        # As exact as smoothing what was recorded, by which a start is led.
        np.testing.assert_allclose(predicted.position[0], segment.measured, rtol=0, atol=1e-6)


@pytest.mark.parametrize("start", [np.zeros(5), np.array([math.nan])], ids=["too long", "nan"])
def test_a_start_that_is_none_is_refused_in_a_sentence(start: Array) -> None:
    with pytest.raises(ConfigError, match="r: the start is "):
        predict(Model(hung()), recorded(hung()), start=start)


def test_whole_trials_are_compared_where_a_model_can_follow_them() -> None:
    robot = hung('damping="0.1"')
    recording = recorded(robot)
    assert longest_interval(Model(robot), [recording], None).length is None
    off = Model(robot.with_parameters({"arm.com_z": -0.15}))
    length = longest_interval(off, [recording], None).length
    assert length is not None and 0.5 <= length < 3.0


def test_a_recording_may_be_cut_as_it_alone_allows() -> None:
    robot = hung('damping="0.1"')
    off, still = Model(robot.with_parameters({"arm.com_z": -0.17})), recorded(robot)
    short = replace(still, time=still.time[:200], command=still.command[:200], position=still.position[:200])
    own, other = (longest_interval(off, [one]).length for one in (still, short))
    both, _ = intervals_of(off, [still, short])
    assert both[0] == both[1] and len({own, other, both[0]}) == 3
    assert intervals_of(off, [still, short], apart={1})[0] == [own, other]
    assert intervals_of(off, [still, short], but={0})[0] == [other, other]
    # What is known by now follows it farther.
    assert intervals_of(off, [short, still], apart={1}, known=Model(robot))[0] == [other, None]


def test_a_model_that_diverges_in_the_shortest_windows_is_told() -> None:
    wild = Model(hung(), (AsymmetricDamping("pivot", -1e4),))
    with pytest.raises(SimulationDiverged, match="pendulum: the model diverges on the recorded commands"):
        longest_interval(wild, [recorded(hung())], None)
