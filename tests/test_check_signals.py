"""What the signals of recordings say, on recordings whose delay, steps, noise, clipping, gaps and rests are known."""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.preflight import findings, judgement
from equimus_ctrl.preflight.latency import Latency, latencies
from equimus_ctrl.preflight.limits import CheckLimits
from equimus_ctrl.preflight.runs import repeats_of, rest_poses
from equimus_ctrl.preflight.scatter import scatter_of, whiteness
from equimus_ctrl.preflight.signals import Signals, signals_of
from equimus_ctrl.types import Array, Recording

DT = 0.005
ANY = (np.array([-np.inf]), np.array([np.inf]))
LEG = nominal_model()
FOLDER = Path(__file__).resolve().parents[1] / "equimus_ctrl" / "preflight"


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def recording(x: Array, time: Array | None = None, command: Array | None = None, name: str = "run") -> Recording:
    """Of one joint and one actuator."""
    time = np.arange(len(x)) * DT if time is None else time
    command = np.zeros((len(x), 1)) if command is None else command
    return Recording(name, time, command, np.asarray(x)[:, None], ("drive",), ("joint",))


def signals(x: Array, **more: Any) -> Signals:
    return signals_of(recording(x, **more), ANY)


def time_of(seconds: float) -> Array:
    return np.arange(0.0, seconds, DT)


def sine(seconds: float = 12.0, frequency: float = 0.8, noise: float = 0.0, seed: int = 0) -> Array:
    t = time_of(seconds)
    return np.asarray(np.sin(2 * np.pi * frequency * t) + rng(seed).normal(0, 1, len(t)) * noise)


def moved_and_rested(noise: float, seed: int = 0) -> Array:
    """Rests for 2 s, swings for 6, and rests for 2."""
    t = time_of(10.0)
    swing = np.where((t > 2) & (t < 8), 0.25 * (1 - np.cos(2 * np.pi * (t - 2))), 0.0)
    return np.asarray(swing + rng(seed).normal(0, noise, len(t)))


def test_jitter_gaps_and_bursts_are_told() -> None:
    steps = np.full(400, 0.01) + rng().normal(0, 5e-4, 400)
    clock = signals(np.zeros(401), time=np.concatenate([[0.0], np.cumsum(steps)])).clock
    assert clock.jitter == pytest.approx(5e-4, rel=0.1) and clock.rate == pytest.approx(100, rel=0.01)
    assert not clock.gaps and clock.bursts == 0
    steps[100], steps[200] = 0.3, 1e-4
    clock = signals(np.zeros(401), time=np.concatenate([[0.0], np.cumsum(steps)])).clock
    ((start, length),) = clock.gaps
    assert start == pytest.approx(1.0, abs=0.02) and length == pytest.approx(0.3)
    assert clock.bursts == pytest.approx(1 / 400)
    assert clock.jitter < 2e-3, "a gap is no jitter"


@pytest.mark.parametrize("noise", [2e-4, 2e-3])
def test_noise_is_that_at_rest_and_rests_are_found(noise: float) -> None:
    found = signals(moved_and_rested(noise))
    (joint,) = found.joints
    assert joint.noise == pytest.approx(noise, rel=0.1) and joint.at_rest
    first, last = found.rests[0], found.rests[-1]
    assert first[0] == 0 and first[1] == pytest.approx(2.0, abs=0.2)
    assert sum(last) == pytest.approx(10.0, abs=0.2) and last[1] == pytest.approx(2.0, abs=0.2)
    assert sum(length for _, length in found.rests) < 5.0


def test_without_rest_noise_is_that_of_second_differences() -> None:
    found = signals(sine(noise=1e-3))
    assert not found.rests and not found.joints[0].at_rest
    assert found.joints[0].noise == pytest.approx(1e-3, rel=0.15)


@pytest.mark.parametrize("step", [1e-3, 0.05, 0.7])
def test_the_steps_of_a_sensor_are_found(step: float) -> None:
    """The last one leaves three values."""
    (joint,) = signals(np.round(sine(noise=2e-3) / step) * step).joints
    assert joint.step == pytest.approx(step) and joint.noise >= step / np.sqrt(12) - 1e-12


