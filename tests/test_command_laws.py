"""From command to pressure: delay, rate limit and lag against quadrature and an independent integration."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from equimus_ctrl.effects.command import advance_pressure, pressure_history
from equimus_ctrl.effects.following import CARRIED, first_carried, followed_history, go_on
from equimus_ctrl.effects.relaxation import SMALL_SHARE, decay_moments, relax
from equimus_ctrl.types import Array

INF = math.inf

pressures = st.floats(0, 5e4)
lags = st.one_of(st.just(0.0), st.floats(1e-3, 5))
rates = st.one_of(st.just(INF), st.floats(1e3, 1e7))
powers = st.floats(0, 3)


def close(found: float, expected: float, scale: float, rel: float = 1e-9) -> None:
    assert abs(found - expected) <= rel * scale, (found, expected)


def curve(
    pressure: float, target: float, fill: float, vent: float, rate: float, climb: float = INF
) -> Callable[[float], float]:
    """P(t) under a constant target, by an adaptive method; the greatest rate and the lag are in the law, not patched.

    Args:
        pressure: at the start [Pa].
        target: [Pa].
        fill: [s].
        vent: [s].
        rate: [Pa/s].
        climb: greatest rate of a rising pressure, where that is lower [Pa/s].
    """
    up = min(rate, climb)
    tau = fill if target > pressure else vent
    if tau == 0 and (up if target > pressure else rate) == INF:
        return lambda t: target
    if tau == 0:
        away = target - pressure
        pace = up if away > 0 else -rate
        return lambda t: target if abs(away) <= abs(pace) * t else pressure + pace * t

    def slope(t: float, p: Array) -> Array:
        return np.clip((target - p) / tau, -rate, up)

    # The turn from ramp to exponential is a kink: steps are kept short enough not to miss it.
    found = solve_ivp(slope, (0, 2.0), [pressure], method="DOP853", rtol=1e-11, atol=1e-6, dense_output=True)
    assert found.success
    return lambda t: float(found.sol(t)[0])


# --- one constant target ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("x", [0.0, *np.geomspace(1e-12, 800, 60), SMALL_SHARE, 0.999 * SMALL_SHARE])
def test_the_moments_of_a_decay_keep_their_digits(x: float) -> None:
    expected = [
        quad(lambda s, k=k: s**k * math.exp(-x * s), 0, 1, epsabs=0, epsrel=1e-12, limit=200)[0] for k in (0, 1)
    ]
    found = decay_moments(x)
    assert found[0] == pytest.approx(math.exp(-x), rel=1e-14, abs=2e-16)
    np.testing.assert_allclose(found[1:], expected, rtol=2e-10)


@pytest.mark.parametrize("rate", [INF, 8e4, 2e4])
@pytest.mark.parametrize("tau", [0.0, 0.02, 0.3, 5.0])
@pytest.mark.parametrize(("pressure", "target"), [(0.0, 1e4), (3e4, 1e4), (2e4, 2e4)])
def test_relaxing_is_what_an_adaptive_integration_and_quadrature_say(
    pressure: float, target: float, tau: float, rate: float
) -> None:
    other = 99.0  # the time constant of the other direction must not matter
    fill, vent = (tau, other) if target > pressure else (other, tau)
    exact = curve(pressure, target, fill, vent, rate)
    for duration in (1e-4, 1e-2, 0.5, 2.0):
        end, area, moment = relax(pressure, target, fill, vent, rate, duration)
        # At the turn from ramp to exponential the quadratures need to know where it is.
        turn = max(abs(target - pressure) / rate - tau, 0.0)
        points = [turn] if 0 < turn < duration else None
        one = quad(exact, 0, duration, points=points, epsrel=1e-11, limit=200)[0]
        two = quad(lambda s: s * exact(s), 0, duration, points=points, epsrel=1e-11, limit=200)[0]
        close(end, exact(duration) if rate < INF or tau > 0 else target, 5e4, 1e-8)
        close(area, one, 5e4 * duration, 1e-8)
        close(moment, two, 5e4 * duration**2, 1e-8)


@settings(deadline=None, max_examples=300, derandomize=True)
@given(
    pressure=pressures, target=pressures, fill=lags, vent=lags, rate=rates, dt=st.floats(1e-4, 1), n=st.integers(2, 40)
)
def test_one_step_is_many_small_ones(
    pressure: float, target: float, fill: float, vent: float, rate: float, dt: float, n: int
) -> None:
    whole = relax(pressure, target, fill, vent, rate, dt)
    at, area, moment = pressure, 0.0, 0.0
    edges = np.concatenate([[0.0], np.sort(np.random.default_rng(n).uniform(0, dt, n - 1)), [dt]])
    for start, end in itertools.pairwise(edges):
        at, piece, first = relax(at, target, fill, vent, rate, end - start)
        area += piece
        moment += first + start * piece
    close(whole[0], at, 5e4)
    close(whole[1], area, 5e4 * dt)
    close(whole[2], moment, 5e4 * dt * dt)


@settings(deadline=None, max_examples=300, derandomize=True)
@given(pressure=pressures, target=pressures, fill=lags, vent=lags, rate=rates, dt=st.floats(1e-5, 2))
def test_a_pressure_neither_overshoots_nor_runs_faster_than_its_rate(
    pressure: float, target: float, fill: float, vent: float, rate: float, dt: float
) -> None:
    end, area, moment = relax(pressure, target, fill, vent, rate, dt)
    low, high = sorted((pressure, target))
    assert low - 1e-9 <= end <= high + 1e-9
    assert abs(end - pressure) <= rate * dt * (1 + 1e-12) + 1e-9
    assert (low - 1e-6) * dt <= area <= (high + 1e-6) * dt
    assert (low - 1e-6) * dt * dt / 2 <= moment <= (high + 1e-6) * dt * dt / 2
    # Monotone: rising pressures weigh on the second half, falling ones on the first.
    assert (moment - area * dt / 2) * (target - pressure) >= -1e-7 * dt * dt * max(abs(target - pressure), 1)


@pytest.mark.parametrize("pressure", [0.0, 3e4, 5e4])
def test_no_time_constant_and_no_limit_mean_no_lag(pressure: float) -> None:
    assert relax(pressure, 2e4, 0.0, 0.0, INF, 1e-3) == (2e4, 2e4 * 1e-3, pytest.approx(0.5 * 2e4 * 1e-6))


def test_a_rate_that_a_lag_never_reaches_changes_no_bit() -> None:
    for dt in (1e-3, 0.1, 3.0):
        assert relax(1e4, 3e4, 0.1, 0.2, 2.0001e5, dt) == relax(1e4, 3e4, 0.1, 0.2, INF, dt)


def test_a_ramp_turns_into_an_exponential_where_the_two_have_one_slope() -> None:
    """From 0 to 40 kPa at 50 kPa/s behind a lag of 0.2 s: the ramp ends 10 kPa short, at 0.6 s."""
    assert relax(0.0, 4e4, 0.2, 9.0, 5e4, 0.6)[0] == pytest.approx(3e4, rel=1e-14)
    end = relax(0.0, 4e4, 0.2, 9.0, 5e4, 1.0)[0]
    assert end == pytest.approx(4e4 - 1e4 * math.exp(-0.4 / 0.2), rel=1e-14)


# --- a history of commands --------------------------------------------------------------------------------------


class Valve:
    """The pressure over time in plain Python: one adaptive integration between any two changes."""

    def __init__(self, times: Array, values: Array, before: float, valve: Array) -> None:
        delay, fill, vent, rate, flow, power = valve
        self.starts = times + delay
        self.curves: list[Callable[[float], float]] = []
        at = before
        for k, (value, start) in enumerate(zip(values, self.starts, strict=True)):
            if k > 0:
                at = self.curves[-1](start - self.starts[k - 1])
            self.curves.append(curve(at, float(value), fill, vent, rate, flow * (value / 1e4) ** power))
        self.before = before

    def __call__(self, t: float) -> float:
        k = int(np.searchsorted(self.starts, t, side="right")) - 1
        return self.curves[k](t - self.starts[k]) if k >= 0 else self.before


VALVES = {
    "none": [0.0, 0.0, 0.0, INF, INF, 0.0],
    "delay": [0.137, 0.0, 0.0, INF, INF, 0.0],
    "lag": [0.0, 0.1, 0.1, INF, INF, 0.0],
    "asymmetric lag": [0.05, 0.03, 0.3, INF, INF, 0.0],
    "rate": [0.0, 0.0, 0.0, 3e4, INF, 0.0],
    "rate and lag": [0.021, 0.05, 0.12, 6e4, INF, 0.0],
    "flow": [0.0, 0.0, 0.0, INF, 3e4, 1.5],
    "flow and lag": [0.021, 0.03, 0.12, INF, 2e4, 1.0],
    "flow, rate and lag": [0.021, 0.02, 0.12, 6e4, 3e4, 1.2],
    "late": [2.0, 0.1, 0.1, INF, INF, 0.0],
}
TIMES = np.array([0.3, 0.41, 0.413, 0.7, 1.05, 1.0501])
VALUES = np.array([2e4, 5e3, 4e4, 4e4, 0.0, 1.2e4])
BEFORE = 7e3


@pytest.mark.parametrize("name", VALVES)
@pytest.mark.parametrize("dt", [1e-3, 0.11])
def test_a_step_has_the_mean_and_the_first_moment_of_the_pressure(name: str, dt: float) -> None:
    """Whatever changes within it: commands that come and go between two steps included."""
    valve = np.array(VALVES[name])
    exact = Valve(TIMES, VALUES, BEFORE, valve)
    kinks = sorted({*(TIMES + valve[0])})
    pressure, cursor = BEFORE, -1
    for k in range(round(1.4 / dt)):
        start = 0.1 + k * dt
        begun = pressure
        pressure, mean, slope, cursor = advance_pressure(TIMES, VALUES, BEFORE, cursor, start, dt, pressure, valve)
        end = start + dt
        near = [t for t in kinks if start < t < end]
        if k % 7 and not near:
            continue
        if not any(abs(t - end) < 1e-9 for t in kinks):
            close(pressure, exact(end), 5e4, 1e-8)
        if not near and abs(pressure - begun) < 1e-9:
            assert (mean, slope) == (pytest.approx(pressure), pytest.approx(0.0, abs=1e-6))
            continue
        fine = np.unique([*np.linspace(start, end, 9), *near])
        nodes, weights = np.polynomial.legendre.leggauss(12)
        area = moment = 0.0
        for a, b in itertools.pairwise(fine):
            for node, weight in zip(nodes, weights, strict=True):
                t = a + (b - a) * (1 + node) / 2
                value = exact(t) * weight * (b - a) / 2
                area += value
                moment += value * (t - start)
        # The line mean + slope·(s/dt − 1/2).
        tolerance = (
            1e-8 if valve[3] == valve[4] == INF else 1e-4
        )  # the turn from ramp to exponential is not among the nodes
        close(mean * dt, area, 5e4 * dt, tolerance)
        close(dt * dt * (mean / 2 + slope / 12), moment, 5e4 * dt * dt, tolerance)


@settings(deadline=None, max_examples=200, derandomize=True)
@given(
    steps=st.lists(st.floats(1e-3, 2.0), min_size=1, max_size=7),
    values=st.lists(st.floats(-1e5, 1e5), min_size=8, max_size=8),
    first=st.floats(-1.0, 1.0),
    start=st.floats(-2.0, 8.0),
    span=st.floats(1e-4, 6.0),
)
def test_without_a_valve_the_mean_is_the_integral_over_the_window(
    steps: list[float], values: list[float], first: float, start: float, span: float
) -> None:
    times = first + np.cumsum([0.0, *steps])
    held, before, end = np.array(values[: len(times)]), values[-1], start + span

    def command(t: float) -> float:
        at = [v for known, v in zip(times, held, strict=True) if known <= t]
        return at[-1] if at else before

    edges = np.array([start, *(t for t in times if start < t < end), end])
    middles = (edges[1:] + edges[:-1]) / 2
    pieces = [w * command(t) for w, t in zip(np.diff(edges), middles, strict=True)]
    moment = sum(piece * (t - start) for piece, t in zip(pieces, middles, strict=True))
    free = np.array([0.0, 0.0, 0.0, INF, INF, 0.0])
    _, mean, slope, _ = advance_pressure(times, held, before, -1, start, end - start, command(start), free)
    close(mean, sum(pieces) / (end - start), 1e5)
    close(mean / 2 + slope / 12, moment / (end - start) ** 2, 1e5)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(
    n=st.integers(1, 6),
    dt=st.floats(0.01, 0.7),
    first=st.floats(-1.0, 1.0),
    delay=st.floats(0, 0.5),
    fill=lags,
    vent=lags,
    rate=rates,
    flow=rates,
    power=powers,
    seed=st.integers(0, 10_000),
)
def test_the_cursor_handed_on_changes_nothing_and_steps_add_up(
    n: int,
    dt: float,
    first: float,
    delay: float,
    fill: float,
    vent: float,
    rate: float,
    flow: float,
    power: float,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    times, values = first + np.cumsum(rng.uniform(0.01, 1.0, n)), rng.uniform(0, 5e4, n)
    valve = np.array([delay, fill, vent, rate, flow, power])
    pressure, cursor, area, moment = 7e3, -1, 0.0, 0.0
    for k in range(12):
        start = -1.5 + k * dt
        fresh = advance_pressure(times, values, 7e3, -1, start, dt, pressure, valve)
        found = advance_pressure(times, values, 7e3, cursor, start, dt, pressure, valve)
        assert found == fresh
        pressure, mean, slope, cursor = found
        assert cursor == np.searchsorted(times, start - delay, side="right") - 1
        area += mean * dt
        moment += dt * dt * (mean / 2 + slope / 12) + k * dt * mean * dt
    whole = advance_pressure(times, values, 7e3, -1, -1.5, 12 * dt, 7e3, valve)
    if not np.any(np.abs(times + delay - (-1.5 + 12 * dt)) < 1e-9):
        close(whole[0], pressure, 5e4)
    close(whole[1] * 12 * dt, area, 5e4 * 12 * dt)
    close((12 * dt) ** 2 * (whole[1] / 2 + whole[2] / 12), moment, 5e4 * (12 * dt) ** 2)


def test_a_command_that_does_not_change_comes_through_to_the_bit() -> None:
    times, values = np.array([0.0, 1.0]), np.array([0.1, 0.3])
    for numbers in ([0.0, 0.0, 0.0, INF, INF, 0.0], [0.0, 0.7, 0.9, 3e3, 2e3, 1.5]):
        valve = np.array(numbers)
        assert advance_pressure(times, values, 0.7, -1, -0.3, 0.2, 0.7, valve) == (0.7, 0.7, 0.0, -1)
        assert advance_pressure(times, values, 0.7, -1, 0.1, 0.2, 0.1, valve) == (0.1, 0.1, 0.0, 0)
        assert advance_pressure(times, values, 0.7, 0, 1.0, 0.1, 0.3, valve) == (0.3, 0.3, 0.0, 1)
        assert advance_pressure(np.empty(0), np.empty(0), 0.7, -1, 0.0, 1.0, 0.7, valve) == (0.7, 0.7, 0.0, -1)


def test_a_delay_shifts_and_does_nothing_else() -> None:
    """By a power of two, so that the shifted clock has the same bits."""
    valve = np.array([0.25, 0.05, 0.1, 1e5, 3e4, 1.2])
    prompt = valve * [0, 1, 1, 1, 1, 1]
    one, two = BEFORE, BEFORE
    for k in range(60):
        start = k / 32
        one, *late, _ = advance_pressure(TIMES, VALUES, BEFORE, -1, start, 1 / 32, one, valve)
        two, *soon, _ = advance_pressure(TIMES, VALUES, BEFORE, -1, start - 0.25, 1 / 32, two, prompt)
        assert (one, late) == (two, soon)


# --- a flow that grows with the command ---------------------------------------------------------------------------


def after(pressure: float, target: float, duration: float, valve: list[float]) -> tuple[float, float, float, int]:
    """One step under a constant command."""
    return advance_pressure(
        np.zeros(1), np.array([target]), pressure, -1, 0.0, duration, pressure, np.array(valve, dtype=float)
    )


def test_filling_takes_as_long_as_the_power_says() -> None:
    """Rate 20 kPa/s at 10 kPa: to a command u it takes u/(rate·(u/10 kPa)^power)."""
    for power, ratio in ((0.0, 4.0), (0.5, 2.0), (1.0, 1.0), (1.5, 0.5), (2.0, 0.25)):
        for target, whole in ((1e4, 0.5), (4e4, 0.5 * ratio)):
            valve = [0.0, 0.0, 0.0, INF, 2e4, power]
            assert after(0.0, target, whole, valve)[0] == pytest.approx(target, rel=1e-12)
            assert after(0.0, target, 0.6 * whole, valve)[0] == pytest.approx(0.6 * target, rel=1e-12)


@settings(deadline=None, max_examples=200, derandomize=True)
@given(
    pressure=pressures, target=pressures, fill=lags, vent=lags, rate=rates, flow=rates, power=powers,
    dt=st.floats(1e-4, 1),
)  # fmt: skip
def test_a_flow_limits_filling_and_nothing_else(
    pressure: float, target: float, fill: float, vent: float, rate: float, flow: float, power: float, dt: float
) -> None:
    found = after(pressure, target, dt, [0.0, fill, vent, rate, flow, power])
    free = after(pressure, target, dt, [0.0, fill, vent, rate, INF, 0.0])
    if target <= pressure:
        assert found == free
    else:
        limit = flow * (target / 1e4) ** power
        assert found[0] <= min(free[0], pressure + limit * dt) * (1 + 1e-12) + 1e-9
        assert after(pressure, target, dt, [0.0, fill, vent, rate, flow, 0.0]) == after(
            pressure, target, dt, [0.0, fill, vent, min(rate, flow), INF, 0.0]
        )
        assert after(pressure, 1e4, dt, [0.0, fill, fill, INF, flow, power]) == (
            after(pressure, 1e4, dt, [0.0, fill, fill, flow if pressure < 1e4 else INF, INF, 0.0])
        )


def test_a_history_of_commands_is_what_small_steps_of_the_law_add_up_to() -> None:
    delay, fill, vent, rate, flow, power = VALVES["flow, rate and lag"]
    small, dt = 2e-6, 0.0431
    pressure, exact, cursor, at = BEFORE, BEFORE, -1, 0.2
    for _ in range(20):
        begun = at
        exact, mean, _, cursor = advance_pressure(
            TIMES, VALUES, BEFORE, cursor, begun, dt, exact, np.array(VALVES["flow, rate and lag"])
        )
        area = 0.0
        n = round(dt / small)
        held = np.searchsorted(TIMES, begun + small * (np.arange(n) + 0.5) - delay, side="right") - 1
        for u in np.where(held >= 0, VALUES[held], BEFORE).tolist():
            slope = (
                min((u - pressure) / fill, rate, flow * (u / 1e4) ** power)
                if u > pressure
                else (max((u - pressure) / vent, -rate))
            )
            area += (pressure + slope * small / 2) * small
            pressure += slope * small
        close(exact, pressure, 5e4, 1e-4)
        close(mean * dt, area, 5e4 * dt, 1e-4)
        at = begun + dt


def test_no_flow_fills_against_a_command_below_nothing() -> None:
    end, mean, slope, _ = after(-2e4, -1e4, 0.1, [0.0, 0.0, 0.0, INF, 3e4, 1.5])
    assert (end, mean, slope) == (-2e4, -2e4, pytest.approx(0.0, abs=1e-9))


# --- the histories of all actuators -----------------------------------------------------------------------------


def history(start: float, steps: int, dt: float, valve: Array) -> Array:
    out = np.full((steps, 2, 2), np.nan)
    commands = np.stack([VALUES, VALUES[::-1]], axis=1)
    pressure_history(TIMES, commands, np.array([BEFORE, 1e3]), valve, start, dt, out)
    return out


BOTH = np.array([VALVES["rate and lag"], VALVES["delay"]])


def test_a_history_is_one_step_after_another_for_each_actuator() -> None:
    found = history(0.1, 150, 0.01, BOTH)
    for i, (values, before) in enumerate([(VALUES, BEFORE), (VALUES[::-1].copy(), 1e3)]):
        pressure, cursor = before, -1
        for k in range(150):
            pressure, mean, slope, cursor = advance_pressure(
                TIMES, values, before, cursor, 0.1 + k * 0.01, 0.01, pressure, BOTH[i]
            )
            assert (found[k, 0, i], found[k, 1, i]) == (mean, slope)


@pytest.mark.parametrize("skipped", [1, 7, 20, 33, 90])
def test_a_later_start_finds_the_pressures_where_they_are(skipped: int) -> None:
    whole, dt = history(TIMES[0], 120, 0.01, BOTH), 0.01
    late = history(TIMES[0] + skipped * dt, 120 - skipped, dt, BOTH)
    np.testing.assert_allclose(late, whole[skipped:], rtol=0, atol=1e-5)


def test_before_the_first_command_the_pressures_are_settled() -> None:
    found = history(-3.0, 10, 0.1, BOTH)
    np.testing.assert_array_equal(found[:, 0], np.tile([BEFORE, 1e3], (10, 1)))
    np.testing.assert_array_equal(found[:, 1], 0.0)


def test_long_after_the_last_command_they_are_settled_too() -> None:
    found = history(60.0, 3, 0.1, BOTH)
    np.testing.assert_allclose(found[:, 0], np.tile([VALUES[-1], VALUES[0]], (3, 1)), rtol=1e-12)
    np.testing.assert_allclose(found[:, 1], 0.0, atol=1e-6)


@pytest.mark.parametrize("kind", [0.0, 1.0, 2.0, 3.0], ids=["direct", "filtered", "integrated", "slewed"])
@pytest.mark.parametrize("lag", [0.0, 0.03])
@pytest.mark.parametrize("linear", [False, True])
def test_pieces_of_a_history_are_the_whole(kind: float, lag: float, linear: bool) -> None:
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.001, 0.02, 50))
    commands, before, first = rng.normal(size=(50, 1)), np.array([0.2]), np.array([0.4])
    valve = np.array([[0.013, lag, 2.0 * lag, INF, INF, 0.0]])
    follow = np.array([[kind, 0.05 if kind == 1.0 else 3.0, -1.5, 1.5, -0.6, 0.6]])
    whole, pieces = np.empty((60, 2, 1)), np.empty((60, 2, 1))
    lines = np.array([linear])
    followed_history(times, commands, before, valve, follow, first, times[0], 0.01, whole, lines)
    carried = np.empty(CARRIED)
    first_carried(before[0], follow[0], first[0], carried)
    for begin, end in itertools.pairwise([0, 1, 17, 40, 60]):
        start = times[0] + 0.01 * begin
        column = commands[:, 0].copy()
        go_on(times, column, before[0], valve[0], follow[0], start, 0.01, 0, linear, carried, pieces[begin:end])
    np.testing.assert_allclose(pieces, whole, rtol=0, atol=1e-12)
