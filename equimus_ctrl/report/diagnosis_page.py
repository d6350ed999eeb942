"""A diagnosis as one page: HTML that needs nothing else, its figures within."""

from __future__ import annotations

import math
from html import escape

import numpy as np
from matplotlib.figure import Figure

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.diagnosis.residuals import ResidualForce
from equimus_ctrl.diagnosis.results import SETS, Diagnosis
from equimus_ctrl.identification.results import together
from equimus_ctrl.report import diagnosis_splits, diagnosis_text
from equimus_ctrl.report.diagnosis_figures import WORDS, diagnosis_figures, summary_figure
from equimus_ctrl.report.diagnosis_next import next_steps
from equimus_ctrl.report.diagnosis_panels import Scene
from equimus_ctrl.report.diagnosis_units import departures, differing, parameter, unit_answer
from equimus_ctrl.report.diagnosis_words import (
    coordinates_text,
    estimate_text,
    interval_digits,
    interval_text,
    number,
    percent,
    power_of_ten,
    quantity,
    reading,
    short,
)
from equimus_ctrl.report.html import CSS, figure_html, grouped_html, list_html, table_html

METHOD = (
    "The noise of each joint, white and coloured, is estimated from the residuals. A gain is the fall of −2 log "
    "likelihood under it.",
    "Every effect of the catalogue is screened at every place by the component of its response that is orthogonal to "
    "the Jacobian of the parameters, unless inverse dynamics along the measured motion leave it far behind. The best "
    "are fitted by simulation together with all parameters, in sets, forward, backward and exchanged.",
    "An effect is accepted only where its gain exceeds the threshold for the best of all candidates and stands out "
    "from the scatter of the residuals, where validation trials confirm it, where inverse dynamics along the measured "
    "motion show it as far as there are any, and where no unstructured residual force explains as much.",
    "The remaining residuals are searched for generalised forces that depend on what moves, on commands or on time. "
    "Intervals are of 95 %; nominal is the model before refitting.",
)
"""What is done after the refit, see ``_method``."""


def page(diagnosis: Diagnosis, title: str, command_line: str = "") -> str:
    """The page as text.

    Args:
        diagnosis: what was found.
        title: of the page.
        command_line: with which it was made, "" where there was none.
    """
    figures = diagnosis_figures(diagnosis)
    narrow = summary_figure(diagnosis, Scene.of(diagnosis), narrow=True)
    parts = [
        ("size", "Size of the residuals", _size(diagnosis)),
        ("where", "Localization", _where(diagnosis, figures)),
        ("findings", "Missing physics", _findings(diagnosis, figures)),
        ("splits", "Other splits of the trials", _splits(diagnosis, figures)),
        ("units", "Units", _units(diagnosis)),
        ("trials", "Before and after", _before_after(diagnosis, figures)),
        ("unexplained", "Unexplained residuals", _unexplained(diagnosis, figures)),
        ("rejected", "Rejected effects", _rejected(diagnosis)),
        ("confounded", "Not distinguishable", _not_distinguishable(diagnosis)),
        ("parameters", "Model parameters", _parameters(diagnosis)),
        ("candidates", "All candidates", _candidates(diagnosis, figures)),
        ("detectable", "Smallest detectable sizes", _detectable(diagnosis)),
        ("decisions", "What was decided, stage by stage", _decisions(diagnosis)),
        ("method", "Method", _method(diagnosis)),
        ("provenance", "Provenance", _provenance(diagnosis, command_line)),
        ("next", "What to do next", _next(diagnosis, command_line)),
    ]
    kept = [(key, head, body) for key, head, body in parts if body]
    found = diagnosis_text.grouped(diagnosis.findings)
    told = (diagnosis_text.law_sentence(law, diagnosis.model) for law in found)
    summary = " ".join([diagnosis_text.verdict(diagnosis), *told])
    links = "".join(f'<a href="#{key}">{escape(head)}</a>' for key, head, _ in kept)
    hanging = diagnosis_splits.undecided(diagnosis)
    unsure = f"<p>{escape(hanging)}</p>\n" if hanging else ""
    notes = "".join(f"<p>Note: {escape(note)}</p>" for note in diagnosis.notes)
    sections = "\n".join(
        f'<section id="{key}">\n<h2>{escape(head)}</h2>\n{body}\n</section>' for key, head, body in kept
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{escape(title)}</title>\n'
        f"<style>{CSS}</style>\n</head>\n<body>\n<header>\n<h1>{escape(title)}</h1>\n"
        f'<p class="faint">{escape(diagnosis_text.trials(diagnosis))}</p>\n'
        f'<p class="verdict {escape(diagnosis.verdict)}">{escape(diagnosis_text.verdict(diagnosis))}</p>\n'
        f"{unsure}<p>{escape(diagnosis_text.headline(diagnosis))}</p>\n"
        f"<p>{escape(diagnosis_text.held_out(diagnosis))}</p>\n{notes}\n"
        f"<nav>{links}</nav>\n{figure_html(figures['summary'], summary, narrow)}\n</header>\n<main>\n{sections}\n"
        f"</main>\n</body>\n</html>\n"
    )


