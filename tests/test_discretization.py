"""When the physics step is to blame, with deviances that are given instead of simulated."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import pytest
from search_on_paper import DEAD, POOL, RUB, Known, OnPaper, ended

from equimus_ctrl.diagnosis import discretization
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.unexplained import ResidualAnalysis
from equimus_ctrl.engines.base import Discretisation

LEFT = ResidualAnalysis(unexplained=(object(),))  # type: ignore[arg-type]
"""Something that nothing named explains."""
NEEDED, NEEDLESS, WORSE = (
    {(): 4900.0, (RUB,): 950.0},
    {(): 951.0, (RUB,): 950.0},
    {(): 4900.0, (RUB,): 1200.0},
)
"""Deviances without the step's error: the friction explains as much as before, nothing, or it fits far worse."""


def changed(one: Any, **values: Any) -> Any:
    plain = isinstance(one, SimpleNamespace)
    return SimpleNamespace(**{**vars(one), **values}) if plain else dataclasses.replace(one, **values)


def without_step_error(
    known: Known, fine: Known, before: ResidualAnalysis, after: ResidualAnalysis, monkeypatch: pytest.MonkeyPatch
) -> discretization.WithoutStepError | None:
    search = OnPaper(known)
    engine = SimpleNamespace(discretisation=Discretisation(0.004, 8), without_step_error=lambda: "exact")
    data: Any = search.data
    data.simulator, data.coarse = SimpleNamespace(engine=engine), None
    data.converge_finely = lambda fitted: fine(*fitted.labels)
    monkeypatch.setattr(discretization, "replace", changed)
    monkeypatch.setattr(discretization, "Search", lambda *given, **more: OnPaper(fine))
    monkeypatch.setattr(discretization, "_parts_of_the_step", lambda *given: [0])
    monkeypatch.setattr(discretization, "analysed", lambda *given: after)
    monkeypatch.setattr(discretization, "analysed_without", lambda *given: ResidualAnalysis())
    return discretization.without_step_error(search, ended(known, *max(known.of, key=len)), before, Split((), ()))


@pytest.mark.parametrize(
    ("exactly", "before", "after", "effects"),
    [
        (NEEDED, LEFT, LEFT, None),  # nothing less is missing
        (NEEDED, LEFT, ResidualAnalysis(), {RUB}),
        (NEEDED, ResidualAnalysis(), ResidualAnalysis(), None),  # nothing was, and the effect stays
        (NEEDLESS, ResidualAnalysis(), ResidualAnalysis(), set()),
        (NEEDLESS, LEFT, LEFT, set()),
        (WORSE, LEFT, ResidualAnalysis(), None),  # the robot does as with that step
    ],
)
def test_a_step_is_to_blame_where_less_is_missing_without_its_error(
    exactly: dict[tuple[str, ...], float],
    before: ResidualAnalysis,
    after: ResidualAnalysis,
    effects: set[str] | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known, fine = Known({(): 5000.0, (RUB,): 1000.0}), Known(exactly)
    found = without_step_error(known, fine, before, after, monkeypatch)
    if effects is None:
        assert found is None
    else:
        assert found is not None and found.end.best.labels == effects and found.analysis is after
        assert "The physics step of the XML, 4 ms, is too long" in found.sentence and "with 0.5 ms" in found.sentence


def test_what_residual_forces_make_redundant_without_the_steps_error_is_rejected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    deviances = {(): 9000.0, (RUB,): 5000.0, (DEAD,): 4900.0, (RUB, DEAD): 950.0}
    known, fine = Known({**deviances, (RUB, DEAD): 1000.0}), Known(deviances)
    found = without_step_error(known, fine, LEFT, ResidualAnalysis(redundant={0: "restated"}), monkeypatch)
    assert found is not None and found.end.best.labels == {DEAD}
    assert [(part.candidate.label, reason) for part, reason in found.rejected.items()] == [(RUB, "restated")]
    assert not found.end.tried.allows([POOL[RUB]])
