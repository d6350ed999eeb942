"""Settings of hardware and the map between its clock and ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.hardware.clock import WINDOW, ClockMap
from equimus_ctrl.plants.hardware.interface import interface_of
from equimus_ctrl.plants.hardware.settings import HardwareSettings, Safety, Wire

LEG = nominal_model().robot


def test_clocks_are_as_far_apart_as_the_quickest_sample_says() -> None:
    rng = np.random.default_rng(0)
    clock = ClockMap.of(0.0, 100.0 + 0.01)
    for k in range(1, 600):
        stamp = k / 120
        clock = clock.seen(stamp, 100.0 + stamp + 0.002 + abs(rng.normal(0, 0.003)))
    assert clock.local(5.0) == pytest.approx(105.002, abs=2e-4)
    assert clock.lateness(5.0, 105.012) == pytest.approx(0.01, abs=2e-4)
    # A clock that loses 1e-4 is followed within the window.
    for k in range(600, 600 + int(4 * WINDOW * 120)):
        stamp = k / 120
        clock = clock.seen(stamp, 100.0 + stamp * 1.0001 + 0.002)
    assert clock.lateness(stamp, 100.0 + stamp * 1.0001 + 0.002) < 2.1 * WINDOW * 1e-4


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"rate": 0.0}, "rate is 0, expected more than 0"),
        ({"wire": {"domain": 300}}, "domain is 300, expected 0 to 232"),
        ({"wire": {"states": "joint_states"}}, "states is 'joint_states', expected a topic such as /joint_states"),
        ({"wire": {"topic": "x"}}, "own.toml: wire: there is no key 'topic'"),
        ({"safety": {"slew": -1.0}}, "safety: slew is -1, expected more than 0"),
        ({"safety": {"misses": -1}}, "safety: misses is -1, expected at least 0"),
        ({"safety": {"stale": 0.02}}, "safety: stale is 0.02 s, expected at least 3 periods of 0.008333 s"),
        ({"joints": {"hip": {"scale": 0.0}}}, "joints.hip: scale is 0, expected a finite number other than 0"),
        ({"joints": {"ankle": {}}}, "there is no joint 'ankle'"),
        ({"joints": {"hip": 3}}, "joints.hip is 3, expected a table"),
        ({"joints": {"hip": {"name": "knee"}}}, "joints are called knee, knee on the wire"),
        ({"actuators": {"maa": {"index": 1}}}, "actuators have the indices 1, 1, expected 0 to 1, each once"),
        ({"actuators": {"maa": {"unit": 0.0}}}, "actuators.maa: unit is 0, expected a finite number other than 0"),
        ({"format": "equimus-ctrl/hardware/9"}, "expected 'equimus-ctrl/hardware/1'"),
    ],
)
def test_settings_that_make_no_sense(data: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        interface_of(HardwareSettings.from_dict(data, "own.toml"), LEG, "own.toml")
    assert message in str(raised.value) and "own.toml" in str(raised.value)


def test_settings_are_what_their_table_says() -> None:
    from equimus_ctrl import presets

    path = presets.find("hardware", "equimus_leg.toml")
    assert path is not None
    own = HardwareSettings.from_dict(presets.read_toml(path), str(path))
    assert HardwareSettings.from_dict(own.to_dict()) == own
    # What the leg's file says of limits is what follows from the leg itself.
    said, found = interface_of(own, LEG), interface_of(HardwareSettings(), LEG)
    assert replace(own, joints={}, actuators={}, wire=Wire(), safety=Safety()) == HardwareSettings()
    assert (said.wire, said.channels) == (found.wire, found.channels)
    for key in ("command_low", "command_high", "slew", "stop", "margin", "speed", "noise"):
        np.testing.assert_array_equal(getattr(said, key), getattr(found, key))
