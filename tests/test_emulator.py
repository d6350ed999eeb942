"""What the emulator sends and obeys with each fault, in a time that passes as it sleeps; over the wire: test_hardware_dds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.emulation import emulator as module
from equimus_ctrl.emulation.emulator import AHEAD, ANGLE_OFFSET, Emulated, Emulator, EmulatorSettings
from equimus_ctrl.emulation.faults import KINDS, Fault
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.types import Array

BEGUN, PERIOD = 100.0, 1 / 120


class Clock:
    """Goes on only while somebody sleeps."""

    def __init__(self) -> None:
        self.now = BEGUN

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Wire:
    """The robot's end of a wire: what was published and when, and who commands."""

    def __init__(self, clock: Clock, commands: Sequence[tuple[float, tuple[float, ...]]] = ()) -> None:
        self.clock, self.waiting = clock, list(commands)
        self.sent: list[tuple[float, float, tuple[float, ...]]] = []

    def publish(self, stamp: float, names: Sequence[str], position: Sequence[float]) -> None:
        assert list(names) == ["hip", "knee"]
        self.sent.append((self.clock.now - BEGUN, stamp - BEGUN, tuple(position)))

    def take(self) -> list[tuple[float, ...]]:
        here = [values for at, values in self.waiting if BEGUN + at <= self.clock.now]
        del self.waiting[: len(here)]
        return here

    def close(self) -> None: ...

    def columns(self) -> tuple[Array, Array, Array]:
        at, stamp, angles = zip(*self.sent, strict=True)
        return np.array(at), np.array(stamp), np.array(angles)


class Emulation:
    """One second of a robot."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = Clock()
        monkeypatch.setattr(module, "clock", self.clock)

    def __call__(
        self, *faults: str, commands: Sequence[tuple[float, tuple[float, ...]]] = (), **settings: Any
    ) -> tuple[Wire, Emulated]:
        self.clock.now = BEGUN
        wire = Wire(self.clock, commands)
        own = EmulatorSettings(faults=tuple(Fault.parse(text) for text in faults), **settings)
        return wire, Emulator(nominal_model(), settings=own, device=wire).run(1.0)


@pytest.fixture
def emulation(monkeypatch: pytest.MonkeyPatch) -> Emulation:
    return Emulation(monkeypatch)


def test_measurements_come_at_their_rate_and_stamped_with_when_they_were(emulation: Emulation) -> None:
    at, stamp, angles = emulation()[0].columns()
    np.testing.assert_allclose(at, PERIOD * np.arange(1, 121), atol=1e-9)
    np.testing.assert_allclose(stamp, at, atol=1e-9)
    late, stamped, same = emulation(latency=0.05)[0].columns()
    np.testing.assert_allclose(late - stamped, 0.05, atol=1 / module.TICK + 1e-9)
    np.testing.assert_array_equal(same, angles[: len(same)])


@pytest.mark.parametrize("kind", ["nan", "jump", "clock", "back"])
def test_what_is_measured_is_wrong_while_a_fault_acts(kind: str, emulation: Emulation) -> None:
    at, stamp, angles = emulation(f"{kind}:0.4:0.1")[0].columns()
    right = emulation()[0].columns()
    acts = (at > 0.4 - 1e-9) & (at < 0.5 - 1e-9)
    assert acts.sum() == 12
    np.testing.assert_allclose(at, right[0], atol=1e-9)
    np.testing.assert_allclose(stamp - right[1], acts * {"clock": AHEAD, "back": -AHEAD}.get(kind, 0.0), atol=1e-9)
    off = {"nan": math.nan, "jump": ANGLE_OFFSET}.get(kind, 0.0)
    np.testing.assert_allclose(angles - right[2], np.where(acts[:, None], off, 0.0) * np.ones(2), atol=1e-12)


def test_what_stalls_comes_all_at_once_and_what_is_silent_not_at_all(emulation: Emulation) -> None:
    at, stamp, _ = emulation("stall:0.4:0.2")[0].columns()
    assert len(at) == 120 and np.ptp(at[(stamp > 0.4) & (stamp < 0.6)]) < 1e-9
    assert not np.any((at > 0.4) & (at < 0.6 - 1e-9))
    at, _, _ = emulation("silent:0.4:0.199")[0].columns()
    assert len(at) == 96 and not np.any((at > 0.4) & (at < 0.6 - 1e-9))


def test_measurements_come_twice_or_after_the_one_that_follows_them(emulation: Emulation) -> None:
    wire, seen = emulation("repeat:0.5")
    stamps = wire.columns()[1]
    assert seen.measurements == len(stamps) == 60 + 2 * 60 + 1
    assert np.all(np.diff(stamps) > -1e-12) and np.sum(np.diff(stamps) < 1e-9) == 61
    stamps = emulation("reorder:0.5")[0].columns()[1]
    assert np.all(np.diff(stamps)[:58] > 0)
    assert np.sum(np.diff(stamps) < 0) >= 28 and len(np.unique(stamps.round(6))) == len(stamps)


def test_a_share_of_messages_is_lost_each_way(emulation: Emulation) -> None:
    sent = [(0.005 * k, (1e3, 2e3)) for k in range(1, 190)]
    wire, seen = emulation(loss=0.3, commands=sent, seed=3)
    for came, of in ((len(wire.sent), 120), (seen.commands, len(sent))):
        assert abs(came / of - 0.7) < 4 * math.sqrt(0.3 * 0.7 / of)  # four standard deviations


def test_commands_are_obeyed_unless_it_is_deaf_and_vented_where_they_end(emulation: Emulation) -> None:
    sent = [(0.05 * k, (1e3 * k, 500.0)) for k in range(1, 9)]  # until 0.4 s
    _, seen = emulation(commands=sent)
    assert (seen.commands, seen.refused, seen.watchdog) == (8, 0, 1)
    assert seen.highest == [8e3, 500.0] and seen.steepest == 1e3
    assert seen.vented == pytest.approx(0.5, abs=0.01)
    _, deaf = emulation("deaf:0.18", commands=sent)
    assert deaf.commands == 3 and deaf.highest == [3e3, 500.0]
    wrong: list[tuple[float, tuple[float, ...]]] = [(0.1, (1e3,)), (0.2, (1e3, math.nan)), (0.3, (1e3, 2e3, 3e3))]
    _, refusing = emulation(commands=wrong)
    assert (refusing.commands, refusing.refused, refusing.highest) == (3, 3, [0.0, 0.0])


def test_every_fault_is_tried_here_or_over_the_wire() -> None:
    here = {"nan", "jump", "clock", "back", "stall", "silent", "repeat", "reorder", "deaf"}
    assert set(KINDS) == {*here, "second_publisher", "crash"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stal:3", "there is no fault 'stal'; did you mean 'stall'"),
        ("stall", "expected KIND:TIME or KIND:TIME:DURATION"),
        ("stall:x", "expected KIND:TIME or KIND:TIME:DURATION"),
        ("stall:-1", "fault stall: time is -1 s, expected at least 0"),
        ("stall:1:0", "fault stall: duration is 0 s, expected more than 0"),
    ],
)
def test_faults_that_make_no_sense(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        Fault.parse(text)
    assert message in str(raised.value)


@pytest.mark.parametrize(
    "given", [{"loss": 1.0}, {"noise": -1.0}, {"watchdog": 0.0}, {"rate": 97.0}, {"rate": -1.0}, {"seed": -1}]
)
def test_emulators_that_make_no_sense(given: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(given))):
        Emulator(nominal_model(), settings=EmulatorSettings(**given), device=Wire(Clock()))
