"""Effects: their laws against analytic responses, their bounds, how they are written, and what they may sit at."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from equimus_ctrl import effects
from equimus_ctrl.effects import REGISTRY, AsymmetricLag, Effect, FirstOrderLag, TransportDelay, make, parse
from equimus_ctrl.effects.base import Side, check_locations
from equimus_ctrl.effects.command import lag, mean_command
from equimus_ctrl.effects.valves import DELAY, FILL, VENT, valve_settings
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.leg import nominal_leg
from equimus_ctrl.models.model import Model, model_from_dict, model_to_dict

every_effect = pytest.mark.parametrize("name", sorted(REGISTRY))


def sample(name: str, share: float = 0.5) -> Effect:
    """An effect of that name with every parameter at a share of its range."""
    cls = REGISTRY[name]
    values = {key: meta["low"] + share * (meta["high"] - meta["low"]) for key, meta in cls.parameter_info().items()}
    return make(name, {"actuator": "baa", "joint": "knee"}[cls.sits_at], values)


# --- what every effect promises ---------------------------------------------------------------------------------


@every_effect
def test_an_effect_says_what_it_is(name: str) -> None:
    cls = REGISTRY[name]
    assert cls.name == name
    assert name.isidentifier()
    assert cls.side in get_args(Side)
    assert cls.sits_at in ("actuator", "joint")
    assert cls.summary
    assert cls.__doc__
    info = cls.parameter_info()
    assert info, "an effect without parameters cannot be switched off by degrees"
    for key, meta in info.items():
        assert key.isidentifier()
        assert meta["unit"]
        assert meta["doc"]
        assert math.isfinite(meta["low"])
        assert math.isfinite(meta["high"])
        assert meta["low"] < meta["high"]


@every_effect
def test_bounds_are_kept_and_named(name: str) -> None:
    for share in (0.0, 0.5, 1.0):
        sample(name, share)
    good = sample(name)
    for key, meta in good.parameter_info().items():
        span = meta["high"] - meta["low"]
        for value in (meta["low"] - 0.01 * span, meta["high"] + 0.01 * span, math.nan, math.inf, -math.inf):
            with pytest.raises(ConfigError) as caught:
                make(name, good.location, {**good.parameters(), key: value})
            unit = meta["unit"]
            bounds = f"expected {meta['low']:g} to {meta['high']:g} {unit}"
            assert str(caught.value) == f"effect {name} at {good.location!r}: {key} is {value:g} {unit}, {bounds}"


@every_effect
def test_an_effect_is_frozen_hashable_and_equal_to_its_like(name: str) -> None:
    one, two = sample(name), sample(name)
    assert one == two
    assert hash(one) == hash(two)
    assert one != sample(name, 0.25)
    with pytest.raises(FrozenInstanceError):
        one.location = "maa"  # type: ignore[misc]


@every_effect
def test_an_effect_is_read_back_from_what_is_written_of_it(name: str) -> None:
    one = sample(name, 1 / 3)
    values = ",".join(f"{key}={value!r}" for key, value in one.parameters().items())
    assert parse(f"{name}:{one.location}:{values}") == one
    spaced = values.replace("=", " = ").replace(",", " , ")
    assert parse(f" {name} : {one.location} : {spaced} ") == one
    assert make(name, one.location, one.parameters()) == one
    model = Model(nominal_leg(), (one,))
    assert model_from_dict(model_to_dict(model)) == model


@every_effect
def test_whole_numbers_become_floats(name: str) -> None:
    info = REGISTRY[name].parameter_info()
    one = make(name, "baa", dict.fromkeys(info, 1))
    assert all(type(value) is float for value in one.parameters().values())


@every_effect
def test_what_is_missing_or_unknown_is_named(name: str) -> None:
    good = sample(name)
    first = next(iter(good.parameter_info()))
    rest = {key: value for key, value in good.parameters().items() if key != first}
    unit = good.parameter_info()[first]["unit"]
    with pytest.raises(ConfigError) as caught:
        make(name, good.location, rest, "leg.toml")
    assert str(caught.value) == f"leg.toml: effect {name} at {good.location!r} lacks {first!r} [{unit}]"
    with pytest.raises(ConfigError, match=rf"effect {name}: there is no parameter '{first}x'; did you mean '{first}'"):
        make(name, good.location, {**rest, f"{first}x": 0.1})


@every_effect
def test_an_effect_cannot_sit_where_nothing_is(name: str) -> None:
    leg = nominal_leg()
    one = make(name, "nowhere", sample(name).parameters())
    names = {"actuator": "baa, maa", "joint": "hip, knee"}[one.sits_at]
    with pytest.raises(ConfigError) as caught:
        Model(leg, (one,))
    expected = f"nominal_leg: effect {name}: there is no {one.sits_at} 'nowhere' (known: {names})"
    assert str(caught.value) == expected
    check_locations((sample(name),), leg.joint_names, leg.actuator_names, "leg")


# --- how they are written ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "",
        "transport_delay",
        "transport_delay:baa",
        "transport_delay:baa:delay=0.1:x",
        "transport_delay:baa:delay",
        "transport_delay:baa:delay=",
        "transport_delay:baa:delay=soon",
        "transport_delay:baa:delay=0.1=0.2",
    ],
)
def test_a_text_of_another_form_is_answered_with_an_example(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(text)
    assert str(caught.value).startswith(f"effect {text!r}: ")
    assert "expected name:location:parameter=value, such as transport_delay:baa:delay=0.1" in str(caught.value)


def test_the_example_of_the_message_is_right() -> None:
    assert parse("transport_delay:baa:delay=0.1") == TransportDelay("baa", 0.1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("transport_dely:baa:delay=0.1", "there is no effect 'transport_dely'; did you mean 'transport_delay'?"),
        ("transport_delay:baa:dely=0.1", "effect transport_delay: there is no parameter 'dely'; did you mean 'delay'?"),
        ("transport_delay:baa:", "effect transport_delay at 'baa' lacks 'delay' [s]"),
        ("transport_delay:baa:delay=5", "effect transport_delay at 'baa': delay is 5 s, expected 0 to 2 s"),
    ],
)
def test_a_wrong_name_or_number_in_a_text_is_named(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(text)
    assert message in str(caught.value)


def test_a_parameter_given_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match="'delay' is given twice"):
        parse("transport_delay:baa:delay=0.1, delay =0.2")


# --- the laws ---------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=200, derandomize=True)
@given(
    steps=st.lists(st.floats(1e-3, 2.0), min_size=1, max_size=7),
    values=st.lists(st.floats(-1e5, 1e5), min_size=8, max_size=8),
    first=st.floats(-1.0, 1.0),
    start=st.floats(-2.0, 8.0),
    span=st.floats(1e-4, 6.0),
)
def test_a_mean_command_is_the_integral_over_the_window(
    steps: list[float], values: list[float], first: float, start: float, span: float
) -> None:
    times = first + np.cumsum([0.0, *steps])
    held, before, end = np.array(values[: len(times)]), values[-1], start + span

    def command(t: float) -> float:
        at = [v for known, v in zip(times, held, strict=True) if known <= t]
        return at[-1] if at else before

    edges = np.array([start, *(t for t in times if start < t < end), end])
    middles = (edges[1:] + edges[:-1]) / 2
    expected = sum(w * command(t) for w, t in zip(np.diff(edges), middles, strict=True)) / (end - start)
    found, _ = mean_command(times, held, before, -1, start, end)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-6)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(
    n=st.integers(1, 6),
    dt=st.floats(0.01, 0.7),
    first=st.floats(-1.0, 1.0),
    seed=st.integers(0, 10_000),
)
def test_the_cursor_handed_on_changes_nothing_and_the_means_add_up(n: int, dt: float, first: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    times, values = first + np.cumsum(rng.uniform(0.01, 1.0, n)), rng.uniform(0, 5e4, n)
    cursor, total = -1, 0.0
    for k in range(12):
        start, end = -0.5 + k * dt, -0.5 + (k + 1) * dt
        mean, cursor = mean_command(times, values, 7e3, cursor, start, end)
        fresh, at = mean_command(times, values, 7e3, -1, start, end)
        assert (mean, cursor) == (fresh, at)
        assert cursor == np.searchsorted(times, start, side="right") - 1
        total += mean * (end - start)
    whole, _ = mean_command(times, values, 7e3, -1, -0.5, -0.5 + 12 * dt)
    assert total == pytest.approx(whole * 12 * dt, rel=1e-9)


def test_a_command_that_does_not_change_in_a_window_comes_through_to_the_bit() -> None:
    times, values = np.array([0.0, 1.0]), np.array([0.1, 0.3])
    assert mean_command(times, values, 0.7, -1, -0.3, -0.1) == (0.7, -1)
    assert mean_command(times, values, 0.7, -1, 0.1, 0.3) == (0.1, 0)
    assert mean_command(times, values, 0.7, 0, 1.0, 1.1) == (0.3, 1)
    assert mean_command(np.empty(0), np.empty(0), 0.7, -1, 0.0, 1.0) == (0.7, -1)


@pytest.mark.parametrize("tau", [0.02, 0.3, 5.0])
@pytest.mark.parametrize("dt", [1e-4, 1e-2, 0.5])
def test_a_lag_steps_as_one_minus_the_exponential(tau: float, dt: float) -> None:
    pressure, mean = lag(0.0, 1e4, tau, 99.0, dt)
    assert pressure == pytest.approx(1e4 * (1 - math.exp(-dt / tau)), rel=1e-9)
    integral, _ = quad(lambda t: 1e4 * (1 - math.exp(-t / tau)), 0, dt, epsabs=0, epsrel=1e-12)
    assert mean == pytest.approx(integral / dt, rel=1e-7, abs=1e-7)
    pressure, mean = lag(1e4, 0.0, 99.0, tau, dt)
    assert pressure == pytest.approx(1e4 * math.exp(-dt / tau), rel=1e-9)
    integral, _ = quad(lambda t: 1e4 * math.exp(-t / tau), 0, dt, epsabs=0, epsrel=1e-12)
    assert mean == pytest.approx(integral / dt, rel=1e-9)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(
    pressure=st.floats(0, 5e4),
    target=st.floats(0, 5e4),
    fill=st.floats(1e-3, 5),
    vent=st.floats(1e-3, 5),
    dt=st.floats(1e-3, 1),
    share=st.floats(0.01, 0.99),
)
def test_two_steps_of_a_lag_are_one_and_neither_overshoots(
    pressure: float, target: float, fill: float, vent: float, dt: float, share: float
) -> None:
    whole, mean = lag(pressure, target, fill, vent, dt)
    half, first = lag(pressure, target, fill, vent, share * dt)
    end, second = lag(half, target, fill, vent, (1 - share) * dt)
    assert end == pytest.approx(whole, rel=1e-9, abs=1e-6)
    assert share * first + (1 - share) * second == pytest.approx(mean, rel=1e-9, abs=1e-6)
    low, high = sorted((pressure, target))
    assert low - 1e-9 <= whole <= high + 1e-9
    assert low - 1e-6 <= mean <= high + 1e-6


@pytest.mark.parametrize("pressure", [0.0, 3e4, 5e4])
def test_no_time_constant_means_no_lag(pressure: float) -> None:
    assert lag(pressure, 2e4, 0.0, 0.0, 1e-3) == (2e4, 2e4)


# --- settings of a valve ----------------------------------------------------------------------------------------


def test_each_effect_writes_its_own_actuators_row() -> None:
    attached = [TransportDelay("baa", 0.1), FirstOrderLag("maa", 0.2), AsymmetricLag("baa", 0.3, 0.4)]
    valve = valve_settings(attached, ("maa", "baa"))
    np.testing.assert_array_equal(valve, [[0.0, 0.2, 0.2], [0.1, 0.3, 0.4]])
    assert (DELAY, FILL, VENT) == (0, 1, 2)
    np.testing.assert_array_equal(valve_settings([], ("maa", "baa")), np.zeros((2, 3)))


def test_delays_in_series_add_up() -> None:
    valve = valve_settings([TransportDelay("maa", 0.1), TransportDelay("maa", 0.05)], ("maa",))
    assert valve[0, DELAY] == pytest.approx(0.15)


@pytest.mark.parametrize(
    "pair",
    [
        (FirstOrderLag("maa", 0.1), FirstOrderLag("maa", 0.2)),
        (FirstOrderLag("maa", 0.1), AsymmetricLag("maa", 0.2, 0.3)),
    ],
)
def test_two_lags_at_one_actuator_are_refused(pair: tuple[Effect, Effect]) -> None:
    with pytest.raises(ConfigError) as caught:
        Model(nominal_leg(), pair)
    one, two = (effect.name for effect in pair)
    expected = f"nominal_leg: 'maa' has two effects that exclude each other, {one} and {two}"
    assert str(caught.value) == expected


def test_lags_at_two_actuators_and_a_delay_beside_a_lag_are_welcome() -> None:
    Model(nominal_leg(), (FirstOrderLag("maa", 0.1), FirstOrderLag("baa", 0.1), TransportDelay("maa", 0.1)))


def test_what_the_package_offers_is_what_is_registered() -> None:
    offered = [getattr(effects, name) for name in effects.__all__]
    classes = {cls for cls in offered if isinstance(cls, type) and issubclass(cls, Effect)} - {Effect}
    assert classes <= set(REGISTRY.values())
