"""What was found and what was not: the counts of one method over all cases, and who was taken for whom."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from equimus_ctrl.proof.answers import BINS, OURS, STRONG, Case, Method, bin_of
from equimus_ctrl.proof.drawing import Kind
from equimus_ctrl.proof.shares import Share

CONSISTENT, UNEXPLAINED, FAILED = "consistent", "unexplained", "failed"
"""Answers that name nothing."""
NOTHING = "nothing missing"
"""Truth of the cases where there is nothing to find."""

Table = Mapping[str, Share]
"""Which cases → how many of them."""


@dataclass(frozen=True, eq=False)
class Tally:
    """What a method came to.

    Attributes:
        method: its name.
        false_alarms: of cases where nothing is missing: all, with white and with coloured noise.
        single: effects named exactly right: all, strong ones, and by excess.
        group: those, or one that the method calls not distinguishable.
        effects: effect → strong ones named exactly right.
        misplaced: strong single effects named right, but at other places.
        with_unexplained: of the single effects named exactly right, beside which something was called unexplained.
        pair: sets exactly right: all, those of which each part alone is strong, and by the weaker one's excess.
        pair_group: those, or of which each is one that the method calls not distinguishable.
        recall: of the effects in pairs, all and those strong alone, that were named.
        precision: of what was named in pairs, that was there.
        outside: called unexplained and put where it acts: all, strong ones, and by excess.
        unexplained: of strong physics from outside, called so wherever.
        placed: of what was called so, put where it acts.
        wrong: physics from outside that was given names: all, strong, and by excess.
        all_joints: friction of all joints named exactly right: all, strong ones, and by the weakest one's excess.
        triple: sets of three exactly right: all, those of which each part alone is strong, and by the weakest's excess.
    """

    method: Method
    false_alarms: Table
    single: Table
    group: Table
    effects: Table
    misplaced: Share
    with_unexplained: Share
    pair: Table
    pair_group: Table
    recall: Table
    precision: Share
    outside: Table
    unexplained: Share
    placed: Share
    wrong: Table
    all_joints: Table
    triple: Table

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {
            key: value.to_dict() if isinstance(value, Share) else {k: share.to_dict() for k, share in value.items()}
            for key, value in vars(self).items()
            if key != "method"
        }


def by_strength(cases: Sequence[Case], right: Callable[[Case], bool]) -> Table:
    """Shares of all cases, of strong ones, and of each range of the excess."""
    table = {"all": Share.among(map(right, cases))}
    table["strong"] = Share.among(right(c) for c in cases if c.strength >= STRONG)
    for name in BINS:
        table[name] = Share.among(right(c) for c in cases if bin_of(c.strength) == name)
    return table


def tally(cases: Sequence[Case], method: Method = OURS) -> Tally:
    """Count a method's answers."""
    of = {kind: [c for c in cases if c.kind == kind] for kind in get_args(Kind)}

    def false(some: Iterable[Case]) -> Share:
        return Share.among(not c.answer(method).silent for c in some)

    def exact(c: Case) -> bool:
        return c.exact(method)

    none, single, pair, outside, all_joints, triple = of.values()
    strong = [c for c in single if c.strength >= STRONG]
    effects = {}
    for name in sorted({effect for c in strong for effect in c.wanted}):
        effects[name] = Share.among(exact(c) for c in strong if name in c.wanted)
    beyond = [c for c in outside if c.strength >= STRONG]
    called = [c for c in beyond if c.unexplained(method)]
    return Tally(
        method,
        {
            "all": false(none),
            "white": false(c for c in none if not c.coloured),
            "coloured": false(c for c in none if c.coloured),
        },
        by_strength(single, exact),
        by_strength(single, lambda c: c.in_group(method)),
        effects,
        Share.among(set(c.named(method)) == set(c.wanted) and not exact(c) for c in strong),
        Share.among(bool(c.answer(method).unexplained) for c in single if exact(c)),
        by_strength(pair, exact),
        by_strength(pair, lambda c: c.in_group(method)),
        {"all": _recall(pair, method, 0.0), "strong": _recall(pair, method, STRONG)},
        Share.among(c.wanted.get(e) == where for c in pair for e, where in c.named(method).items()),
        by_strength(outside, lambda c: c.unexplained(method) and c.placed(method)),
        Share.among(c.unexplained(method) for c in beyond),
        Share.among(c.placed(method) for c in called),
        by_strength(outside, lambda c: bool(c.answer(method).findings)),
        by_strength(all_joints, exact),
        by_strength(triple, exact),
    )


def _recall(pairs: Sequence[Case], method: Method, least: float) -> Share:
    found = []
    for case in pairs:
        named = case.named(method)
        for finding in case.truth["findings"]:
            if finding["alone"] >= least:
                found += [named.get(e) == where for e, where in case.places.parts([finding]).items()]
    return Share.among(found)


def confusion(cases: Sequence[Case], method: Method = OURS, least: float = STRONG) -> dict[str, dict[str, float]]:
    """Truth → what it was called → how often; what was called several wrong names counts in parts.

    Args:
        cases: all of them.
        method: whose answers.
        least: excess, of a part of a pair that alone, below which an effect does not count.
    """
    rows: dict[str, dict[str, float]] = {}

    def add(row: str, column: str, weight: float = 1.0) -> None:
        own = rows.setdefault(row, {})
        own[column] = own.get(column, 0.0) + weight

    for case in cases:
        answer, named = case.answer(method), case.named(method)
        wrong = [name for name in named if name not in case.wanted]
        fallback = FAILED if answer.failed else UNEXPLAINED if answer.unexplained else CONSISTENT
        if case.kind == "none":
            missing = [NOTHING]
        elif case.kind == "outside":
            missing = [case.truth["outside"][0]["effect"]] if case.strength >= least else []
        else:
            missing = [f["effect"] for f in case.truth["findings"] if f["alone"] >= least]
        for name in missing:
            if name in named:
                add(name, name)
            elif wrong:
                for other in wrong:
                    add(name, other, 1.0 / len(wrong))
            else:
                add(name, fallback)
    return rows
