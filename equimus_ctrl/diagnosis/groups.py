"""What differs between groups of trials, such as units of a robot or days: parameters with a value of their own there.

All groups share one model. A parameter of the model or of an effect gets a value of its own in a group where that lets
−2 ln L fall by more than an effect has to (``Scoring.threshold``) and held-out trials confirm it; an effect
that does nothing in a group is absent there. Moves are ranked by their gain to first order,

    (rᵀPc)² / cᵀPc,    c = column of the parameter's Jacobian in the rows of the group, 0 elsewhere

r the whitened residual, P the projection beyond all parameters that are free: Rao's score test (Rao, 1948). The best
are fitted; what a later one makes unnecessary is dropped.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.diagnosis.confirmation import Confirmation, confirmation_of, least_confirmed
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.hypothesis import Hypothesis, Part
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.parameters import FreeParameters, in_group
from equimus_ctrl.identification.projection import DEPENDENT, Nuisance
from equimus_ctrl.identification.segments import groups_of, groups_with_own
from equimus_ctrl.identification.whitened_fit import whiten_fit
from equimus_ctrl.types import Array

TRIED = 3
"""So many of the moves that gain most to first order are fitted."""


@dataclass(frozen=True)
class Own:
    """A parameter with a value of its own in a group.

    Attributes:
        name: of the model's parameter, dotted; or of a part's, see ``OwnParameter.name``.
        group: the group.
        part: place of the part in the hypothesis; None for the model's.
    """

    name: str
    group: str
    part: int | None = None

    def label(self, hypothesis: Hypothesis) -> str:
        """Such as ``arm.mass in B``, or ``friction of coulomb_friction:elbow in B``."""
        if self.part is None:
            return in_group(self.name, self.group)
        candidate = hypothesis[self.part].candidate
        where = "+".join(candidate.locations)
        return in_group(f"{self.name} of {candidate.effect.name}:{where}", self.group)


@dataclass(frozen=True, eq=False)
class Apart:
    """A fitted hypothesis, what is free in it, and the search that goes on from there.

    Attributes:
        search: with the data, whose free parameters have those of groups among them.
        best: the hypothesis.
    """

    search: Search
    best: Fitted

    @property
    def data(self) -> Data:
        """What is fitted."""
        return self.search.data

    @property
    def own(self) -> tuple[Own, ...]:
        """What has a value of its own in a group."""
        of_model = [Own(f.name, f.group) for f in self.data.free.free if f.group]
        parts = enumerate(self.best.hypothesis)
        return (*of_model, *(Own(name, group, k) for k, part in parts for name, group in part.candidate.own))

    def with_own(self, own: Own) -> Apart | None:
        """The same with one more value, fitted; None where that cannot be."""
        if own.part is None:
            return self._with_free(own)
        part = self.best.hypothesis[own.part]
        more = replace(part.candidate, own=(*part.candidate.own, (own.name, own.group)))
        values = {**part.values, in_group(own.name, own.group): part.values[own.name]}
        return self.with_part(own.part, Part(more, values))

    def _with_free(self, own: Own) -> Apart | None:
        free, theta = self.data.free, self.theta
        i = next(i for i, f in enumerate(free.free) if f.name == own.name and not f.group)
        more = replace(free.free[i], group=own.group)
        data = replace(self.data, free=FreeParameters(free.model, (*free.free, more)))
        return self.fitted_with(data, np.append(theta, theta[i]), self.best.hypothesis)

    def without(self, own: Own) -> Apart | None:
        """The same with the common value, fitted; None where that cannot be."""
        if own.part is None:
            free = self.data.free
            kept = [i for i, f in enumerate(free.free) if (f.name, f.group) != (own.name, own.group)]
            fewer = FreeParameters(free.model, tuple(free.free[i] for i in kept))
            return self.fitted_with(replace(self.data, free=fewer), self.theta[kept], self.best.hypothesis)
        part = self.best.hypothesis[own.part]
        left = tuple(pair for pair in part.candidate.own if pair != (own.name, own.group))
        values = {key: v for key, v in part.values.items() if key != in_group(own.name, own.group)}
        fewer_own = Part(replace(part.candidate, own=left), values)
        return self.with_part(own.part, fewer_own)

    def with_part(self, k: int, part: Part) -> Apart | None:
        """The same with another part in the k-th one's place, fitted; None where that cannot be."""
        return self.fitted_with(self.data, self.theta, self._replaced(k, part))

    @property
    def theta(self) -> Array:
        """(p,) the model's own parameters, without those of effects."""
        return self.best.fit.theta[: len(self.data.free.free)]

    def _replaced(self, k: int, part: Part) -> Hypothesis:
        hypothesis = self.best.hypothesis
        return (*hypothesis[:k], part, *hypothesis[k + 1 :])

    def fitted_with(self, data: Data, theta: Array, hypothesis: Hypothesis) -> Apart | None:
        """A hypothesis fitted with the data's free parameters, from θ of the model's; None where that cannot be."""
        search = self.search if data is self.data else replace(self.search, data=data)
        try:
            begin = (data.theta_of(theta, hypothesis), self.best.fit.starts)
            steps = search.settings.long_steps
            after = data.converge(data.coarse_fit(hypothesis, [begin], self.best.noise, steps))
        except SimulationDiverged:  # so it cannot be what happened
            return None
        return Apart(search, after)

    def moves(self, groups: Sequence[str]) -> list[tuple[float, Own]]:
        """What may get a value of its own, with the gain to first order, the largest first."""
        fit = self.best.fit
        whitened = whiten_fit(self.data.times, fit, self.best.noise)
        rows = np.repeat([s.group for s in self.data.segments], [s.outputs.size for s in self.data.segments])
        nuisance, found = Nuisance.of(whitened.slopes), list[tuple[float, Own]]()
        residual, taken = nuisance.project_out(whitened.residual), set(self.own)
        for i, own in self._splittable():
            for group in groups_with_own(groups):
                move = replace(own, group=group)
                absent = own.part is not None and group in self.best.hypothesis[own.part].candidate.absent
                if move in taken or absent:
                    continue
                column = np.where(rows == group, whitened.slopes[:, i], 0.0)
                beyond = nuisance.project_out(column)
                strength = float(beyond @ beyond)
                if strength > DEPENDENT * float(column @ column):
                    found.append((float(residual @ beyond) ** 2 / strength, move))
        return sorted(found, key=lambda move: -move[0])

    def _splittable(self) -> Iterator[tuple[int, Own]]:
        """Parameters that all groups may share, with their places in θ."""
        free = self.data.free.free
        yield from ((i, Own(f.name, "")) for i, f in enumerate(free) if not f.group)
        first, alone = len(free), 2
        for k, part in enumerate(self.best.hypothesis):
            there = len(groups_of(self.data.segments)) - len(part.candidate.absent)
            if there >= alone:
                yield from ((first + i, Own(p.name, "", k)) for i, p in enumerate(part.candidate.common))
            first += part.candidate.n_parameters


