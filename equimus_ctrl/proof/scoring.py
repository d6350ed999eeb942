"""The score of a proof, and which of its goals are met."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Literal

from equimus_ctrl.effects.base import Robots
from equimus_ctrl.proof.answers import OURS, Case, Method, Places
from equimus_ctrl.proof.estimates import (
    HeldOut,
    ParameterEstimate,
    coverage,
    effect_estimates,
    held_out,
    robot_estimates,
)
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.tally import Tally, confusion, tally
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.shown import Short

SCHEMA = "equimus-ctrl/proof-score/1"
MOST_FALSE_ALARMS = 0.01
LEAST_SINGLE, LEAST_GROUP, LEAST_PAIR, LEAST_OUTSIDE, LEAST_ALL_JOINTS = 0.95, 0.99, 0.85, 0.90, 0.95
MOST_ERROR = 0.05
COVERAGE = (0.90, 0.98)
LEAST_HELD_OUT = 0.8
MOST_SECONDS = 60.0

State = Literal["met", "missed", "open", "too few"]
"""Of so many cases as there are: missed, where the 95 % interval lies off the goal; too few, where not even the best
outcome would have its interval within the goal, so that nothing can be claimed; else met, or open where the figure is
off the goal and its interval reaches it."""


@dataclass(frozen=True)
class Goal:
    """One figure against its goal.

    Attributes:
        name: its key in JSON.
        title: for people.
        value: what was reached; nan of no case.
        low: least value that meets the goal.
        high: greatest.
        share: what is counted: the figure itself, or how many numbers lie between ``low`` and ``high``.
        needed: between what that share has to be.
        judged: whether missing it counts; times do not, for they depend on the computer.
    """

    name: str
    title: str
    value: float
    low: float
    high: float
    share: Share
    needed: tuple[float, float]
    judged: bool = True

    @property
    def state(self) -> State:
        """Whether it is met."""
        within = self.low <= self.value <= self.high
        if not self.judged:  # it is of these cases, not of all that there could be
            return "met" if within else "missed"
        low, high = self.share.interval
        if self.share.of and (high < self.needed[0] or low > self.needed[1]):
            return "missed"
        if not self.share.can_show(*self.needed):
            return "too few"
        return "met" if within else "open"

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        ends = {key: v if math.isfinite(v) else None for key, v in (("least", self.low), ("most", self.high))}
        value = self.value if math.isfinite(self.value) else None
        return {"name": self.name, "value": value, **ends, "state": self.state, "judged_by": self.share.to_dict()}


@dataclass(frozen=True, eq=False)
class Effort:
    """What the diagnoses cost.

    Attributes:
        seconds: of each, by the clock.
        cpu_seconds: of each, of one processor.
        memory: the most that a process held [byte]; 0 where that is not known.
    """

    seconds: tuple[float, ...]
    cpu_seconds: tuple[float, ...]
    memory: int

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "median_s": median(self.seconds),
            "longest_s": max(self.seconds),
            "median_cpu_s": median(self.cpu_seconds),
            "longest_cpu_s": max(self.cpu_seconds),
            "peak_memory_byte": self.memory or None,
        }


@dataclass(frozen=True, eq=False, repr=False)
class Score(Short):
    """What a proof came to.

    Attributes:
        cases: with their seals opened.
        tallies: method → counts, the diagnosis first.
        estimates: method → estimated parameters of the effects named right.
        own: the robot's parameters.
        heldout: share of the held-out excess residual variance that is explained.
        effort: of the diagnoses.
        robots: what kind of robots these are.
    """

    cases: tuple[Case, ...]
    tallies: Mapping[Method, Tally]
    estimates: Mapping[Method, Sequence[ParameterEstimate]]
    own: tuple[ParameterEstimate, ...]
    heldout: tuple[HeldOut, ...]
    effort: Effort
    robots: Robots = "elastic"

    def told(self) -> str:
        """How many cases, and which goals are met."""
        by_state: dict[str, int] = {}
        for goal in self.goals:
            by_state[goal.state] = by_state.get(goal.state, 0) + 1
        return f" of {len(self.cases)} cases: goals " + ", ".join(f"{n} {state}" for state, n in by_state.items())

    @property
    def ours(self) -> Tally:
        """Of the diagnosis."""
        return self.tallies[OURS]

    @property
    def goals(self) -> tuple[Goal, ...]:
        """All of them."""
        t, estimates = self.ours, self.estimates[OURS]
        main = [n.error for n in estimates if n.main]
        shares = [h.share for h in self.heldout]
        seconds = self.effort.seconds
        quick = Share.among(s <= MOST_SECONDS for s in seconds)
        return (
            counted_goal("false_alarms", "false alarms", t.false_alarms["all"], 0.0, MOST_FALSE_ALARMS),
            counted_goal("single", "single effects right", t.single["strong"], LEAST_SINGLE),
            counted_goal("single_group", "… or not distinguishable", t.group["strong"], LEAST_GROUP),
            counted_goal("pair", "pairs exactly right", t.pair["strong"], LEAST_PAIR),
            counted_goal("pair_group", "… or not distinguishable", t.pair_group["strong"], LEAST_PAIR),
            counted_goal("outside", "outside: unexplained, placed", t.outside["strong"], LEAST_OUTSIDE),
            *self._of_all_joints,
            _median_goal("main_error", "median error, main parameters", main, 0.0, MOST_ERROR),
            _median_goal("error", "median error, all parameters", [n.error for n in estimates], 0.0, MOST_ERROR),
            counted_goal("coverage", "intervals of effects hold", coverage(estimates), *COVERAGE),
            counted_goal("own_coverage", "intervals of the robot hold", coverage(self.own), *COVERAGE),
            _median_goal("heldout", "held-out error taken, median", shares, LEAST_HELD_OUT, math.inf),
            Goal("seconds", "longest diagnosis, s", max(seconds), 0.0, MOST_SECONDS, quick, (1.0, 1.0), judged=False),
        )

    @property
    def _of_all_joints(self) -> tuple[Goal, ...]:
        """Where friction of all joints was drawn: a kind that is drawn only where it is asked for."""
        share = self.ours.all_joints["all"]
        title = "friction in all joints right"
        return (counted_goal("all_joints", title, share, LEAST_ALL_JOINTS),) if share.of else ()

    @property
    def accurate(self) -> bool:
        """Whether no goal of accuracy is missed."""
        return not any(goal.judged and goal.state == "missed" for goal in self.goals)

    @property
    def lines(self) -> list[dict[str, Any]]:
        """Case by case what was true and what was said, in plain JSON types."""
        return [_line(case) for case in self.cases]

    def to_dict(self) -> dict[str, Any]:
        """What ``prove --json`` prints: plain JSON types, SI units."""
        enough = Share.among(h.share >= LEAST_HELD_OUT for h in self.heldout)
        return {
            "schema": SCHEMA,
            "accurate": self.accurate,
            "goals": [goal.to_dict() for goal in self.goals],
            **self.ours.to_dict(),
            "parameters": {
                "error": _errors(self.estimates[OURS]),
                "coverage": coverage(self.estimates[OURS]).to_dict(),
                "unbounded": sum(not n.bounded for n in self.estimates[OURS]),
                "own_coverage": coverage(self.own).to_dict(),
                "own_median_error": _median([n.error for n in self.own]),
                "estimates": [n.to_dict() for n in self.estimates[OURS]],
            },
            "heldout": {
                "median_share": _median([h.share for h in self.heldout]),
                "enough": enough.to_dict(),
                "shares": {str(h.case): h.share for h in self.heldout},
            },
            "effort": self.effort.to_dict(),
            "confusion": confusion(self.cases),
            "confusion_all": confusion(self.cases, least=0.0),
            "baselines": {
                name: {**t.to_dict(), "error": _errors(self.estimates[name]), "confusion": confusion(self.cases, name)}
                for name, t in self.tallies.items()
                if name != OURS
            },
            "cases": self.lines,
        }


def score(
    truths: Sequence[Mapping[str, Any]],
    reports: Sequence[Mapping[str, Any]],
    baselines: Sequence[Mapping[Method, Mapping[str, Any]]],
    robot: Robot,
) -> Score:
    """Compare what was said with what is true.

    Args:
        truths: of every case, see ``store.open_truth``.
        reports: of every case, see ``blind.report_of``.
        baselines: of every case, name → answer; empty where there are none.
        robot: whose places the cases speak of.
    """
    places = Places.of(robot)
    rows = zip(truths, reports, baselines, strict=True)
    cases = tuple(Case(truth, report, own, places) for truth, report, own in rows)
    methods = [m for m in cases[0].methods if all(m in c.methods for c in cases)]
    spent = [case.report["proof"] for case in cases]
    return Score(
        cases,
        {m: tally(cases, m) for m in methods},
        {m: effect_estimates(cases, m) for m in methods},
        tuple(robot_estimates(cases)),
        tuple(held_out(cases)),
        Effort(
            tuple(s["seconds"] for s in spent),
            tuple(s["cpu_seconds"] for s in spent),
            max(s["peak_memory_byte"] or 0 for s in spent),
        ),
        robot.traits.catalogue,
    )


def counted_goal(name: str, title: str, share: Share, low: float, high: float = 1.0) -> Goal:
    """A share against its goal."""
    return Goal(name, title, share.value, low, high, share, (low, high))


def _median_goal(name: str, title: str, values: Sequence[float], low: float, high: float) -> Goal:
    """The median as the order statistic that half of the values keep."""
    value = median(values) if values else math.nan
    return Goal(name, title, value, low, high, Share.among(low <= v <= high for v in values), (0.5, 1.0))


def _median(values: Sequence[float]) -> float | None:
    return median(values) if values else None


def _errors(estimates: Sequence[ParameterEstimate]) -> dict[str, Any]:
    """Medians of relative errors: of main and of all parameters, over everything and for each effect."""
    found: dict[str, Any] = {
        "main": _median([n.error for n in estimates if n.main]),
        "all": _median([n.error for n in estimates]),
        "effects": {},
    }
    for effect in sorted({n.of for n in estimates}):
        own = [n for n in estimates if n.of == effect]
        names = dict.fromkeys(n.name for n in own)
        found["effects"][effect] = {name: _median([n.error for n in own if n.name == name]) for name in names}
    return found


def _line(case: Case) -> dict[str, Any]:
    """One case, for those who look for what went wrong."""
    answer = case.answer(OURS)
    return {
        "case": case.number,
        "kind": case.kind,
        "strength": case.strength,
        "right": case.right(OURS),
        "truth": [{"effect": t["effect"], "locations": list(t["locations"])} for t in case.missing],
        "verdict": "failed" if answer.failed else case.report["verdict"],
        "named": [{"effect": f["effect"], "locations": list(f["locations"])} for f in answer.findings],
        "unexplained": [left["location"] for left in answer.unexplained],
        "seconds": case.report["proof"]["seconds"],
        **({"failed": answer.failed} if answer.failed else {}),
        **({"baselines": _others(case)} if case.baselines else {}),
    }


def _others(case: Case) -> dict[str, list[str]]:
    return {
        method: [f"{f['effect']}:{'+'.join(f['locations'])}" for f in case.answer(method).findings]
        for method in case.baselines
    }
