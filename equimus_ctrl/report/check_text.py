"""What a check of recordings found, for a terminal of 80 columns: a row a recording, a joint, a drive, a parameter."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.preflight.findings import Severity
from equimus_ctrl.preflight.information import EffectInformation, Information, ParameterInformation
from equimus_ctrl.preflight.result import CheckResult
from equimus_ctrl.report.diagnosis_text import smallest

if TYPE_CHECKING:
    from rich.console import Console

STYLES: dict[Severity, str] = {"stop": "bold red", "warning": "yellow", "note": ""}
MOST_RECORDINGS, MOST_PARAMETERS, MOST_TRADE_OFFS = 8, 14, 4
"""Rows of a table; the others are counted, and stand in the JSON."""
NONE = "–"


def headline(check: CheckResult) -> str:
    """What comes of it, in a sentence."""
    count = len(check.signals)
    whole = f"{count} recording{'s' * (count != 1)} with {check.model.name}"
    if check.stops:
        return f"{whole}: a diagnosis would mean nothing"
    warnings, notes = (len(check.of(s)) for s in ("warning", "note"))
    said = f"{warnings} warning{'s' * (warnings != 1)}, {notes} note{'s' * (notes != 1)}"
    return f"{whole}: nothing keeps a diagnosis from meaning something ({said})"


def print_check(console: Console, check: CheckResult) -> None:
    """A check for a terminal."""
    console.print(Text(headline(check), style="bold red" if check.stops else "bold"))
    for finding in check.findings:
        text = Text.assemble((finding.severity, STYLES[finding.severity]), ": ", finding.sentence)
        console.print(Padding(text, (0, 0, 0, 2)))
    console.print(recordings_table(check))
    console.print(joints_table(check))
    console.print(actuators_table(check))
    known = check.information
    if known is None:
        return
    console.print(parameters_table(known))
    for trade_off in known.trade_offs[:MOST_TRADE_OFFS]:
        console.print(Padding(Text(f"{trade_off}"), (0, 0, 0, 2)))
    if more := known.trade_offs[MOST_TRADE_OFFS:]:
        console.print(f"  … {len(more)} more such combinations", markup=False)
    rows = effect_rows(known)
    if rows:
        console.print(Text("\nSmallest detectable sizes, by which every other such effect would be accepted", "bold"))
    for who, sizes in rows:
        console.print(Padding(Text(f"{who}: {sizes}"), (0, 0, 0, 2)))
    for said in sentences(known):
        console.print(Padding(Text(said, style="dim"), (0, 0, 0, 2)))


def _figures(value: float, digits: int = 2) -> str:
    """So many figures, without an exponent where there are more before the point."""
    return f"{value:.0f}" if abs(value) >= 10**digits else f"{value:.{digits}g}"


def _table(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]], more: str = "") -> Table:
    table = Table(
        title=title, title_justify="left", title_style="bold", caption=more or None, caption_justify="left",
        box=SIMPLE_HEAD, padding=(0, 1, 0, 0),
    )  # fmt: skip
    for k, heading in enumerate(headings):
        table.add_column(heading, justify="right" if k else "left", no_wrap=bool(k), overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def recordings_table(check: CheckResult) -> Table:
    """When the rows of each recording came, and how long it rests."""
    shown = check.signals if len(check.signals) <= MOST_RECORDINGS + 2 else check.signals[:MOST_RECORDINGS]
    rows = [
        (
            own.name,
            f"{own.clock.duration:.1f}",
            f"{own.clock.rate:.4g}",
            f"{1e3 * own.clock.jitter:.2f}",
            str(len(own.clock.gaps)),
            f"{len(own.rests)}",
            f"{sum(length for _, length in own.rests):.1f}",
        )
        for own in shown
    ]
    more = len(check.signals) - len(shown)
    headings = ("recording", "time\ns", "rate\nHz", "jitter\nms", "gaps", "rests", "resting\ns")
    return _table("Recordings", headings, rows, f"… {more} more" if more else "")


def joints_table(check: CheckResult) -> Table:
    """What all recordings show of each joint."""
    rows = []
    for j, name in enumerate(check.model.robot.joint_names):
        own = [signals.joints[j] for signals in check.signals]
        where, fine = display_units.position(check.model, name), display_units.error(check.model, name)
        step = max(joint.step for joint in own)
        noise = math.sqrt(sum(joint.noise**2 for joint in own) / len(own))
        mark = "" if any(joint.at_rest for joint in own) else "≤ "
        rows.append(
            (
                name,
                where(_figures(where.factor * (max(i.high for i in own) - min(i.low for i in own)), 3)),
                where(_figures(where.factor * max(joint.peak_speed for joint in own))) + "/s",
                where(_figures(where.factor * max(joint.peak_acceleration for joint in own))) + "/s²",
                f"{max(joint.bandwidth for joint in own):.2g} Hz",
                mark + fine(f"{fine.factor * noise:.2g}"),
                fine(f"{fine.factor * step:.3g}") if step else NONE,
            )
        )
    headings = ("joint", "travel", "peak\nspeed", "peak\naccel.", "bandwidth", "noise", "sensor\nstep")
    return _table("Joints, over all recordings", headings, rows)


def actuators_table(check: CheckResult) -> Table:
    """What was commanded, and how late joints move after steps."""
    rows = []
    total = sum(own.clock.rows for own in check.signals)
    for k, late in enumerate(check.latencies):
        own = [signals.commands[k] for signals in check.signals]
        unit = display_units.command(check.model, late.actuator)
        weights = [signals.clock.rows / total for signals in check.signals]
        at_high, at_low = (
            sum(w * c for w, c in zip(weights, shares, strict=True))
            for shares in ([c.at_high for c in own], [c.at_low for c in own])
        )
        low, high = min(c.low for c in own), max(c.high for c in own)
        rows.append(
            (
                late.actuator,
                f"{unit.factor * low:.3g} … " + unit(f"{unit.factor * high:.3g}"),
                f"{100 * at_low:.0f} %",
                f"{100 * at_high:.0f} %",
                f"{1e3 * late.low:.0f} … {1e3 * late.high:.0f} ms" if late.shows else "does not show",
                str(late.steps),
            )
        )
    headings = ("actuator", "command", "at lowest", "at highest", "dead time", "by steps")
    return _table("Actuators", headings, rows)


def parameters_table(known: Information) -> Table:
    """What could be known of each parameter, the least certain first."""
    order = sorted(known.parameters, key=lambda own: -_share(own))
    shown = order if len(order) <= MOST_PARAMETERS + 2 else order[:MOST_PARAMETERS]
    rows = [
        (
            own.name,
            f"{own.value:.4g} {own.unit}".removesuffix(" 1"),
            "not identifiable" if math.isinf(own.deviation) else f"{own.deviation:.2g}",
            NONE if math.isinf(own.deviation) or not own.value else f"{100 * _share(own):.2g} %",
        )
        for own in shown
    ]
    more = len(order) - len(shown)
    headings = ("parameter", "nominal", "least standard\ndeviation", "of it")
    return _table(
        "Parameters: what an estimate could know at best",
        headings,
        rows,
        f"… {more} more are known better" if more else "",
    )


def _share(own: ParameterInformation) -> float:
    return own.deviation / abs(own.value) if own.value else own.deviation / own.range


def effect_rows(known: Information) -> list[tuple[str, str]]:
    """(effect and its parameter, sizes by place), then where it does not show, and where parameters do the same."""
    by_effect: dict[str, list[EffectInformation]] = {}
    for own in known.effects:
        named, parameter = own.smallest.named, own.smallest.parameter
        by_effect.setdefault(f"{named.effect} ({parameter})".replace("_", " "), []).append(own)
    rows = []
    for who, places in sorted(by_effect.items()):
        parts = [", ".join(f"{smallest(own.smallest)} at {_place(own)}" for own in places if own.possible)]
        for said, confounded in (("does not show at", False), ("acts like free parameters at", True)):
            hidden = [_place(own) for own in places if not own.possible and own.confounded is confounded]
            parts.append(f"{said} {', '.join(hidden)}" if hidden else "")
        rows.append((who, "; ".join(part for part in parts if part)))
    return rows


def _place(own: EffectInformation) -> str:
    return own.smallest.named.locations[0]


def sentences(known: Information) -> list[str]:
    """What has to be known of these figures."""
    looked, fitted = known.intervals
    said = [
        "To first order about the nominal model, all parameters estimated along, for a model that explains all else: "
        f"the nominal one is off by {_figures(known.far)} times the noise."
    ]
    if known.share < 1:
        said.append(
            f"From {100 * known.share:.2g} % of what a diagnosis would fit ({looked} of its {fitted} shooting "
            f"intervals), as much as the time did for (--budget)."
        )
    if known.not_done:
        names = ", ".join(name.replace("_", " ") for name in known.not_done)
        said.append(f"Not looked at in the time (--budget): {names}.")
    return said
