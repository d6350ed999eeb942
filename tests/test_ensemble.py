"""Ensembles of legs: drawn evenly, within their ranges, and the same for the same seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import equimus_ctrl as eq
from equimus_ctrl.robots.elastic.morphology import pack
from equimus_ctrl.tuning.ensemble import Member, latin_hypercube, make_ensemble
from equimus_ctrl.tuning.study import EnsembleSettings

SETTINGS = EnsembleSettings(
    stiffness=0.15, area=0.10, damping=0.4, rest_length=0.02, mass=0.05, delay=(0.01, 0.08), lag=(0.02, 0.12)
)


@pytest.fixture(scope="module")
def model() -> eq.Model:
    return eq.nominal_model()


@pytest.fixture(scope="module")
def legs(model: eq.Model) -> list[Member]:
    return make_ensemble(model, SETTINGS, 42, 7)


@given(st.integers(1, 40), st.integers(1, 8), st.integers(0, 2**32 - 1))
def test_a_latin_hypercube_has_one_point_in_every_slice(count: int, dimensions: int, seed: int) -> None:
    points = latin_hypercube(count, dimensions, np.random.default_rng(seed))
    assert points.shape == (count, dimensions) and np.all((points >= 0) & (points < 1))
    for axis in range(dimensions):
        assert sorted(np.floor(points[:, axis] * count).astype(int)) == list(range(count))


def test_no_points_is_no_error() -> None:
    assert latin_hypercube(0, 3, np.random.default_rng(0)).shape == (0, 3)


def ratio(leg: Member, name: str) -> float:
    return leg.morphology.parameters()[name] / eq.nominal_leg().parameters()[name]


SPREADS = {
    **{f"{a}.{key}": getattr(SETTINGS, key) for a in ("maa", "baa") for key in ("stiffness", "area", "damping")},
    **{f"{a}.rest_length": SETTINGS.rest_length for a in ("maa", "baa")},
    **{f"{j}.damping": SETTINGS.damping for j in ("hip", "knee")},
    **{f"{link}.{key}": SETTINGS.mass for link in ("thigh", "calf") for key in ("mass", "inertia")},
}


def test_numbers_spread_over_their_ranges_and_nothing_else_moves(legs: list[Member]) -> None:
    nominal = eq.nominal_leg().parameters()
    drawn = legs[2:]
    for name, value in nominal.items():
        ratios = np.array([leg.morphology.parameters()[name] / value if value else 1.0 for leg in drawn])
        if name in SPREADS:
            spread = SPREADS[name]
            assert np.all(np.abs(ratios - 1) <= spread + 1e-12), name
            # Forty slices: the two outermost reach to within a fortieth of the range on either side.
            assert ratios.max() > 1 + spread * (1 - 2 / 40) - 1e-12 and ratios.min() < 1 - spread * (1 - 2 / 40) + 1e-12
        else:
            np.testing.assert_array_equal([leg.morphology.parameters()[name] for leg in drawn], value)


def test_a_link_keeps_its_shape(legs: list[Member]) -> None:
    for leg in legs:
        assert ratio(leg, "thigh.mass") == pytest.approx(ratio(leg, "thigh.inertia"))


def test_valves_spread_over_their_ranges(legs: list[Member]) -> None:
    valves = np.array([leg.valve for leg in legs[2:]])
    assert np.all((valves[:, :, 0] >= 0.01) & (valves[:, :, 0] <= 0.08))
    assert np.all((valves[:, :, 1] >= 0.02) & (valves[:, :, 1] <= 0.12))
    np.testing.assert_array_equal(valves[:, :, 1], valves[:, :, 2])
    assert np.ptp(valves[:, 0, 0]) > 0.9 * 0.07 and np.ptp(valves[:, 1, 1]) > 0.9 * 0.10


def test_the_first_is_the_model_and_the_second_the_hardest(legs: list[Member]) -> None:
    first, second = legs[:2]
    assert (first.name, second.name) == ("model", "hardest")
    for name, spread in SPREADS.items():
        assert ratio(first, name) == pytest.approx(1.0, abs=1e-15)
        sign = 1 if name.endswith(".area") else 0 if name.endswith(".rest_length") else -1
        assert ratio(second, name) == pytest.approx(1 + sign * spread)
    np.testing.assert_allclose(first.valve, [[0.045, 0.07, 0.07, np.inf, np.inf, 0.0]] * 2)
    np.testing.assert_allclose(second.valve, [[0.08, 0.12, 0.12, np.inf, np.inf, 0.0]] * 2)
    assert [leg.name for leg in make_ensemble(eq.nominal_model(), SETTINGS, 1, 0)] == ["model"]


def test_names_are_told_apart(legs: list[Member]) -> None:
    assert len({leg.name for leg in legs}) == len(legs)


def test_the_parameter_vector_is_the_morphologys(legs: list[Member]) -> None:
    for leg in legs:
        np.testing.assert_array_equal(leg.parameters, pack(leg.morphology))


def test_the_same_seed_gives_the_same_legs(model: eq.Model) -> None:
    one, two, other = (make_ensemble(model, SETTINGS, 6, seed) for seed in (3, 3, 4))
    for a, b, c in zip(one, two, other, strict=True):
        assert np.array_equal(a.parameters, b.parameters) and np.array_equal(a.valve, b.valve)
        if a.name.startswith("leg"):
            assert not np.array_equal(a.parameters, c.parameters)


def test_all_can_be_drawn(model: eq.Model) -> None:
    legs = make_ensemble(model, SETTINGS, 5, 3, fixed=False)
    assert len(legs) == 5 and all(leg.name.startswith("leg") for leg in legs)
    assert all(not np.array_equal(leg.parameters, pack(model.morphology)) for leg in legs)


def test_the_models_own_valves_are_spread_instead(model: eq.Model) -> None:
    own = eq.Model(model.morphology, (eq.TransportDelay("baa", 0.1), eq.AsymmetricLag("baa", 0.05, 0.2)), model.phase)
    for leg in make_ensemble(own, replace(SETTINGS, valve_spread=0.2), 12, 0):
        np.testing.assert_array_equal(
            leg.valve[0], [0.0, 0.0, 0.0, np.inf, np.inf, 0.0]
        )  # the model says that this valve has nothing
        shares = leg.valve[1, :3] / [0.1, 0.05, 0.2]
        assert np.all(np.abs(shares - 1) <= 0.2 + 1e-12) and shares[1] == pytest.approx(shares[2])


def test_a_models_flow_is_spread_and_its_power_is_not(model: eq.Model) -> None:
    own = eq.Model(model.morphology, (eq.FillingFlow("baa", 4e4, 1.5),), model.phase)
    valves = np.array([leg.valve for leg in make_ensemble(own, replace(SETTINGS, valve_spread=0.2), 12, 0)])
    assert np.all(np.abs(valves[:, 1, 4] / 4e4 - 1) <= 0.2 + 1e-12) and np.ptp(valves[:, 1, 4]) > 0.2 * 4e4
    np.testing.assert_array_equal(valves[:, 1, 5], 1.5)
    np.testing.assert_array_equal(valves[:, 0], [[0.0, 0.0, 0.0, np.inf, np.inf, 0.0]] * 12)


def test_no_spread_is_the_model_itself(model: eq.Model) -> None:
    still = EnsembleSettings(
        stiffness=0, area=0, damping=0, rest_length=0, mass=0, delay=(0.03, 0.03), lag=(0.05, 0.05), valve_spread=0
    )
    for leg in make_ensemble(model, still, 4, 0):
        np.testing.assert_array_equal(leg.parameters, pack(model.morphology))
        np.testing.assert_allclose(leg.valve, [[0.03, 0.05, 0.05, np.inf, np.inf, 0.0]] * 2, rtol=1e-15)


def test_a_leg_rests_where_nothing_pushes_it(legs: list[Member]) -> None:
    pressure = np.array([15e3, 9e3])
    for leg in legs[:4]:
        pose = leg.rest(pressure, "swing")
        push = eq.Kinematics(leg.morphology).acceleration(pose, [0.0, 0.0], pressure)
        np.testing.assert_allclose(push, 0.0, atol=1e-5)
