"""Recordings that MuJoCo made: what its physics step adds to the motion is no physics that a model lacks.

The compiled equations of motion are exact; a simulation by MuJoCo has the error of its step, and dry friction that
creeps, for its constraints are soft. In recordings of such a simulation that is seen before anything else is, for they
have little noise or none. At a hypothesis, with d what MuJoCo predicts less what the exact engine does, r the
residuals, both whitened, and P the projection beyond all free parameters and initial states,

    λ = rᵀPd / dᵀPd,    G = ‖Pr‖² − ‖P(r − d)‖² = (2λ − 1) dᵀPd

λ is 1 where MuJoCo made the recordings, and 0 where a robot did; G is what χ² falls by, with nothing fitted. Tried are
the XML's own step; of recordings without noise, whose residuals are all of this shape, the step that λ says, for an
error of first order is in proportion to it; the XML's step with dry friction that holds what it stops, as simulated
plants of this package do; and so short a step that friction alone creeps. Where χ² falls by more than an effect has to
make it fall, d is taken off the recordings, and the search goes on with the exact engine: to first order that is a
search with MuJoCo's. It has to be that once still, at the hypothesis that fits best then.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import chdtri

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.engines.base import Engine
from equimus_ctrl.engines.choice import MujocoEngine, simulation_of
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.residuals import followed
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.identification.step_error import changes_between, changes_from
from equimus_ctrl.identification.whitened_fit import whiten_fit
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

SETTLED = 0.05
"""In units of the noise: changes of d by less, with the parameters that it leads to, end the rounds."""
ROUNDS = 6
"""So often d is worked out at most, each time at the parameters that the last one led to."""
NOISELESS = 1e-4
"""Of the motion: only where noise is less are laws with states, which are compiled one by one, looked at too."""
NEARER = 0.5
"""λ is nearer to 1 than to 0 or 2."""
SQUARES_LEFT = 0.1
"""Of ‖Pr‖², at most, where residuals are d times a number."""
SHORTEST = 1 / 16
"""Of the XML's step: the error of one that is so short is not looked for."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """A search in recordings of which the error of MuJoCo's step is taken off.

    Attributes:
        search: with the segments without it.
        end: where it is.
        raw: the segments as they were recorded.
        maker: the engine that made them.
        share: λ.
        gain: G.
        model: of the hypothesis at which the error was last worked out.
    """

    search: Search
    end: SearchState
    raw: Sequence[Segment]
    maker: Engine
    share: float
    gain: float
    model: Model

    @property
    def sentence(self) -> str:
        """For a person."""
        step = self.maker.discretisation
        assert step is not None
        return (
            "These recordings look as if MuJoCo had simulated them with a physics step of about "
            f"{1e3 * step.step:.2g} ms: they show {self.share:.3g} times its error (χ² falls by {self.gain:.4g} with "
            "it), which is no physics, and was taken off."
        )

    @property
    def taken(self) -> list[Array]:
        """For each segment (m, nj + ne) what was taken off."""
        return [raw.outputs - own.outputs for raw, own in zip(self.raw, self.search.data.segments, strict=True)]

    def holding(self, end: SearchState) -> Simulated | None:
        """Where the search goes on if the simulation's dry friction holds what it stops; None where nothing changes.

        A hypothesis without dry friction does not tell that from friction that creeps. One with it does: by whose error
        χ² falls further.

        Args:
            end: where the search has come to.

        Raises:
            BudgetSpent: where the budget ends.
        """
        maker, best = self.maker, end.best
        if not isinstance(maker, MujocoEngine) or maker.hard_friction or not _dry(best):
            return None
        held = replace(maker, hard_friction=True)
        creeps, holds = (_shown(self.search.data, best, own, self.taken) for own in (maker, held))
        if holds is None or (creeps is not None and holds.gain <= creeps.gain):
            return None
        return replace(self, end=end, maker=held, share=holds.share, gain=holds.gain).settled()

    def settled(self) -> Simulated:
        """The same at the hypothesis that its search has come to; as it is where that diverges on the way.

        Nothing is fitted again where that hypothesis has the error that was taken off.

        Raises:
            BudgetSpent: where the budget ends.
        """
        try:
            search, best = _taken_off(
                self.search, self.raw, self.end.best, self.maker, _Off.of(np.concatenate(self.taken))
            )
            if best is self.end.best:
                return replace(self, model=best.fit.model)
            base = search.refit(self.end.tried, best, ())[0] if best.hypothesis else best
            # Its parts were exchanged before: the rest of the error changes no more than numbers.
            end = search.needed(search.moved(replace(self.end, base=base), best))
        except SimulationDiverged:
            return self
        return replace(self, search=search, end=end, model=end.best.fit.model)

    def without_error(self, split: Split) -> Split:
        """The trials that are held out, likewise: from where they start the error follows, and by it where they do.

        Where the hypothesis diverges on one, they stay as they were recorded.
        """
        data, raw = self.search.data, (*split.validation, *split.test)
        held_out: Sequence[Segment] = raw
        off, unsure = _Off.nothing(raw), np.asarray(data.least_noise)
        for _ in range(ROUNDS if raw else 0):
            try:
                error = np.concatenate(_error(data.simulator, self.maker, self.model, held_out))
            except SimulationDiverged:
                held_out = raw
                break
            off = off.towards(error, unsure)
            held_out = _less(raw, off.taken)
            if np.all(np.sqrt(np.mean(off.missed**2, axis=0)) < SETTLED * unsure):
                break
        count = len(split.validation)
        validation, test = tuple(held_out[:count]), tuple(held_out[count:])
        return replace(split, train=tuple(data.segments), validation=validation, test=test)


def simulated(search: Search, end: SearchState) -> Simulated | None:
    """Where a search goes on if MuJoCo made the recordings, by its best hypothesis or one with a part less; else None.

    Raises:
        BudgetSpent: where the budget ends.
    """
    data = search.data
    for fitted in dict.fromkeys((end.best, *end.without)):
        engine = simulation_of(fitted.fit.model, any_law=_noiseless(data, fitted))
        if engine is None or data.simulator.engine.discretisation is not None:
            continue
        for maker, shown in _makers(data, fitted, engine):
            if shown is None or not data.thresholds.decides(partial(_exceeds, search, shown.gain)):
                continue
            if abs(shown.share - 1.0) < NEARER:
                with suppress(SimulationDiverged):  # so it cannot be what happened
                    found = _begun(search, end, fitted, maker)
                    if found.end.best.labels != fitted.labels:  # so it was another hypothesis' error
                        found = found.settled()
                    if _once(found):
                        return replace(found, share=shown.share, gain=shown.gain)
    return None


@dataclass(frozen=True)
class _Shown:
    """λ, dᵀPd, and ‖Pr‖² of the residuals."""

    share: float
    size: float
    whole: float

    @property
    def gain(self) -> float:
        """G."""
        return (2 * self.share - 1) * self.size


def _makers(data: Data, fitted: Fitted, engine: MujocoEngine) -> Iterator[tuple[Engine, _Shown | None]]:
    """Engines that may have made the recordings, and what these show of each."""
    own = _shown(data, fitted, engine)
    yield engine, own
    dry, steps = _dry(fitted), []
    if dry:
        held = replace(engine, hard_friction=True)
        yield held, _shown(data, fitted, held)
    if own is not None and _all_of_it(own) and own.share > SHORTEST:
        steps.append(own.share)
    if dry:
        steps.append(SHORTEST)
    for share in steps:
        other = replace(engine, dt=share * engine.discretisation.step)
        yield other, _shown(data, fitted, other)


def _dry(fitted: Fitted) -> bool:
    return any(effect.dry for effect in fitted.fit.model.effects)


def _all_of_it(shown: _Shown) -> bool:
    """Whether the residuals are d times a number, and nothing else."""
    return shown.share**2 * shown.size > (1 - SQUARES_LEFT) * shown.whole


def _exceeds(search: Search, gain: float, t: Thresholds) -> bool:
    return gain > search.threshold(1, t)


def _once(found: Simulated) -> bool:
    """Whether recordings show the error once, by the hypothesis that fits best without it."""
    data = found.search.data
    shown = _shown(data, found.end.best, found.maker, found.taken)
    return shown is not None and data.thresholds.decides(partial(_alike, shown))


def _alike(shown: _Shown, t: Thresholds) -> bool:
    """Whether λ is 1, as far as is known or but for what is of second order."""
    away = abs(shown.share - 1.0)
    return away < t.as_simulated or away**2 * shown.size < float(chdtri(1, t.significance))


def _shown(data: Data, fitted: Fitted, maker: Engine, taken: Sequence[Array] | None = None) -> _Shown | None:
    """What residuals show of an engine's step; None where it diverges or there is no error.

    Args:
        data: the segments.
        fitted: a hypothesis.
        maker: the engine.
        taken: for each segment (m, nj + ne) what was taken off.
    """
    try:
        change = changes_between(data.simulator, replace(data.simulator, engine=maker), fitted.fit, data.segments)
    except SimulationDiverged:
        return None
    whitened = whiten_fit(data.times, fitted.fit, fitted.noise)
    nuisance = Nuisance.of(whitened.slopes)
    error = nuisance.project_out(whitened.columns(data.times, change)[:, 0])
    residual = whitened.residual
    if taken is not None:
        residual = residual + whitened.columns(data.times, [own[:, :, None] for own in taken])[:, 0]
    residual = nuisance.project_out(residual)
    size = float(error @ error)
    return _Shown(float(residual @ error) / size, size, float(residual @ residual)) if size > 0 else None


def _noiseless(data: Data, fitted: Fitted) -> bool:
    moved = np.ptp(np.concatenate([s.measured for s in data.segments]), axis=0)
    return all(joint.sigma < NOISELESS * way for joint, way in zip(fitted.noise, moved, strict=False))


@dataclass(frozen=True, eq=False)
class _Off:
    """What is taken off, on its way to a fixed point d = g(d): d depends on parameters and starts, and these on it.

    Relaxed by Aitken's Δ² (Irons & Tuck, 1969), for where friction stops a joint g turns about the fixed point.

    Attributes:
        taken: (m, nj + ne) of all segments.
        missed: g(d) − d where it came from.
        relaxed: how much of that was added.
    """

    taken: Array
    missed: Array
    relaxed: float = 0.0

    @classmethod
    def nothing(cls, segments: Sequence[Segment]) -> _Off:
        """None of it."""
        return cls.of(np.concatenate([np.zeros(s.outputs.shape) for s in segments]) if segments else np.zeros((0, 0)))

    @classmethod
    def of(cls, taken: Array) -> _Off:
        """(m, nj + ne) of all segments."""
        return cls(taken, np.zeros_like(taken))

    def towards(self, error: Array, sigma: Array) -> _Off:
        """The next one, where g(d) is known, with (nj + ne,) of the noise."""
        missed, relaxed = error - self.taken, 1.0
        if self.relaxed:
            turned = (missed - self.missed) / sigma
            relaxed = -self.relaxed * float((self.missed / sigma * turned).sum())
            relaxed /= max(float((turned**2).sum()), 1e-300)
        return _Off(self.taken + relaxed * missed, missed, relaxed)


def _taken_off(
    search: Search, raw: Sequence[Segment], fitted: Fitted, maker: Engine, off: _Off
) -> tuple[Search, Fitted]:
    """A search in segments without the error of MuJoCo's step, and a hypothesis fitted to them.

    Both as they are where the error that was taken off before is the hypothesis' own.

    Args:
        search: in the segments without what was taken off.
        raw: the segments as they were recorded.
        fitted: the hypothesis.
        maker: the engine that made them.
        off: what was taken off.
    """
    data = search.data
    for _ in range(ROUNDS):
        error = np.concatenate(_error_at(data.simulator, maker, fitted, data.segments))
        if off.taken.any() and _small(error - off.taken, fitted):
            break
        off = off.towards(error, np.array([joint.sigma for joint in fitted.noise]))
        unsure = data.thresholds.step_unsure * np.sqrt(np.mean(off.taken**2, axis=0))
        data = replace(data, segments=_less(raw, off.taken), least_noise=unsure)
        begun = data.coarse_fit(fitted.hypothesis, [fitted.begin], fitted.noise, search.settings.long_steps)
        fitted = data.converge(begun)
    return replace(search, data=data), fitted


def _begun(search: Search, end: SearchState, fitted: Fitted, maker: Engine) -> Simulated:
    """A search that begins at a hypothesis fitted to segments without the error of MuJoCo's step."""
    raw = search.data.segments
    search, fitted = _taken_off(search, raw, fitted, maker, _Off.nothing(raw))
    tried = SearchHistory(first=end.tried.first, rejected=end.tried.rejected)
    base = search.refit(tried, fitted, ())[0] if fitted.hypothesis else fitted
    after = search.beginning(base, fitted) if fitted.hypothesis else SearchState(base, base, tried=tried)
    return Simulated(search, after, raw, maker, 1.0, 0.0, fitted.fit.model)


