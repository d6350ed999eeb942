"""At the end of a search: other laws in a part's place, from where they imitate it, and what makes up for a part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded
from search_on_paper import DEAD, FULL, OFF, RUB, STICK, Known, OnPaper, ended

from equimus_ctrl.diagnosis import extensions, imitators
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.compensation import compensated
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.diagnosis.imitators import imitations, outdoes, with_imitators
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.effects import ConstantForce, FrictionWarmup, ParallelSpring
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

MANY = SearchSettings(many_minima=True)
TWO = {(): 5000.0, (OFF,): 3000.0, (DEAD,): 3000.0, (FULL,): 4000.0, (OFF, DEAD): 1000.0, (FULL, DEAD): 900.0}
NOMINAL = Model(MjcfRobot("arm", PENDULUM.format(drive=MOTOR)))


def data_of(real: Model) -> Data:
    segments = split(NOMINAL, recorded(real, count=2)).train
    return Data(default_free_parameters(NOMINAL), segments, Simulator(engine_for(NOMINAL), 1))


def part(law: type, **values: float) -> Part:
    return Part(Candidate(law, ("hinge",), (values,)), values)


def test_the_rest_of_a_spring_makes_up_for_a_constant_force_that_is_left_out() -> None:
    """F + k(r − x) = k(r + F/k − x)."""
    data = data_of(NOMINAL)
    force, spring = part(ConstantForce, size=0.5), part(ParallelSpring, stiffness=0.25, rest=-1.0)
    starts = [s.start for s in data.segments]
    whole = data.coarse_fit((force, spring), [(data.theta_of(data.free.start, (force, spring)), starts)],
                            data.nominal_fit().noise, 0)  # fmt: skip
    theta = compensated(data, whole, whole.hypothesis[1:])
    assert theta is not None
    assert theta == pytest.approx([*data.free.start, 0.25, 1.0], rel=1e-3, abs=1e-4)
    alone = data.coarse_fit((spring,), [(theta, starts)], whole.noise, 0)
    for one, other in zip(alone.fit.residuals, whole.fit.residuals, strict=True):
        assert np.allclose(one, other, atol=1e-4)
    assert compensated(data, whole, whole.hypothesis) is None
    assert compensated(data, whole, (part(ParallelSpring, stiffness=0.25, rest=0.0),)) is None


@pytest.mark.parametrize(
    ("stick", "dimensions", "taken"),
    [(986.0, 3, False), (985.0, 3, True), (991.0, 1, False), (989.0, 1, True)],
    ids=["three parameters", "worth them", "one dimension, chance", "one dimension"],
)
def test_a_law_is_taken_by_its_parameters_or_clearly_by_its_dimensions(
    stick: float, dimensions: int, taken: bool
) -> None:
    """Two more parameters cost 2 ln 1000 = 13.8."""
    known = Known({(): 5000.0, (RUB,): 1000.0, (STICK,): stick})
    search = OnPaper(known, MANY)
    search.data.dimensions = lambda fitted, k, most: dimensions  # type: ignore[misc, method-assign]
    assert outdoes(search, known(STICK), known(RUB)) == taken
    assert not (taken and outdoes(search, known(RUB), known(STICK)))


@pytest.mark.parametrize(
    ("two", "alone", "named"),
    [(1000.0, 1500.0, {RUB, DEAD}), (1020.0, 1500.0, {STICK}), (1000.0, 3000.0, {STICK})],
    ids=["better", "worse", "the first of them gains too little"],
)
def test_two_simple_laws_take_the_place_of_one_that_draws_a_little_of_each(
    two: float, alone: float, named: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three parameters against two: 6.9 more by Schwarz."""
    known = Known({(): 5000.0, (STICK,): 1010.0, (RUB,): alone, (DEAD,): 4000.0, (RUB, DEAD): two})
    monkeypatch.setattr(imitators, "imitations", lambda search, state, k: [])
    assert with_imitators(OnPaper(known, MANY), ended(known, STICK)).best.labels == named


