"""What a search keeps book of, with deviances that are given instead of simulated."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import gammaincc
from search_on_paper import DEAD, FULL, OFF, POOL, RUB, STICK, VALUES, Known, OnPaper, ended, fitted, held_out_rejects

from equimus_ctrl.diagnosis import confirmation, refit
from equimus_ctrl.diagnosis import search as search_module
from equimus_ctrl.diagnosis.alternatives import (
    contested,
    exchanged_beside_fewer,
    in_place,
    listed,
    narrowed,
    replacement,
    simplified,
    without_parts,
)
from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.findings import _alone
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, beside
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.screening import Screened, ScreenedGains
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import RivalDeviance, SearchHistory, SearchState, StopReason, no_rival
from equimus_ctrl.diagnosis.smallest_sizes import near_threshold, smallest_size, smallest_sizes
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.effects import REGISTRY
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.models.model import nominal_model


@pytest.mark.parametrize(("alone", "best"), [(1700.0, {FULL, OFF}), (3000.0, {DEAD, RUB})], ids=["near", "far behind"])
def test_of_two_missing_effects_the_first_need_not_be_the_best_alone(alone: float, best: set[str]) -> None:
    """The pair shares no effect with the best one beside a second, so that no exchange of one leads to it."""
    known = Known(
        {(): 5000.0, (DEAD,): 1500.0, (FULL,): alone, (RUB,): 4000.0, (OFF,): 4000.0,
         (DEAD, RUB): 1000.0, (DEAD, OFF): 1450.0, (FULL, OFF): 200.0}
    )  # fmt: skip

    class Both(OnPaper):
        _beside_runners_up = Search._beside_runners_up

    assert Both(known).run(known()).best.labels == best
    assert OnPaper(known).run(known()).best.labels == {DEAD, RUB}
    # Beside what leaves the same residuals nothing else is missing.
    assert Both(replace(known, same=[frozenset({DEAD, FULL})])).run(known()).best.labels == {DEAD, RUB}


def test_what_leaves_the_same_as_the_best_takes_no_other_firsts_place() -> None:
    deviances = {(): 5000.0, (DEAD,): 1500.0, (STICK,): 1510.0, (FULL,): 1700.0, (OFF,): 4000.0, (RUB,): 4000.0}
    known = Known({**deviances, (DEAD, RUB): 1000.0, (FULL, OFF): 200.0}, same=[frozenset({DEAD, STICK})])

    class Both(OnPaper):
        _beside_runners_up = Search._beside_runners_up

    assert Both(known, SearchSettings(runners_up=1)).run(known()).best.labels == {FULL, OFF}


@pytest.mark.parametrize(
    ("apart", "many_minima", "same"),
    [(0.9, False, True), (1.1, False, False), (0.0, True, False)],
    ids=["indistinguishable", "distinguishable", "where fits have many minima"],
)
def test_fits_leave_the_same_where_their_predictions_differ_by_less_than_is_distinguishable(
    apart: float, many_minima: bool, same: bool
) -> None:
    """Ten numbers, each so many standard deviations apart: χ² is ten times the square, to be less than 10."""
    search = OnPaper(Known({(): 5000.0}), SearchSettings(many_minima=many_minima))
    vars(search.data).update(times=[np.arange(5.0)])
    sigma = np.array([0.01, 0.2])
    best, other = (replace(fitted(1000.0, label), noise=tuple(JointNoise(s) for s in sigma)) for label in (DEAD, FULL))
    best.fit.residuals[0][:], other.fit.residuals[0][:] = 0.5, 0.5 + np.sqrt(apart) * sigma
    assert Search._leaves_the_same(search, best, other) is same


class Extending(OnPaper):
    """It tells what it extends."""

    extended: list[tuple[float, float]]
    challenge = Search.challenge

    def extensions(
        self,
        tried: SearchHistory,
        fitted: Fitted,
        replaced: str = "",
        known: Any = None,
        rival: RivalDeviance = no_rival,
    ) -> tuple[list[Fitted], SearchHistory]:
        self.extended.append((fitted.deviance, rival(Thresholds())))
        return [self.known(*fitted.labels, OFF)], tried


@pytest.mark.parametrize(
    ("lower", "rival", "again"),
    [(0.4, None, False), (0.6, None, True), (60.0, 930.0, False), (170.0, 930.0, True)],
    ids=["as low", "lower", "none reaches the rival", "one may reach the rival"],
)
def test_a_hypothesis_is_extended_again_where_its_fit_ended_lower_and_that_may_decide(
    lower: float, rival: float | None, again: bool
) -> None:
    """The extension known lacks 500 of what is listed, which is up to 10 + 60 more than the rival's deviance.

    Three times the fall of what is extended has to be more for it to matter.
    """
    search = Extending(Known({(): 5000.0, (RUB,): 4000.0, (RUB, OFF): 1500.0}))
    object.__setattr__(search, "extended", [])
    _, tried = search.challenge(SearchHistory(), search.known(RUB))
    beside = None if rival is None else fitted(rival, RUB, DEAD)
    found, _ = search.challenge(tried, fitted(4000.0 - lower, RUB), DEAD, beside)
    assert [own.labels for own in found] == [{RUB, OFF}]
    assert search.extended[1:] == ([(4000.0 - lower, np.inf if rival is None else rival + 70)] if again else [])


def test_how_near_alternatives_have_to_come_is_asked_of_the_thresholds() -> None:
    """Three times 160 is less than the 500 that the extension known lacks, and more than the 440 with twice the scatter."""
    flips = set[tuple[str, float]]()

    def watch(condition: Callable[[Thresholds], bool], holds: bool) -> None:
        varied = [("step_scatter", 0.5), ("step_scatter", 2.0), ("indistinguishable", 2.0)]
        flips.update(own for own in varied if condition(Thresholds().scaled(*own)) != holds)

    search = Extending(Known({(): 5000.0, (RUB,): 4000.0, (RUB, OFF): 1500.0}))
    object.__setattr__(search, "extended", [])
    vars(search.data).update(thresholds=Thresholds(watch=watch))
    _, tried = search.challenge(SearchHistory(), search.known(RUB))
    assert not flips
    search.challenge(tried, fitted(3840.0, RUB), DEAD, fitted(930.0, RUB, DEAD))
    assert search.extended[1:] == [] and flips == {("step_scatter", 2.0)}


def test_what_is_listed_has_to_come_near_the_end() -> None:
    """Within 10 and 60 for the step's error, and a parameter's ln 1000 less than a law with one more has to."""
    known = Known({(): 5000.0, (RUB,): 1000.0, (OFF,): 1500.0})
    search = Extending(known)
    object.__setattr__(search, "extended", [])
    end = listed(search, SearchState(known(), known(RUB), (known(),), ((),)))
    assert search.extended == [(5000.0, 1070.0)] and end.alternatives == ((known(OFF),),)
    search.extended.clear()
    listed(search, SearchState(known(), fitted(1000.0, STICK), (known(),), ((),)))
    assert search.extended == [(5000.0, pytest.approx(1070.0 + 2 * np.log(1000)))]


def test_a_part_that_takes_the_place_of_one_it_excludes_is_measured_against_none() -> None:
    known = Known({(): 5000.0, (RUB,): 2000.0, (STICK,): 1800.0})

    class Found(OnPaper):
        def challenge(
            self, tried: SearchHistory, fitted: Fitted, instead_of: str = "", rival: Fitted | None = None
        ) -> tuple[list[Fitted], SearchHistory]:
            # One more part is Stribeck's friction, which leaves no other at that joint.
            own = {(): [RUB], (RUB,): [STICK], (STICK,): []}[tuple(fitted.labels)]
            return [known(label) for label in own if label != instead_of], tried

    end = Found(known).run(known())
    assert end.best.labels == {STICK}
    assert [w.labels for w in end.without] == [frozenset()]
    assert [r.labels for r in end.alternatives[0]] == [{RUB}]


def test_the_part_that_stays_of_two_has_alternatives_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known({(): 5000.0, (DEAD,): 1500.0, (FULL,): 1502.0, (OFF,): 4000.0, (DEAD, OFF): 1000.0,
                   (FULL, OFF): 1003.0})  # fmt: skip
    search, found = OnPaper(known), ended(known, DEAD, OFF)
    assert [r.labels for r in found.alternatives[0]] == [{FULL, OFF}]
    kept = without_parts(search, found, [1])
    assert kept.best.labels == {DEAD} and kept.alternatives == ((),)
    assert {r.label for r in listed(search, kept).alternatives[0]} == {OFF, FULL}
    # Held-out trials reject the offset beside the dead zone and this alone, and confirm a saturation in its place.
    dead, nothing = frozenset({DEAD}), frozenset[str]()
    end = confirmation.confirmed(search, found, held_out_rejects(monkeypatch, [(dead, dead | {OFF}), (nothing, dead)]))
    assert end.best.labels == {FULL}
    assert len(end.best.hypothesis) == len(end.without) == len(end.alternatives) == 1


def test_a_rejected_effect_does_not_come_back_with_an_mjcf_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known({(): 5000.0, (RUB,): 2000.0, (OFF,): 3000.0, (RUB, OFF): 1000.0})
    split = held_out_rejects(monkeypatch, [(frozenset(), frozenset({RUB}))])
    search = OnPaper(known, SearchSettings(many_minima=True))
    begun = ended(known, RUB, OFF)
    alone = without_parts(search, replace(begun, tried=begun.tried.having(*known.fits.values())), [1])
    assert not confirmation.confirmed(search, alone.rejecting([POOL[OFF]]), split).best.hypothesis
    assert confirmation.confirmed(search, alone, split).best.labels == {RUB, OFF}


def test_what_is_said_of_an_effect_is_what_was_said_last(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known(
        {(): 5000.0, (RUB,): 2000.0, (OFF,): 3000.0, (DEAD,): 4000.0, (RUB, OFF): 1000.0, (RUB, DEAD): 1100.0}
    )
    rejects = [(frozenset({OFF}), frozenset({RUB, OFF})), (frozenset({RUB}), frozenset({RUB, OFF}))]
    split = held_out_rejects(monkeypatch, rejects)
    search = OnPaper(known, SearchSettings(many_minima=True))
    begun = ended(known, RUB, OFF)
    begun = replace(begun, tried=begun.tried.having(*known.fits.values()))
    said: dict[str, confirmation.Confirmation] = {}
    end = confirmation.confirmed(search, begun, split, said.__setitem__)
    assert end.best.labels == {RUB, DEAD}
    assert {label: one.found for label, one in said.items()} == {RUB: 1.0, DEAD: 1.0}


@pytest.mark.parametrize(("simple", "left"), [(1010.0, {OFF, RUB}), (1500.0, {OFF, STICK})])
def test_what_takes_a_rejected_effects_place_is_as_simple_as_it_may_be(
    monkeypatch: pytest.MonkeyPatch, simple: float, left: set[str]
) -> None:
    known = Known(
        {(): 5000.0, (OFF,): 3000.0, (DEAD,): 4000.0, (STICK,): 3500.0, (RUB,): 3600.0, (OFF, DEAD): 900.0,
         (OFF, STICK): 1000.0, (OFF, RUB): simple}
    )  # fmt: skip
    split = held_out_rejects(monkeypatch, [(frozenset({OFF}), frozenset({OFF, DEAD}))])
    search = OnPaper(known, SearchSettings(many_minima=True))
    begun = ended(known, OFF, DEAD)
    begun = replace(begun, tried=begun.tried.having(known(OFF, STICK)))
    said: dict[str, confirmation.Confirmation] = {}
    end = confirmation.confirmed(search, begun, split, said.__setitem__)
    assert end.best.labels == left and said.keys() - {DEAD} == left and said[DEAD].found == 0.0


@pytest.mark.parametrize(
    ("fitted_alone", "left"), [((RUB, OFF), {RUB, OFF}), ((RUB,), {RUB}), ((), set[str]())], ids=["both", "one", "none"]
)
def test_held_out_trials_judge_what_an_ended_search_had_come_to(
    monkeypatch: pytest.MonkeyPatch, fitted_alone: tuple[str, ...], left: set[str]
) -> None:
    """What is left was fitted on the way, as it is and without each of its parts, for there is no time for any fit."""
    known = Known(
        {(): 5000.0, (RUB,): 2000.0, (OFF,): 3000.0, (DEAD,): 4000.0, (RUB, OFF): 1000.0, (RUB, DEAD): 1100.0,
         (OFF, DEAD): 1200.0, (RUB, OFF, DEAD): 500.0}
    )  # fmt: skip
    rejects = [(frozenset({RUB, OFF}), frozenset({RUB, OFF, DEAD}))]
    split = held_out_rejects(monkeypatch, rejects)

    class Ended(OnPaper):
        def refit(
            self, tried: SearchHistory, fitted: Fitted, hypothesis: tuple[Part, ...]
        ) -> tuple[Fitted, SearchHistory]:
            raise BudgetSpent

    begun = ended(known, RUB, OFF, DEAD)
    begun = replace(begun, tried=begun.tried.having(*(known(label) for label in fitted_alone)))
    said: dict[str, confirmation.Confirmation] = {}
    end = confirmation.confirmed_as_fitted(Ended(known), begun, split, said.__setitem__)
    assert end.best.labels == left and said[DEAD].found == 0.0 and said.keys() - {DEAD} == left
    assert [without.labels for without in end.without] == [
        left - {part.candidate.label} for part in end.best.hypothesis
    ]


def test_where_held_out_trials_reject_what_an_ended_search_had_come_to_the_next_best_is_judged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = Known({(): 5000.0, (RUB,): 2000.0, (STICK,): 1800.0, (DEAD,): 1700.0, (OFF,): 3000.0, (RUB, OFF): 1000.0})
    rejects = [(frozenset({RUB}), frozenset({RUB, OFF})), (frozenset[str](), frozenset({DEAD}))]
    split = held_out_rejects(monkeypatch, rejects)
    begun = ended(known, RUB, OFF)
    begun = replace(begun, tried=begun.tried.having(known(RUB), known(STICK), known(DEAD)))
    said: dict[str, confirmation.Confirmation] = {}
    end = confirmation.confirmed_as_fitted(OnPaper(known), begun, split, said.__setitem__)
    assert end.best.labels == {STICK} and end.without == (known(),)
    assert {label: one.found for label, one in said.items()} == {OFF: 0.0, DEAD: 0.0, STICK: 1.0}


def test_where_no_part_is_left_the_best_effects_alone_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that began with several laws together may have fitted none by itself."""
    known = Known({(): 5000.0, (RUB, OFF): 1000.0, (RUB,): 3000.0, (OFF,): 3100.0, (DEAD,): 2000.0, (FULL,): 2500.0})
    rejects = [(frozenset({OFF}), frozenset({RUB, OFF})), (frozenset[str](), frozenset({OFF}))]
    split = held_out_rejects(monkeypatch, [*rejects, (frozenset[str](), frozenset({RUB}))])
    begun = replace(ended(known, RUB, OFF), alternatives=((), ()))
    said: dict[str, confirmation.Confirmation] = {}
    search = OnPaper(known, SearchSettings(many_minima=True))
    converged = {known(DEAD): fitted(1990.0, DEAD), known(FULL): fitted(1500.0, FULL)}
    search.data.converge = lambda f: converged.get(f, f)  # type: ignore[misc]
    end = confirmation.confirmed(search, begun, split, said.__setitem__)
    # The best one is so of fits until converged: others were given a few steps.
    assert end.best is converged[known(FULL)] and end.without == (known(),)
    assert said.keys() == {RUB, OFF, FULL} and said[FULL].found == 1.0
    assert said[RUB].found == said[OFF].found == 0.0


