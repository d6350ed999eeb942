"""Open-loop prediction: against an independent integration, engine against engine, and the exact leg's recordings."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from morphologies import newton_acceleration
from scipy.integrate import solve_ivp

from equimus_ctrl.effects import (
    AsymmetricLag,
    CoulombFriction,
    Creep,
    Effect,
    FirstOrderLag,
    Hysteresis,
    NarrowingArea,
    NonlinearStiffness,
    ParallelSpring,
    StribeckFriction,
    TransportDelay,
)
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.predict import check_columns, local_motion, measured_start, predict
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.recordings import read_set
from equimus_ctrl.robots.elastic.leg import ideal_leg, nominal_leg
from equimus_ctrl.robots.elastic.morphology import JointStop, Morphology, Phase
from equimus_ctrl.types import Array, Recording, Start

ENGINES: tuple[EngineName, ...] = ("reduced", "mujoco")
LEG = nominal_leg()
COLUMNS = (LEG.actuator_names, LEG.joint_names)


every_engine = pytest.mark.parametrize("engine", ENGINES)


def made_up(
    commands: list[tuple[float, tuple[float, float]]],
    *,
    duration: float = 3.0,
    first: float = 0.0,
    start: tuple[float, float] = (1.3, 0.9),
    before: tuple[float, float] | None = None,
    rate: float = 97.0,
    **changes: Any,
) -> Recording:
    """A trial at jittered times; each (from time, command) holds from the first row at or after its time."""
    rng = np.random.default_rng(4)
    gaps = rng.uniform(0.5, 1.5, int(duration * rate)) / rate
    time = first + np.concatenate([[0.0], np.cumsum(gaps)])
    command = np.zeros((len(time), 2))
    for at, value in commands:
        command[time >= first + at] = value
    return Recording(
        "made_up",
        time,
        command,
        np.tile(start, (len(time), 1)),
        *COLUMNS,
        before=None if before is None else np.array(before),
        **changes,
    )


START = np.array([1.3, 0.9])
STEPS = [(0.0, (5e3, 2e3)), (0.4, (20e3, 2e3)), (1.1, (20e3, 15e3)), (1.9, (3e3, 8e3))]


# --- the oracle -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """A stretch of constant target: the pressure is target + (at − target)·exp(−(t − start)/tau)."""

    start: float
    target: float
    at: float
    tau: float

    def pressure(self, t: float) -> float:
        decay = math.exp(-(t - self.start) / self.tau) if self.tau > 0 else 0.0
        return self.target + (self.at - self.target) * decay


def pieces(recording: Recording, actuator: int, effects: tuple[Effect, ...]) -> list[Piece]:
    """The pressure of one actuator over time, by hand for each kind of effect."""
    delay, fill, vent = 0.0, 0.0, 0.0
    for effect in effects:
        if effect.location != recording.actuators[actuator]:
            continue
        if isinstance(effect, TransportDelay):
            delay += effect.delay
        elif isinstance(effect, FirstOrderLag):
            fill = vent = effect.time_constant
        elif isinstance(effect, AsymmetricLag):
            fill, vent = effect.fill, effect.vent
    now = recording.command_before[actuator]
    found = [Piece(recording.time[0], now, now, 0.0)]
    for t, command in zip(recording.time, recording.command[:, actuator], strict=True):
        if command != found[-1].target:
            at = found[-1].pressure(t + delay)
            found.append(Piece(t + delay, command, at, fill if command > at else vent))
    return found


def exact(
    m: Morphology, recording: Recording, start: Array, effects: tuple[Effect, ...] = (), phase: Phase = "swing"
) -> Array:
    """(n, nj) by an adaptive method, stopped and restarted at every change of a pressure's law."""
    laws = [pieces(recording, i, effects) for i in range(len(m.actuators))]
    switches = sorted({piece.start for law in laws for piece in law if piece.start < recording.time[-1]})
    k = Kinematics(m, phase)
    n = len(m.joints)
    state = np.concatenate([start, np.zeros(n)])
    out = np.empty((len(recording.time), n))
    for begin, end in zip(switches, [*switches[1:], recording.time[-1]], strict=True):
        current = [[piece for piece in law if piece.start <= begin][-1] for law in laws]

        def slope(t: float, x: Array, current: list[Piece] = current) -> Array:
            pressure = [piece.pressure(t) for piece in current]
            return np.concatenate([x[n:], k.acceleration(x[:n], x[n:], pressure)])

        found = solve_ivp(slope, (begin, end), state, method="DOP853", rtol=1e-9, atol=1e-11, dense_output=True)
        assert found.success
        inside = (recording.time >= begin) & (recording.time <= end)
        out[inside] = found.sol(recording.time[inside])[:n].T
        state = found.y[:, -1]
    return out


