"""Effects: what every one of them promises, their bounds, how they are written, and what they may sit at."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError
from typing import get_args

import casadi as ca
import numpy as np
import pytest
import tomlkit
from effect_cases import CASES

from equimus_ctrl import effects
from equimus_ctrl.effects import (
    REGISTRY,
    AsymmetricFriction,
    AsymmetricLag,
    CoulombFriction,
    Cutoff,
    DeadZone,
    Effect,
    FillingFlow,
    FirstOrderLag,
    ForceEffect,
    GravityTilt,
    LoadFriction,
    ParallelSpring,
    RateLimit,
    Saturation,
    SupplyCoupling,
    TransportDelay,
    catalogue,
    make,
    parse,
)
from equimus_ctrl.effects.base import Side, check_locations
from equimus_ctrl.effects.command import DELAY, FILL, FLOW, POWER, RATE, VENT
from equimus_ctrl.effects.force import force_effects, laws_of
from equimus_ctrl.effects.valves import shaped_commands, valve_settings
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model, model_from_dict, model_to_dict
from equimus_ctrl.robots.elastic.leg import nominal_leg

every_effect = pytest.mark.parametrize("name", sorted(REGISTRY))


PLACES = {"actuator": "baa", "joint": "knee", "link": "thigh", "foot": "foot", "base": "base"}
"""One place of each kind on the leg."""

every_place = pytest.mark.parametrize(
    ("name", "kind"), [(name, kind) for name, cls in catalogue("elastic").items() for kind in cls.sits_at]
)


def sample(name: str, share: float = 0.5, kind: str | None = None) -> Effect:
    """An effect of that name with every parameter at a share of its range, at a place of the first of its kinds."""
    cls = REGISTRY[name]
    values = {key: meta["low"] + share * (meta["high"] - meta["low"]) for key, meta in cls.parameter_info().items()}
    return make(name, PLACES[kind or cls.sits_at[0]], values)


# --- what every effect promises ---------------------------------------------------------------------------------


@every_effect
def test_an_effect_says_what_it_is(name: str) -> None:
    cls = REGISTRY[name]
    assert cls.name == name
    assert name.isidentifier()
    assert cls.side in get_args(Side)
    assert cls.sits_at and set(cls.sits_at) <= set(PLACES)
    assert isinstance(cls.sits_at, tuple)
    assert cls.simulated, "no engine has a law of its kind, so it is no candidate"
    assert issubclass(cls, ForceEffect) or not (cls.rubs or cls.loads)
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


def test_dry_friction_opposes_the_motion() -> None:
    x, rate = ca.SX.sym("x"), ca.SX.sym("rate")
    p = {"forward": ca.SX(0.3), "backward": ca.SX(0.2)}
    force = ca.Function("force", [x, rate], [AsymmetricFriction.sliding_force(x, rate, [], ca.SX(0), p)])
    assert [float(force(0.1, r)) for r in (-2.0, 2.0)] == pytest.approx([0.2, -0.3])
    load = ca.Function("load", [rate], [LoadFriction.sliding_force(x, rate, [], ca.SX(5), {"share": ca.SX(0.1)})])
    assert [float(load(r)) for r in (-2.0, 0.0, 2.0)] == pytest.approx([0.5, 0.0, -0.5])


def test_the_laws_of_effects_come_once_each_and_by_name() -> None:
    rubbing = CoulombFriction("hip", 0.1), CoulombFriction("knee", 0.1)
    others = ParallelSpring("knee", 0.1, 0.5), DeadZone("baa", 100.0)
    assert laws_of((others[0], *rubbing, others[1])) == (CoulombFriction, ParallelSpring)
    assert force_effects((others[1], others[0], *rubbing)) == (others[0], *rubbing)
    assert laws_of((others[1],)) == ()


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
            unit = "" if meta["unit"] == "1" else f" {meta['unit']}"
            bounds = f"expected {meta['low']:g} to {meta['high']:g}{unit}"
            assert str(caught.value) == f"effect {name} at {good.location!r}: {key} is {value:g}{unit}, {bounds}"


@every_effect
def test_an_effect_is_frozen_hashable_and_equal_to_its_like(name: str) -> None:
    one, two = sample(name), sample(name)
    assert one == two
    assert hash(one) == hash(two)
    assert one != sample(name, 0.25)
    with pytest.raises(FrozenInstanceError):
        one.location = "maa"  # type: ignore[misc]


@every_place
def test_an_effect_is_read_back_from_what_is_written_of_it(name: str, kind: str) -> None:
    one = sample(name, 1 / 3, kind)
    assert one.location in nominal_leg().places()[kind]
    values = ",".join(f"{key}={value!r}" for key, value in one.parameters().items())
    assert parse(f"{name}:{one.location}:{values}") == one
    spaced = values.replace("=", " = ").replace(",", " , ")
    assert parse(f" {name} : {one.location} : {spaced} ") == one
    assert make(name, one.location, one.parameters()) == one
    model = Model(nominal_leg(), (one,))
    assert model_from_dict(model_to_dict(model)) == model
    assert model_from_dict(tomlkit.parse(tomlkit.dumps(model_to_dict(model))).unwrap()) == model


@every_effect
def test_whole_numbers_become_floats(name: str) -> None:
    info = REGISTRY[name].parameter_info()
    one = make(name, "baa", {key: math.ceil(meta["low"]) for key, meta in info.items()})
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


@pytest.mark.parametrize("name", catalogue("elastic"))
def test_an_effect_cannot_sit_where_nothing_is(name: str) -> None:
    leg = nominal_leg()
    one = make(name, "nowhere", sample(name).parameters())
    known = ", ".join(sorted(place for kind in one.sits_at for place in leg.places()[kind]))
    with pytest.raises(ConfigError) as caught:
        Model(leg, (one,))
    kinds = " or ".join(one.sits_at)
    assert str(caught.value) == f"nominal_leg: effect {name}: there is no {kinds} 'nowhere' (known: {known})"
    for kind in one.sits_at:
        check_locations((sample(name, kind=kind),), leg.places(), "leg")


@pytest.mark.parametrize("name", catalogue("elastic"))
def test_an_effect_does_not_sit_at_another_kind_of_place(name: str) -> None:
    cls = REGISTRY[name]
    for kind in set(PLACES) - set(cls.sits_at):
        with pytest.raises(ConfigError, match=f"effect {name}: there is no {cls.sits_at[0]}.* {PLACES[kind]!r}"):
            Model(nominal_leg(), (make(name, PLACES[kind], sample(name).parameters()),))


# --- on and off -------------------------------------------------------------------------------------------------


def acts(name: str) -> dict[str, float]:
    acting = CASES[name].acting
    assert acting is not None, f"give effect_cases numbers with which {name} shows"
    return acting


def swing(*effects: Effect) -> np.ndarray:
    """Two seconds of the leg under commands that change, its valves not too quick for any rate limit."""
    lags = (FirstOrderLag("maa", 0.05), FirstOrderLag("baa", 0.05))
    if any(effect.exclusive == "lag" for effect in effects):
        lags = ()
    commands = np.array([[10e3, 2e3], [20e3, 9e3], [3e3, 12e3], [12e3, 4e3]])
    times = np.array([0.0, 0.5, 1.0, 1.5])
    trial = Trial("swing", times, commands, np.zeros(2), 0.0, np.array([1.3, 0.9]), np.arange(0, 2, 0.01))
    found = simulate([Model(nominal_leg(), (*lags, *effects))], [trial], threads=1)[0]
    assert found.sound.all()
    return found.position[0]


@every_place
def test_an_effect_changes_the_prediction_when_on_and_does_not_when_off(name: str, kind: str) -> None:
    cls, place = REGISTRY[name], PLACES[kind]
    acting, idle = acts(name), CASES[name].idle
    if issubclass(cls, ForceEffect):
        idle = {**acting, **cls.neutral}
    assert idle is not None, f"give effect_cases numbers with which {name} does nothing"
    # What takes a lag's place is compared with no lag: a lag of no time.
    none = swing(FirstOrderLag(place, 0.0)) if cls.exclusive == "lag" else swing()
    assert np.abs(swing(make(name, place, acts(name))) - none).max() > 2e-3
    np.testing.assert_array_equal(swing(make(name, place, idle)), none)


@every_place
def test_an_effect_that_fades_is_nothing_in_the_end(name: str, kind: str) -> None:
    cls, place = REGISTRY[name], PLACES[kind]
    end = cls.fades_to()
    assert set(end) <= set(cls.parameter_info())
    if not end:
        assert cls.grows_from() is None
        return
    none = swing(FirstOrderLag(place, 0.0)) if cls.exclusive == "lag" else swing()
    np.testing.assert_allclose(swing(make(name, place, {**acts(name), **end})), none, atol=1e-12)
    if name == "joint_stop":  # stopping is much the same however hard the stop
        return
    whole = swing(make(name, place, acts(name))) - none
    acting = acts(name)
    near = [{**acting, **{k: v + share * (acting[k] - v) for k, v in end.items()}} for share in (0.97, 1.0)]
    slope = -np.subtract(*(swing(make(name, place, values)) for values in near)) / 0.03
    assert 0.3 < np.linalg.norm(slope) / np.linalg.norm(whole) < 3.0  # about in proportion
    assert np.sum(slope * whole) > 0.5 * np.linalg.norm(slope) * np.linalg.norm(whole)


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


# --- settings of a valve ----------------------------------------------------------------------------------------


def test_each_effect_writes_its_own_actuators_row() -> None:
    attached = [
        TransportDelay("baa", 0.1),
        FirstOrderLag("maa", 0.2),
        AsymmetricLag("baa", 0.3, 0.4),
        RateLimit("baa", 5e4),
        FillingFlow("maa", 4e4, 1.5),
        GravityTilt("base", 0.1),  # no valve's business
    ]
    valve = valve_settings(attached, ("maa", "baa"))
    np.testing.assert_array_equal(valve, [[0.0, 0.2, 0.2, math.inf, 4e4, 1.5], [0.1, 0.3, 0.4, 5e4, math.inf, 0.0]])
    assert (DELAY, FILL, VENT, RATE, FLOW, POWER) == (0, 1, 2, 3, 4, 5)
    np.testing.assert_array_equal(valve_settings([], ("maa", "baa")), [[0.0, 0.0, 0.0, math.inf, math.inf, 0.0]] * 2)


def test_delays_in_series_add_up() -> None:
    valve = valve_settings([TransportDelay("maa", 0.1), TransportDelay("maa", 0.05)], ("maa",))
    assert valve[0, DELAY] == pytest.approx(0.15)


@pytest.mark.parametrize(
    "pair",
    [
        (FirstOrderLag("maa", 0.1), FirstOrderLag("maa", 0.2)),
        (FirstOrderLag("maa", 0.1), AsymmetricLag("maa", 0.2, 0.3)),
        (RateLimit("maa", 1e4), RateLimit("maa", 2e4)),
        (FillingFlow("maa", 1e4, 0.0), FillingFlow("maa", 2e4, 1.0)),
        (DeadZone("maa", 1e3), DeadZone("maa", 1e3)),
        (Cutoff("maa", 1e3), Cutoff("maa", 2e3)),
    ],
)
def test_two_of_a_kind_at_one_actuator_are_refused(pair: tuple[Effect, Effect]) -> None:
    with pytest.raises(ConfigError) as caught:
        Model(nominal_leg(), pair)
    one, two = (effect.name for effect in pair)
    expected = f"nominal_leg: 'maa' has two effects that exclude each other, {one} and {two}"
    assert str(caught.value) == expected


def test_lags_at_two_actuators_and_a_delay_beside_a_lag_are_welcome() -> None:
    Model(nominal_leg(), (FirstOrderLag("maa", 0.1), FirstOrderLag("baa", 0.1), TransportDelay("maa", 0.1)))


def test_what_the_package_offers_is_what_is_registered() -> None:
    offered = [getattr(effects, name) for name in effects.__all__]
    classes = {cls for cls in offered if isinstance(cls, type) and issubclass(cls, Effect) and hasattr(cls, "name")}
    assert classes == {cls for cls in REGISTRY.values() if cls.__module__.startswith("equimus_ctrl.")}


# --- the value of a command -------------------------------------------------------------------------------------


def test_commands_pass_dead_zone_coupling_and_saturation_in_this_order() -> None:
    commands = np.array([[0.0, 0.0], [3e3, 1e3], [10e3, 4e3], [30e3, 20e3]])
    effects = [Saturation("maa", 15e3), SupplyCoupling("maa", 0.5), DeadZone("baa", 2e3), DeadZone("maa", 1e3)]
    for order in (effects, effects[::-1]):
        found = shaped_commands(order, ("maa", "baa"), commands)
        baa = np.maximum(commands[:, 1] - 2e3, 0)
        maa = np.minimum(np.maximum(np.maximum(commands[:, 0] - 1e3, 0) - 0.5 * baa, 0), 15e3)
        np.testing.assert_allclose(found, np.stack([maa, baa], axis=1), rtol=1e-15)


def test_a_valve_with_a_cutoff_follows_its_least_command_and_nothing_below() -> None:
    commands = np.array(
        [[0.0, 5e3], [np.nextafter(3e3, 0), 5e3], [3e3, 5e3], [np.nextafter(3e3, 1e4), 5e3], [9e3, 0.0]]
    )
    found = shaped_commands([Cutoff("maa", 3e3)], ("maa", "baa"), commands)
    np.testing.assert_array_equal(found[:, 0], [0.0, 0.0, *commands[2:, 0]])
    np.testing.assert_array_equal(found[:, 1], commands[:, 1])


def test_a_cutoff_sees_what_dead_zone_coupling_and_saturation_left() -> None:
    ahead: list[tuple[Effect, float]] = [
        (DeadZone("maa", 1e3), 5e3), (SupplyCoupling("maa", 0.25), 5e3), (Saturation("maa", 4e3), 4e3),
    ]  # fmt: skip
    for effect, reached in ahead:
        for least, expected in ((reached, reached), (np.nextafter(reached, 1e6), 0.0)):
            both = [Cutoff("maa", float(least)), effect]
            for order in (both, both[::-1]):
                found = shaped_commands(order, ("maa", "baa"), np.array([[6e3, 4e3]]))
                np.testing.assert_array_equal(found, [[expected, 4e3]])
    # What it shuts has been asked for all the same: the others' supply has given way to it.
    starved = shaped_commands([Cutoff("baa", 5e3), SupplyCoupling("maa", 0.25)], ("maa", "baa"), np.array([[6e3, 4e3]]))
    np.testing.assert_array_equal(starved, [[5e3, 0.0]])


def test_channels_that_starve_each_other_do_so_at_once() -> None:
    """What one loses is a share of what the other asks for, not of what is left of it."""
    both = [SupplyCoupling("maa", 0.2), SupplyCoupling("baa", 0.1)]
    np.testing.assert_allclose(shaped_commands(both, ("maa", "baa"), np.array([[10e3, 20e3]])), [[6e3, 19e3]])
    three = shaped_commands([SupplyCoupling("b", 0.5)], ("a", "b", "c"), np.array([[1e3, 9e3, 5e3]]))
    np.testing.assert_allclose(three, [[1e3, 6e3, 5e3]])


def test_the_commands_handed_in_are_left_alone() -> None:
    commands = np.array([[10e3, 20e3]])
    shaped = shaped_commands([], ("maa", "baa"), commands)
    shaped[:] = 0
    shaped_commands([DeadZone("maa", 5e3)], ("maa", "baa"), commands)
    np.testing.assert_array_equal(commands, [[10e3, 20e3]])