def test_a_rejected_effect_is_no_simpler_one_and_none_that_fits_as_well() -> None:
    known = Known({(): 5000.0, (RUB,): 1010.0, (STICK,): 1000.0, (OFF,): 1001.0})
    search = OnPaper(known, SearchSettings(many_minima=True))
    found = replace(ended(known, STICK), alternatives=((),), tried=SearchHistory(tuple(known.fits.values())))
    assert simplified(search, found).best.labels == {RUB}
    assert {r.label for r in in_place(search, found, 0, lambda t: 50.0)[0]} == {OFF}
    found = found.rejecting([POOL[RUB], POOL[OFF]])
    assert simplified(search, found).best.labels == {STICK}
    assert in_place(search, found, 0, lambda t: 50.0)[0] == []


@pytest.mark.parametrize("beside", [900.0, 1010.0], ids=["better from there", "worse from there"])
def test_alternatives_are_fitted_again_beside_the_other_parts_as_they_are_now(beside: float) -> None:
    known = Known(
        {(): 5000.0, (RUB,): 3000.0, (DEAD,): 3100.0, (FULL,): 3200.0, (RUB, DEAD): 1000.0, (RUB, FULL): beside}
    )
    search = OnPaper(known)
    far = fitted(1100.0, RUB, FULL)  # where the fit without the dead zone led
    found = SearchState(known(), known(RUB, DEAD), (known(DEAD), known(RUB)), ((), (far,)))
    end = contested(search, found)
    if beside < 1000.0:
        assert end.best is known(RUB, FULL)
    else:
        assert end.best is known(RUB, DEAD)
        assert far in end.alternatives[1] and known(RUB, FULL) in end.alternatives[1]
        assert known(RUB, FULL) in end.tried.fitted


