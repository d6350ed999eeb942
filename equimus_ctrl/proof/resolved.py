"""How often designed trials resolve what recordings did not, and whether their predictions come true."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import median
from typing import Any, Literal, get_args

from equimus_ctrl.experiments.loop import Realised
from equimus_ctrl.experiments.refitting import EXACT
from equimus_ctrl.proof.answers import OURS, STRONG, Case, Places
from equimus_ctrl.proof.designing import End
from equimus_ctrl.proof.drawing import Kind
from equimus_ctrl.proof.scoring import Goal, counted_goal
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.robots.base import Robot

Outcome = Literal["exact", "told", "unseen", "silent", "wrong", "failed"]
"""What an answer is: exactly right; not, but what is there is among what it tells as not distinguishable; or so but for
effects that are smaller than what it says that it would have seen; nothing found though something is missing; something
else named; no answer."""
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
RIGHT: tuple[Outcome, ...] = ("exact", "told", "unseen")
KNOWN = "right, not distinguishable or too small to be seen"
LEAST_RIGHT, LEAST_NEAR = 0.95, 0.90
FACTOR = 2.0
"""Within what predicted gaps are to be of the realised ones."""


def outcome(case: Case) -> Outcome:
    """What the diagnosis' answer to a case is."""
    answer = case.answer(OURS)
    if answer.failed:
        return "failed"
    if case.right(OURS):
        return "exact"
    if case.among_left():
        return "told"
    if case.but_for_unseen():
        return "unseen"
    return "silent" if answer.silent else "wrong"


def near(predicted: float, realised: float, noise: bool = True) -> bool:
    """Whether a realised gap is within a factor of two of a predicted one, both as exact as refits are.

    Args:
        predicted: G.
        realised: it.
        noise: whether its noise, of the standard deviation 2√G, may move it further.
    """
    room = EXACT + (2.0 * math.sqrt(max(predicted, 0.0)) if noise else 0.0)
    return predicted / FACTOR - room <= realised <= predicted * FACTOR + room


@dataclass(frozen=True)
class Gap:
    """The gap of a pair of explanations in a designed trial: predicted, and what became of it.

    Attributes:
        case: its number.
        number: of the trial.
        realised: both.
        true: whether the explanation that is taken for the truth is what is there.
    """

    case: int
    number: int
    realised: Realised
    true: bool

    @property
    def within(self) -> bool:
        """Whether the predicted interval holds it."""
        own = self.realised.predicted
        return own.low - EXACT <= self.realised.gap <= own.high + EXACT

    def near(self, noise: bool = True) -> bool:
        """Whether it is within a factor of two, see ``near``."""
        return near(self.realised.predicted.gap, self.realised.gap, noise)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        own = {"case": self.case, "number": self.number, **self.realised.to_dict(), "named_is_true": self.true}
        return {**own, "within_interval": self.within, "within_factor_2": self.near(False)}


@dataclass(frozen=True, eq=False)
class Trial:
    """A designed trial that was made.

    Attributes:
        family: of its commands.
        kept: whether the true robot kept the limits in it.
        excess: how far it left them, in units of their ranges, at most 0 where it kept them; None where that has no
            end: a robot without limits, or one that was lost.
        nearest: the limit that it came nearest to, as a sentence.
        seconds: that its design took.
        promised: whether what is there was among the explanations that it was designed for: of others nothing is
            promised.
    """

    family: str
    kept: bool
    excess: float | None
    nearest: str
    seconds: float
    promised: bool


