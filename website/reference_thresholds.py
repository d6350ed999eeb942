"""The page of thresholds, from the policies that ask them."""

from __future__ import annotations

from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.preflight.limits import CheckLimits


def page() -> str:
    """All numbers that accept or reject something, with meaning, unit and origin."""
    parts = [
        "# Thresholds",
        "The numbers by which `diagnose` accepts or rejects, and by which `check` speaks up; "
        "`equimus-ctrl list thresholds` says the same. "
        "How answers depend on them: [the proof](../evidence/proof_thresholds.md).",
    ]
    for title, listed in (("Diagnosis", Thresholds.listed()), ("Check of recordings", CheckLimits.listed())):
        rows = [
            f"| `{t.name}`<br>{f'{t.value:g} {t.unit}'.rstrip()} | {_cell(t.meaning)} | "
            f"{_cell(f'{t.origin.basis}: {t.origin.why}')} |"
            for t in listed
        ]
        parts += [f"## {title}", "\n".join(["| name, value | meaning | origin |", "| --- | --- | --- |", *rows])]
    return "\n\n".join(parts) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("*", "\\*")