def test_the_oracles_equations_are_the_independent_ones() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        q, v, p = rng.uniform([0.4, -0.1], [2.7, 2.1]), rng.normal(0, 3, 2), rng.uniform(0, 5e4, 2)
        np.testing.assert_allclose(Kinematics(LEG).acceleration(q, v, p), newton_acceleration(LEG, q, v, p), rtol=1e-9)


EFFECTS: dict[str, tuple[Effect, ...]] = {
    "none": (),
    "delay": (TransportDelay("maa", 0.0837), TransportDelay("baa", 0.2001)),
    "lag": (FirstOrderLag("maa", 0.15), FirstOrderLag("baa", 0.03)),
    "asymmetric lag": (AsymmetricLag("maa", 0.05, 0.4), AsymmetricLag("baa", 0.3, 0.02)),
    "delay and lag": (TransportDelay("maa", 0.05), FirstOrderLag("maa", 0.2), AsymmetricLag("baa", 0.1, 0.25)),
}


@lru_cache(maxsize=16)
def case(name: str, on_the_step: bool = False) -> tuple[Model, Recording, Array]:
    """A model with effects, a trial whose clock is not at zero, and what an independent integration makes of it.

    The start is no rest, and the command before another than the first.
    """
    recording = made_up(STEPS, first=3.7, before=(9e3, 0.0))
    if on_the_step:
        recording = replace(recording, time=np.unique(np.round(recording.time, 3)))
    expected = exact(LEG, recording, START, EFFECTS[name])
    assert np.ptp(expected, axis=0).min() > 0.1
    low, high = LEG.joint_range
    assert np.all((expected > low) & (expected < high))  # the stops' kinks are another test's matter
    return Model(LEG, EFFECTS[name]), recording, expected


@every_engine
@pytest.mark.parametrize("name", EFFECTS)
def test_both_engines_follow_an_independent_integration(name: str, engine: EngineName) -> None:
    model, recording, expected = case(name)
    np.testing.assert_allclose(predict(model, recording, start=START, engine=engine), expected, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "bound"),
    [("none", 3e-6), ("delay", 2e-7), ("lag", 6e-8), ("asymmetric lag", 3e-8), ("delay and lag", 2e-8)],
)
def test_the_reduced_engine_is_as_exact_as_its_valves(name: str, bound: float) -> None:
    """A change of the command within a step acts by its mean and by when it comes.

    Lagging pressures are followed to 6e-8 rad, whatever their time constants; a step of 15 kPa costs up to 3e-6.
    """
    model, recording, expected = case(name)
    np.testing.assert_allclose(predict(model, recording, start=START), expected, atol=bound)


def test_commands_that_change_on_a_physics_step_are_followed_to_a_ten_millionth() -> None:
    model, recording, expected = case("none", on_the_step=True)
    np.testing.assert_allclose(predict(model, recording, start=START), expected, atol=1e-7)