def test_speed_acceleration_and_bandwidth_are_those_of_the_motion() -> None:
    omega = 2 * np.pi * 0.8
    (joint,) = signals(sine(noise=1e-3)).joints
    assert joint.travel == pytest.approx(2.0, rel=0.01)
    assert joint.peak_speed == pytest.approx(omega, rel=0.1)
    assert joint.peak_acceleration == pytest.approx(omega**2, rel=0.25)
    assert 0.75 <= joint.bandwidth <= 1.5
    (faster,) = signals(sine(noise=1e-3) + 0.1 * sine(frequency=12.0)).joints
    assert faster.bandwidth == pytest.approx(12.0, abs=1.0)


def test_noise_alone_has_no_bandwidth_that_is_motion() -> None:
    counts = [signals(rng(seed).normal(0, 1e-3, 2000)).joints[0].bandwidth for seed in range(20)]
    assert sum(value > 0 for value in counts) <= 1


@pytest.mark.parametrize("every", [2, 3, 5])
def test_values_that_are_held_are_another_clock(every: int) -> None:
    x = sine(40.0, noise=1e-4)
    held = signals(x[np.arange(len(x)) // every * every])
    assert held.joints[0].held == pytest.approx((every - 1) / every, abs=0.03)
    (said,) = [f for f in judged([held]) if f.about == "clock"]
    assert "two clocks" in said.sentence and f"every {1e3 * every * DT:.3g} ms" in said.sentence


def test_a_camera_between_rows_is_another_clock_and_friction_is_none() -> None:
    t = time_of(40.0)
    camera = np.searchsorted(np.arange(0, 40, 1 / 120.0), t, side="right") - 1
    x = sine(40.0, noise=1e-4)
    stamps = np.minimum(np.rint(np.arange(0, 40, 1 / 120.0) / DT).astype(int), len(x) - 1)
    assert signals(x[stamps][camera]).joints[0].held == pytest.approx(1 - 120 / 200, abs=0.05)
    # A joint that sticks for a while, now and then, and moves on.
    sticks = np.repeat(np.arange(300) * 0.05, rng().integers(1, 30, 300))
    assert signals(sticks).joints[0].held == 0
    assert signals(x).joints[0].held == 0


def test_a_clipped_sensor_is_told_and_a_rest_at_an_end_is_not() -> None:
    clipped = signals(np.minimum(sine(noise=1e-3), 0.8))
    flats = clipped.joints[0].flats
    assert len(flats) >= 8 and {flat.value for flat in flats} == {0.8}
    hidden = np.arccos(0.8) / np.pi / 0.8  # time above 0.8 of a sine at 0.8 Hz
    assert max(flat.length for flat in flats) == pytest.approx(hidden, abs=0.03)
    (said,) = [f for f in judged([clipped]) if f.about == "clipping"]
    assert "pos.joint stays exactly at 45.84°" in said.sentence
    quiet = np.clip(sine(), 0.0, None) ** 2  # comes to its lowest value without speed, and stays
    stops_once = np.minimum(np.cumsum(np.full(1000, 0.01)), 5.0)  # a hard end, once: a rest
    for x in (quiet, stops_once, sine(), np.round(sine() / 0.01) * 0.01, moved_and_rested(0.0)):
        assert not [f for f in judged([signals(x)]) if f.about == "clipping"]


def judged(given: list[Signals], model: Model | None = None) -> list[findings.Finding]:
    return judgement.judged(model or one_joint(), given, [Latency("drive", 0.0, np.inf, 0)], (), ())


def one_joint() -> Model:
    from equimus_ctrl.robots.mjcf.robot import MjcfRobot

    xml = """<mujoco><worldbody><body><joint name="joint" axis="0 1 0"/>
      <inertial mass="1" pos="0 0 -0.3" diaginertia="0.01 0.01 0.01"/></body></worldbody>
      <actuator><motor name="drive" joint="joint"/></actuator></mujoco>"""
    return Model(MjcfRobot("one", xml))


def test_commands_at_their_limits_are_counted() -> None:
    t = time_of(10.0)
    u = np.clip(3e4 * np.sin(t), 0.0, 2e4)[:, None]
    found = signals_of(recording(sine(10.0), command=u), (np.array([0.0]), np.array([2e4])))
    (own,) = found.commands
    assert own.at_high == pytest.approx(np.mean(u == 2e4)) and own.at_low == pytest.approx(np.mean(u == 0))
    assert own.beyond == 0 and own.changes > 500
    (own,) = signals_of(recording(sine(10.0), command=u), (np.array([0.0]), np.array([1e4]))).commands
    assert own.beyond == pytest.approx(np.mean(u > 1e4))


def stepped(delay: float, lag: float, noise: float, orders: int, seed: int) -> Recording:
    """A joint with a mass (or none) that a force (or a speed) moves from rest, late by a delay and behind a lag."""
    t = time_of(12.0)
    wanted = np.where(np.floor(t / 2.0) % 2 == 1, 1.0 + 0.2 * seed, 0.0)
    fine, many = DT / 25, round(12.0 / DT) * 25
    force = speed = place = 0.0
    x = np.empty(len(t))
    late = round(delay / fine)
    for k in range(many):
        if k % 25 == 0:
            x[k // 25] = place
        u = wanted[(k - late) // 25] if k >= late else 0.0
        force = force + (u - force) * fine / lag if lag else u
        if orders == 2:
            speed += (20 * force - 25 * place - 8 * speed) * fine
        else:
            speed = 2 * force - 2 * place
        place += speed * fine
    return recording(x + rng(seed).normal(0, noise, len(x)), command=wanted[:, None], name=f"t{seed}")


@pytest.mark.parametrize("orders", [1, 2])
@pytest.mark.parametrize(("delay", "lag"), [(0.0, 0.0), (0.02, 0.0), (0.08, 0.0), (0.15, 0.0), (0.08, 0.04)])
def test_a_dead_time_lies_within_its_bounds(delay: float, lag: float, orders: int) -> None:
    trials = [stepped(delay, lag, 1e-3, orders, seed) for seed in range(2)]
    (found,) = latencies(trials, [signals_of(r, ANY) for r in trials], {"drive": frozenset({"joint"})})
    assert found.steps >= 2 and found.shows
    assert found.low - 1e-9 <= delay <= found.high + 1e-9
    assert found.high - found.low < 0.12, "bounds that say something"
    if delay == 0.15:
        assert found.low > 0.06


@pytest.mark.parametrize("apart", [0.0, DT, 0.15, 0.3])
def test_steps_of_two_drives_that_either_could_have_moved_say_nothing_of_the_later_one(apart: float) -> None:
    """Drive a moves the joint 20 ms late, b 120 ms late, which steps at the same row as a or a little behind."""
    fast, slow = (stepped(delay, 0.0, 1e-3, 2, seed) for seed, delay in ((0, 0.02), (1, 0.12)))
    rows = round(apart / DT)
    late = np.vstack([np.zeros((rows, 1)), slow.command])[: len(slow.command)]
    moved = np.concatenate([np.zeros(rows), slow.position[:, 0]])[: len(slow.position)]
    both = Recording(
        "both", fast.time, np.column_stack([fast.command, late]), fast.position + moved[:, None], ("a", "b"), ("joint",)
    )
    own = signals_of(both, (np.full(2, -np.inf), np.full(2, np.inf)))
    first, later = latencies([both], [own], dict.fromkeys("ab", frozenset({"joint"})))
    assert not later.shows
    assert first.shows == (apart > DT) and (not first.shows or first.low <= 0.02 <= first.high)


def test_what_an_earlier_step_moves_late_is_not_of_the_next_one() -> None:
    """Motion begins 0.4 s after each command, the second one 0.35 s behind the first."""
    t = time_of(6.0)
    command = np.where(t >= 3.35, 2.0, np.where(t >= 3.0, 1.0, 0.0))
    x = np.where(t >= 3.4, 1 - np.exp(-3 * np.maximum(t - 3.4, 0)), 0.0) + rng(2).normal(0, 1e-3, len(t))
    trial = recording(x, command=command[:, None])
    (found,) = latencies([trial], [signals_of(trial, ANY)], {"drive": frozenset({"joint"})})
    assert not found.shows or found.low <= 0.4 <= found.high


def test_a_step_that_was_sent_between_rows_is_within_the_bounds() -> None:
    """Sent 10 ms before the row that logs it: the dead time is longer than what passes from there."""
    trial = stepped(0.02, 0.0, 1e-5, 1, 0)
    coarse = Recording("c", trial.time[::3], trial.command[::3], trial.position[::3], ("drive",), ("joint",))
    (found,) = latencies([coarse], [signals_of(coarse, ANY)], {"drive": frozenset({"joint"})})
    assert found.shows and found.low <= 0.02 <= found.high


def test_without_steps_from_rest_no_dead_time_shows() -> None:
    t = time_of(12.0)
    swung = recording(sine(), command=np.sin(t)[:, None])
    (found,) = latencies([swung], [signals_of(swung, ANY)], {"drive": frozenset({"joint"})})
    assert not found.shows and found.high == np.inf


def test_repeats_are_found_and_what_differs_between_them() -> None:
    t = time_of(10.0)
    command = np.where(t > 3, 1.0, 0.0)[:, None]
    shift = [0.0, 0.01, -0.02]
    trials = [
        recording(moved_and_rested(1e-3, seed) + shift[seed], command=command, name=f"t{seed}") for seed in range(3)
    ]
    other = recording(moved_and_rested(1e-3, 9), command=2 * command, name="other")
    given = [signals_of(r, ANY) for r in (*trials, other)]
    (own,) = repeats_of([*trials, other], given)
    assert own.names == ("t0", "t1", "t2")
    assert own.spread[0] == pytest.approx(np.std(shift, ddof=1), rel=0.1)
    assert own.offset[0] == pytest.approx(own.spread[0], rel=0.02) and own.noise[0] == pytest.approx(1e-3, rel=0.1)
    (pose,) = rest_poses([*trials, other], given)
    assert pose.difference == pytest.approx(0.03, rel=0.05) and len(pose.names) == 4
    said = judgement.judged(one_joint(), given, [], (own,), (pose,))
    assert {"repeats", "differences"} <= {f.about for f in said}
    alike = [replace(r, position=r.position - shift[k]) for k, r in enumerate(trials)]
    same = [signals_of(r, ANY) for r in alike]
    (own,) = repeats_of(alike, same)
    assert own.spread[0] < 1.3 * own.noise[0]
    assert not [f for f in judgement.judged(one_joint(), same, [], (own,), ()) if f.about == "repeats"]


def moved_by(starts: Array, late: float, seed: int) -> Recording:
    """A joint that follows each of some steps at once, a little later in time; a row logs what was sent since."""
    t = time_of(10.0)
    command, x = np.zeros(len(t)), np.zeros(len(t))
    for k, start in enumerate(starts):
        command = np.where(t >= start + late, (k + 1) % 2, command)
        x = x + (-1) ** k * np.clip(2 * (t - start - late), 0.0, 1.0)
    return recording(x + rng(seed).normal(0, 1e-3, len(t)), command=command[:, None], name=f"late by {late:g} s")


def differ(trials: list[Recording]) -> list[findings.Finding] | None:
    """Differences between repeats; None where they are none."""
    given = [signals_of(r, ANY) for r in trials]
    found = repeats_of(trials, given)
    said = judgement.judged(one_joint(), given, [], found, ())
    return [f for f in said if f.about == "repeats"] if found else None


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_runs_whose_commands_come_later_are_no_repeats_that_differ(steps: int) -> None:
    starts = np.linspace(2.0, 8.0, steps)
    first = moved_by(starts, 0.0, 0)
    assert differ([first, moved_by(starts, 0.0, 1)]) == []
    assert differ([first, moved_by(starts, DT, 1)]) == []
    assert differ([first, moved_by(starts, 0.1, 1)]) is None
    other = replace(first, position=first.position + np.where(first.time[:, None] > 5, 0.02, 0.0))
    for late in (0.0, DT):
        (said,) = differ([other, moved_by(starts, late, 1)]) or ()
        assert said.channel == "pos.joint"


def test_one_recording_with_more_noise_or_another_rate_is_told() -> None:
    given = [signals_of(recording(moved_and_rested(1e-3, k), name=f"t{k}"), ANY) for k in range(4)]
    assert not [f for f in judged(given) if f.about == "differences"]
    noisy = signals_of(recording(moved_and_rested(5e-3, 7), name="odd"), ANY)
    (said,) = [f for f in judged([*given, noisy]) if f.about == "differences"]
    assert said.recording == "odd" and "noise of pos.joint" in said.sentence
    x = moved_and_rested(1e-3, 8)[::3]
    slow = signals_of(recording(x, time=np.arange(len(x)) * 3 * DT, name="slow"), ANY)
    (said,) = [f for f in judged([*given, slow]) if f.about == "differences"]
    assert said.channel == "time" and said.value == pytest.approx(1 / DT / 3)


Spoil = Callable[[Array], Array]


@pytest.mark.parametrize(
    ("spoil", "about"),
    [
        (lambda x: rng(3).normal(0, 2e-3, len(x)), "noise"),
        (lambda x: np.round(x / 0.9) * 0.9, "quantisation"),
        (lambda x: np.zeros(len(x)), "noise"),
    ],
)
def test_what_can_mean_nothing_stops(spoil: Spoil, about: str) -> None:
    scatter = [scatter_of(recording(spoil(moved_and_rested(1e-3, seed)))) for seed in range(3)]
    assert about in {f.about for f in findings.stops(one_joint(), scatter)}
    good = [scatter_of(recording(moved_and_rested(1e-3, seed))) for seed in range(3)]
    assert findings.stops(one_joint(), good) == []


def pulse(size: float, seconds: float = 60.0, rate: float = 100.0) -> tuple[Array, Array]:
    """(time, positions) of a joint that rests but for 0.3 s in which it goes up to a size and comes back."""
    t = np.arange(0.0, seconds, 1 / rate)
    return t, np.where((t > 20) & (t < 20.3), size * np.sin(np.pi * (t - 20) / 0.3), 0.0)


def test_a_short_motion_in_a_long_rest_is_motion() -> None:
    """A peak of 7 standard deviations, χ² above 700; steps of a sensor that are crossed six times."""
    t, x = pulse(7e-3)
    noisy = [recording(x + rng(seed).normal(0, 1e-3, len(t)), time=t) for seed in range(8)]
    for trial in noisy:
        assert findings.stops(one_joint(), [scatter_of(trial)]) == []
    coarse = recording(np.round(6 * x / 7e-3) * 1e-3, time=t)
    assert findings.stops(one_joint(), [scatter_of(coarse)]) == []
    still = [recording(rng(seed).normal(0, 1e-3, len(t)), time=t) for seed in range(8)]
    for trial in still:
        assert [f.about for f in findings.stops(one_joint(), [scatter_of(trial)])] == ["noise"]
    assert findings.stops(one_joint(), [scatter_of(r) for r in (*still, noisy[0])]) == []


@pytest.mark.parametrize("frequency", [12.0, 24.0, 28.6, 30.0, 45.0])
def test_motion_without_rest_is_not_called_noise(frequency: float) -> None:
    """In 100 rows a second second differences are of the motion, and as large as it is."""
    t = np.arange(0.0, 10.0, 0.01)
    x = np.sin(2 * np.pi * frequency * t) + rng().normal(0, 1e-3, len(t))
    assert findings.stops(one_joint(), [scatter_of(recording(x, time=t))]) == []


def test_white_noise_is_told_from_motion_at_a_level() -> None:
    chances = np.array([whiteness(rng(seed).normal(size=2000)) for seed in range(400)])
    assert 0.02 < np.mean(chances < 0.05) < 0.09 and 0.2 < np.mean(chances < 0.3) < 0.4
    assert whiteness(rng().normal(size=500) + np.sin(np.arange(500))) < 1e-6


def test_one_joint_of_two_that_does_not_move_is_a_warning() -> None:
    def both(x: Array, y: Array) -> Recording:
        t = np.arange(len(x)) * DT
        return Recording("r", t, np.zeros((len(x), 2)), np.column_stack([x, y]), ("maa", "baa"), ("hip", "knee"))

    trial = both(moved_and_rested(1e-3), rng(5).normal(0, 1e-3, 2000))
    assert findings.stops(LEG, [scatter_of(trial)]) == []
    (said,) = findings.buried(LEG, [scatter_of(trial)], CheckLimits())
    assert said.severity == "warning" and said.channel == "pos.knee"


def test_fewer_values_than_parameters_stop() -> None:
    x = np.repeat([0.0, 0.3, 0.1, 0.4], 200)
    scatter = [scatter_of(recording(x))]
    (said,) = findings.too_few(scatter, 3)
    assert said.severity == "stop" and "change 3 times" in said.sentence
    assert findings.too_few(scatter, 2) == []


def test_a_joint_in_slow_motion_and_coarse_steps_is_not_stopped() -> None:
    """Several steps are enough: their errors average out."""
    x = np.round(0.05 * sine(20.0, 0.1) / 0.02) * 0.02
    assert findings.stops(one_joint(), [scatter_of(recording(x))]) == []


def test_thresholds_say_what_they_are_and_where_they_are_asked() -> None:
    told = list(CheckLimits.listed())
    assert len(told) > 8
    asked: dict[str, set[str]] = {own.name: set() for own in told}
    for path in sorted(FOLDER.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "limits":
                asked[node.attr].add(path.stem)
    for own in told:
        assert own.value > 0 and len(own.meaning.split()) > 5 and own.origin.why
        assert asked[own.name] == set(own.where), own.name


def test_severities_are_in_order() -> None:
    said = judged([signals(np.minimum(sine(), 0.8)), signals(sine())])
    places = [findings.SEVERITIES.index(f.severity) for f in said]
    assert all(a <= b for a, b in pairwise(places))
