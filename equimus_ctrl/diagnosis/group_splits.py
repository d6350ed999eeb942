"""Candidates and hypotheses that differ between groups of trials, such as units of a robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part
from equimus_ctrl.identification.parameters import in_group
from equimus_ctrl.identification.segments import groups_with_own


def with_groups(pool: Sequence[Candidate], groups: Sequence[str]) -> list[Candidate]:
    """Candidates, those that have a size also in each group alone: what all groups show would dilute these."""
    return [*pool, *(_alone_in(candidate, group, groups) for group in groups for candidate in pool if candidate.sizes)]


def _alone_in(candidate: Candidate, group: str, groups: Sequence[str]) -> Candidate:
    return replace(candidate, absent=tuple(other for other in groups if other != group))


def own_in_each_group(hypothesis: Hypothesis, groups: Sequence[str]) -> Hypothesis | None:
    """A hypothesis whose last part acts in all groups of trials, with a size of its own in each; None without any.

    With one size for all, what fits units best that differ may be another law.
    """
    part = hypothesis[-1]
    own = tuple(product(part.candidate.sizes, groups[1:]))  # the first has the common one
    if not own or part.candidate.own:
        return None
    wider = replace(part.candidate, own=own, absent=())
    return (*hypothesis[:-1], Part(wider, wider.in_each_group(part.values)))


def splits_by_group(hypothesis: Hypothesis, groups: Sequence[str]) -> list[Hypothesis]:
    """For each part the hypothesis with one more size of its own in a group: what differs by unit hides the rest."""
    found = []
    for k, part in enumerate(hypothesis):
        candidate = part.candidate
        here = [group for group in groups if group not in candidate.absent]
        for name, group in product(candidate.sizes, groups_with_own(groups)):
            common = [other for other in here if (name, other) not in candidate.own]
            if group in common and len(common) > 1:
                own = replace(candidate, own=(*candidate.own, (name, group)))
                split = Part(own, {**part.values, in_group(name, group): part.values[name]})
                found.append((*hypothesis[:k], split, *hypothesis[k + 1 :]))
    return found