def _size(diagnosis: Diagnosis) -> str:
    """The size of the residuals of each state of the model, joint by joint."""
    text, *_ = diagnosis_text.against_noise(diagnosis)
    shown = [display_units.error(diagnosis.model, joint) for joint in diagnosis.joints]
    factors, alike = np.array([u.factor for u in shown]), len({u.unit for u in shown}) == 1
    states, parts = diagnosis_text.states(diagnosis), [part for part in SETS if getattr(diagnosis, part)]
    groups = [(diagnosis_text.PARTS[part], [WORDS[state] for state in states]) for part in parts]
    sizes = [diagnosis.rmse(state, part) * factors for part in parts for state in states]
    sigma = diagnosis.sigma * factors
    rows = [
        (joint if alike else f"{joint} [{unit.unit}]", *(number(v[j]) for v in sizes), number(float(sigma[j])))
        for j, (joint, unit) in enumerate(zip(diagnosis.joints, shown, strict=True))
    ]
    if alike and len(rows) > 1:
        noise = math.sqrt(float((sigma**2).mean()))
        rows.append(("all joints", *(number(together(v)) for v in sizes), number(noise)))
    colour = [
        f"{joint}: {number(own.white * u.factor)} {u.unit} white, {number(own.coloured * u.factor)} {u.unit} "
        f"correlated over {number(own.time * 1e3)} ms"
        for joint, own, u in zip(diagnosis.joints, diagnosis.noise, shown, strict=True)
        if own.coloured > 0
    ]
    coloured = f"<p>The noise is coloured, as fitted to the residuals.</p>{list_html(colour)}" if colour else ""
    if any(own.sigma > size for own, size in zip(diagnosis.noise, diagnosis.sigma, strict=True)):
        coloured += "<p>Second differences of the residuals allow no more noise than the table has.</p>"
    first = f"RMSE in {shown[0].unit}" if alike else "RMSE"
    channels = list_html(diagnosis_text.of_channels(diagnosis)) if diagnosis.channels else ""
    return f"<p>{escape(text)}</p>{grouped_html(first, [*groups, ('noise', [''])], rows)}{coloured}{channels}"


def _where(diagnosis: Diagnosis, figures: dict[str, Figure]) -> str:
    lines = diagnosis_text.where(diagnosis) if diagnosis.verdict != "consistent" else []
    alt = "Size and mean of the errors against time since a step, angle, speed and commands, joint by joint"
    return list_html(lines) + figure_html(figures["residuals"], alt)


def _findings(diagnosis: Diagnosis, figures: dict[str, Figure]) -> str:
    if not diagnosis.findings:
        return ""
    model, found = diagnosis.model, diagnosis_text.grouped(diagnosis.findings)
    rows, several = [], len(found) > 1
    for law in found:
        e = law.findings[0].evidence
        gains = (number(e.gain), number(e.threshold), power_of_ten(e.log10_p_value), number(e.validation_gain))
        alone = [diagnosis_text.share_alone(s) for s in (e.share_alone, e.validation_share_alone)] if several else []
        rows.append((short(law.named, model), *gains, *alone, percent(e.share), percent(e.validation_share)))
    groups = [("−2 log likelihood", ["gain", "threshold", "p-value", "gain in validation"])]
    if several:
        groups.append(("explained alone", ["fitted", "validation"]))
        whole = percent(diagnosis.explained("train")), percent(diagnosis.explained("validation"))
        rows.append(("all together", *[""] * 6, *whole))
    groups.append(("explained beside the others" if several else "explained", ["fitted", "validation"]))
    shown = []
    for law in found:
        text = diagnosis_text.law_sentence(law, model)
        sizes = table_html(*diagnosis_text.by_place(law)) if len(law.findings) > 1 else ""
        figure = figure_html(figures[f"finding_{law.first + 1}"], f"Curves of {short(law.named, model)}: {text}")
        shown.append(f"<h3>{escape(text)}</h3>{sizes}{figure}")
    explained = (
        '<p class="faint">Gain: fall of −2 log likelihood with the effect, everything else free without it. Explained: '
        "share of the excess residual variance (mean squared residual above the noise variance).</p>"
    )
    together = f"<p>{escape(text)}</p>" if (text := diagnosis_text.together(diagnosis)) else ""
    sentences = [diagnosis_text.law_sentence(law, model) for law in found]
    return f"{list_html(sentences)}{grouped_html('effect', groups, rows)}{together}{explained}{''.join(shown)}"


