"""Laws that the torque domain leaves out, and what brings them back; what it explains is given, not computed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from search_on_paper import DEAD, RUB, Known, OnPaper, ended, fitted

from equimus_ctrl.diagnosis import laws_of_forces, smooth_laws, torque_start
from equimus_ctrl.diagnosis.coordinates import Coordinate
from equimus_ctrl.diagnosis.hypothesis import Candidate
from equimus_ctrl.diagnosis.laws_of_forces import with_laws_of_forces
from equimus_ctrl.diagnosis.policy import Thresholds
from equimus_ctrl.diagnosis.residuals import ResidualForce
from equimus_ctrl.diagnosis.smooth_laws import SHAPES
from equimus_ctrl.diagnosis.torque_screening import TorqueFit
from equimus_ctrl.diagnosis.torque_start import not_shown
from equimus_ctrl.effects import REGISTRY

DRAG, WARM, STUCK = (
    Candidate(REGISTRY[name], ("hinge",), ({},)) for name in ("viscous_friction", "friction_warmup", "dahl_friction")
)


@pytest.mark.parametrize(("drag", "warm", "left"), [(5.0, 4.0, [WARM]), (500.0, 4.0, []), (5.0, 400.0, [])])
def test_a_law_left_out_is_simulated_where_torques_show_nothing(
    drag: float, warm: float, left: list[Candidate], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of noise a law explains some 5 too. What torques show of another, or of this one, is taken as it is."""
    fits = {DRAG: TorqueFit(drag, {}), WARM: TorqueFit(warm, {"size": 0.1, "time_constant": 1.0})}
    screen = SimpleNamespace(alone=lambda: fits, missing=1000.0 if drag > 100 else 10.0, robot=None)
    monkeypatch.setattr(torque_start, "torque_screen", lambda *given: screen)
    monkeypatch.setattr(torque_start, "beside", lambda robot, part, hypothesis: hypothesis)
    data: Any = SimpleNamespace(thresholds=Thresholds())
    domain: Any = None
    assert not_shown(data, domain, fitted(0.0), [DRAG, WARM], [WARM]) == left
    assert not_shown(data, domain, fitted(0.0), [DRAG, WARM], [DRAG]) == []


@pytest.mark.parametrize("shown", [True, False])
def test_smooth_forces_are_all_asked_where_torques_do_not_show_what_is_named_either(
    shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(smooth_laws, "shows", lambda *given: shown)
    monkeypatch.setattr(smooth_laws, "_joints", lambda *given: ["hinge"])
    monkeypatch.setattr(smooth_laws, "_candidate", lambda joint, shape, excitation: (joint, shape))
    monkeypatch.setattr(smooth_laws, "excitation_of", lambda *given: {"hinge": None})
    monkeypatch.setattr(smooth_laws, "replace", lambda domain, width: domain)
    nothing = SimpleNamespace(alone=lambda: {("hinge", shape): TorqueFit(1.0, {}) for shape in SHAPES})
    monkeypatch.setattr(smooth_laws, "torque_screen", lambda *given: nothing)
    search: Any = SimpleNamespace(
        data=SimpleNamespace(free=SimpleNamespace(model=None), segments=()),
        torque_domain=SimpleNamespace(width=4.0),
        pool=[],
    )
    asked = list(smooth_laws._asked_for(search, fitted(0.0), fitted(0.0, RUB), ()))
    assert len(asked) == (0 if shown else len(SHAPES))


def force(*kinds: str, at: str = "hinge") -> ResidualForce:
    coordinates, nothing = tuple(Coordinate(kind, at) for kind in kinds), np.empty(0)  # type: ignore[arg-type]
    return ResidualForce(at, 1.0, coordinates, (at,), 90.0, 40.0, "N·m", None, "", nothing, nothing, nothing)


@pytest.mark.parametrize(
    ("unexplained", "tried", "torques", "asked"),
    [
        (force("time", "vel"), (), True, [WARM]),
        (force("vel"), (), True, [STUCK]),  # viscous friction has no equations of its own, and is simulated anyway
        (force("time", "vel", at="elbow"), (), True, []),
        (force("time", "vel"), (WARM,), True, []),  # once is enough
        (force("time", "vel"), (), False, []),  # without torques none was left out
    ],
)
def test_a_residual_force_asks_for_a_law_over_just_what_it_depends_on(
    unexplained: ResidualForce, tried: tuple[Candidate, ...], torques: bool, asked: list[Candidate]
) -> None:
    end: Any = SimpleNamespace(tried=SimpleNamespace(fitted=[SimpleNamespace(candidates=tried)]))
    search: Any = SimpleNamespace(
        torque_domain=object() if torques else None, allowed_candidates=lambda tried: [DRAG, WARM, STUCK]
    )
    assert laws_of_forces._asked_for(search, end, (unexplained,)) == asked


@pytest.mark.parametrize(("gain", "labels"), [(500.0, {RUB, DEAD}), (5.0, {RUB}), (None, {RUB})])
def test_the_law_is_taken_where_it_is_accepted(
    gain: float | None, labels: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    known = Known({(): 5000.0, (RUB,): 1000.0, (RUB, DEAD): 1000.0 - (gain or 0.0), (DEAD,): 4000.0})
    search, end = OnPaper(known), ended(known, RUB)
    asked = [] if gain is None else [Candidate(REGISTRY["dead_zone"], ("baa",), ())]
    monkeypatch.setattr(laws_of_forces, "_asked_for", lambda *given: asked)
    monkeypatch.setattr(laws_of_forces, "_fits", lambda search, best, asked: [known(RUB, DEAD)] if asked else [])
    after = with_laws_of_forces(search, end, ())
    assert after.best.labels == labels
    assert (after is end) == (gain is None)
    assert (known(RUB, DEAD) in after.tried.fitted) == (gain is not None)
