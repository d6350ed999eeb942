"""The whole diagnosis: refit, search, believe only what trials left out confirm, say what stays unexplained."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from equimus_ctrl.diagnosis.alternatives import ALIKE, in_place, instead, less, listed
from equimus_ctrl.diagnosis.candidates import Part, candidates
from equimus_ctrl.diagnosis.confirmation import Judge, confirmed
from equimus_ctrl.diagnosis.discretization import step_counted, without_step_error
from equimus_ctrl.diagnosis.experiment import Design, separating
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.hypothesis_moves import LONG, Searched
from equimus_ctrl.diagnosis.localization import excess_of, where_off
from equimus_ctrl.diagnosis.policy import SearchPolicy, SearchSettings
from equimus_ctrl.diagnosis.results import (
    STATES,
    Detectable,
    Diagnosis,
    Estimate,
    Evidence,
    Finding,
    Named,
    Ranked,
    Residuals,
    Verdict,
)
from equimus_ctrl.diagnosis.screening import Screened
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.unexplained import Remainder, not_borne_out, remainder
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.errors import ConfigError, SimulationDiverged, unknown_name
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import FreeParameters, place_unit
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model

BLUR = 60.0
"""So far the errors of the physics step may take deviances apart."""
BLURRED = 0.05
"""Where something stays unexplained, rivals within this share of a finding's gain cannot be told apart either."""
AGAIN = 1
"""How often a search goes on beside the names that stay where others were withdrawn: if it comes to doubtful names
again, what is left has none."""
WINDOW = r" from [0-9.]+ s$"
"""What windows' names have beyond those of their recordings."""
Finely = Callable[[Fitted], Fitted]
Progress = Callable[[str, float, str], None]
"""Called with the stage, the share of the whole that is done, and the best hypothesis so far."""


