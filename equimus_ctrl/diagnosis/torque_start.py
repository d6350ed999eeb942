"""Where a search begins, and what it does not simulate, by what candidates explain in the torque domain.

Friction in all joints hides each joint's own: one law after the other, none would be found. Least squares over all
joints find them together, see ``torque_screening``. No law is accepted here: simulation has to accept it. What is left
out of a round is asked for again beside what that round finds, and missed where it finds nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from scipy.special import chdtri

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part, beside, model_of
from equimus_ctrl.diagnosis.torque_columns import Columns
from equimus_ctrl.diagnosis.torque_guesses import far_above_noise, refined_guesses
from equimus_ctrl.diagnosis.torque_screening import CORRELATED, TorqueDomain, TorqueScreen, torque_screen
from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array

START_SHARE = 0.1
"""A law that a search begins with lowers what is missing above the noise by this share at least. It saves rounds: a law
left out is found later, one too many is not accepted by simulation."""
ABOUT = 0.9
"""A search begins with the simplest law that gains this share of what the best one does: measured angles bias gains in
the torque domain by a few per cent. Richer laws are tried in its place by simulation."""
BEHIND = 0.05
"""Candidates that explain less than this share of what the best one does are not simulated in this round, but for the
``AT_LEAST`` best. It saves time: where the best one is accepted, the rest is looked at beside it."""
AT_LEAST = 12
"""So many best candidates are simulated in a round, however little they explain."""
SURE = 3.0
"""Standard errors by which a law's own size at a place has to differ from nothing, for a search to begin with it: on
noise one place in 370 does."""


def laws_asked_for(
    data: Data, domain: TorqueDomain, pool: Sequence[Candidate], most: int
) -> tuple[Hypothesis, Array] | None:
    """The laws that the missing forces of the nominal model ask for, and θ of the model's parameters with them.

    By forward selection: each the one with the best information criterion beside those before it, as long as it lowers
    what is missing above the noise by ``START_SHARE`` and by more than chance would. None where no law does. Where they
    leave far more than noise explains, it is repeated with guesses fitted in the torque domain, see ``torque_guesses``,
    and what leaves less is taken.

    Args:
        data: what was measured.
        domain: the same in the torque domain.
        pool: the candidates.
        most: how many laws.
    """
    pool = [candidate for candidate in pool if not candidate.absent]
    screen, chosen, now = _selected(data, domain, pool, most)
    left = screen.sigma * math.sqrt(now / max(screen.samples * CORRELATED, 1.0))
    if far_above_noise(data, domain, left) and (guesses := refined_guesses(data, domain, pool)):
        other, others, after = _selected(data, replace(domain, guesses=guesses), pool, most)
        if after < now:
            screen, chosen = other, others
    _, sizes = screen.fitted(chosen)
    parts: list[Part] = []
    kept: list[list[float]] = []
    for own, values, error in zip(chosen, sizes, screen.errors(chosen) if chosen else (), strict=True):
        part, needed = Part(own.candidate, own.values(values)), _sure(own, values, error, domain.interval)
        if needed:
            parts.append(part if len(needed) == len(own.candidate.locations) else part.narrowed(needed))
        places = {p.name: set(p.places) for p in own.candidate.parameters}
        stays = [not places[name].isdisjoint(needed) for name in own.scaled]
        kept.append([v if s else own.nothing(n) for n, v, s in zip(own.scaled, values, stays, strict=True)])
    return (_joined(parts, pool), screen.moved(chosen, kept)) if parts else None


def _joined(parts: Sequence[Part], pool: Sequence[Candidate]) -> Hypothesis:
    """Parts of one law at a place each as that law with sizes of its own there, where the pool has it.

    Which of both is selected hangs on how much the first of them explains alone; they say the same.
    """
    joined = list(parts)
    for law in (c for c in pool if c.each and not c.own):
        alone = [p for p in joined if p.candidate.effect is law.effect and len(p.candidate.locations) == 1]
        at = {p.candidate.locations[0]: p for p in alone}
        places = tuple(place for place in law.locations if place in at)
        if len(places) < 2:
            continue
        whole = law if places == law.locations else law.narrowed(places)
        values = {own.name: at[own.places[0]].values[own.key] for own in whole.parameters}
        first = joined.index(alone[0])
        joined[first : first + 1] = [Part(whole, values)]
        joined = [p for p in joined if not any(p is at[place] for place in places)]
    return tuple(joined)


def _selected(
    data: Data, domain: TorqueDomain, pool: Sequence[Candidate], most: int
) -> tuple[TorqueScreen, list[Columns], float]:
    """The nominal model's screen, what is selected of it, and χ² of what that leaves."""
    screen = torque_screen(data, domain, None, pool)
    chosen, price = list[Columns](), math.log(max(screen.samples, 2.0))
    now, each = screen.missing, {candidate.effect for candidate in pool if candidate.each}
    while len({own.candidate.effect if own.candidate.effect in each else own.candidate for own in chosen}) < most:
        options = [whole for own in screen.columns if (whole := _extended(screen.robot, chosen, own)) is not None]
        tried = [(screen.fitted(whole)[0], whole) for whole in options]
        chi2, best = _simplest(tried, price, now) if tried else (now, chosen)
        gain, above = now - chi2, now - screen.samples * CORRELATED
        if not _more_than_chance(data, gain, pool) or gain < START_SHARE * above:
            break
        if gain / CORRELATED <= price * (_count(best) - _count(chosen)):
            break
        now, chosen = chi2, best
    return screen, chosen, now