@pytest.mark.parametrize(("far", "contends"), [(2100.0, True), (2200.0, False)])
def test_only_what_is_close_is_fitted_again_beside_the_other_parts(far: float, contends: bool) -> None:
    """The dead zone gains 2200: half of that and 50 more is close."""
    known = Known(
        {(): 5000.0, (RUB,): 3200.0, (DEAD,): 3000.0, (FULL,): 3100.0, (RUB, DEAD): 1000.0, (RUB, FULL): 900.0}
    )
    alternatives = ((), (fitted(far, RUB, FULL),))
    end = contested(OnPaper(known), SearchState(known(), known(RUB, DEAD), (known(DEAD), known(RUB)), alternatives))
    assert end.best is known(RUB, *([FULL] if contends else [DEAD]))


def test_the_search_that_moves_to_fewer_places_keeps_its_rivals() -> None:
    both, knee = "coulomb_friction:hip+knee", "coulomb_friction:knee"
    pool = {**POOL, both: Candidate(REGISTRY["coulomb_friction"], ("hip", "knee"), (VALUES["coulomb_friction"],))}
    known = Known({(): 5000.0, (knee,): 1002.0, (OFF,): 1500.0})
    search = OnPaper(known)
    broad = Fitted((Part(pool[both], VALUES["coulomb_friction"]),), known().fit, None, 1000.0)  # type: ignore[arg-type]
    end = narrowed(search, SearchState(known(), broad, (known(),), ((known(OFF),),)))
    assert end.best is known(knee)
    assert end.alternatives[0][0] is broad and known(OFF) in end.alternatives[0]