@dataclass(frozen=True)
class DiagnosisSettings:
    """How a diagnosis goes.

    Attributes:
        search: how sets of effects are searched.
        threads: of the simulations; all cores by default.
        engine: by its name; by default see ``engines.choice.engine_for``.
        exclude: names of effects that are not looked for.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    threads: int | None = None
    engine: EngineName | None = None
    exclude: tuple[str, ...] = ()


def diagnose(
    free: FreeParameters,
    split: Split,
    *,
    settings: DiagnosisSettings | None = None,
    simulator: Simulator | None = None,
    designs: Sequence[Design] = (),
    progress: Progress = lambda stage, share, best: None,
) -> Diagnosis:
    """Find what a model leaves out of recordings.

    Args:
        free: the model, and what may be wrong about its numbers.
        split: trials to fit and trials to judge by.
        settings: how it goes.
        simulator: the engine, with no coarser or finer one beside it; see ``engines.choice.engine_for`` for the
            default.
        designs: experiments to choose from where something cannot be told apart.
        progress: see ``Progress``.

    Raises:
        SimulationDiverged: where the model diverges on every trial.
        ConfigError: where an effect is to be excluded that is not known.
    """
    begun = time.perf_counter()
    settings = settings or DiagnosisSettings()
    for name in settings.exclude:
        if name not in REGISTRY:
            raise ConfigError(unknown_name("effect", name, REGISTRY))
    with threadpool_limits(limits=1, user_api="blas"):  # sums in another order would change the last bits
        if simulator is not None:
            policy = SearchPolicy.of(free.model.robot.traits, simulator.engine)
            # What was handed in is taken for exact and cheap.
            policy = replace(policy, coarse_derivatives=False, rescaled_guesses=False)
            data = Data(free, split.train, simulator, policy=policy)
        else:
            positions = [s.measured for s in (*split.train, *split.heldout)]
            engine = engine_for(free.model, settings.engine, positions=positions)
            own, others = Simulator(engine, settings.threads), (engine.coarser(), engine.finer())
            coarse, fine = (None if e is None else replace(own, engine=e) for e in others)
            data = Data(free, split.train, own, coarse, fine, SearchPolicy.of(free.model.robot.traits, engine))
        return _diagnose(data, split, settings, designs, progress, begun)


def _diagnose(
    data: Data,
    split: Split,
    settings: DiagnosisSettings,
    designs: Sequence[Design],
    progress: Progress,
    begun: float,
) -> Diagnosis:
    free, given = data.free, data
    progress("refitting the model", 0.02, "")
    base = data.base()
    near = _near_base(data, split) if data.excessive(base) else None
    base = base if near is None else data.base_from(near, base)
    looked_for = {name: effect for name, effect in REGISTRY.items() if name not in settings.exclude}
    pool = candidates(free.model, split.train, looked_for)
    stages = iter(np.linspace(0.15, 0.8, 12))

    def notify(stage: str, best: str) -> None:
        progress(stage, float(next(stages, 0.8)), best)

    search = Search(data, pool, data.policy.applied(settings.search), notify)
    found = search.run(base)
    if near is not None and data.excessive(found.best):
        search, found = _from_near(search, found, split, near)
    progress("trials left out", 0.82, found.best.label)
    found = confirmed(search, found, split)
    progress("what is left", 0.86, found.best.label)
    rest = remainder(data, found.base, found.best, found.without)
    doubtful: tuple[Named, ...] = ()
    again = AGAIN
    while rest.superfluous:
        dropped = [found.best.hypothesis[k] for k in rest.superfluous]
        doubtful += tuple(_named(part) for part in dropped)
        found = less(search, found, rest.superfluous)
        if found.best.hypothesis:
            names = [part.candidate.label for part in dropped]
            found = confirmed(search, search.go_on(found, names, further=again > 0), split)
            again -= 1
        rest = remainder(data, found.base, found.best, found.without)
    coarse, ranking = "", _ranking(search, found)
    if (exact := without_step_error(search, found, rest, settings.threads)) is not None:
        search, found, rest, coarse = exact
        data = search.data
    progress("evidence", 0.94, found.best.label)
    found = listed(search, found)
    if not coarse:
        found = step_counted(data, found, settings.threads)
    judge = Judge(data, split, found)
    if not rest.unexplained:
        rest = not_borne_out(data, found.best, split.heldout, judge.heldout(found.best.fit.model))
        if rest.unexplained and split.other is not None:
            second = _with_others(given, split, split.other, settings, designs, progress, begun)
            if second is not None and not second.unexplained:
                return second
    finely = cache(data.settle_finely)
    parts = range(len(found.best.hypothesis))
    findings = tuple(_finding(search, found, judge, k, bool(rest.unexplained), finely) for k in parts)
    findings = tuple(sorted(findings, key=lambda f: -f.evidence.gain))
    verdict = _verdict(findings, rest)
    experiment = None
    if designs:
        experiment = separating(data, found, findings, designs)
    residuals = {
        state: Residuals(train, tuple(judge.heldout(model)))
        for state, model, train in zip(
            STATES,
            (free.model, found.base.fit.model, found.best.fit.model),
            (tuple(judge.nominal()), found.base.fit.residuals, found.best.fit.residuals),
            strict=True,
        )
    }
    noise = found.best.noise
    progress("done", 1.0, found.best.label)
    return Diagnosis(
        verdict,
        free.model,
        found.base.fit.model,
        found.best.fit.model,
        found.base,
        found.best,
        tuple(split.train),
        tuple(split.heldout),
        residuals,
        where_off(free.model, split.train, found.base.fit.residuals, noise),
        findings,
        rest.unexplained,
        doubtful,
        ranking,
        () if findings or rest.unexplained else _detectable(search, found),
        experiment,
        {state: float(excess_of(residuals[state].train, noise).mean()) for state in STATES},
        (*_notes(found, split, settings), *_beyond_range(free.model, split), *([coarse] if coarse else [])),
        time.perf_counter() - begun,
    )


def _with_others(
    data: Data,
    split: Split,
    other: Split,
    settings: DiagnosisSettings,
    designs: Sequence[Design],
    progress: Progress,
    begun: float,
) -> Diagnosis | None:
    """The diagnosis with other trials held out, where those that were show what the rest does not."""

    def notify(stage: str, share: float, best: str) -> None:
        progress(f"{stage}, other trials held out", 0.94 + 0.05 * share, best)

    try:
        found = _diagnose(replace(data, segments=other.train), other, settings, designs, notify, begun)
    except SimulationDiverged:  # so the first stands
        return None
    before, now = (", ".join(_trials(part.heldout)) for part in (split, other))
    note = f"{before}, held out at first, showed what the other trials do not; so they were fitted, and {now} judged."
    return replace(found, notes=(*found.notes, note))


def _trials(segments: Sequence[Segment]) -> list[str]:
    """Names of the trials that segments are of; those of windows begin with their trial's."""
    names: dict[int, str] = {}
    for s in segments:
        names.setdefault(s.recording, re.sub(WINDOW, "", s.trial.name))
    return list(names.values())


