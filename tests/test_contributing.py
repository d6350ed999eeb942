"""What CONTRIBUTING.md and docs/diagnosis.md list of the code is all of it, and there."""

from __future__ import annotations

import re

import pytest
from test_imports import ROOT, imported, modules

from equimus_ctrl.diagnosis.stages import STAGES

PAGE = (ROOT.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
FILE = r"`((?:\w+/)+\w+\.py)`"
READ = re.findall(FILE, PAGE.partition("\n## From recordings to the page\n")[2])
"""Files to be opened by who follows a diagnosis, under ``equimus_ctrl/``."""
LISTED = ("cli", "options", "workflow", "diagnosis", "identification", "engines", "report")
"""Parts of the package of which all is listed that a diagnosis runs through; of what these rest on some alone."""


def is_diagnosis(module: str) -> bool:
    return module.startswith(("diagnosis.", "report.diagnosis_")) or module in ("cli.diagnose", "workflow.diagnoses")


def file_of(module: str) -> str:
    return f"{module.replace('.', '/')}.py"


def test_the_files_that_contributing_names_are_there() -> None:
    named = re.findall(FILE, PAGE)
    assert len(named) > 20
    assert not [name for name in named if not (ROOT / name).is_file() and not (ROOT.parent / name).is_file()]


@pytest.mark.slow
def test_all_that_a_diagnosis_runs_through_is_to_be_read_once() -> None:
    """The modules of a diagnosis, and whatever of the parts listed one of them imports."""
    own = {module for module in modules() if is_diagnosis(module)}
    used = {target for module in own for target, _ in imported(module) if target.partition(".")[0] in LISTED}
    files = {file_of(module) for module in own | used if (ROOT / file_of(module)).is_file()}
    assert len(files) > 80
    assert sorted(files - set(READ)) == []
    assert sorted({name for name in READ if READ.count(name) > 1}) == []


@pytest.mark.parametrize(("page", "between"), [("CONTRIBUTING.md", " → "), ("docs/diagnosis.md", ", ")])
def test_the_stages_are_listed_in_their_order(page: str, between: str) -> None:
    text = " ".join((ROOT.parent / page).read_text(encoding="utf-8").split())
    assert between.join(("refit", *STAGES, "report")) in text