@pytest.mark.parametrize(("fewer", "reached"), [(1020.0, True), (1500.0, False)], ids=["loses little", "loses much"])
def test_what_is_better_beside_an_effect_at_one_place_less_is_reached_through_it(
    monkeypatch: pytest.MonkeyPatch, fewer: float, reached: bool
) -> None:
    """A saturation fits far better than the dead zone, but not beside friction at both joints, which takes part of it."""
    both = "coulomb_friction:hip+knee"
    monkeypatch.setitem(
        POOL, both, Candidate(REGISTRY["coulomb_friction"], ("hip", "knee"), (VALUES["coulomb_friction"],))
    )
    known = Known(
        {(): 6000.0, (both,): 3000.0, (RUB,): 3100.0, (DEAD,): 4000.0, (FULL,): 3900.0, (both, DEAD): 1000.0,
         (both, FULL): 1300.0, (RUB, DEAD): fewer, (RUB, FULL): 400.0}
    )  # fmt: skip
    end = exchanged_beside_fewer(OnPaper(known), ended(known, both, DEAD))
    assert end.best.labels == ({RUB, FULL} if reached else {both, DEAD})
    assert len(end.without) == 2


def test_beside_a_part_stays_what_it_does_not_exclude() -> None:
    robot, parts = nominal_model().robot, {label: Part(c, VALUES[label.split(":")[0]]) for label, c in POOL.items()}
    assert beside(robot, parts[STICK], (parts[RUB], parts[DEAD], parts[OFF])) == (parts[DEAD], parts[OFF])
    both = Part(replace(POOL[RUB], locations=("hip", "knee")), VALUES["coulomb_friction"])
    assert beside(robot, parts[STICK], (both, parts[OFF])) == (parts[OFF],), "alike at both, or at none"


