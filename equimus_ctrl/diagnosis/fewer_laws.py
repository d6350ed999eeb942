"""One law in the place of several, at both ends of a search: they may be what two laws together make of one other.

A search adds law by law, each the best beside those before it. Of a law that it did not look at in time, or fitted to
the wrong minimum, the first may imitate one half and the second the other; no exchange of one part for another leads
back from there. Which single law would explain as much as several is asked of the torque domain
(``torque_screening``), of one hypothesis once; simulated is only what it offers, and simulation decides.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

from equimus_ctrl.diagnosis.alternatives import indistinguishable
from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.hypothesis import Hypothesis, Part, beside
from equimus_ctrl.diagnosis.hypothesis_moves import HypothesisMoves
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.diagnosis.torque_columns import Columns, usual_laws
from equimus_ctrl.diagnosis.torque_screening import CORRELATED, TorqueDomain, TorqueScreen, torque_screen
from equimus_ctrl.diagnosis.torque_start import ABOUT
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False)
class Offer:
    """A hypothesis with one law in the place of several.

    Attributes:
        hypothesis: the other parts as they are, and the law with the values that least squares give it.
        theta: (p,) of the model's parameters with it, and the values.
        price: χ² of what it leaves in the torque domain, with the information criterion's cost of its parameters.
    """

    hypothesis: Hypothesis
    theta: Array
    price: float


def with_fewer_laws(search: HypothesisMoves, state: SearchState) -> SearchState:
    """The end with one law in the place of several, where that is not distinguishable from them, or better.

    As is where there is no torque domain, or where it offers none. Several whose gain over the one law is accepted
    stay: a search that goes on from it would find them again. Each round leaves fewer laws, so it ends.
    """
    while len(state.best.hypothesis) > 1:
        fits, tried = _fits(search, state)
        now, state = state.best, replace(state, tried=tried)
        as_good = (f for f in fits if indistinguishable(search, f, search.score(now)) and not search.accepts(f, now))
        best = min((f for f in as_good if not search.aliased(f)), key=search.score, default=None)
        if best is None:
            break
        state = search.exchanged(replace(state, best=best, without=(), alternatives=()))
    return state


def _fits(search: HypothesisMoves, state: SearchState) -> tuple[tuple[Fitted, ...], SearchHistory]:
    """The best offers, fitted; those of the history where the same hypothesis was asked for before."""
    key = (state.best, state.tried.rejected)
    if (known := state.tried.united.get(key)) is not None:
        return known, state.tried
    fits = []
    for offer in offers(search, state)[: search.settings.contenders]:
        search.notify(f"{offer.hypothesis[-1].candidate.label} in the place of several", state.best.label)
        if (fitted := _fitted(search, state, offer)) is not None:
            fits.append(fitted)
    return tuple(fits), replace(state.tried.having(*fits), united={**state.tried.united, key: tuple(fits)})


def _fitted(search: HypothesisMoves, state: SearchState, offer: Offer) -> Fitted | None:
    """An offer fitted from the torque domain's values, and from the present ones; None where it diverges."""
    data, best = search.data, state.best
    begins = [
        (data.theta_of(offer.theta, offer.hypothesis), best.fit.starts),
        (data.theta_of(best.fit.theta, offer.hypothesis), best.fit.starts),
    ]
    with suppress(SimulationDiverged):  # so it cannot be what happened
        quick = data.coarse_fit(offer.hypothesis, begins, best.noise, search.settings.long_steps)
        return data.converge(quick)
    return None


