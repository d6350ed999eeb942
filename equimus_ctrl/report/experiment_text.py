"""A designed experiment as text: what it decides, with which chance, and what it cannot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from equimus_ctrl.diagnosis.rivals import NOTHING, Rival
from equimus_ctrl.experiments.power import LIKELY, MOST_REPEATS, Power
from equimus_ctrl.experiments.results import Designed, Pair
from equimus_ctrl.experiments.sensors import Remedy
from equimus_ctrl.report.diagnosis_words import listed, number, percent, quantity, short
from equimus_ctrl.shown import counted

if TYPE_CHECKING:
    from rich.console import Console

TOLD_REMEDIES = 3
"""Sensors and parameters that are listed for a pair."""


def named(rival: Rival) -> str:
    """An explanation in words, with the sizes that are given."""
    words = " and ".join(short(own) for own in rival.effects) or NOTHING
    sizes = [f"{key.replace('_', ' ')} {quantity(value, unit, 2)}" for key, value, unit in rival.given_sizes]
    return f"{words} ({', '.join(sizes)})" if sizes else words


def headline(found: Designed) -> str:
    """What the trial is."""
    under = f" under {found.condition.text}" if found.condition.text else ""
    smaller = "" if found.amplitude >= 1 else f", shrunk to {percent(found.amplitude)} by the limits"
    families = listed(list(dict.fromkeys(own.family for own in found.tried)))
    return (
        f"A trial of {number(found.commands.duration)} s{under}: {found.family}{smaller}; the best of "
        f"{counted(found.evaluations, 'design')} ({families}), seed {found.seed}"
        + (", ended by its budget." if found.timed_out else ".")
    )


def pair_sentence(found: Designed, pair: Pair) -> str:
    """What becomes of two explanations."""
    first, second = (named(found.rivals.rivals[k]) for k in pair.places)
    power = pair.harder
    if pair.ending == "settled":
        return f"{first} or {second}: the recordings so far settle this already."
    if pair.ending == "inseparable":
        return (
            f"{first} or {second}: not distinguishable within the limits. None of "
            f"{counted(found.evaluations, 'design')} settles this with {percent(LIKELY)}, nor would {MOST_REPEATS} "
            f"repeats; one does with {percent(power.chance)} (expected gap {gap_text(power)})."
        )
    if pair.ending == "another trial":
        return (
            f"{first} or {second}: not by this trial (expected gap {gap_text(power)}), but by another that was tried; "
            "design again after it, when fewer explanations are left."
        )
    trials = "one trial settles this" if power.repeats == 1 else f"{power.repeats:.0f} repeats settle this"
    once = percent(power.chance)
    with_chance = f"with {once}" if power.repeats == 1 else f"with {percent(LIKELY)} or more, one with {once}"
    return f"{first} or {second}: {trials} {with_chance} (expected gap {gap_text(power)})."


def gap_text(power: Power) -> str:
    """−2Δln L that is expected, with its interval, and what is needed."""
    low, high = (_gap(value) for value in power.interval)
    needed = _gap(max(power.needed - power.ahead, 0.0))
    return f"{_gap(power.gap)}, 90 % between {low} and {high}; needed {needed}"


def _gap(value: float) -> str:
    """−2Δln L to a tenth at most: less says nothing."""
    return number(value, 1) if abs(value) < 10 else number(value)


def remedy_sentence(remedy: Remedy) -> str:
    """What a sensor or a known parameter would do."""
    beside = f"expected gap {_gap(remedy.gap)} in place of {_gap(remedy.without)}"
    if remedy.kind == "parameter":
        return f"{remedy.name} known to {quantity(remedy.noise, remedy.unit, 2)}: {beside}"
    return f"a sensor {remedy.name} with noise of {quantity(remedy.noise, remedy.unit, 2)}: {beside}"


def helpful(found: Designed, pair: Pair) -> list[Remedy]:
    """What would settle an inseparable pair: the best of each kind, best first."""
    best: dict[str, Remedy] = {}
    for own in found.remedies.get(pair.places, ()):
        if found.settles(own):
            best.setdefault(own.name.partition(".")[0] if own.kind == "sensor" else own.kind, own)
    return list(best.values())[:TOLD_REMEDIES]


def limits_sentence(found: Designed) -> str:
    """How sure it is that the limits are kept."""
    count = len(found.rivals.rivals)
    return (
        f"Within the limits under each of {counted(count, 'explanation')} with {counted(found.draws, 'draw')} of its "
        f"parameters: the true robot, if it is one of them, leaves them with a chance of at most "
        f"{percent(found.leaves_with)}. Nearest to a limit: {found.excess}."
    )


def print_design(console: Console, found: Designed, run: str, again: str) -> None:
    """A design for a terminal.

    Args:
        console: where people read.
        found: the design.
        run: the command line that makes the trial.
        again: the one that diagnoses with it.
    """
    from rich.padding import Padding
    from rich.text import Text

    def say(text: str, indent: int = 0, style: str = "") -> None:
        console.print(Padding(Text(text, style=style), (0, 0, 0, indent)))

    def listing(head: str, lines: Sequence[str]) -> None:
        if lines:
            say(head, style="bold")
        for line in lines:
            say(line, 2)

    count = len(found.rivals.rivals)
    listing(f"The diagnosis leaves {counted(count, 'explanation')}", [named(own) for own in found.rivals.rivals])
    say(headline(found), style="bold")
    for pair in found.pairs:
        say(pair_sentence(found, pair), 2)
        if pair.ending == "inseparable":
            own = helpful(found, pair)
            for remedy in own:
                say(f"would distinguish them: {remedy_sentence(remedy)}", 4)
            if not own:
                say("no further sensor would, nor a parameter made known; another condition might (--can)", 4)
    say(limits_sentence(found))
    for text, why in found.refused:
        say(f"Not tried, {text}: {why}", style="yellow")
    if not any(own.ending in ("one trial", "repeats", "another trial") for own in found.pairs):
        say("No trial within these limits decides anything: none is worth making.", style="bold")
        return
    say("Make the trial (on the robot with --plant hardware --arm), then diagnose it with the others:")
    for line in (run, again):
        console.print(f"  {line}", markup=False, soft_wrap=True, highlight=False)