def _near_base(data: Data, split: Split) -> Fitted | None:
    """The model fitted to short windows; None where there are none, or where it diverges in them."""
    if not split.near:
        return None
    try:
        return replace(data, segments=split.near).base()
    except SimulationDiverged:  # so short windows tell nothing
        return None


def _from_near(search: Search, found: Searched, split: Split, base: Fitted) -> tuple[Search, Searched]:
    """The search's end, or where one that begins with what short windows tell ends, if that fits better.

    Errors do not grow in short windows: what a small change does there tells what a larger one does.
    """
    data, settings, notify = search.data, search.settings, search.notify
    near = Search(replace(data, segments=split.near), search.pool, settings, notify)
    try:
        best = near.run(base).best
    except SimulationDiverged:  # so short windows tell nothing
        return search, found
    labels = [sorted(part.candidate.label for part in fitted.hypothesis) for fitted in (best, found.best)]
    if not best.hypothesis or labels[0] == labels[1]:
        return search, found
    other = Search(data, search.pool, settings, notify, near.fitted)
    begin = (best.fit.theta, [s.start for s in data.segments])
    try:
        start = data.settle(data.rough(best.hypothesis, [begin], white_noise(best.fit.residuals), LONG))
    except SimulationDiverged:  # so it cannot be what happened
        return search, found
    end = other.go_on(other.beginning(found.base, start))
    best_search, best_end = (other, end) if other.score(end.best) < search.score(found.best) else (search, found)
    best_search.fitted = [*search.fitted, *other.fitted]
    return best_search, best_end


def _named(part: Part) -> Named:
    return Named(part.candidate.effect.name, part.candidate.locations)


def _verdict(findings: Sequence[Finding], rest: Remainder) -> Verdict:
    if rest.unexplained:
        return "partly_explained" if findings else "unexplained"
    return "explained" if findings else "consistent"


def _finding(search: Search, found: Searched, judge: Judge, k: int, left: bool, finely: Finely) -> Finding:
    best, without = found.best, found.without[k]
    part = best.hypothesis[k]
    gain = without.deviance - best.deviance
    count = part.candidate.n_parameters
    chance = (_log_chance(gain, count) + math.log(max(len(search.pool), 1))) / math.log(10)
    evidence = Evidence(
        gain,
        search.threshold(count),
        min(chance, 0.0),
        judge.gain(without, best),
        judge.share(without.fit.residuals, best.fit.residuals, found.base.fit.residuals),
        judge.share(*(judge.heldout(f.fit.model) for f in (without, best, found.base))),
    )
    alike = max(ALIKE, BLURRED * gain) if left else ALIKE
    return Finding(part, _estimates(search.data, best, k), evidence, _equivalent(search, found, k, alike, finely))


def _log_chance(gain: float, count: int) -> float:
    """Ln P(χ²(count) > gain), by its asymptote where it is too small to be computed."""
    exact = float(chi2.logsf(gain, count))
    if math.isfinite(exact):
        return exact
    return (count / 2 - 1) * math.log(gain / 2) - gain / 2 - math.lgamma(count / 2)


def _estimates(data: Data, best: Fitted, k: int) -> dict[str, Estimate]:
    first = len(data.free.free) + sum(p.candidate.n_parameters for p in best.hypothesis[:k])
    found = {}
    for i, key in enumerate(best.hypothesis[k].values):
        free = best.fit.parameters.free[first + i]
        value, width = float(best.fit.theta[first + i]), float(best.fit.uncertainty.half_width[first + i])
        low, high = value - width, value + width
        if first + i in data.jumps(best.hypothesis):
            low, high = data.span(best, first + i)
        low = max(low, free.low) if math.isfinite(low) else -math.inf
        high = min(high, free.high) if math.isfinite(high) else math.inf
        found[key] = Estimate(value, low, high, free.unit)
    return found


