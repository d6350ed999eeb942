"""The tables of a proof, for a terminal and as Markdown."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from equimus_ctrl.proof.answers import BINS, OURS, STRONG
from equimus_ctrl.proof.baselines import TITLES
from equimus_ctrl.proof.estimates import ParameterEstimate
from equimus_ctrl.proof.scoring import Goal, Score
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.tally import CONSISTENT, Tally

NOTHING = "–"
NUMBER = re.compile(r"[≤≥] |[-−+]?\d")
"""How a cell begins that holds one."""
METHODS = {OURS: "diagnosis", **TITLES}


@dataclass(frozen=True)
class Sheet:
    """A table.

    Attributes:
        title: over it.
        columns: their heads.
        rows: cells as text.
        note: under it.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def rich(self, most: int | None = None) -> Table:
        """For a terminal, of its rows so many at most."""
        shown = self.rows[:most]
        left = len(self.rows) - len(shown)
        table = Table(
            title=Text(self.title, style="bold"),
            title_justify="left",
            caption=" ".join(filter(None, [f"{left} more rows are in the files." if left else "", self.note])) or None,
            caption_justify="left",
            box=SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
        )
        for name, number in zip(self.columns, self.numbers(), strict=True):
            table.add_column(name, justify="right" if number else "left")
        for row in shown:
            table.add_row(*map(Text, row), style="yellow" if row[-1] == "missed" else None)
        return table

    def numbers(self) -> tuple[bool, ...]:
        """Whether each column holds numbers, which stand to the right; words stand to the left."""
        return numbers(len(self.columns), self.rows)

    def markdown(self) -> str:
        """For a file."""
        lines = [f"## {self.title}", ""]
        if self.rows:
            rule = ["---:" if number else "---" for number in self.numbers()]
            lines += [_line(self.columns), _line(rule)]
            lines += [*map(_line, self.rows), ""]
        note = self.note if self.rows or self.note else "None."
        return "\n".join([*lines, *([note, ""] if note else [])])


def numbers(columns: int, rows: Sequence[Sequence[str]]) -> tuple[bool, ...]:
    """Whether each column of a table holds numbers: they begin all its cells that say something, after the first."""
    said = [[row[k] for row in rows if row[k] not in ("", NOTHING)] for k in range(columns)]
    return tuple(k > 0 and all(map(NUMBER.match, cells)) for k, cells in enumerate(said))


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def sheets(score: Score) -> list[Sheet]:
    """All tables, the goals first."""
    return [goals_sheet(score), strength_sheet(score), effects_sheet(score), estimates_sheet(score), wrong_sheet(score)]


def markdown(head: Mapping[str, Any], score: Score, first: Sequence[Sheet] = ()) -> str:
    """All of it as one file.

    Args:
        head: what the proof was made from, line by line.
        score: what it came to.
        first: tables before those of the score.
    """
    parts = ["# Blinded ground truths", "", *(f"- {key}: {value}" for key, value in head.items()), ""]
    return "\n".join([*parts, *(sheet.markdown() for sheet in (*first, *sheets(score)))])


def goals_sheet(score: Score) -> Sheet:
    """Every figure against its goal, and what else there is to know in one line each."""
    rows = [(g.title, goal_value(g), goal_interval(g), goal_wanted(g), g.state) for g in score.goals]
    t, effort = score.ours, score.effort
    more: list[tuple[str, str, str]] = [
        ("false alarms, white noise", *_shown(t.false_alarms["white"])),
        ("false alarms, coloured noise", *_shown(t.false_alarms["coloured"])),
        ("effects of pairs named", *_shown(t.recall["strong"])),
        ("names in pairs right", *_shown(t.precision)),
        ("single: right, at wrong places", *_shown(t.misplaced)),
        ("single: right, and unexplained residuals", *_shown(t.with_unexplained)),
        ("outside: unexplained", *_shown(t.unexplained)),
        ("outside: of these placed", *_shown(t.placed)),
        ("outside: given wrong names", *_shown(t.wrong["strong"])),
        ("held-out error taken by 80 %", *_shown(Share.among(h.share >= 0.8 for h in score.heldout))),
        ("median diagnosis, s", f"{median(effort.seconds):.1f}", ""),
        ("median diagnosis, CPU s", f"{median(effort.cpu_seconds):.1f}", ""),
        ("largest memory, MB", f"{effort.memory / 1e6:.0f}" if effort.memory else NOTHING, ""),
    ]
    return Sheet(
        f"{len(score.cases)} cases: reached and wanted",
        ("", "reached", "95 % interval", "goal", ""),
        (*rows, *((title, value, interval, "", "") for title, value, interval in more)),
        f"Missing physics counts from an excess residual variance of {STRONG:g} on. Open: undecided. Too few: "
        "so few cases could not show it, however they came out.",
    )


def goal_value(goal: Goal) -> str:
    """What was reached."""
    if math.isnan(goal.value):
        return NOTHING
    if goal.name == "seconds":
        return f"{goal.value:.1f}"
    return str(goal.share) if goal.value == goal.share.value else f"{100 * goal.value:.1f} % (n = {goal.share.of})"