def absent(part: Part, groups: Sequence[str]) -> Part:
    """A part that does not act in some groups any more, without the values that it has there."""
    own = part.candidate.own
    left = tuple((name, group) for name, group in own if group not in groups)
    gone = {in_group(name, group) for name, group in own if group in groups}
    values = {key: v for key, v in part.values.items() if key not in gone}
    return Part(replace(part.candidate, own=left, absent=(*part.candidate.absent, *groups)), values)


def told_apart(apart: Apart, split: Split) -> Apart:
    """With the values of groups that are needed and confirmed, and those alone.

    Raises:
        BudgetSpent: where the budget ends.
    """
    groups = groups_of(apart.data.segments)
    apart = _forward(apart, groups)
    apart = _alike_where_possible(_backward(apart, split))
    return _where_present(apart, groups)


def _forward(apart: Apart, groups: Sequence[str]) -> Apart:
    search = apart.search  # whatever is free, the threshold is the same

    def promising(gain: float) -> bool:
        return search.data.thresholds.decides(lambda t: gain * search.settings.optimism > search.threshold(1, t))

    while True:
        tried = [own for gain, own in apart.moves(groups)[:TRIED] if promising(gain)]
        options = [after for own in tried if (after := apart.with_own(own)) is not None]
        best = min(options, key=lambda after: after.best.deviance, default=None)
        if best is None or not _accepts(apart.search, apart.best, best.best):
            return apart
        apart = best


