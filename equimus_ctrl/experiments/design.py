"""The design of an experiment: commands within limits that tell rivals apart, and what they are expected to show.

First CMA-ES goes over families of commands and known conditions (``search``), by distances to first order. What is
best is taken through the limits with many draws of all rivals' parameters, and shrunk about rest until none leaves them
(``limits``). Of what is left, the design is taken whose trial settles most, the rivals refitted without linearising
(``power``). Pairs that all of these settle, or none, need no draws for that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import ConfigError, NothingFeasible, SimulationDiverged
from equimus_ctrl.experiments.conditions import KnownCondition
from equimus_ctrl.experiments.families import Family, families
from equimus_ctrl.experiments.ground import Crowd, Ground
from equimus_ctrl.experiments.limits import Excess, Limits
from equimus_ctrl.experiments.power import DRAWS, Power, powers
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.experiments.results import Designed, Pair, TriedFamily
from equimus_ctrl.experiments.search import Arm, Over, search
from equimus_ctrl.experiments.sensors import check_noises, remedies
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.shown import counted
from equimus_ctrl.types import Array

EVALUATIONS, COSTLY_EVALUATIONS = 400, 120
"""Of designs, where simulations take little and long, see ``Ground.takes_long``."""
LOOKED_AT = 16
"""Models that are looked at in the search, the rivals with their estimates and draws of their parameters; of each
different one there is one draw, or more."""
LIMIT_DRAWS = 99
"""Of each rival that the final design is taken through: the true robot leaves the limits with 1 % at most."""
CANDIDATES, COSTLY_CANDIDATES = 8, 4
"""Designs that are compared by refitting, also where simulations take long."""
LEADERS = 2
"""Families whose designs are compared first."""
DECIDED = 0.01
"""A pair that is settled with all but this chance, or with no more, in all of them does not decide between them."""
ALIKE = 0.05
"""Chances of settling what may be in the place of what was found differ by no less."""
FEW_DRAWS = 3
"""Of the true rival where candidates are compared."""
COSTLY_DRAWS = 4
"""Of the true rival for the final design, where simulations take long."""
REFITS = 160
"""For the power of the final design, in all: with more pairs each has fewer draws, down to ``LEAST_DRAWS``."""
LEAST_DRAWS = 4
ALL_PAIRS = 3
"""Rivals up to which all pairs are told; of more, each is told from the first."""

Progress = Callable[[str, float], None]
"""Called with the stage and its share that is done."""


def designed(
    rivals: Rivals,
    limits: Limits,
    *,
    conditions: Sequence[KnownCondition] = (KnownCondition(),),
    over_families: Sequence[Family] = (),
    seed: int = 0,
    evaluations: int | None = None,
    over: Over = lambda: False,
    draws: int = LIMIT_DRAWS,
    refits: int = REFITS,
    noises: Mapping[str, float] | None = None,
    track: float | None = None,
    simulator: Simulator | None = None,
    progress: Progress = lambda stage, share: None,
) -> Designed:
    """Commands under which rivals differ most, within limits.

    The same seed and evaluations give the same bits; where time ends the search, the best so far is designed.

    Args:
        rivals: between which it is to decide.
        limits: that it must not leave, with its duration.
        conditions: that the user can make; one of them is taken.
        over_families: of commands; all by default.
        seed: of the search, and of draws.
        evaluations: of designs, in all; by default as many as the engine does in about half a minute.
        over: whether the time is up.
        draws: of each rival's parameters through which the design is taken.
        refits: for the power of the final design, in all; each pair has ``LEAST_DRAWS`` to ``power.DRAWS`` of them.
        noises: sensor → its standard deviation, for what would tell apart what no design does.
        track: natural frequency of feedback by which joints track references, see ``Ground.of`` [Hz].
        simulator: that of the rivals by default.
        progress: see ``Progress``.

    Raises:
        ConfigError: where there is one rival alone, or the robot does not come to rest.
        NothingFeasible: where no design moves within the limits.
    """
    if len(rivals.rivals) < 2:
        raise ConfigError(
            f"the diagnosis of {rivals.model.name} leaves one explanation ({rivals.rivals[0].label}); expected two or "
            "more, between which an experiment could decide"
        )
    check_noises(rivals, noises or {})
    with threadpool_limits(limits=1, user_api="blas"):  # sums in another order would change the last bits
        simulator = simulator or rivals.simulator()
        grounds, refused = _grounds(rivals, limits, conditions, simulator, track)
        costly = grounds[0].takes_long
        arms = list[Arm]()
        for c, ground in enumerate(grounds):
            crowd = ground.crowd(_few_models(rivals, 0 if costly else LOOKED_AT, np.random.default_rng([seed, 0])))
            several = over_families or families()
            arms += [
                Arm(ground, family, 1 + seed * 1000 + c * len(several) + f, crowd) for f, family in enumerate(several)
            ]
        asked = evaluations or (COSTLY_EVALUATIONS if costly else EVALUATIONS)
        wanted = told_pairs(rivals)
        timed_out = search(arms, asked, over, lambda share: progress("search", share))
        final = _Final.of(rivals, draws, seed)
        kept = final.kept(_candidates(arms), progress, COSTLY_CANDIDATES if costly else CANDIDATES)
        if not kept:
            raise NothingFeasible(_why_nothing(arms))
        chosen = _best(kept, 0 if simulator.engine.costly else FEW_DRAWS, seed, over, progress)
        count = COSTLY_DRAWS if costly else int(np.clip(refits // len(wanted), LEAST_DRAWS, DRAWS))
        progress("power", 0.0)
        found = _powers(chosen, count, wanted, seed)
        pairs, others = [], dict[tuple[int, int], Commands]()
        for both in _both_ways(found):
            own, other = _ending(rivals, both, final, arms, min(count, LEAST_DRAWS))
            pairs.append(own)
            if other is not None:
                others[own.places] = other
        lost = [own.places for own in pairs if own.ending == "inseparable"]
        moving = [chosen.commands, *(_largest(arms, final) if lost else ())]
        hopeless = {places: [*moving, *([others[places]] if places in others else [])] for places in lost}
        progress("sensors", 0.0)
        would = remedies(rivals, hopeless, limits, noises=noises, simulator=simulator)
    return Designed(
        rivals=rivals,
        limits=limits,
        condition=chosen.ground.condition,
        family=chosen.family,
        commands=chosen.commands,
        amplitude=chosen.amplitude,
        pairs=tuple(pairs),
        excess=chosen.excess,
        draws=draws,
        tried=tuple(
            TriedFamily(a.family.name, a.ground.condition.text, a.spent, None if a.best is None else a.value)
            for a in arms
        ),
        refused=refused,
        seed=seed,
        evaluations=sum(a.spent for a in arms),
        timed_out=timed_out,
        remedies=would,
    )


def told_pairs(rivals: Rivals) -> list[tuple[int, int]]:
    """(true, other) both ways round: all of few rivals, of many each with the first, which is named first."""
    few = len(rivals.rivals) <= ALL_PAIRS
    return [pair for pair in rivals.pairs if few or 0 in pair]


def _grounds(
    rivals: Rivals, limits: Limits, conditions: Sequence[KnownCondition], simulator: Simulator, track: float | None
) -> tuple[list[Ground], tuple[tuple[str, str], ...]]:
    """Where the robot rests under each condition; conditions under which it does not, and why."""
    found, refused = list[Ground](), list[tuple[str, str]]()
    for condition in conditions:
        try:
            found.append(Ground.of(rivals, limits, condition, simulator, track))
            _ = found[-1].bounds
        except ConfigError as error:
            if len(conditions) == 1:
                raise
            refused.append((condition.text, str(error)))
            found = [own for own in found if own.condition is not condition]
    if not found:
        raise ConfigError(refused[0][1])
    return found, tuple(refused)


def _models(rivals: Rivals, draws: int, rng: np.random.Generator) -> list[Model]:
    """All rivals with their estimates, and with draws of their parameters."""
    found = [rival.model for rival in rivals.rivals]
    for rival in rivals.rivals:
        found += [rival.model_at(theta) for theta in rival.draws(rng, draws)]
    return found


def _few_models(rivals: Rivals, count: int, rng: np.random.Generator) -> list[Model]:
    """All rivals with their estimates, and about so many in all with draws."""
    several = len(rivals.rivals)
    return _models(rivals, max((count - several) // several, 1), rng)


def _candidates(arms: Sequence[Arm]) -> list[tuple[Arm, Array]]:
    """Designs that are worth a closer look: of two families at a time the best, then those that go farthest."""
    ranked = [(arm, arm.candidates) for arm in sorted(arms, key=lambda arm: -arm.value)]
    found = list[tuple[Arm, Array]]()
    for k in range(0, len(ranked), LEADERS):
        some = ranked[k : k + LEADERS]
        found += [(arm, points[n]) for n in range(2) for arm, points in some if n < len(points)]
    return found


@dataclass(frozen=True, eq=False)
class _Kept:
    """A design that keeps the limits."""

    ground: Ground
    family: str
    commands: Commands
    amplitude: float
    excess: Excess

    def powers(self, rng: np.random.Generator, draws: int, pairs: Sequence[tuple[int, int]]) -> list[Power]:
        """For pairs of rivals, by their places."""
        ground = self.ground
        return powers(ground.rivals, self.commands, rng, draws=draws, pairs=pairs, simulator=ground.simulator)


@dataclass(frozen=True, eq=False)
class _Final:
    """Many draws of all rivals, through which designs are taken; at rest under each condition once."""

    models: list[Model]
    crowds: dict[int, Crowd]

    @classmethod
    def of(cls, rivals: Rivals, draws: int, seed: int) -> _Final:
        return cls(_models(rivals, draws, np.random.default_rng([seed, 1])), {})

    def kept(
        self, designs: Sequence[tuple[Arm, Array]], progress: Progress = lambda stage, share: None, most: int = 1
    ) -> list[_Kept]:
        """The first designs, shrunk until none of the draws leaves the limits; without those that then do not move."""
        found = list[_Kept]()
        for arm, point in designs:
            if len(found) == most:
                break
            ground = arm.ground
            if id(ground) not in self.crowds:
                self.crowds[id(ground)] = ground.crowd(self.models)
            course = arm.commands(point).course
            try:
                share, excess = self.crowds[id(ground)].within(course)
            except ConfigError:  # even at rest: another condition may do
                continue
            commands = ground.trial(ground.rest + share * (course - ground.rest))
            if np.any(commands.course != ground.rest):
                found.append(_Kept(ground, arm.family.name, commands, share, excess))
            progress("limits", len(found) / most)
        return found


def _why_nothing(arms: Sequence[Arm]) -> str:
    """Why there is no design."""
    name, count = arms[0].ground.rivals.model.name, counted(sum(arm.spent for arm in arms), "design")
    return (
        f"{name}: of {count} none that moves it stays within the limits under all explanations; expected wider "
        "limits, or another rest"
    )


def _best(kept: Sequence[_Kept], draws: int, seed: int, over: Over, progress: Progress) -> _Kept:
    """The one whose trial settles most, rivals refitted; with some draws where it counts.

    Pairs of which all designs settle as much do not decide, so that these need no draws. What may only hide beside what
    was found is not taken for the truth here: the gap is about the same either way.
    """
    if len(kept) == 1:
        return kept[0]
    rivals = kept[0].ground.rivals
    looked_at = [pair for pair in told_pairs(rivals) if not rivals.rivals[pair[0]].given]
    judged = _judged(kept, 0, looked_at, seed, over, progress)
    chances = np.array([[one.chance for one in own.powers] for own in judged])
    open_ = np.flatnonzero((chances.min(axis=0) < 1 - DECIDED) & (chances.max(axis=0) > DECIDED))
    if draws and len(open_) and not over():
        pairs = [looked_at[k] for k in open_]
        judged = _judged([own.kept for own in judged], draws, pairs, seed, over, progress)
    return max(judged, key=lambda own: own.score).kept


def _powers(chosen: _Kept, count: int, pairs: Sequence[tuple[int, int]], seed: int) -> list[Power]:
    """For pairs of rivals, with so many draws of the true one; of many pairs those that few draws decide have few."""
    few = len(pairs) > ALL_PAIRS * (ALL_PAIRS - 1)
    found = chosen.powers(np.random.default_rng([seed, 2]), LEAST_DRAWS if few else count, pairs)
    if not few or count <= LEAST_DRAWS:
        return found
    open_ = [k for k, own in enumerate(found) if DECIDED < own.chance < 1 - DECIDED]
    more = chosen.powers(np.random.default_rng([seed, 2]), count, [pairs[k] for k in open_]) if open_ else []
    known = dict(zip(open_, more, strict=True))
    return [known.get(k, own) for k, own in enumerate(found)]


@dataclass(frozen=True, eq=False)
class _Judged:
    """A design with its power for some pairs."""

    kept: _Kept
    powers: Sequence[Power]

    @property
    def score(self) -> tuple[float, float, list[float]]:
        """The mean chances, and then gaps over their uncertainty, the worst pair's first.

        What may only hide beside what was found comes second to what may be in its place, of which the chance counts
        to ``ALIKE``. Of designs that settle all pairs it is the one that would still do so if a law were a little
        wrong.
        """
        rivals = self.kept.ground.rivals.rivals
        named = [one.chance for one in self.powers if not (rivals[one.first].given or rivals[one.second].given)]
        chance, whole = (float(np.mean(own)) if own else 0.0 for own in (named, [one.chance for one in self.powers]))
        return round(chance / ALIKE), round(whole, 2), sorted(round(_surety(one), 1) for one in self.powers)


def _surety(power: Power) -> float:
    """A gap over its standard deviation, by noise, 2√G, and by what is not known of the true rival."""
    mean = float(power.gaps.mean())
    return mean / math.sqrt(4.0 * mean + float(power.gaps.var()))


def _judged(
    kept: Sequence[_Kept], draws: int, pairs: Sequence[tuple[int, int]], seed: int, over: Over, progress: Progress
) -> list[_Judged]:
    """Designs with their power; those that diverge are left out."""
    found = list[_Judged]()
    for k, own in enumerate(kept):
        if found and over():
            break
        rng = np.random.default_rng([seed, 2])
        with suppress(SimulationDiverged):
            found.append(_Judged(own, own.powers(rng, draws, pairs)))
        progress("refits", (k + 1) / len(kept))
    return found or [_Judged(own, ()) for own in kept]


def _largest(arms: Sequence[Arm], final: _Final) -> list[Commands]:
    """Of what was tried first the trial whose commands go farthest: where nothing decides, the search does not move."""
    found = [own.commands for arm in arms if arm.largest is not None for own in final.kept([(arm, arm.largest)])]
    span = [float(np.ptp(own.course, axis=0).max()) for own in found]
    return [found[int(np.argmax(span))]] if found else []


def _both_ways(found: Sequence[Power]) -> Iterator[tuple[Power, Power]]:
    """Powers of each pair, the first rival true and the second."""
    known = {(own.first, own.second): own for own in found}
    return ((own, known[j, i]) for (i, j), own in known.items() if i < j)


def _ending(
    rivals: Rivals, both: tuple[Power, Power], final: _Final, arms: Sequence[Arm], draws: int
) -> tuple[Pair, Commands | None]:
    """What becomes of a pair; where the design does not settle it, of all that were tried the one that may."""
    accepted = all(rivals.rivals[own.first].accepted for own in both)
    if accepted and any(own.ahead > own.needed for own in both):
        return Pair(both, "settled"), None
    repeats = max(own.repeats for own in both)
    if math.isfinite(repeats):
        return Pair(both, "one trial" if repeats == 1 else "repeats"), None
    pair = both[0].first, both[0].second
    tried = [(arm, arm.nearest[pair]) for arm in arms if pair in arm.nearest]
    tried.sort(key=lambda own: -own[1].separation.distance(*pair))
    for other in final.kept([(arm, own.point) for arm, own in tried[:1]]):
        several = other.powers(np.random.default_rng(0), draws, [pair, pair[::-1]])
        often = all(math.isfinite(own.repeats) for own in several)
        return Pair(both, "another trial" if often else "inseparable"), other.commands
    return Pair(both, "inseparable"), None
