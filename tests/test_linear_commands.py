"""Commands that go along a line between rows: against a fine staircase, an adaptive integration and their recordings."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mjcf_models import refusal
from pendulum_runs import MOTOR, PENDULUM, SERVO
from scipy.integrate import solve_ivp
from test_command_laws import BEFORE, TIMES, VALUES, VALVES, close

from equimus_ctrl import recordings
from equimus_ctrl.effects.command import pressure_history
from equimus_ctrl.effects.relaxation import relax, relax_along
from equimus_ctrl.effects.valves import FirstOrderLag, TransportDelay
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.predict import predict
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

INF = math.inf
PIECES = 4000
MASS, LENGTH, ABOUT, GRAVITY = 0.6, 0.4, 0.004 + 0.002 + 0.6 * 0.4**2, 9.81
"""Of the pendulum of ``pendulum_runs``, with its inertia about the hinge [kg m²]."""


def staircase(
    pressure: float, target: float, slope: float, fill: float, vent: float, rise: float, fall: float, span: float
) -> tuple[float, float, float]:
    """The same under many targets that are held in turn, at the means of their pieces of the line."""
    area, moment, h = 0.0, 0.0, span / PIECES
    for k in range(PIECES):
        aim = target + slope * (k + 0.5) * h
        rate = rise if aim > pressure else fall
        pressure, piece, first = relax(pressure, aim, fill, vent, rate, h)
        area += piece
        moment += first + k * h * piece
    return pressure, area, moment


@settings(deadline=None, max_examples=150, derandomize=True)
@given(
    pressure=st.floats(0, 5e4),
    target=st.floats(0, 5e4),
    slope=st.one_of(st.just(0.0), st.floats(-2e5, 2e5)),
    fill=st.one_of(st.just(0.0), st.floats(5e-3, 1.0)),
    vent=st.one_of(st.just(0.0), st.floats(5e-3, 1.0)),
    rise=st.one_of(st.just(INF), st.floats(1e3, 3e5)),
    fall=st.one_of(st.just(INF), st.floats(1e3, 3e5)),
    span=st.floats(0.01, 0.5),
)
def test_a_line_is_the_limit_of_a_fine_staircase(
    pressure: float, target: float, slope: float, fill: float, vent: float, rise: float, fall: float, span: float
) -> None:
    found = relax_along(pressure, target, slope, fill, vent, rise, fall, span)
    expected = staircase(pressure, target, slope, fill, vent, rise, fall, span)
    scale = 5e4 + abs(slope) * span
    for one, other, order in zip(found, expected, (0, 1, 2), strict=True):
        close(one, other, scale * span**order, 1e-3)


@settings(deadline=None, max_examples=200, derandomize=True)
@given(
    pressure=st.floats(0, 5e4),
    target=st.floats(0, 5e4),
    fill=st.one_of(st.just(0.0), st.floats(5e-3, 1.0)),
    vent=st.one_of(st.just(0.0), st.floats(5e-3, 1.0)),
    rate=st.one_of(st.just(INF), st.floats(1e3, 3e5)),
    span=st.floats(0.01, 0.5),
)
def test_a_level_line_is_what_is_held(
    pressure: float, target: float, fill: float, vent: float, rate: float, span: float
) -> None:
    found = relax_along(pressure, target, 0.0, fill, vent, rate, rate, span)
    for one, other, order in zip(found, relax(pressure, target, fill, vent, rate, span), (0, 1, 2), strict=True):
        close(one, other, 5e4 * span**order)


@settings(deadline=None, max_examples=200, derandomize=True)
@given(
    pressure=st.floats(0, 5e4), target=st.floats(0, 5e4), slope=st.floats(-2e5, 2e5), fill=st.floats(5e-3, 1.0),
    vent=st.floats(5e-3, 1.0), rate=st.one_of(st.just(INF), st.floats(1e3, 3e5)), span=st.floats(0.01, 0.5),
    share=st.floats(0.05, 0.95),
)  # fmt: skip
def test_two_parts_of_a_line_are_the_whole(
    pressure: float, target: float, slope: float, fill: float, vent: float, rate: float, span: float, share: float
) -> None:
    part = share * span
    whole = relax_along(pressure, target, slope, fill, vent, rate, rate, span)
    one = relax_along(pressure, target, slope, fill, vent, rate, rate, part)
    two = relax_along(one[0], target + slope * part, slope, fill, vent, rate, rate, span - part)
    close(two[0], whole[0], 1e5, 1e-8)
    close(one[1] + two[1], whole[1], 1e5 * span, 1e-8)
    close(one[2] + two[2] + part * two[1], whole[2], 1e5 * span**2, 1e-8)


@pytest.mark.parametrize("name", VALVES)
def test_a_history_is_that_of_a_fine_staircase(name: str) -> None:
    """With delays, rows that come and go within a step, and a start after the first row."""
    valve, dt = np.array([VALVES[name]]), 0.01
    fine = np.arange(0.0, 1.5, 1e-4)
    aims = np.interp(fine + 0.5e-4, TIMES, VALUES)
    aims[fine < TIMES[0]] = BEFORE
    held, linear = np.empty((2, 120, 2, 1))
    before = np.array([BEFORE])
    for start in (0.1, 0.45):
        pressure_history(fine, aims[:, None].copy(), before, valve, start, dt, held)
        pressure_history(TIMES, VALUES[:, None].copy(), before, valve, start, dt, linear, True)
        # A filling flow is that in the middle of a line, or of its part in a step.
        assert np.abs(linear - held).max() < (2e-4 if valve[0, 4] == INF else 4e-3) * 4e4
    assert name == "late" or np.abs(np.diff(linear[:, 0, 0])).max() > 100.0, "the pressure should move"


def slow(name: str = "slow", linear: bool = True, times: float = 0.11) -> Recording:
    """A pendulum's commands in rows that are far apart, and no motion worth the name."""
    time = np.arange(0.0, 2.001, 0.01)
    rows = np.arange(0.0, 2.2, times)
    torque = np.interp(time, rows, 2.0 * np.sin(7 * rows))
    notes = {"interpolation": "linear"} if linear else {}
    return Recording(name, time, torque[:, None], 0.1 * np.ones((len(time), 1)), ("drive",), ("hinge",), notes=notes)