def test_the_ideal_leg_is_predicted_by_the_same_kernel() -> None:
    recording = made_up(STEPS, duration=1.5)
    expected = exact(ideal_leg(), recording, START)
    np.testing.assert_allclose(predict(Model(ideal_leg()), recording, start=START), expected, atol=1e-4)


FREE = replace(LEG, joints=tuple(replace(j, lower=None, upper=None) for j in LEG.joints))


def test_stance_is_predicted_by_the_reduced_engine() -> None:
    recording = made_up([(0.0, (5e3, 2e3)), (0.2, (10e3, 4e3))], duration=0.6)
    expected = exact(FREE, recording, START, phase="stance")
    assert np.ptp(expected, axis=0).min() > 0.01
    np.testing.assert_allclose(predict(Model(FREE, phase="stance"), recording, start=START), expected, atol=1e-5)


def test_stance_is_predicted_by_mujoco_too() -> None:
    recording = made_up([(0.0, (5e3, 2e3)), (0.2, (10e3, 4e3))], duration=0.6)
    model = Model(FREE, phase="stance")
    found = predict(model, recording, start=START, engine="mujoco")
    np.testing.assert_allclose(found, predict(model, recording, start=START), atol=1e-4)


def test_the_engines_agree_where_the_leg_hits_its_stop() -> None:
    """The knee falls onto its stop and rests there.

    The instant of the blow lies within a step, and the stop's damper sets in at once, so no fixed step is exact.
    """
    recording = made_up([(0.0, (5e3, 2e3)), (0.3, (5e3, 45e3)), (1.6, (5e3, 0.0))], duration=2.5)
    expected = exact(LEG, recording, START)
    low, high = LEG.joint_range
    assert np.any((expected < low) | (expected > high))
    np.testing.assert_allclose(predict(Model(LEG), recording, start=START), expected, atol=1e-3)
    np.testing.assert_allclose(predict(Model(LEG), recording, start=START, engine="mujoco"), expected, atol=1e-3)


@pytest.mark.parametrize("name", EFFECTS)
def test_a_run_of_the_plant_played_back_through_the_engine_is_the_run(name: str) -> None:
    """The plant and the engine hold one law of the valves, one clock and one start."""
    plant = MujocoPlant(Model(LEG, EFFECTS[name]))
    rng = np.random.default_rng(2)
    commands = rng.uniform(0, 30e3, (12, 2)).repeat(7, axis=0)
    before = np.array([4e3, 1e3])
    seen = [plant.reset(Start(command=before))]
    seen += [plant.step(command) for command in commands]
    time = np.arange(len(seen)) / 120
    position = np.array([observation.position for observation in seen])
    assert np.ptp(position, axis=0).min() > 0.05
    trial = Recording("run", time, np.vstack([commands, commands[-1]]), position, *COLUMNS, before=before)
    found = predict(plant.model, trial, engine="mujoco", start=position[0])
    np.testing.assert_allclose(found, position, atol=1e-9)


PUSHING: dict[str, tuple[tuple[Effect, ...], float]] = {
    "springs": ((ParallelSpring("hip", 2.0, 1.1), NonlinearStiffness("maa", 2e4, 0.17)), 1.5e-4),
    "areas": ((NarrowingArea("maa", 1.0), NarrowingArea("baa", -0.3)), 1.5e-4),
    "memories": ((Creep("maa", 150.0, 0.3), Hysteresis("baa", 1.0, 0.01)), 2e-4),
    "friction at joints": ((CoulombFriction("hip", 0.3), StribeckFriction("knee", 0.02, 0.03, 0.5)), 1e-3),
    "friction at drives": ((CoulombFriction("maa", 2.0), CoulombFriction("baa", 1.0)), 1.5e-3),
}
"""Effects and how far MuJoCo may be from the reduced engine [rad]; its dry friction gives way a little."""


