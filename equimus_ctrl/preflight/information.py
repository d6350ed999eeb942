"""Which parameters recordings determine, and which effects they could show at which size, before anything is fitted.

With J the derivatives of the nominal model's predictions by its parameters θ, whitened by the noise of the recordings,
the free initial states projected out, no unbiased estimate has a smaller covariance than (JᵀJ)⁻¹ (Cramér, 1946; Rao,
1945). An effect of size a changes predictions by c(a); with P the projection off J's columns, χ² = cᵀPc is what it
would gain in −2Δln L in the mean beside the number of its parameters, which it gains where there is no effect. Where
that is the acceptance threshold of ``diagnose``, it would be accepted every other time or more often.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from equimus_ctrl.diagnosis.budget import Budget, BudgetSpent
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, with_default_engine
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.diagnosis.results import Detectable
from equimus_ctrl.diagnosis.scoring import Scoring
from equimus_ctrl.diagnosis.screening import Screened, screen_strengths
from equimus_ctrl.diagnosis.smallest_sizes import near_threshold, smallest_sizes
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.engines.base import Engine
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.uncertainty import TradeOff, identifiable
from equimus_ctrl.identification.whitened_fit import whiten_fit
from equimus_ctrl.types import Array

SHARE_OF_BUDGET = 0.6
"""Of what is left of the time so much is planned to be used: how long simulations take differs."""
FAIR = 4.0
"""Times the share of what is left of the budget that one effect may take: drives that are elastic take long."""
LEAST_SEGMENTS, LEAST_ROWS = 2, 100
"""Shooting intervals that are simulated, however little time there is, and rows of each."""
REPEATED = 3
"""Simulations that tell how long one takes."""
AROUND = 4.0
"""How many times each guess is simulated about: at rounds of sizes and with parameters moved, and worked out."""


@dataclass(frozen=True)
class ParameterInformation:
    """What recordings could say of one parameter.

    Attributes:
        name: of it.
        unit: SI.
        value: of the nominal model.
        deviation: least standard deviation of an estimate, all others estimated too; inf where it has no effect.
        alone: the same if all others were known.
        range: between its bounds.
    """

    name: str
    unit: str
    value: float
    deviation: float
    alone: float
    range: float


@dataclass(frozen=True)
class EffectInformation:
    """What recordings could show of one effect at one place.

    Attributes:
        smallest: the smallest detectable size.
        scale: what that compares with in these recordings: the largest force, the travel [the same unit].
        possible: whether an effect can be that large.
        sized: whether it has a size, in proportion to which it changes the motion; else it is the weakest one tried.
        confounded: whether it does not show because free parameters can do the same.
    """

    smallest: Detectable
    scale: float
    possible: bool
    sized: bool
    confounded: bool

    @property
    def share(self) -> float:
        """The size as a share of what it compares with."""
        return self.smallest.size / self.scale


@dataclass(frozen=True, eq=False)
class Information:
    """What recordings could say of a model and of what it lacks.

    Attributes:
        parameters: the free ones.
        trade_offs: practically unidentifiable combinations, strongest first.
        effects: by name and place.
        not_done: effects that the time did not do for.
        engine: that simulated.
        intervals: shooting intervals simulated, and how many a diagnosis fits.
        share: of what a diagnosis compares, looked at.
        far: the nominal model's error over the noise, from initial states that fit it best to first order.
    """

    parameters: tuple[ParameterInformation, ...]
    trade_offs: tuple[TradeOff, ...]
    effects: tuple[EffectInformation, ...]
    not_done: tuple[str, ...]
    engine: Engine
    intervals: tuple[int, int]
    share: float
    far: float


def information(
    free: FreeParameters,
    split: Split,
    noise: Array,
    settings: DiagnosisSettings,
    budget: Budget,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> Information:
    """What a diagnosis of some recordings could find, by linear response about the nominal model.

    Args:
        free: the parameters to estimate.
        split: trials, of which those that a diagnosis fits are looked at.
        noise: (nj,) of the joints' measurements [rad or m].
        settings: of the diagnosis.
        budget: after which what is known by then is given, but for the parameters.
        progress: called with the stage and the share done.

    Raises:
        SimulationDiverged: where the nominal model diverges on every trial.
    """
    with threadpool_limits(limits=1, user_api="blas"):  # sums in another order would change the last bits
        data = replace(with_default_engine(free, split, settings), thresholds=settings.thresholds)
        whole = list(data.segments)
        pool = candidates(free.model, whole, {n: e for n, e in REGISTRY.items() if n not in settings.exclude})
        single = [c for c in pool if len(c.locations) == 1 and not c.each]
        chosen = _in_time(data, whole, single, budget)
        progress("parameters", 0.1)
        data = replace(data, segments=chosen)
        seen = _nominal(data, noise)
        share = sum(s.outputs.size for s in chosen) / sum(s.outputs.size for s in whole)
        parameters, trade_offs = _parameters(data, seen, share)
        scoring = Scoring(replace(data, segments=whole), pool, data.policy.applied(settings.search))
        data = replace(data, budget=budget)
        effects, left = _effects(data, seen, single, scoring, share, whole, progress)
        # Initial states, which noisy measurements say, are not the model's fault.
        far = float(np.sqrt(np.mean(whiten_fit(data.times, seen.fit, seen.noise).residual ** 2)))
    return Information(
        parameters, trade_offs, effects, left, data.simulator.engine, (len(chosen), len(whole)), share, far
    )


def _nominal(data: Data, noise: Array) -> Fitted:
    """The nominal model, as if its residuals were the noise of the measurements."""
    fitted = data.nominal_fit()
    beside = fitted.noise[len(noise) :]  # of other channels their residuals say what is known
    return replace(fitted, noise=(*(JointNoise(float(size)) for size in noise), *beside))


def _in_time(data: Data, segments: Sequence[Segment], pool: Sequence[Candidate], budget: Budget) -> list[Segment]:
    """Shooting intervals, evenly over all, as many as the budget does for."""
    if math.isinf(budget.seconds) or len(segments) <= LEAST_SEGMENTS:
        return list(segments)
    first = segments[:1]
    model, start = data.free.model, [first[0].start[None, :]]
    data.simulator([model], first, start)  # compiles, if there is anything to compile
    begun = time.perf_counter()
    count = len(data.free.free) + len(first[0].free_at) + 1
    for _ in range(REPEATED):
        data.simulator([model] * count, first, [np.tile(first[0].start, (count, 1))])
    once = (time.perf_counter() - begun) / REPEATED
    guesses = sum(len(c.guesses) for c in pool)
    each = once * (1 + AROUND * guesses / count)
    left = SHARE_OF_BUDGET * (budget.begun + budget.seconds - time.perf_counter())
    most = left / max(each, 1e-9)
    if most < LEAST_SEGMENTS:  # the first parts of these
        share = max(most, 0.0) / LEAST_SEGMENTS
        places = np.unique(np.linspace(0, len(segments) - 1, LEAST_SEGMENTS).round().astype(int))
        return [
            segments[k].first(min(max(int(share * len(segments[k].measured)), LEAST_ROWS), len(segments[k].measured)))
            for k in places
        ]
    count = min(int(most), len(segments))
    return [segments[k] for k in np.unique(np.linspace(0, len(segments) - 1, count).round().astype(int))]


def _parameters(
    data: Data, seen: Fitted, share: float
) -> tuple[tuple[ParameterInformation, ...], tuple[TradeOff, ...]]:
    """What is known of each parameter, from a share of what is measured."""
    free = data.free
    slopes = whiten_fit(data.times, seen.fit, seen.noise).slopes / math.sqrt(share)
    known = identifiable(slopes, free.names, free.scale, free.start)
    deviations = np.where(known.hidden, np.inf, np.sqrt(np.maximum(np.diag(known.inverse), 0.0)) * free.scale)
    strength = np.linalg.norm(slopes, axis=0)
    with np.errstate(divide="ignore"):
        alone = free.scale / strength
    rows = tuple(
        ParameterInformation(f.label, f.unit, f.start, float(sd), float(own), f.high - f.low)
        for f, sd, own in zip(free.free, deviations, alone, strict=True)
    )
    return rows, known.trade_offs


def _effects(
    data: Data,
    seen: Fitted,
    pool: Sequence[Candidate],
    scoring: Scoring,
    share: float,
    whole: Sequence[Segment],
    progress: Callable[[str, float], None],
) -> tuple[tuple[EffectInformation, ...], tuple[str, ...]]:
    """The smallest detectable sizes, and the names of effects that the budget did not do for."""
    excitation = excitation_of(data.free.model, whole)
    by_name: dict[str, list[Candidate]] = {}
    for candidate in pool:
        by_name.setdefault(candidate.effect.name, []).append(candidate)
    found, left = list[EffectInformation](), list[str]()
    # Equations with states of their own may have to be compiled: the others first.
    order = sorted(by_name, key=lambda name: (by_name[name][0].effect.own_equations, name))
    for k, name in enumerate(order):
        progress(name.replace("_", " "), 0.1 + 0.9 * k / len(order))
        fair = data.budget.share(min(FAIR / (len(order) - k), 1.0))
        try:
            fair.check()
            rows = _screened(replace(data, budget=fair), seen, by_name[name], scoring, share)
        except BudgetSpent:
            left.append(name)
            continue
        for own, candidate, changes in rows:
            place = candidate.locations[0]
            info = candidate.effect.parameter_info()[own.parameter]
            scale = _compares_with(excitation[place], info["unit"]) if place in excitation else 1.0
            nothing = candidate.effect.grows_from()
            room = math.inf if nothing is None else max(info["high"] - nothing, nothing - info["low"])
            possible = math.isfinite(own.size) and own.size <= room
            found.append(EffectInformation(own, scale, possible, nothing is not None, changes and not possible))
    return tuple(found), tuple(left)


def _compares_with(shown: Excitation, unit: str) -> float:
    """What a size with this unit is a share of."""
    more = {
        "Pa": shown.command,
        "Pa/s": shown.command * shown.speed / shown.span,
        "N/m³": shown.force / shown.span**3,
        "1/(N·m)": 1.0 / shown.force,
    }
    return more.get(unit, shown.scale(unit))


def _screened(
    data: Data, seen: Fitted, own: Sequence[Candidate], scoring: Scoring, share: float
) -> list[tuple[Detectable, Candidate, bool]]:
    """The smallest sizes of candidates of one effect, and whether any guess changes as much, parameters as they are."""

    def strengths(pool: Sequence[Candidate]) -> list[Screened]:
        return [
            replace(s, strength=s.strength / share, whole=None if s.whole is None else s.whole / share)
            for s in screen_strengths(data, seen, pool)
        ]

    found = strengths(own)
    threshold = scoring.threshold
    sizes = smallest_sizes(data.free.model, near_threshold(found, threshold, strengths), threshold)
    return [
        (size, s.candidate, s.whole is not None and bool(np.any(s.whole >= threshold(s.candidate.n_parameters))))
        for size, s in zip(sizes, found, strict=True)
    ]