def _accepts(search: Search, simple: Fitted, rich: Fitted) -> bool:
    """Whether a value more is worth its gain, as ``Scoring.accepts``."""
    gain = simple.deviance - rich.deviance
    return search.data.thresholds.decides(lambda t: gain > search.threshold(1, t))


def _backward(apart: Apart, split: Split) -> Apart:
    """Without the values that are not needed, or that held-out trials do not confirm."""
    while True:
        options = [after for own in apart.own if (after := apart.without(own)) is not None]
        least = min(options, key=lambda after: after.best.deviance, default=None)
        if least is None:
            return apart
        if not _accepts(apart.search, least.best, apart.best):
            apart = least
            continue
        judged = [(confirmation(apart, after.best, split), after) for after in options]
        worst = least_confirmed(apart.search, [said for said, _ in judged])
        if worst is None:
            return apart
        apart = judged[worst][1]


def _alike_where_possible(apart: Apart) -> Apart:
    """Effects of some groups alone in all of them, where that fits as well and is needed there."""
    for k, part in enumerate(apart.best.hypothesis):
        if not part.candidate.absent or part.candidate.own:
            continue
        alike = apart.with_part(k, Part(replace(part.candidate, absent=()), part.values))
        if alike is None or _accepts(apart.search, alike.best, apart.best):
            continue
        rest = tuple(other for other in apart.best.hypothesis if other is not part)
        without = apart.fitted_with(apart.data, apart.theta, rest)
        if without is not None and apart.search.accepts(without.best, alike.best):
            return _alike_where_possible(alike)
    return apart


def confirmation(apart: Apart, without: Fitted, split: Split) -> Confirmation:
    """What recordings say of a value of a group: nothing against it where none are held out."""
    if not split.validation:
        return Confirmation("evident", math.inf)
    holdout = HoldoutResiduals(apart.data, split, SearchState(apart.best, apart.best))
    return confirmation_of(apart.search, holdout, without, apart.best)


def _where_present(apart: Apart, groups: Sequence[str]) -> Apart:
    """Effects whose size is nothing in a group, absent there where that fits as well."""
    for k, part in enumerate(apart.best.hypothesis):
        nothing, sizes = part.candidate.grows_from(), part.candidate.sizes
        if len(sizes) != 1 or not part.candidate.own:
            continue
        name = sizes[0]
        size_in = {g: part.values.get(in_group(name, g), part.values[name]) for g in groups}
        here = [g for g in groups if g not in part.candidate.absent]
        weakest = min(here, key=lambda g: abs(size_in[g] - nothing[name]))
        without = [g for g in here if size_in[g] == size_in[weakest]]
        if len(without) == len(here):
            continue
        after = apart.with_part(k, absent_with_common(part, without, here))
        if after is not None and not _accepts(apart.search, after.best, apart.best):
            return _where_present(after, groups)
    return apart


def absent_with_common(part: Part, without: Sequence[str], here: Sequence[str]) -> Part:
    """``absent``, the values of one of the groups left becoming the common ones where no group left has these."""
    left = [g for g in here if g not in without]
    smaller = absent(part, without)
    names = [p.name for p in part.candidate.common]
    own = {name: [g for n, g in smaller.candidate.own if n == name] for name in names}
    values, kept = dict(smaller.values), list(smaller.candidate.own)
    for name in names:
        if len(own[name]) == len(left):  # nobody has the common value any more
            values[name] = values.pop(in_group(name, left[0]))
            kept.remove((name, left[0]))
    order = [*names, *(in_group(n, g) for n, g in kept)]
    return Part(replace(smaller.candidate, own=tuple(kept)), {key: values[key] for key in order})


def rebuilt(apart: Apart, before: SearchState) -> SearchState:
    """The end of a search with other values of groups: what it would be without each part, and without any.

    Fits with other parameters of the model free are of no use there, so none of them stays.
    """
    search = apart.search
    same = before.base.fit.parameters.names == search.data.free.names
    tried = before.tried if same else SearchHistory(first=before.tried.first, rejected=before.tried.rejected)
    base = before.base if same else search.refit(tried, apart.best, ())[0]
    return search.moved(replace(before, base=base, tried=tried), apart.best)