@pytest.mark.parametrize("name", PUSHING)
def test_the_engines_and_the_plant_agree_on_what_pushes(name: str) -> None:
    effects, tolerance = PUSHING[name]
    model, recording = Model(FREE, effects), made_up(STEPS, duration=2.0)
    expected = predict(model, recording, start=START)
    assert np.abs(expected - predict(Model(FREE), recording, start=START)).max() > 0.02
    np.testing.assert_allclose(
        predict(model, recording, start=START, engine="mujoco"), expected, rtol=0, atol=tolerance
    )
    plant = MujocoPlant(model)
    seen = [plant.reset(Start(position=START, command=STEPS[0][1]))]
    seen += [plant.step(STEPS[1][1]) for _ in range(60)]
    time = np.arange(61) / 120
    run = Recording("run", time, np.tile(STEPS[1][1], (61, 1)), np.zeros((61, 2)), *COLUMNS, before=STEPS[0][1])
    found = np.array([observation.position for observation in seen])
    np.testing.assert_allclose(found, predict(model, run, start=START), rtol=0, atol=tolerance)


@every_engine
def test_an_equilibrium_stays_where_it_is(engine: EngineName) -> None:
    pressure = (12e3, 3e3)
    rest = Kinematics(LEG).equilibrium(pressure)
    recording = made_up([(0.0, pressure)], start=tuple(rest))
    np.testing.assert_allclose(predict(Model(LEG), recording, engine=engine), recording.position, atol=2e-6)


@every_engine
def test_the_same_call_gives_the_same_bits_and_leaves_the_recording_alone(engine: EngineName) -> None:
    recording = made_up(STEPS, duration=0.5)
    position = recording.position.copy()
    model = Model(LEG, EFFECTS["delay and lag"])
    first = predict(model, recording, engine=engine)
    np.testing.assert_array_equal(first, predict(model, recording, engine=engine))
    np.testing.assert_array_equal(position, recording.position)
    np.testing.assert_allclose(first[0], recording.position[0], rtol=1e-15)