def goal_interval(goal: Goal) -> str:
    """Its 95 % interval, where it is a share."""
    counted = goal.value == goal.share.value and goal.name != "seconds"
    return ends_of(goal.share) if counted and goal.share.of else ""


def goal_wanted(goal: Goal) -> str:
    """What is wanted."""
    if goal.name == "seconds":
        return f"≤ {goal.high:g}"
    low, high = 100 * goal.low, 100 * goal.high
    if goal.low > 0 and goal.high < 1:
        return f"{low:g} to {high:g} %"
    return f"≥ {low:g} %" if goal.low > 0 else f"≤ {high:g} %"


def ends_of(share: Share) -> str:
    """The 95 % interval of a share."""
    low, high = share.interval
    return f"{100 * low:.3g} to {100 * high:.3g} %"


def _shown(share: Share) -> tuple[str, str]:
    return str(share), ends_of(share) if share.of else ""


def _short(share: Share) -> str:
    return f"{100 * share.value:.0f} % ({share.count}/{share.of})" if share.of else NOTHING


def strength_sheet(score: Score) -> Sheet:
    """Every method over how much of the error the missing physics makes."""
    kinds: tuple[tuple[str, Callable[[Tally], Mapping[str, Share]]], ...] = (
        ("single", lambda t: t.single),
        ("pair", lambda t: t.pair),
        ("triple", lambda t: t.triple),
        ("outside", lambda t: t.outside),
        ("wrong names", lambda t: t.wrong),
    )
    rows = [("false alarms", "0", *(_short(t.false_alarms["all"]) for t in score.tallies.values()))]
    for title, table in kinds:
        for name in (*BINS, "all"):
            shares = [table(t)[name] for t in score.tallies.values()]
            if shares[0].of:
                rows.append((title, name, *map(_short, shares)))
    others = "; ".join(f"{name}: {title}" for name, title in TITLES.items() if name in score.tallies)
    return Sheet(
        "Right answers by excess",
        ("", "excess", *score.tallies),
        tuple(rows),
        "Excess: mean squared error over the noise's variance when all but the missing physics is fitted; in a pair "
        "with the weaker one alone missing. Wrong names: given to what is from outside."
        + (f" {others}." if others else ""),
    )


def effects_sheet(score: Score) -> Sheet:
    """Strong single effects, one by one."""
    tables = [t.effects for t in score.tallies.values()]
    rows = [(name, *(_short(table[name]) for table in tables)) for name in tables[0]]
    return Sheet(
        "Single effects named right",
        ("", *score.tallies),
        tuple(rows),
        "" if rows else "No case has a single effect that counts.",
    )


def estimates_sheet(score: Score) -> Sheet:
    """Errors and intervals of every parameter of the effects that were named right."""
    estimates = score.estimates[OURS]
    rows = []
    for effect, name in sorted({(n.of, n.name) for n in estimates}):
        own = [n for n in estimates if (n.of, n.name) == (effect, name)]
        rows.append((f"{effect}.{name}", *_errors(own)))
    rows.append(("all", *_errors(estimates)))
    rows.append(("the robot's own", *_errors(score.own)))
    return Sheet(
        "Parameters of what was named right",
        ("", "number", "median error", "intervals that hold"),
        tuple(rows),
        "Errors are relative to the distance from where the effect does nothing; those of a spring's rest, a centre "
        "and a stop's angle to the range that they are drawn from.",
    )


def _errors(estimates: Sequence[ParameterEstimate]) -> tuple[str, str, str]:
    error = f"{_two_digits(100 * median(n.error for n in estimates))} %" if estimates else NOTHING
    return str(len(estimates)), error, str(Share.among(n.covered for n in estimates))


def _two_digits(value: float) -> str:
    """Rounded to two digits, without a power of ten where a number is as short: 1.4, 220."""
    return f"{float(f'{value:.2g}'):g}"


def wrong_sheet(score: Score) -> Sheet:
    """Every case whose answer was not right, but for weak effects that were not seen."""
    rows, unseen = [], 0
    for line in score.lines:
        if not line["right"]:
            if line["kind"] != "none" and line["strength"] < STRONG and line["verdict"] == CONSISTENT:
                unseen += 1
                continue
            said = _named(line["named"])
            if line["unexplained"]:
                said.append(f"unexplained at {', '.join(line['unexplained'])}")
            said = said or [line.get("failed") or line["verdict"]]
            truth = ", ".join(_named(line["truth"])) or "nothing"
            rows.append((str(line["case"]), line["kind"], f"{line['strength']:.3g}", truth, ", ".join(said)))
    note = f"Weak ones (excess below {STRONG:g}) that were not detected are not listed: {unseen}."
    columns = ("case", "kind", "excess", "truth", "said")
    return Sheet("Answers that were not right", columns, tuple(rows), note if unseen else "")


def _named(found: Sequence[Mapping[str, Any]]) -> list[str]:
    return [f"{f['effect']}:{'+'.join(f['locations'])}" for f in found]