def test_what_is_not_needed_beside_an_imitator_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    fits = {(): 5000.0, (OFF,): 3000.0, (DEAD,): 3000.0, (FULL,): 990.0, (OFF, DEAD): 1000.0, (FULL, DEAD): 985.0}
    known = Known({**fits, (FULL, OFF): 989.0})

    def imitated(search: Search, state: SearchState, k: int) -> Sequence[Fitted]:
        return [known(FULL, DEAD)] if state.best.labels == {OFF, DEAD} and k == 0 else []

    monkeypatch.setattr(imitators, "imitations", imitated)
    assert with_imitators(OnPaper(known, MANY), ended(known, OFF, DEAD)).best.labels == {FULL}
    assert with_imitators(OnPaper(known), ended(known, OFF, DEAD)).best.labels == {OFF, DEAD}


def test_what_else_could_be_is_not_asked_of_what_the_scatter_hides(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imitators, "imitations", lambda search, state, k: [known(FULL, DEAD)] if k == 0 else [])
    for lost, best in (((), {FULL, DEAD}), ((OFF,), {OFF, DEAD}), ((DEAD,), {FULL, DEAD})):
        known = Known(TWO, lost=lost)
        assert with_imitators(OnPaper(known, MANY), ended(known, OFF, DEAD)).best.labels == best


def test_what_else_could_be_is_not_asked_of_what_makes_validation_trials_worse(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known(TWO)
    monkeypatch.setattr(imitators, "imitations", lambda search, state, k: [known(FULL, DEAD)] if k == 0 else [])
    for worse, validation, best in (
        ((), [1], {FULL, DEAD}), ((OFF,), [1], {OFF, DEAD}), ((DEAD,), [1], {FULL, DEAD}), ((OFF,), [], {FULL, DEAD})
    ):  # fmt: skip

        class There:
            def __init__(self, *given: object) -> None: ...

            def gain(self, simple: Fitted, rich: Fitted, worse: Sequence[str] = worse) -> float:
                return -17.0 if (rich.labels - simple.labels) & set(worse) else -15.0

        monkeypatch.setattr(extensions, "HoldoutResiduals", There)
        held_out: Any = SimpleNamespace(validation=validation)
        search = OnPaper(known, MANY)
        object.__setattr__(search, "held_out", held_out)
        assert with_imitators(search, ended(known, OFF, DEAD)).best.labels == best


def test_what_is_fitted_only_to_be_listed_is_not_tried_on_held_out_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    known = Known({(): 5000.0, (RUB,): 1000.0, (DEAD,): 1005.0})
    monkeypatch.setattr(imitators, "imitations", lambda search, state, k: [known(DEAD)])
    tried = with_imitators(OnPaper(known, MANY), ended(known, RUB)).tried
    assert tried.imitations == (known(DEAD),) and known(DEAD) not in tried.fitted


@pytest.mark.slow
def test_a_law_is_fitted_in_the_place_of_one_that_stands_for_it() -> None:
    real = replace(NOMINAL, effects=(FrictionWarmup("hinge", 0.1, 2.0),))
    data = data_of(real)
    search = Search(data, candidates(NOMINAL, data.segments), MANY)
    base = data.base()
    (viscous,) = (c for c in search.pool if c.label == "viscous_friction:hinge")
    best, _ = search.refit(SearchState(base, base).tried, base, (Part(viscous, {"damping": 0.05}),))
    end = with_imitators(search, SearchState(base, best, (base,), ((),)))
    assert end.best.labels == {"friction_warmup:hinge"}
    values = end.best.hypothesis[0].values
    assert values["size"] == pytest.approx(0.1, rel=0.05) and values["time_constant"] == pytest.approx(2.0, rel=0.1)
    labels = {fit.hypothesis[-1].candidate.label for fit in imitations(search, end, 0)}
    assert "friction_warmup:hinge" not in labels and "viscous_friction:hinge" in labels