@every_engine
def test_only_commands_and_times_matter_not_what_was_measured_later(engine: EngineName) -> None:
    recording = made_up(STEPS, duration=0.5)
    moved = recording.position.copy()
    moved[len(moved) // 2 :] += 0.7
    other = replace(recording, position=moved)
    np.testing.assert_array_equal(
        predict(Model(LEG), recording, engine=engine), predict(Model(LEG), other, engine=engine)
    )


@every_engine
def test_a_trial_may_be_one_row(engine: EngineName) -> None:
    recording = Recording("one", [2.0], [[1e4, 0.0]], [[1.4, 0.3]], *COLUMNS)  # type: ignore[arg-type]
    np.testing.assert_array_equal(predict(Model(LEG), recording, engine=engine), [[1.4, 0.3]])


def test_the_exact_legs_recordings_are_reproduced_to_their_noise(recordings_dir: Path) -> None:
    """Of the nominal leg exactly, with 1.8 mrad of white noise, by a program that shares no code with this one."""
    folder = recordings_dir / "concealed" / "open_1"
    if not folder.is_dir():
        pytest.skip(f"no recordings of the exact leg at {folder}")
    residual = [predict(Model(LEG), trial) - trial.position for trial in read_set(folder)]
    rmse = np.sqrt((np.concatenate(residual) ** 2).mean(axis=0))
    assert rmse.max() < 0.0020
    slow = read_set(folder)[0]
    np.testing.assert_allclose(predict(Model(LEG), slow), predict(Model(LEG), slow, engine="mujoco"), atol=2e-4)


# --- where a trial starts ---------------------------------------------------------------------------------------


def noisy(before: tuple[float, float] | None, change_at: float, **changes: Any) -> Recording:
    """A hundred samples a second, all different; the command changes at ``change_at``."""
    time = 5.0 + np.arange(40) / 100
    command = np.where(time[:, None] - 5.0 >= change_at - 1e-9, (2e4, 1e4), (1e4, 0.0))
    position = np.random.default_rng(0).normal(1.0, 0.1, (40, 2))
    return Recording(
        "noisy",
        time,
        command,
        position,
        *COLUMNS,
        before=None if before is None else np.array(before),
        **changes,
    )


@pytest.mark.parametrize(
    ("before", "change_at", "rows"),
    [
        (None, 9.0, 11),  # at rest throughout: 0 to 0.1 s, both included
        ((1e4, 0.0), 9.0, 11),
        (None, 0.05, 5),  # up to the change, which has not moved anything at its own row but ends the rest
        ((1e4, 0.0), 0.05, 5),
        (None, 0.3, 11),
        ((0.0, 0.0), 9.0, 1),  # the very first row is a change
        ((1e4, 5.0), 9.0, 1),  # of one channel alone
        (None, 0.01, 1),
    ],
)
def test_the_start_is_the_mean_of_the_rest_before_the_first_change(
    before: tuple[float, float] | None, change_at: float, rows: int
) -> None:
    recording = noisy(before, change_at)
    np.testing.assert_allclose(measured_start(recording), recording.position[:rows].mean(axis=0), rtol=1e-14)


def test_a_trial_that_says_it_had_not_settled_starts_at_its_first_row() -> None:
    moving = noisy(None, 9.0, notes={"settled": "no"})
    np.testing.assert_array_equal(measured_start(moving), moving.position[0])
    settled = noisy(None, 9.0, notes={"settled": "yes"})
    np.testing.assert_allclose(measured_start(settled), settled.position[:11].mean(axis=0), rtol=1e-14)


@every_engine
def test_the_measured_start_is_where_the_prediction_starts(engine: EngineName) -> None:
    recording = noisy(None, 0.05)
    found = predict(Model(LEG), recording, engine=engine)
    np.testing.assert_allclose(found[0], measured_start(recording), rtol=1e-12)
    own = predict(Model(LEG), recording, engine=engine, start=np.array([1.5, 0.2]))
    np.testing.assert_array_equal(own[0], [1.5, 0.2])


# --- what cannot be ---------------------------------------------------------------------------------------------


@every_engine
@pytest.mark.parametrize(
    "change",
    [{"maa.stiffness": 1e9}, {"knee.damping": 50.0}, {"gravity": 1e7}, {"baa.damping": 1e5}],
    ids=lambda change: next(iter(change)),
)
def test_a_diverging_simulation_raises(
    engine: EngineName,
    change: dict[str, float],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Far too stiff for the step: one sentence, no numbers, and none of MuJoCo's own words on screen or in its log."""
    monkeypatch.chdir(tmp_path)
    model = Model(LEG.with_parameters(change))
    recording = made_up(STEPS, duration=1.0)
    with pytest.raises(SimulationDiverged) as caught:
        predict(model, recording, engine=engine, dt=1e-3)
    assert str(caught.value).startswith("made_up: the simulation of nominal_leg diverged at ")
    assert str(caught.value).endswith(" s")
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


@every_engine
@pytest.mark.filterwarnings("ignore:.*physics step")
@pytest.mark.parametrize("n", [2, 3, 5, 9])
def test_numbers_are_never_returned_from_beyond_the_divergence(engine: EngineName, n: int) -> None:
    """A short trial of the last stable and the first unstable stiffnesses: angles of a leg, or none."""
    time = np.arange(n) / 480 + 1e-6 * np.arange(n)
    for stiffness in np.geomspace(1e6, 1e9, 13):
        model = Model(LEG.with_parameters({"maa.stiffness": float(stiffness)}))
        trial = Recording("short", time, np.full((n, 2), 1e4), np.tile((1.6, 0.1), (n, 1)), *COLUMNS)
        try:
            found = predict(model, trial, engine=engine)
        except SimulationDiverged:
            continue
        assert np.all(np.abs(found) < 2 * math.pi)


@every_engine
def test_other_columns_are_refused_with_both_lists(engine: EngineName) -> None:
    swapped = replace(made_up(STEPS, duration=0.2), actuators=("baa", "maa"))
    with pytest.raises(ConfigError) as caught:
        predict(Model(LEG), swapped, engine=engine)
    assert str(caught.value) == (
        "made_up: has joints hip, knee and actuators baa, maa, but the model nominal_leg has hip, knee and maa, baa"
    )
    check_columns(Model(LEG), made_up(STEPS, duration=0.2))


def test_an_unknown_engine_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"there is no engine 'mujco'; did you mean 'mujoco'\? \(known: mujoco, red"):
        predict(Model(LEG), made_up(STEPS, duration=0.2), engine="mujco")  # type: ignore[arg-type]


@pytest.mark.parametrize("start", [[1.3], [1.3, 0.9, 0.1], [[1.3, 0.9]], [math.nan, 0.9], [math.inf, 0.9]])
def test_a_start_that_cannot_be_is_refused(start: list[float]) -> None:
    for engine in ENGINES:
        with pytest.raises(ConfigError, match="start"):
            predict(Model(LEG), made_up(STEPS, duration=0.2), engine=engine, start=np.array(start))


@pytest.mark.parametrize("dt", [0.0, -1e-3, math.nan, math.inf])
def test_a_step_that_cannot_be_is_refused(dt: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for engine in ENGINES:
        with pytest.raises(ConfigError, match="step"):
            predict(Model(LEG), made_up(STEPS, duration=0.2), engine=engine, dt=dt)


def test_softer_stops_are_the_models_own() -> None:
    """A change of a stop's numbers needs no new kernel and is felt."""
    recording = made_up([(0.0, (5e3, 45e3))], duration=1.0)
    soft = replace(
        LEG, joints=tuple(replace(j, lower=JointStop(0.5, 20.0), upper=JointStop(1.5, 20.0)) for j in LEG.joints)
    )
    expected = exact(soft, recording, START)
    found = predict(Model(soft), recording, start=START)
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert np.abs(found - predict(Model(LEG), recording)).max() > 0.05


def test_a_motion_read_off_late_in_a_trial_is_that_of_its_parabola() -> None:
    """x₀ + v₀ (s − t) + a (s − t)²/2 about an instant t between two samples, and a trial of a window begins there."""
    time, at = np.arange(100) / 50 + 3.0, 4.013
    x0, v0, a = np.array([0.3, -0.2]), np.array([1.5, -4.0]), np.array([-7.0, 2.0])
    way = (time - at)[:, None]
    command = np.zeros((100, 2))
    recorded = Recording("t", time, command, x0 + v0 * way + a * way**2 / 2, ("maa", "baa"), ("hip", "knee"))
    position, velocity = local_motion(recorded, at, 0.06)
    assert position == pytest.approx(x0) and velocity == pytest.approx(v0)
    few = local_motion(recorded, at, 0.001)
    assert few[0] == pytest.approx(x0) and few[1] == pytest.approx(v0)
    part = Trial.of(recorded, position, (at, 4.5))
    assert part.start == at and at <= part.sample_times[0] < at + 0.02 and part.sample_times[-1] == pytest.approx(4.5)
    assert Trial.of(recorded, x0, (0.0, 4.0)).start == 3.0, "no earlier than what was recorded"


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_a_trial_of_more_steps_than_memory_holds_is_refused_before_any_is_taken(engine: EngineName) -> None:
    """A wrong time in a command history that nobody read from a file."""
    model, pose = Model(nominal_leg()), np.array([1.5, 0.1])
    times, ends = np.array([0.0]), np.array([0.5, 1e6])
    trial = Trial("long", times, np.zeros((1, 2)), np.zeros(2), 0.0, pose, ends)
    with pytest.raises(
        ConfigError, match=r"^long: 1e\+06 s take .* physics steps of .* s, expected at most 20,000,000"
    ):
        engine_for(model, engine).simulate([model], [trial], [pose[None]])