@dataclass(frozen=True, eq=False)
class Followed:
    """One case at first and with each designed trial more.

    Attributes:
        cases: with the answers, the first without a designed trial.
        trials: that were made, one fewer.
        end: why there was no further one; None where as many were made as were asked for.
        said: the same as a sentence, where there is more to say.
    """

    cases: tuple[Case, ...]
    trials: tuple[Trial, ...]
    end: End | None
    said: str = ""

    def after(self, count: int) -> Case:
        """With so many designed trials; what ended sooner keeps its answer."""
        return self.cases[min(count, len(self.cases) - 1)]

    def outcome(self, count: int) -> Outcome:
        """With so many designed trials."""
        return outcome(self.after(count))

    @property
    def gaps(self) -> list[Gap]:
        """Of all its trials."""
        return [
            Gap(case.number, number, Realised.from_dict(own), case.right(OURS))
            for number, case in enumerate(self.cases)
            for own in case.report.get("realised", ())
        ]

    def to_dict(self, most: int) -> dict[str, Any]:
        """As JSON data."""
        first = self.cases[0]
        return {
            "case": first.number,
            "kind": first.kind,
            "strength": first.strength,
            "truth": [{"effect": t["effect"], "locations": list(t["locations"])} for t in first.missing],
            "outcomes": [self.outcome(k) for k in range(most + 1)],
            "named": [_named(case) for case in self.cases],
            "left": [len(case.report.get("rivals", {}).get("explanations", ())) for case in self.cases],
            "end": self.end,
            **({"said": self.said} if self.said else {}),
            "trials": [dict(vars(trial)) for trial in self.trials],
            "diagnosis_seconds": [case.report["proof"]["seconds"] for case in self.cases],
        }


@dataclass(frozen=True, eq=False)
class Resolved:
    """What designed trials came to, over all cases.

    Attributes:
        most: designed trials of each case.
        followed: the cases.
        margin: the chance at most with which a design is to leave the limits.
        answers: SHA-256 of all answers, taken before any truth was opened.
    """

    most: int
    followed: tuple[Followed, ...]
    margin: float
    answers: str

    def shares(
        self, which: Sequence[Outcome] = RIGHT, of: Callable[[Case], bool] = lambda case: True
    ) -> tuple[Share, ...]:
        """After 0, 1, … designed trials, how many of some cases have one of some outcomes."""
        own = [f for f in self.followed if of(f.cases[0])]
        return tuple(Share.among(f.outcome(k) in which for f in own) for k in range(self.most + 1))

    def told(self) -> str:
        """Right answers after each number of trials, as a clause."""
        shares = ", ".join(f"{share.count}" for share in self.shares())
        return f"{KNOWN} after 0 to {self.most} designed trials: {shares} of {len(self.followed)}"

    @cached_property
    def gaps(self) -> tuple[Gap, ...]:
        """Of all trials whose predictions could be judged."""
        return tuple(gap for own in self.followed for gap in own.gaps)

    @cached_property
    def made(self) -> tuple[Trial, ...]:
        """All designed trials."""
        return tuple(trial for own in self.followed for trial in own.trials)

    @property
    def kept(self) -> Share:
        """Of the trials those in which the true robot kept the limits."""
        return Share.among(trial.kept for trial in self.made)

    @property
    def kept_promises(self) -> Share:
        """Of those that were designed for what is there, see ``Trial.promised``."""
        return Share.among(trial.kept for trial in self.made if trial.promised)

    @property
    def near(self) -> Share:
        """Realised gaps within a factor of two of the predicted ones, noise aside."""
        return Share.among(gap.near() for gap in self.gaps)

    @property
    def ends(self) -> dict[str, Share]:
        """Why cases had no further trial → how many had as the end of it, and of these how many answers are right."""
        names = [*get_args(End), None]
        return {
            name or "trials": Share.among(f.outcome(self.most) in RIGHT for f in self.followed if f.end == name)
            for name in names
        }

    @property
    def goals(self) -> tuple[Goal, ...]:
        """All of them."""
        after = f"after {self.most} designed trial{'s' * (self.most > 1)}: {KNOWN}"
        return (
            counted_goal("resolved", after, self.shares()[-1], LEAST_RIGHT),
            counted_goal("gaps", "realised gaps within a factor of 2, and noise", self.near, LEAST_NEAR),
            counted_goal(
                "limits", "limits kept in trials designed for the truth", self.kept_promises, 1.0 - self.margin
            ),
        )

    @property
    def accurate(self) -> bool:
        """Whether no goal is missed."""
        return not any(goal.state == "missed" for goal in self.goals)

    def by_kind(self) -> dict[str, tuple[Share, ...]]:
        """Kind of ground truth → right after each number of trials; ``seen`` are those that show in the recordings."""
        kinds = [kind for kind in get_args(Kind) if any(f.cases[0].kind == kind for f in self.followed)]
        found = {kind: self.shares(of=lambda c, kind=kind: c.kind == kind) for kind in kinds}  # type: ignore[misc]
        return {**found, "seen": self.shares(of=lambda c: c.kind == "none" or c.strength >= STRONG)}

    def seconds(self, number: int) -> tuple[float, float]:
        """Medians of what the designs of a number and the diagnoses with it took; nan where there are none [s]."""
        designs = [f.trials[number - 1].seconds for f in self.followed if 0 < number <= len(f.trials)]
        diagnoses = [f.cases[number].report["proof"]["seconds"] for f in self.followed if number < len(f.cases)]
        return median(designs) if designs else math.nan, median(diagnoses) if diagnoses else math.nan

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            "trials": self.most,
            "answers_sha256": self.answers,
            "goals": [goal.to_dict() for goal in self.goals],
            "outcomes": {name: _dicts(self.shares((name,))) for name in OUTCOMES},
            "right": _dicts(self.shares()),
            "right_by_kind": {kind: _dicts(shares) for kind, shares in self.by_kind().items()},
            "ends": {name: {"cases": share.of, "right": share.count} for name, share in self.ends.items()},
            "gaps": {
                "within_factor_2": Share.among(gap.near(False) for gap in self.gaps).to_dict(),
                "within_factor_2_and_noise": self.near.to_dict(),
                "within_interval": Share.among(gap.within for gap in self.gaps).to_dict(),
                "each": [gap.to_dict() for gap in self.gaps],
            },
            "limits": {
                "margin": self.margin,
                "kept": self.kept.to_dict(),
                "kept_promises": self.kept_promises.to_dict(),
            },
            "seconds": [
                {"design": None if math.isnan(design) else design, "diagnosis": None if math.isnan(said) else said}
                for design, said in map(self.seconds, range(self.most + 1))
            ],
            "cases": [own.to_dict(self.most) for own in self.followed],
        }