def test_parts_are_known_by_what_they_are_and_where() -> None:
    again = Part(replace(POOL[DEAD]), VALUES["dead_zone"])
    known = fitted(0.0, DEAD, FULL)
    without = replace(fitted(0.0), hypothesis=(again,))
    other = replacement(known, without)
    assert other is not None and other.candidate.label == FULL


def test_what_diverges_over_whole_trials_is_not_what_short_intervals_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known({(): 5000.0, (RUB,): 1000.0})
    search, found = OnPaper(known), ended(known)

    def diverged(*a: object) -> Fitted:
        raise SimulationDiverged("diverges")

    monkeypatch.setattr(refit, "replace", lambda own, **changed: own)
    search.data.coarse_fit, search.data.segments = diverged, ()  # type: ignore[attr-defined, method-assign, misc]
    assert refit.searched_from_short(search, found, held_out_rejects(monkeypatch, []), found.base) == (search, found)


def test_what_a_search_tells_on_the_way_has_no_other_hypothesis_fits_without_parts() -> None:
    known = Known({(): 5000.0, (RUB, OFF): 900.0, (OFF, DEAD): 1000.0, (RUB,): 3000.0, (OFF,): 2000.0, (DEAD,): 4000.0})
    told: list[SearchState] = []
    search = OnPaper(known)
    object.__setattr__(search, "reached", lambda data, state: told.append(state))
    search.needed(replace(ended(known, RUB, OFF), best=known(OFF, DEAD)))
    assert told and all(state.best is known(OFF, DEAD) and state.without == () for state in told)
    assert known(DEAD) in told[-1].tried.fitted


def test_what_diverges_from_where_a_larger_set_ended_begins_at_the_nominal_parameters() -> None:
    begun: list[float] = []

    def coarse_fit(hypothesis: object, begin: Any, *rest: object, settled: object) -> Fitted:
        begun.append(float(begin[0][0][0]))
        if begun[-1] < 1.0:
            raise SimulationDiverged("diverges")
        return fitted(10.0, RUB)

    model = nominal_model()
    data: Any = SimpleNamespace(
        free=SimpleNamespace(free=[None], start=np.ones(1), model=model),
        theta_of=lambda theta, hypothesis: Data.theta_of(data, theta, hypothesis),
        coarse_fit=coarse_fit,
        converge=lambda f, settled: f,
        discontinuous=lambda hypothesis, but: [],
        segments=(),
    )
    found, _ = HypothesisMoves(data, []).refit(
        SearchHistory(), fitted(5.0, RUB, OFF), (Part(POOL[RUB], VALUES["coulomb_friction"]),)
    )
    assert found.deviance == 10.0 and begun == [0.0, 1.0]


@pytest.mark.parametrize(
    ("simpler", "begun"), [(8.0, [{"friction": 0.01}, {"friction": 0.0}]), (12.0, [{"friction": 0.01}])]
)
def test_a_fit_that_failed_begins_again_at_a_simpler_one(simpler: float, begun: list[dict[str, float]]) -> None:
    """One that is held by it cannot fit better: where a trial diverges, say, the fit is lost."""
    guesses: list[dict[str, float]] = []

    def coarse_fit(hypothesis: tuple[Part, ...], begin: Any, *rest: object, settled: object) -> Fitted:
        guesses.append(dict(hypothesis[0].values))
        return fitted(10.0 if len(guesses) == 1 else 7.0, RUB)

    data: Any = SimpleNamespace(
        free=SimpleNamespace(free=[], start=np.ones(1), model=nominal_model()),
        theta_of=lambda theta, hypothesis: theta,
        coarse_fit=coarse_fit,
        converge=lambda f, settled: f,
        discontinuous=lambda hypothesis, but: [],
        segments=(),
    )
    found, tried = HypothesisMoves(data, []).refit(
        SearchHistory((fitted(simpler),)), fitted(5.0, RUB, OFF), (Part(POOL[RUB], VALUES["coulomb_friction"]),)
    )
    assert found.deviance == (7.0 if simpler < 10.0 else 10.0) and guesses == begun
    assert tried.fitted[-1] is found