def _equivalent(search: Search, found: Searched, k: int, margin: float, finely: Finely) -> tuple[Named, ...]:
    """What could stand in the part's place as well; not what takes more numbers, which can imitate anything simpler.

    What is near is looked at with fine steps: where commands jump, the errors of longer ones can tell alike from alike.
    """
    margin = max(margin + search.settings.valleys, search.settings.least_share * search.data.n)
    own = found.best.hypothesis[k].candidate.label
    named: dict[str, Named] = {}
    near = search.score(found.best) + margin + BLUR
    for rival in sorted(in_place(search, found, k, margin + BLUR), key=search.score):
        other = instead(rival, found.without[k])
        if rival.n_parameters > found.best.n_parameters or other is None or search.score(rival) >= near:
            continue
        label = other.candidate.label
        if (
            label != own
            and label not in named
            and search.score(finely(rival)) < search.score(finely(found.best)) + margin
        ):
            named[label] = _named(other)
    return tuple(named.values())


def _ranking(search: Search, found: Searched) -> tuple[Ranked, ...]:
    alone: dict[str, float] = {}
    for fitted in found.fitted:
        if len(fitted.hypothesis) == 1:
            label = fitted.label
            alone[label] = max(alone.get(label, -math.inf), found.base.deviance - fitted.deviance)
    ranked = [
        Ranked(
            Named(s.candidate.effect.name, s.candidate.locations),
            max(s.gains[1], 0.0),
            alone.get(s.candidate.label),
            search.threshold(s.candidate.n_parameters),
        )
        for s in found.first
    ]
    return tuple(sorted(ranked, key=lambda r: -max(r.fitted or 0.0, r.screened if r.fitted is None else 0.0)))


def _detectable(search: Search, found: Searched) -> tuple[Detectable, ...]:
    smallest = []
    for s in found.first:
        size = _smallest(s, search.threshold(s.candidate.n_parameters))
        key = next(iter(s.candidate.effect.parameter_info()))
        unit = s.candidate.effect.parameter_info()[key]["unit"]
        told = place_unit(search.data.free.model, unit, s.candidate.locations[0])
        named = Named(s.candidate.effect.name, s.candidate.locations)
        smallest.append(Detectable(named, key, size, told))
    return tuple(smallest)


def _smallest(screened: Screened, threshold: float) -> float:
    """The first parameter at which the change alone would be believed, from the guess that is nearest to that."""
    key, nothing = next(iter(screened.candidate.effect.parameter_info())), screened.candidate.effect.grows_from()
    values = np.array([guess[key] for guess in screened.tried])
    strength = np.maximum(screened.strength, 1e-300)
    if nothing is not None:
        nearest = int(np.argmin(np.abs(np.log(strength / threshold))))
        return float(abs(values[nearest] - nothing) * math.sqrt(threshold / strength[nearest]))
    seen = strength >= threshold
    if not seen.any():
        return math.nan
    return float(values[seen][np.argmin(strength[seen])])


def _beyond_range(model: Model, split: Split) -> list[str]:
    """Where commands leave the range beyond which a simulation clips them: the robot need not."""
    notes = []
    for name, (low, high) in model.robot.clipped_commands().items():
        column = model.robot.actuator_names.index(name)
        commands = np.concatenate([s.trial.commands[:, column] for s in (*split.train, *split.heldout)])
        if commands.min() < low or commands.max() > high:
            notes.append(
                f"Commands of {name} go from {commands.min():.4g} to {commands.max():.4g}, beyond the XML's "
                f"ctrlrange of {low:.4g} to {high:.4g}: MuJoCo clips them there, which the robot need not do."
            )
    return notes


def _notes(found: Searched, split: Split, settings: DiagnosisSettings) -> list[str]:
    notes = []
    if settings.exclude:
        notes.append(f"Not looked for, as was asked: {', '.join(settings.exclude)}.")
    if not split.heldout:
        notes.append("Nothing was held out, so nothing judged what was found but the trials that it was fitted to.")
    fit = found.best.fit
    held = [f.name for f, side in zip(fit.parameters.free, fit.at_bound, strict=True) if side]
    if held:
        notes.append(
            f"{', '.join(held)} ended at a bound: what the model leaves out may have gone there, or the bounds are too "
            "narrow."
        )
    if not fit.converged:
        notes.append("The last fit was stopped before it had converged.")
    return notes
