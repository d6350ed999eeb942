"""What stages of a diagnosis may change, keep and tell, with fits that are given instead of simulated."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from search_on_paper import DEAD, OFF, POOL, RUB, STICK, VALUES, Known, OnPaper, ended, fitted, held_out_rejects

from equimus_ctrl.diagnosis import reporting, search_stage, stages
from equimus_ctrl.diagnosis.budget import Budget, BudgetSpent
from equimus_ctrl.diagnosis.confirmation import Confirmation
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.residuals import ResidualAboveNoise
from equimus_ctrl.diagnosis.results import Decision, Equivalent, Named, Rejected
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState, Undecided
from equimus_ctrl.diagnosis.state import DiagnosisInputs, DiagnosisSettings, State, forward
from equimus_ctrl.diagnosis.unexplained import ResidualAnalysis
from equimus_ctrl.effects import REGISTRY
from equimus_ctrl.errors import SimulationDiverged

AGREED, DENIED = Confirmation("gain", 0.9), Confirmation("gain", 0.1)


@dataclass(frozen=True, eq=False)
class Searching:
    """A search that says what it fits."""

    data: Any
    pool: Any = ()

    @staticmethod
    def score(fit: Fitted) -> float:
        return fit.deviance


def trials(*names: str) -> tuple[Any, ...]:
    return tuple(SimpleNamespace(recording=k, recording_name=name) for k, name in enumerate(names))


def inputs(split: Split, told: list[tuple[str, float]] | None = None) -> DiagnosisInputs:
    nothing: Any = SimpleNamespace()

    def progress(stage: str, share: float, best: str) -> None:
        (told if told is not None else []).append((stage, share))

    data = Data(nothing, split.train, nothing)
    return DiagnosisInputs(data, split, DiagnosisSettings(), progress, 0.0, nothing)


def state_of(end: SearchState, split: Split | None = None, search: Any = None, **known: Any) -> State:
    return State(
        inputs(split or Split((), ())), search or Searching(SimpleNamespace(simulator=None)), end, None, (), **known
    )


# --- other trials held out ----------------------------------------------------------------------------------------

ALONE = ResidualAnalysis((ResidualAboveNoise("hip", 1.0, 9.0, 3.0, "validation"),))
OTHER = Split(trials("a", "d"), trials("c"), trials("test"))
SPLIT = Split(trials("a", "c"), trials("d"), trials("test"), other=OTHER)


def repeated(monkeypatch: pytest.MonkeyPatch, **known: Any) -> tuple[State, list[str]]:
    """What is known after the stage, the second diagnosis having come to this, and which stages it had."""
    asked: list[str] = []

    def through(given: DiagnosisInputs, order: Any, whole: bool) -> State:
        asked.extend(stage.name for stage in order)
        second = State(given, Searching(None), SearchState(fitted(9.0), fitted(1.0, RUB)), None, (), **known)
        return second.decided("search", f"{RUB} accepted", "it gains")

    monkeypatch.setattr(stages, "_through", through)
    first = state_of(SearchState(fitted(9.0), fitted(8.0, OFF)), SPLIT, analysis=ALONE)
    return stages.repeat_with_other_holdout(first.decided("search", f"{OFF} accepted", "it gains")), asked


def test_a_second_diagnosis_that_leaves_nothing_is_the_answer_beside_what_the_first_decided(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    after, asked = repeated(monkeypatch)
    assert after.end.best.labels == {RUB} and after.inputs.split is OTHER
    assert [(d.stage, d.decision, d.other_holdout) for d in after.decisions] == [
        ("search", f"{OFF} accepted", False),
        ("search", f"{RUB} accepted", True),
        ("other_holdout", "held out instead: c", False),
    ]
    assert [d.to_dict().get("other_holdout", False) for d in after.decisions] == [False, True, False]
    assert after.notes == (
        "d, held out at first, showed what the other trials do not; so they were fitted, and c judged.",
    )
    # What only adds to an answer is carried out once, for the one that is taken.
    assert asked == list(stages.STAGES[: stages.STAGES.index("other_holdout")])


def test_the_test_set_has_no_say_in_which_trials_are_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def simulated(*given: Any) -> Any:
        raise AssertionError("the test set was simulated")

    monkeypatch.setattr(reporting, "residuals_of", simulated)
    assert repeated(monkeypatch)[0].end.best.labels == {RUB}


@pytest.mark.parametrize(
    ("known", "reason"),
    [
        ({"analysis": ALONE}, "that diagnosis leaves residuals unexplained"),
        ({"failed": "its error is 12 times that"}, "its error is 12 times that"),
    ],
)
def test_one_that_leaves_something_is_told_and_changes_nothing(
    known: dict[str, Any], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    after, _ = repeated(monkeypatch, **known)
    assert after.end.best.labels == {OFF} and after.inputs.split is SPLIT and after.analysis is ALONE
    assert [d.other_holdout for d in after.decisions] == [False, True, False]
    assert after.decisions[-1] == Decision("other_holdout", "held out instead: c; rejected", reason)


def test_one_that_the_budget_ends_leaves_the_stage_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BudgetSpent):
        repeated(monkeypatch, cut_short=("search",))
    first = state_of(SearchState(fitted(9.0), fitted(8.0, OFF)), SPLIT, analysis=ALONE)
    after = next(stage for stage in stages.ORDER if stage.name == "other_holdout").after(first)
    assert after.cut_short == ("other_holdout",) and not stages.settled(after) and after.end is first.end


def test_there_is_no_second_diagnosis_where_the_first_was_cut_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages, "_through", lambda *given, **options: pytest.fail("a second diagnosis"))
    first = state_of(SearchState(fitted(9.0), fitted(8.0, OFF)), SPLIT, analysis=ALONE, cut_short=("search",))
    after = next(stage for stage in stages.ORDER if stage.name == "other_holdout").after(first)
    assert after.cut_short == ("search", "other_holdout")


def test_one_that_diverges_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    def diverges(*given: Any, **options: Any) -> State:
        raise SimulationDiverged("gone")

    monkeypatch.setattr(stages, "_through", diverges)
    after = stages.repeat_with_other_holdout(
        state_of(SearchState(fitted(9.0), fitted(8.0, OFF)), SPLIT, analysis=ALONE)
    )
    assert after.decisions[-1].decision.endswith("rejected")


def test_shares_never_fall() -> None:
    told: list[float] = []
    progress = forward(lambda stage, share, best: told.append(share))
    for share in (0.1, 0.8, 0.5, 0.94, 0.9, 1.0):
        progress("", share, "")
    assert told == [0.1, 0.8, 0.8, 0.94, 0.94, 1.0]
    assert [s.share for s in stages.ORDER if s.label] == sorted(s.share for s in stages.ORDER if s.label)
    after = next(s.share for s in stages.ORDER[stages.STAGES.index("other_holdout") :] if s.label)
    before = max(s.share for s in stages.ORDER[: stages.STAGES.index("other_holdout")])
    assert before <= stages.OTHER_SHARE[0] < stages.OTHER_SHARE[1] <= after


# --- what ends a diagnosis ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CutShort(Search):
    """A search that the budget ends on the way to an effect, with fits that are looked up."""

    known: Known = field(default_factory=lambda: Known({(): 900.0, (RUB,): 100.0, (OFF,): 200.0}))
    second: bool = False

    def steps(self, state: SearchState, *given: object, **options: object) -> Any:
        assert self.data.budget.seconds < 10.0, "of a budget of 10 s a search may take a share"
        yield state
        if self.second:
            yield replace(state, best=self.known(RUB), without=(self.known(),), alternatives=((),))
        way = OFF if self.second else RUB
        self.reached(self.data, replace(state, best=self.known(way), tried=state.tried.having(self.known(way))))
        raise BudgetSpent

    def begun_in_torques(self, state: SearchState) -> Any:
        yield from ()

    def score(self, fitted: Fitted) -> float:
        return fitted.deviance

    def refit(self, tried: SearchHistory, fitted: Any, hypothesis: tuple[Part, ...]) -> tuple[Any, SearchHistory]:
        self.data.budget.check()
        return self.known(*(part.candidate.label for part in hypothesis)), tried


@pytest.mark.parametrize("second", [False, True], ids=["one", "what comes next is worse"])
@pytest.mark.parametrize("over", [False, True], ids=["its share is up", "the whole is up"])
def test_what_a_search_had_come_to_is_judged_with_the_rest_of_the_budget(
    over: bool, second: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search_stage, "simulated", lambda search, end: None)
    given = inputs(Split((), ()))
    given = replace(given, data=replace(given.data, budget=Budget(10.0, lambda: over, time.perf_counter())))
    search = CutShort(given.data, list(POOL.values()), SearchSettings(), second=second)
    state = State(given, search, SearchState(search.known(), search.known()), None, ())
    after = search_stage.find_effects(state)
    assert after.end.best is search.known(RUB) and after.cut_short == ("search",)
    assert after.data.budget.seconds == 10.0, "the rest may take the rest"
    assert after.ended_in == ("search" if over else "")
    assert after.end.without == (() if over and not second else (search.known(),))
    assert search.known(OFF if second else RUB) in after.end.tried.fitted
    left = [stage.name for stage in stages.skipped(after)]
    assert left == (list(stages.STAGES) if over else ["search"]) and not stages.settled(after)


def test_of_two_ends_the_better_one_is_kept_with_the_fits_of_both() -> None:
    search: Any = SimpleNamespace(score=lambda fit: fit.deviance)
    known = {label: fitted(deviance, label) for label, deviance in ((RUB, 100.0), (OFF, 200.0), (DEAD, 300.0))}
    end = SearchState(fitted(900.0), known[RUB], tried=SearchHistory((known[DEAD], known[RUB])))
    way = SearchState(fitted(900.0), known[OFF], tried=SearchHistory((known[OFF],)))
    for best, (first, second) in ((RUB, (end, way)), (RUB, (way, end))):
        found = search_stage._better(search, first, second)
        assert found.best is known[best] and set(found.tried.fitted) == set(known.values())


def test_a_share_of_a_budget_is_of_what_is_left() -> None:
    half_gone = Budget(10.0, begun=time.perf_counter() - 5.0)
    assert half_gone.share(0.75).seconds == pytest.approx(8.75, abs=0.1)
    assert Budget(10.0, begun=time.perf_counter() - 50.0).share(0.75).over and not half_gone.share(0.75).over
    assert Budget().share(0.75) == Budget()


def test_what_there_was_no_time_to_judge_is_not_called_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known({(): 900.0, (RUB,): 100.0, (RUB, OFF): 50.0})
    split = held_out_rejects(monkeypatch, [])
    end = SearchState(known(), known(RUB, OFF), tried=SearchHistory((known(RUB),)))
    state = state_of(end, split, OnPaper(known), ended_in="search")
    after = stages.confirm_as_fitted(state)
    assert after.end.best.labels == {RUB} and after.rejected == ()
    assert next((d.decision, d.stage) for d in after.decisions) == (f"{OFF} not judged", "confirmation")


@pytest.mark.parametrize("name", [stage.name for stage in stages.ORDER])
def test_the_test_set_is_looked_at_where_all_that_decides_was_carried_out(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the budget ends after that, it is known whether something is unexplained there."""
    monkeypatch.setattr(reporting, "residuals_of", lambda *given: [])
    monkeypatch.setattr(reporting, "not_on_test", lambda *given: ALONE)
    after = reporting.tested(state_of(SearchState(fitted(9.0), fitted(1.0, RUB)), ended_in=name))
    assert (after.analysis is ALONE) is (name in ("alternatives", "units"))


