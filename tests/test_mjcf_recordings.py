"""Recordings of MJCF robots: numbers in their notes, and their columns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mjcf_models import CRANE, PENDULUM, refusal
from scipy.integrate import solve_ivp

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis import plausibility
from equimus_ctrl.diagnosis.holdout import check_settings, split
from equimus_ctrl.effects import ViscousFriction
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.errors import RecordingError
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.mjcf import read_trials


def recording(notes: Mapping[str, str] | None = None, name: str = "trial", robot: MjcfRobot = PENDULUM) -> Recording:
    """Two seconds of a swinging pendulum."""
    time = np.arange(0, 2.001, 0.01)
    na, nj = len(robot.actuators), len(robot.joints)
    position = np.tile(0.3 * np.cos(4 * time)[:, None], (1, nj))
    return Recording(
        name, time, np.zeros((len(time), na)), position, robot.actuator_names, robot.joint_names, notes=notes or {}
    )


NOTED = [
    ({"set.arm.mass": "1.7"}, {"arm.mass": 1.7}),
    ({"times.arm.mass": "1.7"}, {"arm.mass": 1.7}),
    ({"set.arm.mass": "1.7", "times.arm.com_z": "0.5", "rig": "A"}, {"arm.mass": 1.7, "arm.com_z": -0.15}),
    ({"set.tilt": "-0.2"}, {"tilt": -0.2}),
    ({"times.arm.com_z": "-1"}, {"arm.com_z": 0.3}),
]


@pytest.mark.parametrize(("notes", "values"), NOTED)
def test_numbers_in_notes_reach_the_simulation(notes: dict[str, str], values: dict[str, float]) -> None:
    """The factors count from what the model has, whatever that is."""
    model = Model(PENDULUM, (ViscousFriction("pivot", 0.1),))
    (segment,) = cut(model, [recording(notes)])
    (plain,) = cut(model.with_parameters(values), [recording()])
    found, expected, unchanged = (
        simulate_mjcf([m], [s.trial], starts=[s.start[None, :]], threads=1)[0].position
        for m, s in ((model, segment), (model.with_parameters(values), plain), (model, plain))
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert np.abs(found - unchanged).max() > 1e-2
    np.testing.assert_allclose(predict(model, recording(notes)), predict(model.with_parameters(values), recording()))


def test_windows_of_one_recording_have_its_notes() -> None:
    segments = cut(Model(PENDULUM), [recording({"set.arm.mass": "1.7"}), recording()], shoot=0.5)
    assert [dict(s.trial.settings) for s in segments] == [{"arm.mass": 1.7}] * 4 + [{}] * 4


MOVING = {"settled": "no"}


@pytest.mark.parametrize(
    ("shoot", "window", "begins"),
    [(0.5, None, 0.1), (None, None, 0.4), (0.5, (0.05, 1.05), 0.1), (0.5, (0.3, 1.3), 0.3), (5.0, (0.0, 1.0), 0.2)],
)
def test_a_recording_that_begins_in_motion_is_compared_once_its_commands_have_arrived(
    shoot: float | None, window: tuple[float, float] | None, begins: float
) -> None:
    """Commands from before it, which nobody knows, arrive within a fifth of an interval: the longest delay."""
    moving = recording(MOVING)
    segments = cut(Model(PENDULUM), [moving], window=window, shoot=shoot)
    assert segments[0].trial.start == segments[0].trial.sample_times[0] == pytest.approx(begins)
    assert segments[0].trial.times[0] == 0.0, "its first commands are known, and count"
    np.testing.assert_array_equal(segments[0].measured[0], moving.position[round(100 * begins)])
    (first, *_), (known, *_) = (
        cut(Model(PENDULUM), [own], window=window, shoot=shoot)
        for own in (recording(), replace(moving, before=np.zeros(1)))
    )
    assert first.trial.start == known.trial.start == (window or (0.0,))[0]


def test_a_recording_of_which_too_little_is_left_is_told_with_how_long_it_is() -> None:
    told = refusal(lambda: cut(Model(PENDULUM), [recording(MOVING)], window=(0.0, 0.1)))
    assert told == "trial: no shooting interval of 0.1 s holds 10 samples; expected at least 0.2 s"


def test_what_is_not_compared_for_that_is_told() -> None:
    trials = [recording(MOVING, f"trial {k}") for k in range(3)] + [recording(name="at rest")]
    parts = split(Model(PENDULUM), trials, shoot=0.5)
    (told,) = plausibility.left_out_at_first(trials, parts)
    assert told.startswith("trial 0, trial 1, trial 2: in motion at the first row (settled = no), and what was")
    assert "so the first 0.1 s are not compared" in told and "at rest" not in told
    last = replace(parts, train=parts.train[-1:], validation=(), test=())
    (told,) = plausibility.left_out_at_first(trials, last)
    assert "so the first 0.09" in told, "that of an interval, whichever of them are fitted"
    assert plausibility.left_out_at_first(trials[3:], parts) == []
    later = split(Model(PENDULUM), trials, shoot=0.5, window=(0.3, 1.9))
    assert plausibility.left_out_at_first(trials, later, (0.3, 1.9)) == [], "the window leaves it out"


WRONG_NOTES = [
    ({"set.arm.mas": "1"}, "note set.arm.mas: there is no parameter 'arm.mas'; did you mean 'arm.mass'?"),
    ({"times.arm.mas": "1"}, "note times.arm.mas: there is no parameter 'arm.mas'; did you mean 'arm.mass'?"),
    ({"set.arm.mass": "heavy"}, "note set.arm.mass is 'heavy', expected a number"),
    ({"times.arm.mass": ""}, "note times.arm.mass is '', expected a factor"),
    ({"set.arm.mass": "-1"}, "arm.mass is -1, expected a finite number of at least 0"),
    ({"set.arm.mass": "nan"}, "arm.mass is nan, expected a finite number of at least 0"),
    ({"times.arm.mass": "inf"}, "arm.mass is inf, expected a finite number of at least 0"),
]


@pytest.mark.parametrize(("notes", "message"), WRONG_NOTES, ids=[str(notes) for notes, _ in WRONG_NOTES])
def test_notes_that_say_nothing_usable_are_told_with_the_recordings_name(notes: dict[str, str], message: str) -> None:
    told = refusal(lambda: cut(Model(PENDULUM), [recording(notes, "third trial")]))
    assert message in told
    assert told.startswith("third trial: ")


@pytest.mark.parametrize("shoot", [None, 0.5])
def test_notes_of_numbers_are_for_every_robot(shoot: float | None) -> None:
    leg = Model(nominal_leg())
    time = np.arange(0, 2.001, 0.01)
    rest = Recording(
        "leg", time, np.zeros((len(time), 2)), np.tile([1.2, 0.8], (len(time), 1)), leg.morphology.actuator_names,
        leg.morphology.joint_names, notes={"set.hip.damping": "1", "payload.foot": "0.1"},
    )  # fmt: skip
    for segment in cut(leg, [rest], shoot=shoot):
        own = segment.trial.robot_in(leg.robot).parameters()
        assert own["hip.damping"] == 1.0
        assert own["calf.mass"] == pytest.approx(leg.robot.parameters()["calf.mass"] + 0.1)


def test_a_number_that_every_recording_gives_cannot_be_free() -> None:
    model = Model(PENDULUM)
    free = free_parameters(model, ["arm.mass", "arm.inertia"])
    noted = [recording({"set.arm.mass": "1.2"}, f"trial {k}") for k in range(3)]
    told = refusal(lambda: check_settings(free, split(model, noted, shoot=1.0)))
    assert told.startswith("arm.mass is free, but the notes of every recording set it (set.arm.mass)")
    mixed = [*noted[:2], recording(name="without")]
    check_settings(free, split(model, mixed, shoot=1.0))
    check_settings(free_parameters(model, ["arm.inertia"]), split(model, noted, shoot=1.0))
    factors = [recording({"times.arm.mass": "1.2"}, f"trial {k}") for k in range(3)]
    check_settings(free, split(model, factors, shoot=1.0))


def test_recordings_with_other_names_are_told_with_the_right_ones() -> None:
    told = refusal(lambda: cut(Model(CRANE), [recording(robot=PENDULUM)]))
    assert all(name in told for name in (*CRANE.joint_names, *CRANE.actuator_names, "pivot", "motor"))


def written(path: Path, header: str) -> Path:
    rows = [f"{k * 0.01:.2f}" + ",0" * header.count(",") for k in range(50)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("header", "parts"),
    [
        ("time,cmd.push,cmd.servo,cmd.drive,pos.sholder,pos.reach", ("pos.shoulder", "reach")),
        (
            "time,cmd.push,cmd.servo,cmd.drive,pos.hip,pos.knee",
            ("'pos.shoulder' for joint shoulder", "pos.hip, pos.knee"),
        ),
        ("time,cmd.push,cmd.servo,pos.shoulder,pos.reach", ("cmd.drive", "push and servo and drive")),
        ("time,cmd.a,cmd.b,cmd.c,pos.shoulder,pos.reach", ("'cmd.push' for actuator push", "cmd.a, cmd.b, cmd.c")),
        ("time,push,servo,drive,pos.shoulder,pos.reach", ("push", "cmd.<actuator>")),
        ("time,pos.shoulder,pos.reach", ("cmd.<actuator>",)),
    ],
)
def test_wrong_columns_are_told_with_the_right_ones(header: str, parts: tuple[str, ...], tmp_path: Path) -> None:
    path = written(tmp_path / "trial.csv", header)
    told = refusal(lambda: read_trials([path], CRANE))
    assert told.startswith(str(path)) and all(part in told for part in parts)
    with pytest.raises(RecordingError):
        read_trials([path], CRANE)


def test_columns_come_in_the_robots_order_whatever_the_files(tmp_path: Path) -> None:
    header = "time,pos.reach,pos.shoulder,cmd.drive,cmd.servo,cmd.push"
    path = tmp_path / "trial.csv"
    rows = [f"{k * 0.01:.2f},{100 * k},{-0.1 * k:g},3,-2,1e6" for k in range(50)]
    path.write_text("\n".join([header, *rows]) + "\n")
    (found,) = read_trials([path], CRANE)
    assert (found.joints, found.actuators) == (CRANE.joint_names, CRANE.actuator_names)
    np.testing.assert_array_equal(found.command[0], [1e6, -2, 3])
    np.testing.assert_array_equal(found.position[2], [-0.2, 200])


LOADED = """<mujoco model="loaded"><compiler angle="radian" boundmass="1e-12" boundinertia="1e-15"/><option timestep="0.001"/>
  <worldbody><body name="arm"><joint name="pivot" axis="0 1 0" armature="0.02"/>
    <inertial mass="1" pos="0 0 -0.3" diaginertia="0.01 0.01 0.01"/>
    <body name="load" pos="0.02 0 -0.6"><inertial mass="1e-9" pos="0 0 0" diaginertia="1e-12 1e-12 1e-12"/></body>
  </body></worldbody>
  <actuator><motor name="motor" joint="pivot"/></actuator></mujoco>"""


@pytest.mark.slow
def test_a_load_that_was_weighed_is_known_in_its_own_trials_and_the_arm_is_estimated_from_all() -> None:
    """The true motions are those of a pendulum with the load's moments worked out by hand."""
    time, rng = np.arange(0, 3.0, 0.01), np.random.default_rng(2)
    trials = []
    for k, load in enumerate((0.0, 0.4, 1.1)):
        torque = 1.5 * np.sin((3 + k) * time)
        about = 0.02 + 0.01 + 1.2 * 0.3**2 + load * (0.02**2 + 0.6**2)  # of the true arm, of 1.2 kg

        def rates(
            t: float, x: np.ndarray, torque: np.ndarray = torque, load: float = load, about: float = about
        ) -> list[float]:
            # The pivot turns +z to +x: a mass at (x, z) pulls with −m g (x cos q + z sin q).
            down = -9.81 * ((1.2 * -0.3 + load * -0.6) * -np.sin(x[0]) - load * 0.02 * np.cos(x[0]))
            return [x[1], (float(np.interp(t, time, torque)) + down) / about]

        angle = solve_ivp(rates, (0, time[-1]), [0.2, 0.0], t_eval=time, rtol=1e-9, atol=1e-9, max_step=5e-3).y[0]
        notes = {"interpolation": "linear", **({"set.load.mass": str(load)} if load else {})}
        position = (angle + rng.normal(0, 1e-3, len(time)))[:, None]
        trials.append(Recording(f"t{k}", time, torque[:, None], position, ("motor",), ("pivot",), notes=notes))
    model = Model(MjcfRobot("loaded", LOADED))
    fit = workflow.identify_recordings(trials, model, free=["arm.mass"], folds=0).fit
    assert fit.rmse[0] < 1.1e-3
    assert fit.theta[0] == pytest.approx(1.2, abs=1.5 * fit.uncertainty.half_width[0]) and fit.theta[0] > 1.195
    blind = [replace(t, notes={"interpolation": "linear"}) for t in trials]
    assert workflow.identify_recordings(blind, model, free=["arm.mass"], folds=0).fit.rmse[0] > 0.05
