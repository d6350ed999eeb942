"""docs/formats.md has every key of a diagnosis' record, and no other."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from equimus_ctrl.diagnosis.differences import AnotherUnit, Departure, Difference
from equimus_ctrl.diagnosis.estimates import Estimate, Named
from equimus_ctrl.diagnosis.residuals import ResidualAboveNoise, ResidualForce, ResidualLocation
from equimus_ctrl.diagnosis.results import (
    SETS,
    STATES,
    Decision,
    Detectable,
    Diagnosis,
    Evidence,
    Finding,
    Ranked,
)
from equimus_ctrl.diagnosis.rivals import Missing, Rival, Rivals
from equimus_ctrl.engines.base import Engine
from equimus_ctrl.identification.channels import Channels
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.identification.parameters import FreeParameter

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "formats.md").read_text(encoding="utf-8")
TABLE = PAGE.partition("### The record of a diagnosis\n")[2].partition("\n## ")[0]
ROWS = [row.split(" | ", 1) for row in TABLE.splitlines() if row.startswith("| ")][2:]

WRITERS: tuple[Callable[..., Any], ...] = (
    Diagnosis.to_dict, Diagnosis._groups, Diagnosis._parameters, Finding.to_dict, Ranked.to_dict, Detectable.to_dict,
    ResidualForce.to_dict, ResidualAboveNoise.to_dict, Difference.to_dict, Departure.to_dict,
    AnotherUnit.to_dict, Estimate.to_dict, Named.to_dict, Engine.to_dict, Rivals.to_dict, Rival.to_dict,
)  # fmt: skip
WHOLE = (Evidence, Decision, ResidualLocation, Missing, JointNoise, FreeParameter, Channels)
"""Classes all of whose fields are written."""


def keys(function: Callable[..., Any]) -> set[str]:
    """Of the dictionaries that a function writes down."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    written = (key for node in ast.walk(tree) if isinstance(node, ast.Dict) for key in node.keys)
    return {str(key.value) for key in written if isinstance(key, ast.Constant)}


def named(text: str) -> set[str]:
    return set(re.findall(r"`(\w+)`", text))


def test_every_key_of_the_record_is_in_the_formats() -> None:
    top = keys(Diagnosis.to_dict) | keys(Diagnosis._groups)
    listed = set().union(*(named(key) for key, _ in ROWS if "…" not in key))
    assert len(top) > 25 and listed == top
    inner = set().union(*map(keys, WRITERS), *({own.name for own in fields(kind)} for kind in WHOLE))
    assert sorted(inner - named(TABLE)) == []


def test_the_models_and_sets_of_the_record_are_in_the_formats() -> None:
    assert {*STATES, *SETS} <= named(TABLE)
