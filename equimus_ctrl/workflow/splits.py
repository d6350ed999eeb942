"""A diagnosis repeated on random halves of its trials, for the command and for users of the library."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.estimates import Estimate, Named
from equimus_ctrl.diagnosis.holdout import Holdout, kind_of
from equimus_ctrl.diagnosis.results import Diagnosis, Finding
from equimus_ctrl.diagnosis.split_comparison import HeldOutError, Place, SplitAnswer, SplitComparison
from equimus_ctrl.diagnosis.state import Progress
from equimus_ctrl.errors import EquimusError
from equimus_ctrl.types import Array

Diagnosed = Callable[[Holdout | None, Progress], Diagnosis]
"""A diagnosis with some trials held out, those of the default split where none are given; it tells how far it is.

Raises BudgetSpent where the budget ends before there is anything to tell.
"""


def over_splits(diagnosed: Diagnosed, others: Sequence[Holdout], asked: int, progress: Progress) -> Diagnosis:
    """The diagnosis by the default split, with what those by others say.

    A diagnosis by another split that was ended before its answer, or could not be carried out, does not count.

    Args:
        diagnosed: makes them.
        others: what is held out in the other splits.
        asked: how many of these were asked for.
        progress: see ``Progress``.

    Raises:
        EquimusError: where the first cannot be carried out.
        BudgetSpent: where the budget ends before there is anything to tell of the first.
    """

    def part(k: int) -> Progress:
        label = f"split {k} of {len(others)}: " if k else ""
        return lambda stage, share, best: progress(label + stage, (k + share) / (len(others) + 1), best)

    begun = time.perf_counter()
    first = diagnosed(None, part(0))
    answers, fewer = [answer_of(0, first, time.perf_counter() - begun)], list[str]()
    if len(others) < asked:
        fewer.append(f"no more than {len(others)} different ones were found")
    for k, heldout in enumerate(others, start=1):
        begun = time.perf_counter()
        try:
            found = None if first.not_done else diagnosed(heldout, part(k))
        except BudgetSpent:
            found = None
        except EquimusError as error:
            fewer.append(f"split {k} could not be diagnosed: {error}")
            continue
        if found is None or found.not_done:
            fewer.append("the time was up, or the best so far was asked for")
            break
        answers.append(answer_of(k, found, time.perf_counter() - begun))
    return replace(first, splits=SplitComparison(tuple(answers), asked, tuple(fewer)))


def answer_of(number: int, diagnosis: Diagnosis, seconds: float) -> SplitAnswer:
    """What a split's diagnosis found that took so long [s]."""
    named: dict[Place, Mapping[str, Estimate]] = {}
    as_well = set[Place]()
    for finding in diagnosis.findings:
        named |= _named(finding)
        as_well.update(place for other in finding.equivalent for place in _places(other))
    fitted = tuple({s.recording: s.recording_name for s in diagnosis.train}.values())
    errors = tuple(_errors(diagnosis))
    return SplitAnswer(number, fitted, diagnosis.verdict, named, frozenset(as_well) - named.keys(), errors, seconds)


def _named(finding: Finding) -> dict[Place, Mapping[str, Estimate]]:
    """Its parameters at each of its places, of groups of trials that differ in each where it acts."""
    if not finding.by_group:
        return dict.fromkeys(_places(finding.named), finding.parameters)
    return {
        (effect, f"{place} in {group}"): own
        for group, own in finding.by_group.items()
        for effect, place in _places(finding.named)
        if own
    }


def _places(named: Named) -> Iterable[Place]:
    return ((named.effect, location) for location in named.locations)


def _errors(diagnosis: Diagnosis) -> Iterable[HeldOutError]:
    """For each kind of held-out trials and each joint."""
    segments = (*diagnosis.validation, *diagnosis.test)
    left = {
        state: (*diagnosis.residuals[state].validation, *diagnosis.residuals[state].test)
        for state in ("refitted", "corrected")
    }
    for kind in dict.fromkeys(kind_of(s.recording_name) for s in segments):
        own = [k for k, s in enumerate(segments) if kind_of(s.recording_name) == kind]
        sizes = {state: _rmse([residuals[k] for k in own]) for state, residuals in left.items()}
        for j, joint in enumerate(diagnosis.joints):
            yield HeldOutError(kind, joint, sizes["refitted"][j], sizes["corrected"][j])


def _rmse(residuals: Sequence[Array]) -> list[float]:
    return [float(size) for size in np.sqrt(np.mean(np.concatenate(residuals) ** 2, axis=0))]