def _units(diagnosis: Diagnosis) -> str:
    """What differs between groups of trials and from the nominal model."""
    body = list_html(differing(diagnosis))
    groups = diagnosis.groups
    if diagnosis.differences:
        rows = [
            (parameter(d), *("not seen" if own is None else estimate_text(own) for own in d.values.values()))
            for d in diagnosis.differences
        ]
        body += table_html(("parameter", *groups), rows)
    if answer := unit_answer(diagnosis):
        body += f"<p>{escape(answer)}</p>{list_html(departures(diagnosis))}"
    return body


def _splits(diagnosis: Diagnosis, figures: dict[str, Figure]) -> str:
    """What other splits of the trials say."""
    if diagnosis.splits is None:
        return ""
    splits = diagnosis.splits
    body = f"<p>{escape(diagnosis_splits.head(splits))}.</p>"
    if len(splits.answers) > 1:
        if "splits" in figures:
            alt = "The first size of each effect with its interval, split by split; grey where a split does not name it"
            body += figure_html(figures["splits"], alt) + table_html(*diagnosis_splits.of_effects(splits), text=2)
        else:
            body += "<p>No split names an effect.</p>"
        note = "Of joints: the augmented model's error on held-out trials over the refitted one's."
        body += table_html(*diagnosis_splits.of_splits(splits), text=2) + f'<p class="faint">{note}</p>'
    return body + list_html(diagnosis_splits.beside(splits))


def _before_after(diagnosis: Diagnosis, figures: dict[str, Figure]) -> str:
    which = "test" if diagnosis.test else "validation" if diagnosis.validation else "fitted"
    text = f"<p>The {which} trials with the largest residuals of the refitted model.</p>"
    alt = "Measured and predicted angles, residuals and commands of the trials with the largest residuals"
    return text + figure_html(figures["before_after"], alt)


def _unexplained(diagnosis: Diagnosis, figures: dict[str, Figure]) -> str:
    body = list_html(diagnosis_text.remains(diagnosis))
    for k, residual in enumerate(diagnosis.unexplained):
        figure = figures.get(f"unexplained_{k + 1}")
        if figure and isinstance(residual, ResidualForce) and residual.axis:
            against = coordinates_text([residual.axis], diagnosis.model)
            body += figure_html(figure, f"Unstructured residual force at {residual.location}, against {against}")
    return body


def _decisions(diagnosis: Diagnosis) -> str:
    if not diagnosis.decisions:
        return ""
    rows = [
        (f"{d.stage}, other trials held out" if d.other_holdout else d.stage, d.decision, d.reason)
        for d in diagnosis.decisions
    ]
    return table_html(("stage", "decision", "reason"), rows, 3)


def _rejected(diagnosis: Diagnosis) -> str:
    if not diagnosis.rejected:
        return ""
    text = "<p>Each was part of a hypothesis until a stage spoke against it.</p>"
    rows = [(short(own.named, diagnosis.model), own.stage, own.reason) for own in diagnosis.rejected]
    return text + table_html(("effect", "stage", "reason"), rows, 3)


def _not_distinguishable(diagnosis: Diagnosis) -> str:
    return list_html(diagnosis_text.not_distinguishable(diagnosis))


def _parameters(diagnosis: Diagnosis) -> str:
    base, fit, nominal = diagnosis.base.fit, diagnosis.best.fit, diagnosis.model.parameters()
    rows = []
    for i, free in enumerate(base.parameters.free):
        scale = reading(free.unit, free.start)
        value, width = float(fit.theta[i]), float(fit.uncertainty.half_width[i])
        low, high = value - width, value + width
        if math.isfinite(width):
            low, high = max(low, free.low), min(high, free.high)
        interval = value * scale.factor, low * scale.factor, high * scale.factor
        digits = interval_digits(*interval)
        columns = [nominal[free.name], float(base.theta[i]), value][: len(diagnosis_text.states(diagnosis))]
        before = (number(v * scale.factor, digits) for v in columns)
        held = {-1: "low", 0: "", 1: "high"}[int(fit.at_bound[i])]
        rows.append((free.label, scale.unit, *before, interval_text(*interval), held))
    head = ("parameter", "unit", *(WORDS[s] for s in diagnosis_text.states(diagnosis)), "95 % interval", "at bound")
    return table_html(head, rows, 2)


