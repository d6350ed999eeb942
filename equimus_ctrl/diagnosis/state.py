"""What a diagnosis is asked, and what is known of it after each of its stages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from equimus_ctrl.diagnosis.budget import Budget
from equimus_ctrl.diagnosis.differences import AnotherUnit, Difference
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.known import Known
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.results import Decision, Equivalent, Named, Ranked, Rejected
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.diagnosis.unexplained import ResidualAnalysis
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

Progress = Callable[[str, float, str], None]
"""Called with the stage, the share of the whole that is done, and the best hypothesis so far."""


def forward(progress: Progress) -> Progress:
    """The same, whose share never falls: stages know of their own part of the whole alone."""
    most = 0.0

    def told(stage: str, share: float, best: str) -> None:
        nonlocal most
        most = max(most, share)
        progress(stage, most, best)

    return told


@dataclass(frozen=True)
class DiagnosisSettings:
    """How a diagnosis goes.

    Attributes:
        search: how sets of effects are searched.
        threads: of the simulations; all cores by default.
        engine: by its name; by default see ``engines.choice.engine_for``.
        exclude: names of effects that are not looked for.
        budget: how long it may take [s]; its best so far is given then. As long as it needs by default.
        thresholds: that decide.
        notes: what a person ought to know of recordings and model beforehand.
        known: explanations that an earlier diagnosis of the same robot left: none that fits better is missed.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    threads: int | None = None
    engine: EngineName | None = None
    exclude: tuple[str, ...] = ()
    budget: float | None = None
    thresholds: Thresholds = field(default_factory=Thresholds)
    notes: tuple[str, ...] = ()
    known: tuple[Known, ...] = ()


@dataclass(frozen=True, eq=False)
class DiagnosisInputs:
    """What is asked.

    Attributes:
        data: what hypotheses are fitted to.
        split: trials to fit and trials to validate on.
        settings: how it goes.
        progress: see ``Progress``.
        begun: by ``time.perf_counter``.
        nominal: the model that was given; what is free may begin elsewhere, see ``servo_gains``.
    """

    data: Data
    split: Split
    settings: DiagnosisSettings
    progress: Progress
    begun: float
    nominal: Model


@dataclass(frozen=True, eq=False)
class State:
    """What is known after a stage.

    Attributes:
        inputs: what is asked.
        search: what goes on from ``end``: data, candidates and settings.
        end: where the search has come to.
        short: the model fitted to short shooting intervals, where residuals are large; else None.
        nominal: for each segment fitted (m, nj) the residuals of the nominal model [rad or m].
        analysis: the residuals that the end leaves unexplained.
        rejected: parts of hypotheses so far that a stage rejected.
        ranking: all candidates, alone.
        coarse: a sentence on the engine's step, where its error was taken off; "" else.
        compared: search and end before ``hidden_starts``, where that changed the fit: other hypotheses are fitted and
            compared there, measured motion leading to starts of all alike; None where they are ``search`` and ``end``.
        equivalent: for each part of the hypothesis what fits as well in its place; None where nobody looked.
        notes: what else a person ought to know.
        decisions: of the stages so far.
        failed: why the fit says nothing of other trials; "" where it does.
        differences: between groups of trials.
        another_unit: what of the model's parameters is not nominal; None where the nominal values fit as well.
        cut_short: stages that the budget ended, or their share of it.
        ended_in: the stage in which the whole budget ended; "" where it did not.
    """

    inputs: DiagnosisInputs
    search: Search
    end: SearchState
    short: Fitted | None
    nominal: tuple[Array, ...]
    analysis: ResidualAnalysis = field(default_factory=ResidualAnalysis)
    rejected: tuple[Rejected, ...] = ()
    ranking: tuple[Ranked, ...] = ()
    coarse: str = ""
    compared: tuple[Search, SearchState] | None = None
    equivalent: tuple[tuple[Equivalent, ...], ...] | None = None
    notes: tuple[str, ...] = ()
    decisions: tuple[Decision, ...] = ()
    failed: str = ""
    differences: tuple[Difference, ...] = ()
    another_unit: AnotherUnit | None = None
    cut_short: tuple[str, ...] = ()
    ended_in: str = ""

    @property
    def data(self) -> Data:
        """What hypotheses are fitted to by now."""
        return self.search.data

    def without_budget(self) -> State:
        """The same for work of bounded size that is carried out though the budget may have ended."""
        return self.within(Budget())

    def within(self, budget: Budget) -> State:
        """The same for work that is to end with a budget."""
        if budget == self.data.budget:
            return self
        return replace(self, search=replace(self.search, data=replace(self.data, budget=budget)))

    def ended(self, stage: str) -> State:
        """The same, its budget having ended in a stage: the whole, or what that stage may take of it."""
        over = self.inputs.data.budget.over
        why = "the time was up, or the best so far was asked for" if over else "its share of the time was up"
        after = replace(self, cut_short=(*self.cut_short, stage), ended_in=stage if over else "")
        return after.decided(stage, "ended", why)

    def decided(self, stage: str, decision: str, reason: str) -> State:
        """The same with one more decision."""
        return replace(self, decisions=(*self.decisions, Decision(stage, decision, reason)))

    def rejecting(self, stage: str, named: Named, label: str, reason: str) -> State:
        """The same with one more effect rejected, and the decision."""
        after = replace(self, rejected=(*self.rejected, Rejected(named, stage, reason)))
        return after.decided(stage, f"{label} rejected", reason)