def _small(missed: Array, fitted: Fitted) -> bool:
    """Whether what (m, nj + ne) is missed of the error is next to nothing beside a fit's noise."""
    return float(np.sqrt(np.mean((missed / [joint.sigma for joint in fitted.noise]) ** 2))) < SETTLED


def _error_at(own: Simulator, maker: Engine, fitted: Fitted, segments: Sequence[Segment]) -> list[Array]:
    """For each segment (m, nj + ne) d at a fit."""
    return [c[:, :, 0] for c in changes_between(own, replace(own, engine=maker), fitted.fit, segments)]


def _error(own: Simulator, maker: Engine, model: Model, segments: Sequence[Segment]) -> list[Array]:
    """The same of a model from the starts that fit it."""
    starts = followed(model, segments, own)[0]
    return [c[:, :, 0] for c in changes_from(own, replace(own, engine=maker), model, segments, starts)]


def _less(segments: Sequence[Segment], taken: Array) -> list[Segment]:
    """Segments as if (m, nj + ne) had not been measured, of all of them."""
    found, ends = [], np.cumsum([len(s.outputs) for s in segments])[:-1]
    for segment, own in zip(segments, np.split(taken, ends), strict=True):
        nj = segment.measured.shape[1]
        also = None if segment.also is None else segment.also - own[:, nj:]
        found.append(replace(segment, measured=segment.measured - own[:, :nj], also=also))
    return found