def test_the_same_refit_is_done_once() -> None:
    """Discontinuous parameters of parts that the fit has from which it begins are scanned no more."""
    scanned: list[tuple[object, bool]] = []

    def coarse_fit(hypothesis: object, begin: Any, *rest: object, settled: object) -> Fitted:
        scanned.append((settled, False))
        return fitted(10.0 + len(scanned), RUB)

    data: Any = SimpleNamespace(
        free=SimpleNamespace(free=[None], start=np.ones(1), model=nominal_model()),
        theta_of=lambda theta, hypothesis: Data.theta_of(data, theta, hypothesis),
        coarse_fit=coarse_fit,
        converge=lambda f, settled: scanned.append((None, settled)) or f,
        discontinuous=lambda hypothesis, but: [k for k, p in enumerate(hypothesis) if p.candidate.label not in but],
        segments=(),
    )
    moves, start = HypothesisMoves(data, []), fitted(5.0, RUB, OFF)
    rub = (Part(POOL[RUB], VALUES["coulomb_friction"]),)
    first, tried = moves.refit(SearchHistory(), start, rub)
    again, tried = moves.refit(tried, start, rub)
    assert again is first and scanned == [(start.labels, False), (None, True)]
    other, tried = moves.refit(tried, start, (Part(POOL[RUB], {"friction": 0.02}),))
    assert other is not first and len(tried.fitted) == 2
    moves.refit(tried, start, (Part(POOL[DEAD], VALUES["dead_zone"]),))
    assert scanned[-1] == (None, False)


@pytest.mark.parametrize("threshold", [5.0, 18.7, 900.0])
def test_the_smallest_that_would_show_is_where_the_gain_reaches_the_threshold(threshold: float) -> None:
    """What grows from nothing gains as the square of its size, whichever guess is the nearest."""
    sizes, slope = np.array([0.01, 0.04, 0.3]), 120.0
    screened: Any = SimpleNamespace(
        candidate=POOL[RUB], tried=[{"friction": size} for size in sizes], strength=(slope * sizes) ** 2
    )
    assert smallest_size(screened, threshold) == pytest.approx(np.sqrt(threshold) / slope)


def test_a_size_is_looked_at_again_until_it_is_near_the_threshold() -> None:
    """A law that does nothing up to 0.02, and one that the parameters do as well, whatever its size."""

    def strengths(pool: Any, law: Any) -> list[Any]:
        tried = [c.guesses for c in pool]
        sizes = [np.array([guess["friction"] for guess in own]) for own in tried]
        several = zip(pool, tried, sizes, strict=True)
        return [Screened(c, (), np.empty(0), ScreenedGains(0.0, 0.0), own, law(size)) for c, own, size in several]

    rub = replace(POOL[RUB], guesses=({"friction": 0.3},))
    for law, wanted in (
        (lambda size: (120.0 * np.maximum(size - 0.02, 0.0)) ** 2, 0.02 + np.sqrt(18.7) / 120),
        (lambda size: 1e-9 * size**2, math.inf),
    ):
        found = near_threshold(strengths([rub], law), lambda count: 18.7, lambda pool, law=law: strengths(pool, law))  # type: ignore[misc]
        assert [own.candidate for own in found] == [rub]
        (smallest,) = smallest_sizes(nominal_model(), found, lambda count: 18.7)
        assert smallest.size == pytest.approx(wanted, rel=0.2)


def test_of_what_grows_from_nowhere_the_weakest_guess_that_shows_is_told() -> None:
    tried = [{"level": level} for level in (1e4, 2e4, 3e4)]
    screened: Any = SimpleNamespace(candidate=POOL[FULL], tried=tried, strength=np.array([90.0, 30.0, 4.0]))
    assert smallest_size(screened, 18.7) == 2e4
    assert np.isnan(smallest_size(screened, 100.0))


