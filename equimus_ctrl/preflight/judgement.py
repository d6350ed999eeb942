"""Sentences on what recordings are like: each with how bad it is, where, the value, and what would be right."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.models.model import Model
from equimus_ctrl.preflight.findings import SEVERITIES, Finding, buried, coarse, text_of
from equimus_ctrl.preflight.latency import Latency
from equimus_ctrl.preflight.limits import LIMITS, CheckLimits
from equimus_ctrl.preflight.runs import Repeats, RestPose
from equimus_ctrl.preflight.signals import JointSignal, Signals
from equimus_ctrl.types import Array

MOST_NAMED = 3
"""So many recordings are named in a sentence."""
FLATS = 2
"""So often a measurement has to stay at one extreme: once may be a rest."""


def judged(
    model: Model,
    signals: Sequence[Signals],
    latencies: Sequence[Latency],
    repeats: Sequence[Repeats],
    poses: Sequence[RestPose],
    limits: CheckLimits = LIMITS,
) -> list[Finding]:
    """All that signals say, the worst first."""
    found = [
        *coarse(model, [own.joints for own in signals], limits),
        *buried(model, [own.joints for own in signals], limits),
        *_clocks(model, signals, limits),
        *_held(signals, limits),
        *_clipped(model, signals),
        *_commands(model, signals, limits),
        *_rests(signals),
        *_late(latencies, signals),
        *_repeats(model, repeats, limits),
        *_differences(model, signals, poses, limits),
    ]
    return sorted(found, key=lambda f: SEVERITIES.index(f.severity))


def _named(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _joints(signals: Sequence[Signals]) -> Iterator[tuple[str, list[JointSignal]]]:
    for j, joint in enumerate(signals[0].joints):
        yield joint.name, [own.joints[j] for own in signals]


def _clocks(model: Model, signals: Sequence[Signals], limits: CheckLimits) -> list[Finding]:
    found = list[Finding]()
    bursts = [own for own in signals if own.clock.bursts > 0]
    if bursts:
        worst = max(bursts, key=lambda own: own.clock.bursts)
        found.append(
            Finding(
                "warning", "clock", f"{_named([own.name for own in bursts])}: up to {100 * worst.clock.bursts:.2g} "
                "% of the "
                f"rows come less than {limits.burst:g} of the usual {1e3 * worst.clock.interval:.3g} ms after the one "
                "before: stamps seem to say when rows arrived; stamp them where they are measured", worst.name, "time",
                worst.clock.bursts,
            )
        )  # fmt: skip
    gaps = [(own.name, *own.clock.gaps[0], len(own.clock.gaps)) for own in signals if own.clock.gaps]
    if gaps:
        name, start, length, count = max(gaps, key=lambda gap: gap[2])
        others = "" if len(gaps) == 1 else f"; {len(gaps)} recordings have gaps"
        found.append(
            Finding(
                "warning", "clock", f"{name}: no rows for {length:.3g} s after {start:.4g} s, where they are usually "
                f"{1e3 * next(s.clock.interval for s in signals if s.name == name):.3g} ms apart ({count} such gaps"
                f"{others}): what happened there is not compared", name, "time", length, "s",
            )
        )  # fmt: skip
    jittery = [
        (j.speed * own.clock.jitter / j.noise, own, j)
        for own in signals
        for j in own.joints
        if j.speed * own.clock.jitter > limits.jitter * j.noise
    ]
    if jittery:
        ratio, own, joint = max(jittery, key=lambda row: row[0])
        unit = display_units.error(model, joint.name)
        found.append(
            Finding(
                "note", "clock", f"{own.name}: times between rows scatter by {1e3 * own.clock.jitter:.2g} ms; were "
                "stamps "
                f"wrong by that, pos.{joint.name} would be off by {text_of(unit, joint.speed * own.clock.jitter)} "
                f"at its "
                f"usual speed, {ratio:.2g} times its noise: stamps have to be those of the measurement", own.name,
                f"pos.{joint.name}", own.clock.jitter, "s",
            )
        )  # fmt: skip
    return found


def _held(signals: Sequence[Signals], limits: CheckLimits) -> list[Finding]:
    found = []
    for name, own in _joints(signals):
        rows = [(joint.held, k) for k, joint in enumerate(own) if joint.held > limits.held]
        if not rows:
            continue
        share, k = max(rows)
        every = 1.0 / (1.0 - min(share, 0.99))
        interval = signals[k].clock.interval
        names = [signals[i].name for _, i in rows]
        found.append(
            Finding(
                "warning",
                "clock",
                f"{_named(names)}: pos.{name} repeats its value in up to {100 * share:.0f} % of the rows in motion, "
                f"so new "
                f"ones come about every {1e3 * every * interval:.3g} ms, rows every {1e3 * interval:.3g} ms: two "
                f"clocks; keep only rows with a new value, stamped when it was measured",
                names[0] if len(names) == 1 else "",
                f"pos.{name}",
                share,
            )
        )
    return found


def _clipped(model: Model, signals: Sequence[Signals]) -> list[Finding]:
    found = []
    for j, joint in enumerate(signals[0].joints):
        at: dict[float, list[tuple[str, float]]] = {}
        for own in signals:
            for flat in own.joints[j].flats:
                at.setdefault(flat.value, []).append((own.name, flat.length))
        for value, stretches in at.items():
            if len(stretches) < FLATS:
                continue
            unit = display_units.position(model, joint.name)
            names = list(dict.fromkeys(name for name, _ in stretches))
            longest = max(length for _, length in stretches)
            found.append(
                Finding(
                    "warning",
                    "clipping",
                    f"{_named(names)}: pos.{joint.name} stays exactly at {text_of(unit, value, 4)}, which it never "
                    f"passes, {len(stretches)} times, for up to {longest:.2g} s, and is fast just before: the sensor's "
                    f"range ends there, or a hard stop; cut these times (--window), or give the model the stop",
                    names[0] if len(names) == 1 else "",
                    f"pos.{joint.name}",
                    value,
                    "m" if model.robot.slides(joint.name) else "rad",
                )
            )
    return found


def _commands(model: Model, signals: Sequence[Signals], limits: CheckLimits) -> list[Finding]:
    found = []
    low, high = model.robot.command_limits
    for k, name in enumerate(signals[0].commands):
        own = [s.commands[k] for s in signals]
        rows = np.array([s.clock.rows for s in signals], dtype=float)
        unit, column = display_units.command(model, name.name), f"cmd.{name.name}"

        def share(values: Sequence[float], rows: Array = rows) -> float:
            return float(rows @ np.array(values) / rows.sum())

        # No command at all, such as no pressure, is a limit where nothing is lost.
        ends = [("highest", float(high[k]), share([c.at_high for c in own]))]
        ends += [("lowest", float(low[k]), share([c.at_low for c in own]))] if low[k] != 0 else []
        for side, end, of_rows in ends:
            if of_rows > limits.saturated:
                found.append(
                    Finding(
                        "note", "saturation", f"{column} is at its {side} value, {text_of(unit, end, 3)}, in "
                        f"{100 * of_rows:.0f} % of the rows: what more would do is not seen there", "", column, of_rows,
                    )
                )  # fmt: skip
        beyond = share([c.beyond for c in own])
        if beyond > 0:
            reach = f"{text_of(unit, min(c.low for c in own), 3)} to {text_of(unit, max(c.high for c in own), 3)}"
            found.append(
                Finding(
                    "warning", "saturation", f"{column} goes from {reach}, in {max(100 * beyond, 0.01):.2g} % of "
                    "the rows "
                    f"beyond the model's {text_of(unit, float(low[k]), 3)} to {text_of(unit, float(high[k]), 3)}: a "
                    "simulation clips it there, which the robot need not do", "", column, beyond,
                )
            )  # fmt: skip
        if all(c.changes == 0 for c in own):
            values = {c.low for c in own}
            if len(values) == 1:
                found.append(
                    Finding(
                        "note", "excitation", f"{column} never changes: nothing of this drive but its force at "
                        f"{text_of(unit, values.pop(), 3)} can be seen; record steps, staircases or sweeps", "", column,
                    )
                )  # fmt: skip
    return found


def _rests(signals: Sequence[Signals]) -> list[Finding]:
    if any(own.rests for own in signals):
        return []
    return [
        Finding(
            "note",
            "rests",
            "no recording has a rest of a quarter of a second: the noise is estimated from second differences, which "
            "accelerations make larger, and static friction shows at reversals alone; begin and end each recording "
            "at rest",
        )
    ]


def _late(latencies: Sequence[Latency], signals: Sequence[Signals]) -> list[Finding]:
    found = []
    interval = max(own.clock.interval for own in signals)
    for own in latencies:
        if own.shows and own.low > interval:
            found.append(
                Finding(
                    "note",
                    "latency",
                    f"motion begins {1e3 * own.low:.0f} to {1e3 * own.high:.0f} ms after steps of "
                    f"cmd.{own.actuator}, more "
                    "than a row: there is a dead time; diagnose finds how much of it the model lacks",
                    channel=f"cmd.{own.actuator}",
                    value=own.low,
                    unit="s",
                )
            )
    return found


def _repeats(model: Model, repeats: Sequence[Repeats], limits: CheckLimits) -> list[Finding]:
    found = []
    for own in repeats:
        for j, joint in enumerate(model.robot.joint_names):
            ratio = own.spread[j] / own.noise[j]
            if ratio <= limits.spread:
                continue
            unit, steady = display_units.error(model, joint), (own.offset[j] / own.spread[j]) ** 2
            why = "mostly a constant shift: a zero, a load, a temperature" if steady > 0.5 else "not a constant shift"
            found.append(
                Finding(
                    "warning", "repeats", f"{_named(own.names)} have the same commands, and pos.{joint} differs by "
                    f"{text_of(unit, own.spread[j])} (standard deviation), {ratio:.2g} times its noise ({why}): no "
                    f"one model explains them to the noise", "", f"pos.{joint}", own.spread[j],
                )
            )  # fmt: skip
    return found


def _differences(
    model: Model, signals: Sequence[Signals], poses: Sequence[RestPose], limits: CheckLimits
) -> list[Finding]:
    found = []
    rates = [own.clock.rate for own in signals]
    for odd, middle in _odd(rates, limits):
        worst = max(odd, key=lambda k: abs(math.log(rates[k] / middle)))
        found.append(
            Finding(
                "note", "differences", f"{_named([signals[k].name for k in odd])}: {rates[worst]:.3g} rows a second in "
                f"{signals[worst].name}, {middle:.3g} in most recordings", signals[worst].name, "time",
                rates[worst], "Hz",
            )
        )  # fmt: skip
    noisy: dict[int, list[str]] = {}
    for name, own in _joints(signals):
        # Without rests accelerations may make it larger.
        values = [joint.noise if joint.at_rest else 0.0 for joint in own]
        unit = display_units.error(model, name)
        for odd, middle in _odd(values, limits):
            for k in odd:
                text = f"pos.{name} {text_of(unit, values[k])} (elsewhere {text_of(unit, middle)})"
                noisy.setdefault(k, []).append(text)
    for k, texts in noisy.items():
        sentence = f"{signals[k].name}: noise of {', '.join(texts)}"
        found.append(Finding("note", "differences", sentence, signals[k].name))
    apart = [pose for pose in poses if pose.difference > limits.zero * pose.deviation]
    if apart:
        each = []
        for pose in sorted(apart, key=lambda own: -own.difference / own.deviation):
            low, high = (pose.names[int(of(pose.positions))] for of in (np.argmin, np.argmax))
            each.append(
                f"pos.{pose.joint} {text_of(display_units.error(model, pose.joint), pose.difference)} ({low}, {high})"
            )
        found.append(
            Finding(
                "note", "differences", f"before their first commands recordings rest apart, under the same commands: "
                f"{', '.join(dict.fromkeys(each))}: friction, creep, or another zero (--zero-per-trial)", "", "",
                apart[0].difference,
            )
        )  # fmt: skip
    return found


def _odd(values: Sequence[float], limits: CheckLimits) -> Iterator[tuple[list[int], float]]:
    """Places of values far from the median of all, and that; those of 0 say nothing, and two recordings no median."""
    seen = [value for value in values if value > 0]
    if len(seen) < 3:
        return
    middle = float(np.median(seen))
    odd = [k for k, v in enumerate(values) if v > 0 and not 1 / limits.differs < v / middle < limits.differs]
    if odd:
        yield odd, middle
