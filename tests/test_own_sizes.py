"""Laws of several joints with a size of their own at each: what they are in a hypothesis, and what is made of them."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pendulum_runs import recorded
from test_torque_screening import data_of, two_joints

from equimus_ctrl.diagnosis.alternatives import simpler_laws
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.guessed_changes import kept_beside
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, parameters_of, refined, with_part
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves
from equimus_ctrl.diagnosis.results import Named
from equimus_ctrl.diagnosis.screening import screen
from equimus_ctrl.diagnosis.search_state import SearchHistory
from equimus_ctrl.identification.uncertainty import Uncertainty
from equimus_ctrl.models.model import Model

ROBOT = two_joints()
MODEL = Model(ROBOT)


@lru_cache(maxsize=1)
def data() -> Data:
    return data_of(ROBOT, recorded(MODEL, seed=2, seconds=4.0, size=6.0))


@lru_cache(maxsize=1)
def pool() -> dict[str, Candidate]:
    return {c.label: c for c in candidates(MODEL, data().segments)}


def part(label: str, *values: float) -> Part:
    own = pool()[label]
    return Part(own, {p.name: v for p, v in zip(own.parameters, values, strict=True)})


def test_they_have_parameters_of_their_own_in_the_order_of_the_places() -> None:
    rubs = part("stribeck_friction:shoulder,reach", 0.1, 0.2, 0.3, 1.0, 2.0, 0.03)
    free = parameters_of(data().free, (rubs,))
    names = free.names[len(data().free.free) :]
    assert names == tuple(
        f"{joint}.stribeck_friction.{key}"
        for joint in ("shoulder", "reach")
        for key in ("friction", "breakaway", "velocity")
    )
    assert [f.start for f in free.free[-6:]] == [0.1, 0.2, 0.3, 1.0, 2.0, 0.03]
    again = refined((rubs,), np.arange(1.0, 7.0))
    assert list(again[0].values.values()) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert again[0].candidate.at(again[0].values, "reach") == {"friction": 4.0, "breakaway": 5.0, "velocity": 6.0}


def test_another_law_at_one_place_leaves_the_rest() -> None:
    rubs = part("coulomb_friction:shoulder,reach", 0.3, 2.0)
    both = with_part(MODEL, (rubs,), part("stribeck_friction:reach", 1.0, 0.5, 0.02))
    assert [p.candidate.label for p in both] == ["coulomb_friction:shoulder", "stribeck_friction:reach"]
    assert both[0].values == {"friction": 0.3}
    alike = with_part(
        MODEL, (part("coulomb_friction:shoulder+reach", 0.3),), part("stribeck_friction:reach", 1.0, 0.5, 0.02)
    )
    assert [p.candidate.label for p in alike] == ["stribeck_friction:reach"]  # one size for both cannot lose a place
    whole = with_part(MODEL, (part("coulomb_friction:reach", 2.0),), rubs)
    assert [p.candidate.label for p in whole] == ["coulomb_friction:shoulder,reach"]


def test_parameters_that_stay_are_known_by_what_they_are() -> None:
    rubs, drag = part("coulomb_friction:shoulder,reach", 0.3, 2.0), part("quadratic_damping:shoulder", 0.1)
    old = (drag, rubs)
    new = with_part(MODEL, old, part("stribeck_friction:reach", 1.0, 0.5, 0.02))
    assert kept_beside(4, old, new) == (0, 1, 2, 3, 4, 5)  # the model's own, the drag's, the shoulder's friction
    whole = with_part(MODEL, (part("coulomb_friction:reach", 2.0), drag), rubs)
    assert kept_beside(4, (part("coulomb_friction:reach", 2.0), drag), whole) == (0, 1, 2, 3, 5)


@pytest.mark.slow
def test_what_is_there_already_is_not_added_once_more() -> None:
    both = (part("coulomb_friction:shoulder,reach", 0.3, 2.0),)
    fitted = data().coarse_fit(both, [(data().theta_of(data().free.start, both), [s.start for s in data().segments])],
                               data().nominal_fit().noise, 1)  # fmt: skip
    chosen = [
        pool()[label]
        for label in ("coulomb_friction:reach", "coulomb_friction:shoulder,reach", "viscous_friction:reach")
    ]
    assert [s.candidate.label for s in screen(data(), fitted, chosen)] == ["viscous_friction:reach"]


def simpler(of: Part) -> dict[str, dict[str, float]]:
    search = HypothesisMoves(data(), list(pool().values()))
    state: Any = SimpleNamespace(tried=SearchHistory(), best=SimpleNamespace(labels={of.candidate.label}))
    return {p.candidate.label: dict(p.values) for p in simpler_laws(search, state, of)}


def test_simpler_laws_take_over_what_both_have() -> None:
    found = simpler(part("stribeck_friction:shoulder,reach", 0.1, 0.2, 0.3, 1.0, 2.0, 0.03))
    assert found["coulomb_friction:shoulder,reach"] == {"shoulder.friction": 0.1, "reach.friction": 1.0}
    assert found["coulomb_friction:shoulder+reach"]["friction"] == pytest.approx(0.55)
    assert found["stribeck_friction:shoulder+reach"] == pytest.approx(
        {"friction": 0.55, "breakaway": 1.1, "velocity": 0.165}
    )
    assert set(simpler(part("coulomb_friction:shoulder,reach", 0.3, 0.5))) == {"coulomb_friction:shoulder+reach"}
    assert set(simpler(part("asymmetric_friction:reach", 1.0, 1.1))) == {"coulomb_friction:reach"}
    assert not simpler(part("coulomb_friction:reach", 1.0))


def test_each_effect_is_fitted_once_where_it_is_most_promising() -> None:
    search = HypothesisMoves(data(), list(pool().values()))

    def screened(label: str, gain: float) -> Any:
        return SimpleNamespace(candidate=pool()[label], gains=(gain, 0.0))

    price = float(np.log(data().n))
    ranking = [
        screened("coulomb_friction:shoulder,reach", 500.0),
        screened("coulomb_friction:reach", 500.0 - 0.5 * price),
        screened("coulomb_friction:shoulder", 20.0),
        screened("viscous_friction:reach", 10.0),
    ]
    kept = [s.candidate.label for s in search._different(ranking)]
    assert kept == ["coulomb_friction:reach", "viscous_friction:reach"]
    legs = [s for s in ranking if not s.candidate.each]
    assert search._different(legs) == legs


def test_names_say_that_sizes_differ() -> None:
    named = Named("coulomb_friction", ("shoulder", "reach"), each=True)
    assert str(named) == "coulomb_friction at each of shoulder and reach"
    assert named.to_dict() == {"effect": "coulomb_friction", "locations": ["shoulder", "reach"], "each": True}
    assert "each" not in Named("coulomb_friction", ("reach",)).to_dict()


def test_a_size_that_may_be_nothing_gains_by_bounds_alone() -> None:
    """A gain that masses could take up has an interval about 1; friction that is there has none about 0."""
    loud = part("actuator_gain:push", 1.1)
    widths = np.concatenate([np.zeros(len(data().free.free)), [0.3]])
    theta = np.concatenate([data().free.start, [1.1]])
    fit: Any = SimpleNamespace(
        hypothesis=(loud,), fit=SimpleNamespace(uncertainty=SimpleNamespace(half_width=widths), theta=theta)
    )
    assert data().may_be_nothing(fit, 0)
    widths[-1] = 0.05
    assert not data().may_be_nothing(fit, 0)
    fit.hypothesis = (part("parallel_spring:reach", 1.0, 0.1),)  # which has another parameter that may be seen
    assert not data().may_be_nothing(fit, 0)


@pytest.mark.parametrize(("correlation", "nothing"), [(0.0, True), (0.95, False)])
def test_several_sizes_are_judged_together(correlation: float, nothing: bool) -> None:
    """1.5 ± 2 either way: each interval holds nothing; both together do not where their sum is known far better."""
    rubs = part("asymmetric_friction:reach", 1.5, 1.5)
    known = data().free.start
    count = len(known)
    seen = np.eye(count + 2)
    seen[count, count + 1] = seen[count + 1, count] = -correlation
    uncertainty = Uncertainty(np.ones(count + 2), 2 * np.ones(count + 2), seen, (), 100.0, np.eye(count + 2), 2.0)
    fit: Any = SimpleNamespace(
        hypothesis=(rubs,), fit=SimpleNamespace(uncertainty=uncertainty, theta=np.append(known, [1.5, 1.5]))
    )
    assert data().may_be_nothing(fit, 0) is nothing