def test_what_only_adds_to_an_answer_changes_no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    other = Equivalent(Named("dead_zone", ("baa",)), fitted(2.0, DEAD))
    monkeypatch.setattr(stages, "listed", lambda search, end: replace(end, tried=SearchHistory((fitted(3.0, DEAD),))))
    monkeypatch.setattr(stages, "equivalents", lambda *given: ((other,),))
    monkeypatch.setattr("equimus_ctrl.diagnosis.unit_stages.differences", lambda *given: ())
    monkeypatch.setattr("equimus_ctrl.diagnosis.unit_stages.another_unit", lambda *given: None)
    search: Any = Searching(SimpleNamespace(converge_finely=lambda fitted: fitted))
    before = state_of(ended(Known({(): 900.0, (RUB,): 100.0}), RUB), search=search)
    after = before
    for stage in stages.ORDER:
        if not stage.settles:
            after = stage.run(after)
    assert after.equivalent == ((other,),) and len(after.end.tried.fitted) == 1
    assert (after.end.best, after.end.base, after.end.without) == (before.end.best, before.end.base, before.end.without)
    assert after.analysis is before.analysis and after.search is before.search


# --- starts and intervals -----------------------------------------------------------------------------------------


def test_what_is_led_by_the_fit_is_what_was_fitted_and_counts_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """The end before it stays beside: alternatives were fitted as it was."""
    end = ended(Known({(): 900.0, (RUB,): 100.0, (DEAD,): 300.0, (RUB, DEAD): 50.0}), RUB, DEAD)
    better = {f: fitted(f.deviance - 5.0, *f.labels) for f in (end.best, *end.without)}
    led_data, counted = SimpleNamespace(), list[Any]()

    def step_counted(data: Any, state: SearchState) -> SearchState:
        assert data is led_data and state.base is state.best
        counted.append(state.best)
        wide = fitted(state.best.deviance, *state.best.labels)
        return SearchState(wide, wide)

    monkeypatch.setattr(stages, "step_counted", step_counted)
    search = Searching(SimpleNamespace(led_by_fit=lambda f: (led_data, better[f])))
    before = state_of(end, search=search)
    after = stages.lead_by_fit(before)
    assert after.data is led_data and after.compared == (search, end)
    assert counted == [better[end.best]] and after.end.best.deviance == 45.0 and after.end.base is end.base
    assert after.end.without == tuple(better[f] for f in end.without)
    coarse = stages.lead_by_fit(replace(before, coarse="without the step's error"))
    assert coarse.end.best is better[end.best] and len(counted) == 1
    still = Searching(SimpleNamespace(led_by_fit=lambda f: (None, f)))
    same = state_of(end, search=still)
    assert stages.lead_by_fit(same) is same


