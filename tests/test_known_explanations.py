"""A search that goes on at what is known from before, where that fits better than what it came to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pendulum_runs import PENDULUM, SERVO, recorded

from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.estimates import Named
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.diagnosis.known import Known, hypothesis_of, with_known
from equimus_ctrl.diagnosis.policy import SearchPolicy, SearchSettings
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState, begun_at
from equimus_ctrl.effects import REGISTRY, CoulombFriction, SensorOffset
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.proof.leg_simulation import recordings, simulate
from equimus_ctrl.proof.legs import draw
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

ARM = Model(MjcfRobot("arm", PENDULUM.format(drive=SERVO)))
MASS = {"arm.mass": 0.6}


def known(effect: str, **values: float) -> Known:
    return Known(((Named(effect, ("hinge",)), {"hinge": values}),), MASS, ARM)


DRY, WET = known("coulomb_friction", friction=0.08), known("viscous_friction", damping=0.08)


@pytest.fixture(scope="module")
def begun() -> tuple[Search, SearchState]:
    """A search of a pendulum with dry friction that has looked at nothing yet."""
    segments = tuple(cut(ARM, recorded(replace(ARM, effects=(CoulombFriction("hinge", friction=0.1),)), count=2)))
    data = Data(free_parameters(ARM, ["arm.mass"]), segments, reduced_simulator(2e-3, threads=1))
    looked_for = {name: REGISTRY[name] for name in ("coulomb_friction", "viscous_friction")}
    settings = SearchPolicy.of(ARM.robot.traits, data.simulator.engine).applied(SearchSettings())
    search = Search(data, candidates(ARM, segments, looked_for), settings)
    return search, begun_at(data.base())


def test_what_is_known_and_fits_better_is_where_the_search_goes_on(begun: tuple[Search, SearchState]) -> None:
    search, end = begun
    *_, after = with_known(search, end, [WET, DRY])
    assert after.best.label == "coulomb_friction:hinge" and search.accepts(end.base, after.best)
    (part,) = after.best.hypothesis
    assert part.values["friction"] == pytest.approx(0.1, abs=0.01)
    # Also what was known and is not the best was fitted, and is there to be listed beside it.
    assert {"coulomb_friction:hinge", "viscous_friction:hinge"} <= {own.label for own in after.tried.fitted}


def test_what_is_known_but_fits_no_better_changes_nothing(begun: tuple[Search, SearchState]) -> None:
    search, end = begun
    *_, best = with_known(search, end, [DRY])
    (after,) = with_known(search, best, [WET, Known((), MASS, ARM)])
    assert after.best is best.best and len(after.tried.fitted) == len(best.tried.fitted) + 2


def test_what_was_rejected_does_not_come_back(begun: tuple[Search, SearchState]) -> None:
    search, end = begun
    rejected = end.rejecting([own for own in search.pool if own.label == "coulomb_friction:hinge"])
    assert all("coulomb_friction:hinge" not in own.best.labels for own in with_known(search, rejected, [DRY]))


def test_the_model_without_effects_may_fit_better_than_its_refit(begun: tuple[Search, SearchState]) -> None:
    search, end = begun
    data = search.data
    heavy = data.theta_of(np.array([1.2]), ())
    poor = data.coarse_fit((), [(heavy, [s.start for s in data.segments])], end.base.noise, 0)
    *_, after = with_known(search, begun_at(poor), [Known((), MASS, ARM)])
    assert after.best.label == "no missing physics" and after.base is after.best
    assert after.best.deviance < poor.deviance


def test_a_law_with_its_own_sizes_is_its_parts_where_a_pool_has_only_these() -> None:
    friction = REGISTRY["coulomb_friction"]
    alone = [Candidate(friction, (place,), ()) for place in ("hip", "knee")]
    both = Candidate(friction, ("hip", "knee"), (), each=True)
    own = {"hip": {"friction": 0.1}, "knee": {"friction": 0.2}}
    each = Known(((Named("coulomb_friction", ("hip", "knee"), each=True), own),), {}, ARM)
    parts = hypothesis_of(each, alone)
    assert parts is not None
    assert [(p.candidate.locations, dict(p.values)) for p in parts] == [
        (("hip",), {"friction": 0.1}), (("knee",), {"friction": 0.2})
    ]  # fmt: skip
    (whole,) = hypothesis_of(each, [*alone, both]) or ()
    assert whole.candidate is both and dict(whole.values) == {"hip.friction": 0.1, "knee.friction": 0.2}
    # One size at both is another law than two sizes.
    assert hypothesis_of(Known(((Named("coulomb_friction", ("hip", "knee")), own),), {}, ARM), alone) is None
    assert hypothesis_of(known("viscous_friction", damping=0.1), alone) is None


@pytest.mark.slow
def test_what_was_possible_before_is_fitted_in_a_part_s_place() -> None:
    """Alone it need not fit better, and nothing else may have looked at it."""
    model = nominal_model()
    true = replace(
        draw(20, 4, kind="none", trials=2, duration=4.0),
        effects=(CoulombFriction("knee", friction=0.02), SensorOffset("hip", offset=0.08)),
    )
    segments = cut(model, recordings(true, simulate(true, 480.0)), fit_start=True)
    data = Data(default_free_parameters(model), segments, reduced_simulator(threads=1))
    names = ("coulomb_friction", "sensor_offset", "hysteresis")
    search = Search(data, candidates(model, segments, {name: REGISTRY[name] for name in names}))
    pool, base = {own.label: own for own in search.pool}, data.base()
    hypothesis = tuple(
        Part(pool[label], values)
        for label, values in (
            ("hysteresis:baa", {"size": 0.3, "width": 2e-3}),
            ("sensor_offset:hip", {"offset": 0.08}),
        )
    )
    fitted, tried = search.refit(SearchHistory((base,)), base, hypothesis)
    end = search.moved(SearchState(base, base, tried=tried), fitted)
    dry = Known(((Named("coulomb_friction", ("knee",)), {"knee": {"friction": 0.02}}),), {}, model)
    first, *_, last = with_known(search, end, [dry])
    assert frozenset({"coulomb_friction:knee", "sensor_offset:hip"}) in [own.labels for own in first.tried.fitted]
    assert last.best.labels == {"coulomb_friction:knee", "sensor_offset:hip"}
    (hidden, *_) = with_known(search, end, [replace(dry, possible=False)])  # it alone is fitted, but in no part's place
    assert [own.labels for own in hidden.tried.fitted if "coulomb_friction:knee" in own.labels] == [
        {"coulomb_friction:knee"}
    ]
