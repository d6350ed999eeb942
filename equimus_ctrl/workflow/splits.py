"""A diagnosis repeated on random halves of its trials, for the command and for users of the library."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from equimus_ctrl.diagnosis.budget import BudgetSpent
from equimus_ctrl.diagnosis.holdout import Holdout
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.split_comparison import SplitAnswer, SplitComparison
from equimus_ctrl.diagnosis.state import Progress
from equimus_ctrl.errors import EquimusError

Diagnosed = Callable[[Holdout | None, Progress], Diagnosis]
"""A diagnosis with some trials held out, by default the usual ones; it tells how far it is.

Raises BudgetSpent where the budget ends before there is anything to tell.
"""


def over_splits(diagnosed: Diagnosed, others: Sequence[Holdout], asked: int, progress: Progress) -> Diagnosis:
    """The diagnosis by the usual split, with what those by others say.

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
    answers, fewer = [SplitAnswer.of(first, time.perf_counter() - begun)], list[str]()
    if len(others) < asked:
        fewer.append(f"the trials have no more than {len(others)} random halves")
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
        answers.append(SplitAnswer.of(found, time.perf_counter() - begun))
    return replace(first, splits=SplitComparison(tuple(answers), asked, tuple(fewer)))
