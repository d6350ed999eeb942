"""The numbers that decide: all of them told, with where they are asked, and varied without another line."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2, norm

from equimus_ctrl.diagnosis.fitting import CONVERGED_GAIN
from equimus_ctrl.diagnosis.other_numbers import other_numbers
from equimus_ctrl.diagnosis.thresholds import Thresholds

DIAGNOSIS = Path(__file__).resolve().parents[1] / "equimus_ctrl" / "diagnosis"
TOLD = {"blocks", "far_off"}
"""Thresholds that are read for a report too."""
TELLS = {"findings", "initial_states", "units_compared", "smooth_laws", "friction_over_angle", "search_stage"}
"""Modules that tell the acceptance threshold beside a gain."""
PROGRESS = {"OTHER_SHARE", "SEARCH_SHARE", "ROUNDS"}
"""Numbers of these names in ``stages`` and ``refit`` divide the progress that is told."""


@cache
def sources() -> dict[str, ast.Module]:
    return {path.stem: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(DIAGNOSIS.glob("*.py"))}


def thresholds_read() -> Iterator[tuple[str, str, bool]]:
    """Module, threshold, and whether it is asked of a condition's ``t``, wherever the sources read one."""
    names = {t.name for t in Thresholds.listed()}
    for module, tree in sources().items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.Attribute) or node.attr not in names or module == "policy":
                continue
            of = node.value.id if isinstance(node.value, ast.Name) else getattr(node.value, "attr", "")
            if of in ("t", "thresholds"):
                yield module, node.attr, of == "t"


def test_every_number_says_what_it_decides_and_where_it_comes_from() -> None:
    told = list(Thresholds.listed())
    assert len(told) == len({t.name for t in told}) > 20
    for one in told:
        assert getattr(Thresholds(), one.name) == one.value > 0
        assert len(one.meaning.split()) > 5 and one.origin.why
        if one.origin.basis == "calibration":
            assert "benchmarks/thresholds.py" in one.origin.why


def test_theory_gives_the_numbers_that_it_is_said_to_give() -> None:
    thresholds = Thresholds()
    least = 20.0  # about the least gain of one parameter over the candidates of a leg
    assert chi2.isf(thresholds.significance / 100, 1) == pytest.approx(least, abs=1.0)
    lowest = least + norm.ppf(0.05) * 2 * least**0.5
    assert thresholds.validation_share == pytest.approx(lowest / least, abs=0.03)
    assert thresholds.uninformative == pytest.approx((2 * 2) ** 2)
    assert (
        chi2.isf(thresholds.significance / 40, 8)
        < thresholds.residual_gain
        < 1.2 * chi2.isf(thresholds.significance / 40, 8)
    )
    assert chi2.isf(0.0025, 2) == pytest.approx(thresholds.colour, abs=0.1)
    assert norm.isf(0.05) == pytest.approx(thresholds.worse_by_chance, abs=0.01)
    assert thresholds.exchange == 2 * CONVERGED_GAIN
    assert (1 + thresholds.far_off) ** 0.5 == 2.0 and thresholds.step_matters < thresholds.simulation_error


def test_decisions_are_told_to_whoever_varies_the_numbers() -> None:
    seen = []

    def watch(condition: object, holds: bool) -> None:
        thresholds = Thresholds()
        flips = {
            (t.name, f)
            for t in Thresholds.listed()
            for f in (0.5, 2.0)
            if condition(thresholds.scaled(t.name, f)) != holds
        }  # type: ignore[operator]
        seen.append(flips)

    thresholds = Thresholds(watch=watch)
    assert thresholds.decides(lambda t: t.validation_share <= 0.3)
    assert not thresholds.decides(lambda t: t.residual_gain < 3.0)
    assert seen == [{("validation_share", 2.0)}, set()]
    assert thresholds.scaled("trace", 2.0).trace == 0.02 and thresholds.scaled("trace", 2.0).watch is watch
    assert thresholds == Thresholds() and repr(thresholds) == repr(Thresholds())


def test_where_each_number_is_asked_is_told() -> None:
    asked = {(module, name) for module, name, _ in thresholds_read()}
    assert asked == {(module, t.name) for t in Thresholds.listed() for module in t.where}


def test_what_is_not_asked_but_read_is_known() -> None:
    """Whoever varies the numbers has to do everything again with these, for no decision shows what they do."""
    unasked = {name for _, name, is_asked in thresholds_read() if not is_asked}
    assert unasked - TOLD == {t.name for t in Thresholds.listed() if t.read}
    for module, tree in sources().items():
        calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "attr", "") == "threshold"]
        assert module in TELLS or all(len(call.args) == 2 for call in calls), module


def is_number(value: object) -> bool:
    if isinstance(value, tuple | dict):
        return all(map(is_number, value.values() if isinstance(value, dict) else value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def named_numbers(module: str) -> Iterator[str]:
    """Names in capitals that a module of the diagnosis gives to numbers."""
    values = vars(importlib.import_module(f"equimus_ctrl.diagnosis.{module}"))
    for node in sources()[module].body:
        targets = node.targets if isinstance(node, ast.Assign) else []
        for target in targets:
            for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(name, ast.Name) and name.id.isupper() and is_number(values[name.id]):
                    yield name.id


def test_other_numbers_are_those_of_the_code() -> None:
    told = list(other_numbers())
    assert len({(n.module, n.name) for n in told}) == len(told)
    for one in told:
        there = getattr(importlib.import_module(f"equimus_ctrl.{one.module}"), one.name)
        assert one.decides and (there == one.value or np.array_equal(there, one.value)), one


@pytest.mark.parametrize("module", sorted(set(sources()) - {"__init__"}))
def test_no_number_of_the_diagnosis_is_untold(module: str) -> None:
    told = {n.name for n in other_numbers() if n.module == f"diagnosis.{module}"}
    untold = set(named_numbers(module)) - told
    assert untold <= (PROGRESS if module in ("stages", "refit") else set()), f"{module}: {untold}"