ALONE = frozenset({RUB})
REASONS: list[tuple[StopReason, dict[tuple[str, ...], float], SearchSettings, tuple[frozenset[str], ...], set[str]]] = [
    ("no effect accepted", {(): 5000.0, (RUB,): 4990.0}, SearchSettings(), (), set()),
    ("no effect accepted", {(): 5000.0, (RUB,): 2000.0}, SearchSettings(), (), {RUB}),
    ("a residual force explains more", {(): 5000.0, (RUB,): 2000.0}, SearchSettings(), (ALONE,), set()),
    # A round that is outdone is taken back, unless the next one is not.
    ("no effect accepted", {(): 5000.0, (RUB,): 2000.0}, SearchSettings(patience=1), (ALONE,), set()),
    (
        "no effect accepted",
        {(): 5000.0, (RUB,): 2000.0, (OFF,): 3000.0, (RUB, OFF): 1000.0},
        SearchSettings(patience=1),
        (ALONE,),
        {RUB, OFF},
    ),
    ("most rounds", {(): 5000.0, (RUB,): 2000.0}, SearchSettings(most_parts=0), (), set()),
]


@pytest.mark.parametrize(("reason", "deviances", "settings", "outdone", "labels"), REASONS)
def test_a_search_says_why_it_stopped(
    reason: StopReason,
    deviances: dict[tuple[str, ...], float],
    settings: SearchSettings,
    outdone: Sequence[frozenset[str]],
    labels: set[str],
) -> None:
    known = Known(deviances, outdone)
    end = OnPaper(known, settings).run(known())
    assert end.stopped == reason and end.best.labels == labels


BOTH, ALL = frozenset({RUB, OFF}), frozenset({RUB, OFF, DEAD})
LOST = "gains do not stand out from the scatter"
SCATTERED: list[tuple[StopReason, dict[frozenset[str], Sequence[str]], set[str], bool]] = [
    (LOST, {BOTH: [OFF], ALL: [OFF, DEAD]}, {RUB}, False),
    # Beside a third part both stand out, which each alone does not.
    ("no effect accepted", {BOTH: [OFF]}, {RUB, OFF, DEAD}, True),
    # One that stands out by itself is no use where another does not beside it.
    (LOST, {BOTH: [OFF], ALL: [OFF]}, {RUB}, True),
    ("no effect accepted", {}, {RUB, OFF, DEAD}, True),
]


