"""Which laws a search names, lists beside those, and comes back to no more; deviances are given, not simulated."""

from __future__ import annotations

from dataclasses import replace

import pytest
from search_on_paper import DEAD, OFF, POOL, RUB, STICK, Known, OnPaper, ended, fitted, held_out_rejects

from equimus_ctrl.diagnosis import confirmation
from equimus_ctrl.diagnosis import search as search_module
from equimus_ctrl.diagnosis.alternatives import with_all_fitted
from equimus_ctrl.diagnosis.findings import equivalents
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.effects import REGISTRY


def law(locations: str, each: bool = False) -> Candidate:
    effect, places = REGISTRY["viscous_friction"], tuple(locations)
    names = [f"{place}.damping" for place in places] if each else ["damping"]
    return Candidate(effect, places, (dict.fromkeys(names, 0.1),), each=each)


@pytest.mark.parametrize(
    ("gone", "of", "left"),
    [
        (law("a"), law("a"), ""),
        (law("a"), replace(law("a"), absent=("unit",)), ""),
        (law("a"), law("ab"), "ab"),  # it may have failed for what it lacks at the other
        (law("a"), law("b"), "b"),
        (law("a"), law("abc", each=True), "bc"),
        (law("ab", each=True), law("a"), ""),
        (law("ab", each=True), law("abc", each=True), "c"),
        (law("ab"), law("ab"), ""),
        (law("ab"), law("abc", each=True), "abc"),
        (law("ab"), law("a"), "a"),  # with the same parameters at both it was rejected, not there alone
    ],
)
def test_a_law_that_was_rejected_somewhere_comes_back_under_no_label(gone: Candidate, of: Candidate, left: str) -> None:
    tried = SearchState(fitted(0.0), fitted(0.0)).rejecting([gone]).tried
    assert "".join(tried.allowed_places(of)) == left
    assert tried.allows([of]) == (left == "".join(of.locations))
    search = OnPaper(Known({(): 0.0}))
    object.__setattr__(search, "pool", [of])
    assert ["".join(candidate.locations) for candidate in search.allowed_candidates(tried)] == [left] * bool(left)


@pytest.mark.parametrize(("stick", "better"), [(900.0, 90.0), (995.0, 0.0), (1005.0, 0.0), (1011.0, None)])
def test_what_fits_better_is_not_listed_as_if_it_fitted_as_well(stick: float, better: float | None) -> None:
    """A law of three parameters that change what is seen in one direction alone."""
    known = Known({(): 5000.0, (RUB,): 1000.0, (STICK,): stick})
    search = OnPaper(known)
    search.data.dimensions = lambda fitted, k, most: 1  # type: ignore[misc, method-assign]
    (others,) = equivalents(search, ended(known, RUB), False, lambda fitted: fitted)
    assert [other.better for other in others] == ([] if better is None else [better])


@pytest.mark.parametrize(("stick", "better"), [(995.0, None), (993.0, 0.0), (985.0, 0.0), (960.0, 16.2)])
def test_a_law_of_more_dimensions_is_listed_where_chance_would_not_gain_as_much(
    stick: float, better: float | None
) -> None:
    """Two more dimensions gain 6.0 by chance once in twenty times, and cost 13.8 by Schwarz."""
    known = Known({(): 5000.0, (RUB,): 1000.0, (STICK,): stick})
    search = OnPaper(known)
    search.data.dimensions = lambda fitted, k, most: 3  # type: ignore[misc, method-assign]
    (others,) = equivalents(search, ended(known, RUB), False, lambda fitted: fitted)
    assert [other.better for other in others] == ([] if better is None else [pytest.approx(better, abs=0.1)])


@pytest.mark.parametrize("many_minima", [True, False])
def test_a_law_that_another_step_of_the_search_has_fitted_is_listed(many_minima: bool) -> None:
    """Also one that excludes the law named, as a wider one of the same kind does; not one that was rejected."""
    known = Known({(): 5000.0, (RUB,): 1000.0, (STICK,): 985.0, (OFF,): 1001.0, (RUB, DEAD): 999.0})
    search = OnPaper(known, SearchSettings(many_minima=many_minima))
    search.data.dimensions = lambda fitted, k, most: 3  # type: ignore[misc, method-assign]
    end = replace(ended(known, RUB), alternatives=((),))
    end = replace(end, tried=end.tried.having(fitted(990.0, STICK), *known.fits.values()))

    def listed_of(end: SearchState) -> list[Fitted]:
        (others,) = equivalents(search, with_all_fitted(search, end), False, lambda fitted: fitted)
        return [other.fitted for other in others]

    assert listed_of(end) == [known(STICK), known(OFF)]
    assert listed_of(end.rejecting([POOL[STICK]])) == [known(OFF)]
    known_already = replace(end, alternatives=((fitted(990.0, STICK),),))
    assert {other.deviance for other in listed_of(known_already)} == {990.0, 1001.0}


@pytest.mark.parametrize("reason", ["uninformative", "gain"])
def test_a_richer_law_of_which_held_out_trials_say_nothing_is_listed(
    reason: confirmation.Reason, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = Known({(): 5000.0, (RUB,): 1100.0, (STICK,): 1000.0})
    search = OnPaper(known, SearchSettings(many_minima=True))

    def carried_over(search: object, holdout: object, simple: Fitted, rich: Fitted) -> confirmation.Confirmation:
        if simple.labels == {RUB}:
            return confirmation.Confirmation(reason, 0.0)
        return confirmation.Confirmation("gain", 1.0)

    split = held_out_rejects(monkeypatch, [])
    monkeypatch.setattr(confirmation, "carried_over", carried_over)
    monkeypatch.setattr(confirmation, "_makes_worse", lambda *given: None)
    end = confirmation.confirmed(search, ended(known, STICK), split)
    assert end.best.labels == {RUB}
    (others,) = equivalents(search, end, False, lambda fitted: fitted)
    assert [other.fitted.labels for other in others] == [{STICK}] * (reason == "uninformative")
    (others,) = equivalents(search, end.rejecting([POOL[STICK]]), False, lambda fitted: fitted)
    assert others == ()


def test_a_law_in_the_place_of_several_is_pruned_and_simplified_as_any(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known({(): 5000.0, (OFF,): 3000.0, (DEAD,): 3000.0, (OFF, DEAD): 1000.0, (STICK,): 990.0, (RUB,): 995.0})
    united = ended(known, STICK)
    monkeypatch.setattr(search_module, "with_fewer_laws", lambda search, state: united)
    search = OnPaper(known, SearchSettings(many_minima=True))
    assert search.go_on(ended(known, OFF, DEAD), further=False).best.labels == {RUB}
