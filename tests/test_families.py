"""Families of commands: whatever the point of the cube, courses are within all limits and continuous in it."""

from __future__ import annotations

import numpy as np
import pytest
from mjcf_models import refusal

from equimus_ctrl.experiments.families import FAMILIES, CommandBounds, Family, families
from equimus_ctrl.types import Array

TIMES = np.arange(0, 6.0, 0.01)
each_family = pytest.mark.parametrize("family", FAMILIES.values(), ids=list(FAMILIES))


def bounds(na: int, rng: np.random.Generator, tight: bool = True) -> CommandBounds:
    low = rng.uniform(-5, 0, na)
    high = low + rng.uniform(1, 10, na)
    rest = low + rng.choice([0.0, 0.3, 1.0], na) * (high - low)
    rate = rng.uniform(0.5, 20, na) if tight else np.full(na, np.inf)
    return CommandBounds(low, high, rest, rate, 10 * rate, before=0.4, after=0.7)


def points(family: Family, na: int, rng: np.random.Generator, count: int) -> list[Array]:
    corners = [np.zeros(family.dimension(na)), np.ones(family.dimension(na)), np.full(family.dimension(na), 0.5)]
    edges = [np.round(rng.random(family.dimension(na))) for _ in range(count // 3)]
    return [*corners, *edges, *rng.random((count, family.dimension(na)))]


@each_family
@pytest.mark.parametrize("na", [1, 2, 7])
def test_every_point_is_within_all_limits_and_rests_before_and_after(family: Family, na: int) -> None:
    rng = np.random.default_rng(na)
    for z in points(family, na, rng, 30):
        own = bounds(na, rng)
        u = family.commands(z, TIMES, own)
        assert u.shape == (len(TIMES), na) and np.isfinite(u).all()
        slack = 1e-9 * (own.high - own.low)
        assert np.all(u >= own.low - slack) and np.all(u <= own.high + slack)
        assert np.all(u[TIMES <= 0.4] == own.rest) and np.all(u[TIMES[-1] - 0.7 <= TIMES] == own.rest)
        rates = np.diff(u, axis=0) / 0.01
        turning = np.diff(np.vstack([np.zeros(na), rates, np.zeros(na)]), axis=0) / 0.01
        assert np.all(np.abs(rates) <= own.rate * (1 + 1e-9))
        assert np.all(np.abs(turning) <= own.acceleration * (1 + 1e-9))


@each_family
def test_courses_are_continuous_in_the_point(family: Family) -> None:
    """A change of the point by less changes the course by less, down to nothing, also at the cube's edges."""
    rng = np.random.default_rng(3)
    for z in points(family, 2, rng, 12):
        own = bounds(2, rng)
        way = rng.normal(size=len(z))
        sizes = []
        for step in (1e-3, 1e-5, 1e-7):
            moved = np.clip(z + step * way, 0, 1)
            change = family.commands(moved, TIMES, own) - family.commands(z, TIMES, own)
            sizes.append(float(np.abs(change / (own.high - own.low)).max()))
        assert sizes[1] < 0.1 and sizes[2] < 1e-3


@each_family
def test_the_amplitude_scales_about_the_rest(family: Family) -> None:
    rng = np.random.default_rng(5)
    own, z = bounds(2, rng), rng.random(family.dimension(2))
    whole = family.commands(z, TIMES, own) - own.rest
    assert np.abs(whole).max() > 0
    for amplitude in (0.0, 0.3):
        np.testing.assert_allclose(family.commands(z, TIMES, own, amplitude) - own.rest, amplitude * whole, atol=1e-12)


@each_family
def test_every_number_changes_something(family: Family) -> None:
    rng = np.random.default_rng(7)
    own, z = bounds(2, rng, tight=False), rng.uniform(0.2, 0.6, family.dimension(2))
    first = family.commands(z, TIMES, own)
    for k in range(len(z)):
        moved = z.copy()
        moved[k] += 0.3
        assert np.abs(family.commands(moved, TIMES, own) - first).max() > 1e-3, k


@each_family
def test_the_range_is_made_use_of(family: Family) -> None:
    """Some points come near to either end, from a rest at the lowest command as well."""
    rng = np.random.default_rng(11)
    own = CommandBounds([0.0], [50e3], [0.0], [np.inf], [np.inf])
    seen = np.array([family.commands(z, TIMES, own) for z in rng.random((200, family.dimension(1)))])
    assert seen.max() > 40e3 and seen.min() == 0.0


def test_a_multisine_stays_in_its_band() -> None:
    family, times = FAMILIES["multisine"], np.arange(0, 20.0, 0.01)
    own = CommandBounds([-1.0], [1.0], [0.0], [np.inf], [np.inf])
    power = np.abs(np.fft.rfft(family.commands(np.array([0.5, 0.8, 0.0, 0.5, 1.0, 0.0]), times, own)[:, 0])) ** 2
    frequency = np.fft.rfftfreq(len(times), 0.01)
    high = (1 / 19.0) * (5.0 * 19.0 * 0.999) ** 0.5
    assert power[(frequency > 2 * high)].sum() < 1e-3 * power.sum()


def test_what_cannot_be_is_told() -> None:
    own = CommandBounds([0.0], [1.0], [0.0], [np.inf], [np.inf])
    steps = FAMILIES["steps"]
    assert "steps: expected 10 numbers from 0 to 1 for 1 actuators" in refusal(
        lambda: steps.commands(np.zeros(3), TIMES, own)
    )
    assert "expected at least 20" in refusal(lambda: steps.commands(np.zeros(10), TIMES[:105], own))
    assert "expected a range with ends" in refusal(lambda: CommandBounds([0.0], [np.inf], [0.0], [np.inf], [np.inf]))
    assert "at rest is 2, expected 0 to 1" in refusal(lambda: CommandBounds([0.0], [1.0], [2.0], [np.inf], [np.inf]))
    assert "there is no family of commands 'step'; did you mean 'steps'?" in refusal(lambda: families(["step"]))
    assert [own.name for own in families()] == list(FAMILIES) and families(["hold"]) == (FAMILIES["hold"],)