def offers(search: HypothesisMoves, state: SearchState) -> list[Offer]:
    """What explains in the torque domain about as much as several parts, beside the rest, the best first.

    About as much is ``torque_start.ABOUT`` of what these explain there beside the rest. None where parts are not seen
    there, in the place of parts that explain nothing there, with more parameters than they have, or at other joints.
    """
    domain, parts = search.torque_domain, state.best.hypothesis
    if domain is None or not all(part.candidate.effect.in_torques for part in parts):
        return []
    screen, own = _screened(search, domain, state)
    if len(own) < len(parts):
        return []
    price = math.log(max(screen.samples, 2.0))
    whole, _ = screen.fitted(own)
    found: list[Offer] = []
    for count in range(2, len(parts) + 1):
        for several in combinations(range(len(parts)), count):
            rest = [own[k] for k in range(len(parts)) if k not in several]
            alone, _ = screen.fitted(rest)
            if alone <= whole:
                continue
            enough = alone - ABOUT * (alone - whole)
            within = dict(zip(screen.columns, screen.least_beside(rest) <= enough, strict=True))
            most = sum(parts[k].candidate.n_parameters for k in several)
            for one in _beside(screen, state, rest, own):
                if one.candidate.n_parameters > most or not within[one]:
                    continue
                chi2, sizes = screen.fitted([*rest, one])
                if chi2 > enough:
                    continue
                kept = tuple(part for k, part in enumerate(parts) if k not in several)
                law = Part(one.candidate, one.values(sizes[-1]))
                theta = screen.moved([*rest, one], sizes)
                count_of = one.candidate.n_parameters + sum(p.candidate.n_parameters for p in kept)
                found.append(Offer((*kept, law), theta, chi2 / CORRELATED + price * count_of))
    return _one_of_each(found)


def _screened(search: HypothesisMoves, domain: TorqueDomain, state: SearchState) -> tuple[TorqueScreen, list[Columns]]:
    """The nominal model's screen, and of it the columns of the parts, at their present shapes.

    Screened are candidates with no more parameters than the parts have, and at no joint where these are not; the usual
    laws at all joints, for they tell noise from what is missing.
    """
    parts = state.best.hypothesis
    guesses = {**domain.guesses, **{part.candidate.label: dict(part.values) for part in parts}}
    known = {part.candidate.label: part.candidate for part in parts}
    elsewhere, most = _elsewhere(search.data.free.model.robot, parts), sum(c.n_parameters for c in known.values())
    allowed = [c for c in search.allowed_candidates(state.tried) if not c.absent and c.label not in known]
    small = [c for c in allowed if c.n_parameters <= most and elsewhere.isdisjoint(c.locations)]
    pool = [*small, *(c for c in usual_laws(allowed) if c not in small), *known.values()]
    screen = torque_screen(search.data, replace(domain, guesses=guesses), None, pool)
    last = {own.candidate.label: own for own in screen.columns}  # guesses that are given come last
    return screen, [last[label] for label in known if label in last]


def _elsewhere(robot: Robot, parts: Hypothesis) -> set[str]:
    """Joints at which no part acts; none where one acts at a body, and so at all that carry it."""
    places = {place for part in parts for place in part.candidate.locations}
    driven = {name: set(robot.driven_joints(name)) for name in robot.actuator_names}
    if not places <= driven.keys() | set(robot.joint_names):
        return set()
    return set(robot.joint_names) - places.union(*(driven[name] for name in places & driven.keys()))


def _beside(
    screen: TorqueScreen, state: SearchState, rest: Sequence[Columns], own: Sequence[Columns]
) -> Iterator[Columns]:
    """Columns of candidates that can stand beside some parts, and are no part themselves."""
    labels = {one.candidate.label for one in own}
    kept = tuple(Part(one.candidate, one.base) for one in rest)
    for one in screen.columns:
        if one.fixed or one.candidate.label in labels:
            continue
        if beside(screen.robot, Part(one.candidate, one.base), kept) == kept:
            yield one


def _one_of_each(offers: Sequence[Offer]) -> list[Offer]:
    """Of offers of the same laws the best, the best of all first."""
    best: dict[frozenset[str], Offer] = {}
    for offer in sorted(offers, key=lambda o: o.price):
        best.setdefault(frozenset(part.candidate.label for part in offer.hypothesis), offer)
    return list(best.values())
