"""Dry friction at a step's end: what sticks, and the impulses that hold it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import casadi as ca
import numpy as np
import pytest

from equimus_ctrl.models.sticking import sticking
from equimus_ctrl.types import Array

MOST = 12
ROWS = 4


@pytest.fixture(scope="module")
def iterate() -> Callable[..., tuple[Array, float, Array, Array]]:
    """(side, sought, phi, slip, mobility, bound, span) → the same side, sought, phi and slip after an iteration."""
    s = sticking(ROWS)
    given = [s.side, s.sought, s.phi, s.slip, s.mobility, s.bound, s.span]
    sides = ca.Function("sides", given, [s.sides, s.still_sought])
    hold = ca.Function("hold", given, [s.found])

    def step(side: Array, sought: float, *others: Array) -> tuple[Array, float, Array, Array]:
        new, still = sides(side, sought, *others)
        found = np.array(hold(new, still, *others)).ravel()
        return np.array(new).ravel(), float(still), found[ROWS:], found[:ROWS]

    return step


def settled(
    iterate: Callable[..., tuple[Array, float, Array, Array]],
    phi: Array,
    slip: Array,
    a: Array,
    bound: Array,
    span: Array,
) -> tuple[Array, Array]:
    side, sought = np.full(ROWS, 2.0), 1.0
    for _ in range(MOST):
        side, sought, phi, slip = iterate(side, sought, phi, slip, a, bound, span)
        if not sought:
            return phi, slip
    pytest.fail("the active sets do not settle")


def by_enumeration(slip: Array, a: Array, most: Array) -> Array:
    """(n,) impulses within ±most that Coulomb's law asks for, of all ways in which rows may stick or slide."""
    for sides in product((-1, 0, 1), repeat=len(slip)):
        at, free = np.array(sides) * most, np.array(sides) == 0
        x = at.copy()
        x[free] = np.linalg.solve(a[np.ix_(free, free)], -(slip + a @ at)[free])
        rate = slip + a @ x
        if np.all(np.abs(x) <= most) and np.all(rate[~free] * np.array(sides)[~free] <= 0):
            return x
    raise AssertionError("Coulomb's law has a solution")


@pytest.mark.parametrize("seed", range(40))
def test_impulses_are_those_of_coulombs_law(
    seed: int, iterate: Callable[..., tuple[Array, float, Array, Array]]
) -> None:
    rng = np.random.default_rng(seed)
    shape = rng.normal(size=(ROWS, ROWS))
    a = shape @ shape.T + 0.3 * np.eye(ROWS)
    slip, span = rng.normal(size=ROWS), rng.uniform(0.1, 1.0, ROWS)
    bound = rng.uniform(0.0, 1.0, ROWS) * (rng.uniform(size=ROWS) < 0.8)
    phi, rate = settled(iterate, np.zeros(ROWS), slip, a, bound, span)
    expected = by_enumeration(slip, a, bound * span)
    np.testing.assert_allclose(phi * span, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rate, slip + a @ expected, rtol=0, atol=1e-12)


def test_rows_that_others_hold_already_are_left_as_they_were(
    iterate: Callable[..., tuple[Array, float, Array, Array]],
) -> None:
    """Four rows along two directions: only the rates are determined, and they are 0."""
    rng = np.random.default_rng(1)
    shape = rng.normal(size=(ROWS, 2))
    slip = shape @ np.array([0.3, -0.2])
    phi, rate = settled(iterate, np.zeros(ROWS), slip, shape @ shape.T, np.full(ROWS, 50.0), np.ones(ROWS))
    assert np.all(np.isfinite(phi))
    np.testing.assert_allclose(rate, 0.0, rtol=0, atol=1e-10)


def test_what_is_found_stays(iterate: Callable[..., tuple[Array, float, Array, Array]]) -> None:
    """In lanes that go along with others, nothing changes any more."""
    side, bound = np.zeros(ROWS), np.ones(ROWS)
    phi = np.array([0.2, -0.3, 0.1, 0.0])
    again = iterate(side, 0.0, phi, np.full(ROWS, 0.7), np.eye(ROWS), bound, bound)
    np.testing.assert_array_equal(again[2], phi)
    assert again[1] == 0.0