def followed(
    truth: Mapping[str, Any],
    reports: Sequence[Mapping[str, Any]],
    designs: Sequence[Mapping[str, Any]],
    driven: Sequence[Mapping[str, Any]],
    end: End | None,
    robot: Robot,
) -> Followed:
    """A case with its seal opened.

    Args:
        truth: of it.
        reports: without and with each designed trial more.
        designs: of trials, one more than were made where there is a reason to end.
        driven: what is known of the trials that were made.
        end: see ``Followed``.
        robot: whose places they speak of.
    """
    places = Places.of(robot)
    cases = tuple(Case(truth, own, {}, places) for own in reports)
    made = [(design, own) for design, own in zip(designs, driven, strict=False) if not own["failed"]]
    trials = [
        Trial(
            design["design"]["family"], own["kept"], own["excess"], own["nearest"], design["proof"]["seconds"],
            outcome(case) in RIGHT,
        )
        for (design, own), case in zip(made, cases, strict=False)
    ]  # fmt: skip
    why = [own["failed"] for own in driven if own["failed"]] or [own["said"] for own in designs[-1:]]
    return Followed(cases, tuple(trials), end, why[0] if end is not None and why else "")


def _dicts(shares: Sequence[Share]) -> list[dict[str, Any]]:
    return [share.to_dict() for share in shares]


def _named(case: Case) -> list[str]:
    return [f"{f['effect']}:{'+'.join(f['locations'])}" for f in case.answer(OURS).findings] + [
        f"unexplained:{own['location']}" for own in case.answer(OURS).unexplained
    ]