def test_alternatives_are_compared_with_the_end_as_they_were_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[SearchState] = []

    def equivalents(search: Any, end: SearchState, *given: Any) -> tuple[Any, ...]:
        assert search is own
        asked.append(end)
        return ((),)

    monkeypatch.setattr(stages, "listed", lambda search, end: end)
    monkeypatch.setattr(stages, "with_all_fitted", lambda search, end: end)
    monkeypatch.setattr(stages, "equivalents", equivalents)
    own = Searching(SimpleNamespace(converge_finely=lambda fitted: fitted))
    measured = ended(Known({(): 900.0, (RUB,): 100.0}), RUB)
    final = replace(measured, best=fitted(90.0, RUB))
    after = stages.find_alternatives(state_of(final, search=Searching(None), compared=(own, measured)))
    assert asked == [measured] and after.end.best is final.best


def test_intervals_count_the_steps_error_where_it_is_not_taken_off(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = ended(Known({(): 900.0, (RUB,): 100.0}), RUB)
    monkeypatch.setattr(stages, "without_step_error", lambda *given: None)
    monkeypatch.setattr(stages, "step_counted", lambda data, end: wide)
    assert stages.take_off_step_error(state_of(SearchState(fitted(900.0), fitted(100.0, RUB)))).end is wide


# --- what is rejected ---------------------------------------------------------------------------------------------


def confirmed_to(monkeypatch: pytest.MonkeyPatch, end: SearchState, said: dict[str, Confirmation]) -> State:
    def confirmed(search: Any, state: SearchState, split: Any, tell: Any) -> SearchState:
        for label, confirmation in said.items():
            tell(label, confirmation)
        return end

    monkeypatch.setattr(stages, "confirmed", confirmed)
    monkeypatch.setattr(stages, "still_apart", lambda search, end, split: (search, end))
    known = Known({(): 900.0, (RUB,): 100.0, (DEAD,): 300.0, (RUB, DEAD): 50.0})
    return stages.confirm(state_of(ended(known, RUB, DEAD), search=OnPaper(known)))


def test_what_held_out_trials_reject_is_among_the_rejected_with_what_they_say(monkeypatch: pytest.MonkeyPatch) -> None:
    end = SearchState(fitted(900.0), fitted(100.0, RUB))
    after = confirmed_to(monkeypatch, end, {DEAD: DENIED, OFF: DENIED, RUB: AGREED})
    dead, offset = Named("dead_zone", ("baa",)), Named("sensor_offset", ("hip",))
    assert after.rejected == tuple(Rejected(named, "confirmation", str(DENIED)) for named in (dead, offset))
    decided = {d.decision: d.reason for d in after.decisions}
    assert decided == {
        f"{DEAD} rejected": str(DENIED),
        f"{OFF} rejected": str(DENIED),
        f"{RUB} confirmed": str(AGREED),
    }
    assert after.rejected[0].to_dict() == {
        "effect": "dead_zone", "locations": ["baa"], "stage": "confirmation", "reason": str(DENIED),
    }  # fmt: skip
    needless = confirmed_to(monkeypatch, end, {RUB: AGREED})
    assert [(own.named, own.reason) for own in needless.rejected] == [(dead, "not needed beside the others")]


def test_a_richer_law_of_which_held_out_trials_say_nothing_is_not_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    rich = Part(POOL[STICK], VALUES["stribeck_friction"])
    end = SearchState(fitted(900.0), fitted(100.0, RUB, DEAD), undecided=(Undecided(RUB, rich),))
    after = confirmed_to(monkeypatch, end, {STICK: DENIED, RUB: AGREED, DEAD: AGREED})
    assert after.rejected == () and f"{STICK} undecided" in {d.decision for d in after.decisions}


def explained(monkeypatch: pytest.MonkeyPatch, before: SearchState, ends: list[Any], said: list[Any]) -> State:
    """What is known after residual forces rejected parts in turn: ends, and what they dropped, before each search."""
    left = iter([*[ResidualAnalysis(redundant={0: "so"})] * len(ends), ResidualAnalysis()])
    rounds, told = iter(ends), iter(said)

    def confirmed(search: Any, end: SearchState, split: Any, tell: Any) -> SearchState:
        for label, confirmation in next(told).items():
            tell(label, confirmation)
        return replace(end, best=goes[-1])

    goes: list[Any] = []

    def without_redundant(search: Any, end: SearchState, analysis: Any) -> tuple[SearchState, dict[Part, str]]:
        dropped, best = next(rounds)
        goes.append(best)
        return replace(end, best=best), dropped

    monkeypatch.setattr(stages, "analysed", lambda *given: next(left))
    monkeypatch.setattr(stages, "analysed_without", lambda *given: next(left))
    monkeypatch.setattr(stages, "without_redundant", without_redundant)
    monkeypatch.setattr(stages, "confirmed", confirmed)
    monkeypatch.setattr(stages, "still_apart", lambda search, end, split: (search, end))
    monkeypatch.setattr(stages, "ranking", lambda search, end: ())
    search: Any = SimpleNamespace(
        pool=list(POOL.values()), settings=SimpleNamespace(again=1), go_on=lambda end, further: end
    )
    return stages.explain_residuals(state_of(before, search=search))


def test_what_residual_forces_and_then_held_out_trials_reject_have_their_own_reasons(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = SearchState(fitted(900.0), fitted(50.0, RUB, DEAD))
    rub = before.best.hypothesis[0]
    after = explained(monkeypatch, before, [({rub: "a force does as well"}, fitted(300.0, DEAD))], [{OFF: DENIED}])
    assert [(own.named.effect, own.stage, own.reason) for own in after.rejected] == [
        ("coulomb_friction", "unexplained", "a force does as well"),
        ("sensor_offset", "unexplained", str(DENIED)),
    ]


def test_a_law_that_stays_at_some_of_its_places_is_rejected_at_the_others_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    law = Candidate(
        REGISTRY["coulomb_friction"], ("hip", "knee"), ({"hip.friction": 0.01, "knee.friction": 0.01},), each=True
    )
    part = Part(law, dict.fromkeys((p.name for p in law.parameters), 0.01))
    fit: Any = SimpleNamespace(model=object(), residuals=[np.zeros((5, 2))], starts=[], theta=np.zeros(3))
    whole, rest = (replace(fitted(50.0), hypothesis=(own,), fit=fit) for own in (part, part.narrowed(("knee",))))
    dropped = {part.narrowed(("hip",)): "a force does as well"}
    after = explained(monkeypatch, SearchState(fitted(900.0), whole), [(dropped, rest)], [{}])
    assert [(str(own.named), own.reason) for own in after.rejected] == [
        ("coulomb_friction at hip", "a force does as well")
    ]
    assert [d.decision for d in after.decisions] == [f"{part.narrowed(('hip',)).candidate.label} rejected"]


def test_what_is_found_or_fits_as_well_in_the_end_is_not_rejected() -> None:
    rub, dead, off = (Named(label.split(":")[0], (label.split(":")[1],)) for label in (RUB, DEAD, OFF))
    state = state_of(
        SearchState(fitted(900.0), fitted(100.0, RUB)), equivalent=((Equivalent(dead, fitted(1.0, DEAD)),),)
    )
    for named in (rub, dead, off, off):
        state = state.rejecting("confirmation", named, str(named), "so they say")
    assert reporting._rejected(state) == (Rejected(off, "confirmation", "so they say"),)
    assert [d.decision for d in state.decisions][:1] == [f"{rub} rejected"]