def _candidates(diagnosis: Diagnosis, figures: dict[str, Figure]) -> str:
    if not diagnosis.ranking:
        return ""
    model, found = diagnosis.model, diagnosis_text.grouped(diagnosis.findings)
    marks = {own.named: f"rejected ({own.stage})" for own in diagnosis.rejected}
    marks |= {
        other: f"not distinguishable from {short(law.named, model)}"
        for law in found
        for other in law.findings[0].equivalent
    }
    marks |= {diagnosis_text.candidate_of(law): "found" for law in found}
    rows = [
        (
            str(k + 1),
            short(r.named, model),
            marks.get(r.named, ""),
            number(r.screened),
            "" if r.fitted is None else number(r.fitted),
        )
        for k, r in enumerate(diagnosis.ranking)
    ]
    text = "<p>Gain of each as the only effect: expected to first order, and fitted where promising.</p>"
    picture = figure_html(figures["ranking"], "Gain of each of the best candidates; the table has the same values")
    head = ("", "effect", "note", "first order", "fitted")
    kept: list[tuple[tuple[str, ...], bool]] = []
    folded: list[tuple[tuple[str, ...], bool]] = []
    for row, ranked in zip(rows, diagnosis.ranking, strict=True):
        promising = max(ranked.screened, ranked.fitted or 0.0) >= ranked.threshold
        (kept if promising or ranked.named in marks else folded).append((row, marks.get(ranked.named) == "found"))
    shown = [
        table_html(head, [row for row, _ in part], 3, [k for k, (_, strong) in enumerate(part) if strong])
        for part in (kept, folded)
        if part
    ]
    if folded:
        beside = "others, whose gain is" if kept else "candidates, the gain of all of them"
        shown[-1] = (
            f"<details><summary>{len(folded)} {beside} below the acceptance threshold</summary>{shown[-1]}</details>"
        )
    return text + picture + "".join(shown)


def _detectable(diagnosis: Diagnosis) -> str:
    rows = diagnosis_text.detectables(diagnosis)
    if not rows:
        return ""
    beside = " beside what was found" if diagnosis.findings else ""
    text = f"<p>An effect of this size, its other parameters at median values, would be accepted{beside}.</p>"
    return text + table_html(("effect", "smallest size"), rows, 2)


def _method(diagnosis: Diagnosis) -> str:
    """How it was done; the refit by whole trials or by multiple shooting, as the trials were cut."""
    length = diagnosis.interval
    how = (
        f"multiple shooting over intervals of {quantity(length, 's', 2)}, each from an initial state of its own"
        if length is not None
        else "simulating each trial fitted as a whole"
    )
    refit = (
        f"All parameters to estimate are refitted first, by {how}. Everything else is measured against this refitted "
        "model, so that a wrong stiffness is not called friction."
    )
    return f"<ol>{''.join(f'<li>{escape(line)}</li>' for line in (refit, *METHOD))}</ol>"


def _provenance(diagnosis: Diagnosis, command_line: str) -> str:
    rows = [("model", diagnosis.model.name)]
    if diagnosis.model.robot.traits.has_stance:
        rows.append(("phase", diagnosis.model.phase))
    for words, segments in (
        ("trials fitted", diagnosis.train),
        ("validation trials", diagnosis.validation),
        ("test trials", diagnosis.test),
    ):
        names = {s.recording: s.recording_name for s in segments}
        rows.append((words, ", ".join(names.values()) or "none"))
    carried = [f"{e.name} at {e.location}" for e in diagnosis.model.effects]
    if carried:
        rows.append(("effects of the nominal model", ", ".join(carried)))
    rows.append(("samples fitted", str(sum(len(s.measured) for s in diagnosis.train))))
    rows.append(("time taken", f"{diagnosis.seconds:.1f} s"))
    shown = f"<p>Made with</p><pre>{escape(command_line)}</pre>" if command_line else ""
    return table_html(("", ""), rows, 2) + shown


def _next(diagnosis: Diagnosis, command_line: str) -> str:
    """What a person can do now, each with the command that does it."""
    steps = (
        f"<li>{escape(text)}{f'<pre>{escape(command)}</pre>' if command else ''}</li>"
        for text, command in next_steps(diagnosis, command_line)
    )
    return f"<ol>{''.join(steps)}</ol>"