@pytest.mark.parametrize("doubt", [LOST, "validation trials get worse"])
@pytest.mark.parametrize(("reason", "scattered", "labels", "exchanged"), SCATTERED)
def test_what_does_not_stand_out_from_the_scatter_or_makes_validation_trials_worse_is_looked_beyond_once(
    doubt: StopReason,
    reason: StopReason,
    scattered: dict[frozenset[str], Sequence[str]],
    labels: set[str],
    exchanged: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing is exchanged beside it: that takes most of a search's time."""

    def doubtful(simple: Fitted, rich: Fitted) -> bool:
        return bool((rich.labels - simple.labels) & set(scattered.get(rich.labels, ())))

    if doubt == LOST:
        monkeypatch.setattr(OnPaper, "over_scatter", lambda own, one, other, t: 0.5 if doubtful(one, other) else 2.0)
    else:
        monkeypatch.setattr(OnPaper, "spoils", lambda own, one, other: doubtful(one, other))
    own, beside = OnPaper.exchanged, list[frozenset[str]]()

    def exchange(search: OnPaper, state: SearchState) -> SearchState:
        beside.append(state.best.labels)
        return own(search, state)

    monkeypatch.setattr(OnPaper, "exchanged", exchange)
    monkeypatch.setattr(search_module, "with_imitators", lambda search, state: state)
    known = Known({(): 9e3, (RUB,): 5e3, (OFF,): 8e3, (DEAD,): 8.5e3, (RUB, OFF): 3e3, (RUB, DEAD): 4.5e3,
                   (OFF, DEAD): 7.5e3, (RUB, OFF, DEAD): 1e3})  # fmt: skip
    end = OnPaper(known, SearchSettings(many_minima=True, patience=1)).run(known())
    assert end.stopped == (doubt if reason == LOST else reason) and end.best.labels == labels
    assert (BOTH in beside) is (BOTH not in scattered) and (ALL in beside) is exchanged
    few = OnPaper(known, SearchSettings()).run(known())  # where minima are few it counts as any other
    assert few.best.labels == {RUB, OFF, DEAD}


def test_what_stands_for_other_parameters_is_not_taken() -> None:
    """It gains most, where bounds hold those back."""
    known = Known({(): 5000.0, (RUB,): 2000.0, (OFF,): 1000.0, (RUB, OFF): 990.0}, aliased=[OFF])
    end = OnPaper(known).run(known())
    assert end.best.labels == {RUB}


@pytest.mark.parametrize("parts", [(RUB, DEAD), (DEAD, RUB)])
def test_nothing_is_tried_beside_a_part_that_is_not_needed(
    parts: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever it stands in the hypothesis."""
    known = Known({(): 9e3, (RUB,): 1e3, (DEAD,): 9e3, parts: 1e3, (OFF,): 8e3})
    beside: list[frozenset[str]] = []
    own = OnPaper.challenge

    def challenge(search: OnPaper, tried: SearchHistory, fitted: Fitted, *given: Any) -> Any:
        beside.append(fitted.labels)
        return own(search, tried, fitted, *given)

    monkeypatch.setattr(OnPaper, "challenge", challenge)
    end = OnPaper(known).exchanged(SearchState(known(), known(*parts)))
    assert end.best.labels == {RUB}
    assert beside == [frozenset()]


def test_where_no_more_parts_are_asked_for_the_search_says_so() -> None:
    known = Known({(): 5000.0, (RUB,): 2000.0, (OFF,): 1000.0})
    end = OnPaper(known).go_on(SearchState(known(), known(RUB)), further=False)
    assert end.stopped == "no more parts asked for" and end.best.labels == {OFF}


@pytest.mark.parametrize("many_minima", [False, True])
@pytest.mark.parametrize(("n", "k"), [(1000, 1), (1000, 3), (100_000, 1)])
def test_the_threshold_is_the_larger_of_chance_and_simulation_error(n: int, k: int, many_minima: bool) -> None:
    """P(χ² > threshold) is the significance over the number of candidates, by the regularised gamma function."""
    t = Thresholds()
    search = HypothesisMoves(SimpleNamespace(n=n, thresholds=t), list(POOL.values()), SearchSettings(many_minima=many_minima))  # type: ignore[arg-type]  # fmt: skip
    least = search.threshold(k) - (t.minima_scatter if many_minima else 0.0)
    chance = float(gammaincc(k / 2, least / 2))
    if n == 1000:
        assert chance == pytest.approx(t.significance / len(POOL))
    else:
        assert least == t.simulation_error * n and chance < t.significance / len(POOL)


def test_theta_is_the_models_parameters_and_then_the_values_part_by_part() -> None:
    data: Any = SimpleNamespace(free=SimpleNamespace(free=[None, None]))
    hypothesis = fitted(0.0, STICK, OFF).hypothesis
    theta = Data.theta_of(data, np.array([1.0, 2.0, 77.0]), hypothesis)
    np.testing.assert_array_equal(theta, [1.0, 2.0, 0.01, 0.012, 0.1, 0.1])
    np.testing.assert_array_equal(Data.theta_of(data, np.array([1.0, 2.0]), ()), [1.0, 2.0])


GAINS: list[tuple[confirmation.Reason, float, float, float, float, bool, float]] = [
    # reason, gain and χ² distance on held-out trials, that of the part alone, gain on fitted ones, trials of one kind;
    # the ratio
    ("gain", 60.0, 1000.0, 1000.0, 200.0, False, 0.6),
    ("gain", 10.0, 20.0, 20.0, 200.0, True, 0.1),
    ("distance", 10.0, 20.0, 20.0, 200.0, False, 0.5),
    ("evident", 1.0, 2.0, 2.0, 200.0, False, np.inf),
    ("uninformative", 1.0, 2.0, 2.0, 50.0, False, 0.04),
    # A part that does nothing there, or one whose work other parameters do there.
    ("evident", -10.0, 20.0, 0.0, 200.0, False, np.inf),
    ("evident", 1.0, 2.0, 500.0, 200.0, False, np.inf),
    ("uninformative", -10.0, 20.0, 0.0, 50.0, False, -0.4),
]


@pytest.mark.parametrize(("reason", "held_out", "distance", "own", "gain", "same_kind", "ratio"), GAINS)
def test_what_held_out_trials_say_of_a_part_has_a_reason(
    reason: confirmation.Reason,
    held_out: float,
    distance: float,
    own: float,
    gain: float,
    same_kind: bool,
    ratio: float,
) -> None:
    """Half as many samples are held out as fitted."""
    search = OnPaper(Known({(): 1000.0}))
    robot = SimpleNamespace(traits=SimpleNamespace(same_kind_of_trials=same_kind))
    search.data.free.model = SimpleNamespace(robot=robot)  # type: ignore[misc, assignment]
    holdout: Any = SimpleNamespace(
        carried_over=lambda simple, rich: held_out / (0.5 * gain),
        gain=lambda simple, rich: held_out,
        distance=lambda simple, rich: distance,
        own_distance=lambda simple, rich: own,
    )
    said = confirmation.carried_over(search, holdout, fitted(1000.0), fitted(1000.0 - gain, RUB))
    assert said == confirmation.Confirmation(reason, pytest.approx(ratio))


# --- what an effect explains alone --------------------------------------------------------------------------------


def test_alone_is_the_best_fit_with_nothing_else() -> None:
    base, both = fitted(900.0), fitted(100.0, RUB, DEAD)
    only, worse, other = fitted(300.0, RUB), fitted(320.0, RUB), fitted(200.0, DEAD)
    tried = SearchHistory(fitted=(worse, other, both, fitted(150.0, RUB, OFF)))
    end = SearchState(base, both, without=(other, only), tried=tried)
    assert _alone(end, RUB) is only and _alone(end, DEAD) is other
    assert _alone(end, OFF) is None
    assert _alone(replace(end, without=()), RUB) is worse
    assert _alone(SearchState(base, only), RUB) is only