def swung(time: Array, torque: Array, delay: float = 0.0, lag: float = 0.0) -> Array:
    """(n,) angles of the pendulum from rest at 0.1 rad, by an adaptive method: the torque goes along a line."""

    def rates(t: float, x: Array) -> list[float]:
        command = float(np.interp(t - delay, time, torque))
        arrives = x[2] if lag else command
        return [
            x[1],
            (arrives - MASS * GRAVITY * LENGTH * math.sin(x[0])) / ABOUT,
            (command - x[2]) / lag if lag else 0,
        ]

    found = solve_ivp(
        rates, (0.0, float(time[-1])), [0.1, 0.0, torque[0]], t_eval=time, method="DOP853", rtol=1e-10, atol=1e-10,
        max_step=2e-3,
    )  # fmt: skip
    return np.asarray(found.y[0])


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_both_engines_follow_a_torque_along_lines(engine: EngineName) -> None:
    """Rows 0.11 s apart: held, they lead elsewhere."""
    model = Model(MjcfRobot("arm", PENDULUM.format(drive=MOTOR)))
    trial = slow()
    rows = trial.time[::11]
    coarse = Recording(
        "rows", rows, trial.command[::11].copy(), trial.position[::11].copy(), ("drive",), ("hinge",), notes=trial.notes
    )
    expected = swung(rows, coarse.command[:, 0])
    start = np.array([0.1, 0.0])
    bound = {"reduced": 1e-6, "mujoco": 3e-4}[engine]  # MuJoCo's integrator is of order one
    dt = {"reduced": 1e-3, "mujoco": 1e-5}[engine]
    assert np.abs(predict(model, coarse, engine=engine, dt=dt, start=start)[:, 0] - expected).max() < bound
    held = replace(coarse, notes={})
    assert np.abs(predict(model, held, engine=engine, dt=dt, start=start)[:, 0] - expected).max() > 0.05


def test_a_late_and_lagging_torque_goes_along_lines_too() -> None:
    effects = (TransportDelay("drive", 0.037), FirstOrderLag("drive", 0.06))
    model = Model(MjcfRobot("arm", PENDULUM.format(drive=MOTOR)), effects)
    trial = slow()
    expected = swung(trial.time, trial.command[:, 0], delay=0.037, lag=0.06)
    assert np.abs(predict(model, trial, start=np.array([0.1, 0.0]))[:, 0] - expected).max() < 1e-5


def test_the_engines_agree_on_a_servo_along_lines() -> None:
    model = Model(MjcfRobot("arm", PENDULUM.format(drive=SERVO)), (FirstOrderLag("drive", 0.03),))
    trial = slow()
    start = np.array([0.1, 0.0])
    exact = predict(model, trial, engine="reduced", start=start)
    assert np.abs(predict(model, trial, engine="mujoco", dt=2e-5, start=start) - exact).max() < 3e-4


def test_shooting_intervals_go_along_the_same_lines() -> None:
    """The part of a line that lies before an interval has done what it does to the lag."""
    model = Model(MjcfRobot("arm", PENDULUM.format(drive=MOTOR)), (FirstOrderLag("drive", 0.2),))
    whole, *_ = cut(model, [slow()])
    parts = cut(model, [slow()], shoot=0.5)
    assert {s.trial.linear for s in (whole, *parts)} == {True}
    assert len({s.trial.history for s in parts}) == 1


def test_commands_at_instants_are_those_in_force() -> None:
    time = np.array([0.0, 1.0, 3.0])
    trial = Trial("t", time, np.array([[0.0], [2.0], [4.0]]), np.array([-1.0]), 0.0, np.zeros(1), time)
    instants = np.array([-1.0, 0.0, 0.5, 2.0, 3.0, 9.0])
    np.testing.assert_allclose(trial.command_at(instants)[:, 0], [-1, 0, 0, 2, 4, 4])
    np.testing.assert_allclose(replace(trial, linear=True).command_at(instants)[:, 0], [-1, 0, 1, 3, 4, 4])


def test_the_note_is_kept_by_files_and_other_words_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "slow.csv"
    recordings.write(file, slow())
    assert recordings.read(file, limits=recordings.Limits.of_mjcf(["hinge"], ["drive"])).linear
    file.write_text(file.read_text().replace("= linear", "= cubic"))
    told = refusal(lambda: recordings.read(file, limits=recordings.Limits.of_mjcf(["hinge"], ["drive"])))
    assert told.endswith("row 1: note 'interpolation' is 'cubic', expected hold or linear")
    assert "expected hold or linear" in refusal(
        lambda: recordings.write(file, replace(slow(), notes={"interpolation": "cubic"}))
    )