def _simplest(tried: Sequence[tuple[float, list[Columns]]], price: float, now: float) -> tuple[float, list[Columns]]:
    """Of what gains about as much as the best by the information criterion, the one with the fewest parameters."""

    def score(one: tuple[float, list[Columns]]) -> float:
        return one[0] / CORRELATED + price * _count(one[1])

    best = min(tried, key=score)
    close = [one for one in tried if one[0] <= best[0] + (1 - ABOUT) * max(now - best[0], 0.0)]
    fewest = min(_count(whole) for _, whole in close)
    return min((one for one in close if _count(one[1]) == fewest), key=score)


def _count(chosen: Sequence[Columns]) -> int:
    return sum(own.candidate.n_parameters for own in chosen)


def _more_than_chance(data: Data, gain: float, pool: Sequence[Candidate]) -> bool:
    """Whether none of the candidates lets χ² fall by so much by chance."""
    count = max(len(pool), 1)
    return data.thresholds.decides(lambda t: gain / CORRELATED > float(chdtri(1, t.significance / count)))


def _sure(own: Columns, values: Sequence[float], error: Array, interval: float) -> tuple[str, ...]:
    """The places at which a law's sizes differ from nothing; a delay by a sample at least, for commands are held."""
    places = {p.name: p.places for p in own.candidate.parameters}
    least = interval if own.candidate.effect.delays else 0.0
    differ = {
        place
        for name, value, spread in zip(own.scaled, values, error, strict=True)
        if abs(value - own.nothing(name)) > max(SURE * spread, least)
        for place in places[name]
    }
    return tuple(place for place in own.candidate.locations if place in differ)


def _extended(robot: Robot, chosen: Sequence[Columns], own: Columns) -> list[Columns] | None:
    """Some chosen candidates and one more, without those that it excludes; None where it cannot be beside them.

    Nor where no value of it is nothing: then least squares know no size of it.
    """
    if own.fixed or any(own.candidate is old.candidate for old in chosen):
        return None
    part = Part(own.candidate, own.base)
    kept = []
    for old in chosen:
        left = beside(robot, part, (Part(old.candidate, old.base),))
        if left and left[0].candidate is not old.candidate:
            return None  # it would take part of a law
        if left:
            kept.append(old)
    return [*kept, own]


def worth_simulating(data: Data, domain: TorqueDomain, fitted: Fitted, pool: Sequence[Candidate]) -> list[Candidate]:
    """Candidates without those that are far behind the best one in the torque domain, see ``BEHIND``.

    All where none of them explains anything there. Those that cannot be seen there stay. Guesses are joined by what
    least squares give.

    Args:
        data: what was measured.
        domain: the same in the torque domain.
        fitted: the hypothesis that they are to be added to.
        pool: the candidates.
    """
    screen = torque_screen(data, domain, fitted, pool)
    fits = screen.alone()
    gains = sorted((fit.gain for fit in fits.values()), reverse=True)
    prune = len(gains) > AT_LEAST and _more_than_chance(data, gains[0], pool)
    least = min(BEHIND * gains[0], gains[AT_LEAST - 1]) if prune else -math.inf
    kept = []
    for candidate in pool:
        if candidate not in fits:
            kept.append(candidate)
        elif fits[candidate].gain >= least:
            kept.append(_with_guess(data.free.model, candidate, fits[candidate].values))
    return kept


def _with_guess(model: Model, candidate: Candidate, values: Mapping[str, float]) -> Candidate:
    """A candidate that can also begin at some values, if these are no worse than possible."""
    nothing = candidate.fades_to() or candidate.grows_from()
    if nothing and all(values[name] == v for name, v in nothing.items() if name in values):
        return candidate
    try:
        model_of(model, (Part(candidate, values),))
    except (ConfigError, ModelError):
        return candidate
    own = {p.name: float(values[p.name]) for p in candidate.parameters}
    return replace(candidate, guesses=(*candidate.guesses, own))
