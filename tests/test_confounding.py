"""Effects beside residual forces: what is confounded with one is rejected, what is true stays whatever else is missing."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.diagnosis import unexplained
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.explained_variance import explained
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.diagnosis.residual_force import discard_unstable, linearise_fit
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory
from equimus_ctrl.diagnosis.unexplained import ResidualAnalysis, residual_analysis, select_forces
from equimus_ctrl.effects.base import REGISTRY, Effect, parse
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.proof.leg_simulation import recordings, simulate
from equimus_ctrl.proof.legs import draw
from equimus_ctrl.proof.outside import CrossSpring, Leak, PressureGrowth
from equimus_ctrl.types import Array


def left(
    effects: tuple[Effect, ...], outside: tuple[Effect, ...], named: dict[str, dict[str, float]]
) -> tuple[tuple[str, ...], ResidualAnalysis]:
    """Labels of what is fitted to a concealed leg, and what remains."""
    drawn = draw(20, 4, kind="none", trials=6, duration=6.0)
    ground_truth = replace(drawn, effects=effects, outside=outside)
    model = nominal_model()
    segments = cut(model, recordings(ground_truth, simulate(ground_truth, 480.0)), fit_start=True)
    data = Data(default_free_parameters(model), segments, reduced_simulator(threads=2))
    pool = {c.label: c for c in candidates(model, segments)}
    base = data.base()
    search = Search(data, list(pool.values()))
    best, tried = search.refit(
        SearchHistory(), base, tuple(Part(pool[label], values) for label, values in named.items())
    )
    parts = best.hypothesis
    without = [search.refit(tried, best, parts[:k] + parts[k + 1 :])[0] for k in range(len(parts))]
    return tuple(part.candidate.label for part in parts), residual_analysis(data, base, best, without)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("outside", "label", "values"),
    [
        (Leak("maa", share=0.05), "sensor_scale:knee", {"scale": 1.05}),
        (PressureGrowth("baa", growth=2e-3), "narrowing_area:baa", {"loss": -0.2}),
        (CrossSpring("hip", stiffness=0.1), "joint_stop:knee", {"angle": 0.4, "stiffness": 0.3, "damping": 0.01}),
    ],
    ids=lambda value: value.name if isinstance(value, Effect) else "",
)
def test_an_effect_that_is_confounded_with_a_residual_force_is_redundant(
    outside: Effect, label: str, values: dict[str, float]
) -> None:
    labels, rest = left((), (outside,), {label: values})
    assert labels == (label,) and set(rest.redundant) == {0}


LEAK = (Leak("maa", share=0.05),)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "values", "outside"),
    [
        ("joint_stop:knee:angle=0.15,stiffness=50,damping=0.5", (0.15, 50.0, 0.5), LEAK),
        ("joint_stop:knee:angle=0.14,stiffness=3.2,damping=0.045", (0.14, 3.0, 0.05), ()),
        ("joint_stop:hip:angle=1.6,stiffness=2.0,damping=0.045", (1.6, 1.9, 0.05), ()),
        ("sensor_scale:knee:scale=1.05", (1.05,), ()),
        ("coulomb_friction:knee:friction=0.01", (0.01,), LEAK),
    ],
    ids=[
        "hard stop beside a leak",
        "soft stop",
        "stop softer than the joint itself",
        "scale",
        "friction and leak",
    ],
)
def test_a_true_effect_is_not(text: str, values: tuple[float, ...], outside: tuple[Effect, ...]) -> None:
    effect = parse(text)
    label = f"{effect.name}:{effect.location}"
    labels, rest = left((effect,), outside, {label: dict(zip(effect.parameters(), values, strict=True))})
    assert labels == (label,)
    assert not rest.redundant
    assert bool(rest.unexplained) == bool(outside)


@pytest.mark.slow
def test_what_a_bound_holds_back_takes_no_part_of_a_residual() -> None:
    """A damping below all that it may be: to first order the parameter itself would cross its bound and explain it."""
    drawn = draw(20, 4, kind="none", trials=4, duration=5.0)
    model = nominal_model()
    free = default_free_parameters(model)
    place = free.names.index("knee.damping")
    little = drawn.robot.with_parameters({"knee.damping": 0.2 * free.low[place]})
    ground_truth = replace(drawn, robot=little)
    segments = cut(model, recordings(ground_truth, simulate(ground_truth, 480.0)), fit_start=True)
    data = Data(free, segments, reduced_simulator(threads=1))
    base = data.base()
    at = linearise_fit(data, base, base.noise)
    assert at is not None and at.whitened_fit.held is not None
    assert [name for name, held in zip(free.names, at.whitened_fit.held, strict=True) if held] == ["knee.damping"]
    columns = at.columns[[(own.location, own.depends_on) for own in at.families].index(("knee", "vel.knee"))]

    def gain(slopes: Array) -> float:
        return explained(at.whitened_fit.residual, Nuisance.of(slopes), columns).gain

    least = data.thresholds.residual_gain
    assert 2 * gain(at.whitened_fit.slopes) < least < 0.5 * gain(at.whitened_fit.movable)
    selected = select_forces(data, at, 0.0)
    assert selected[0].candidate.family.joints == ("knee",)


def test_responses_that_grew_without_bound_are_discarded() -> None:
    good, bad = np.full((4, 2, 1), 0.3), np.full((4, 2, 1), 0.2)
    wild = np.array([0.0, 1e3, 1e12, np.inf])[:, None, None] * np.ones((1, 2, 1))
    lost = np.where(np.isinf(wild), np.nan, 0.0)
    first = np.concatenate([good, wild, bad, lost], axis=2)
    second = np.concatenate([good, good, bad, good], axis=2)
    for told, given in zip(discard_unstable([first, second]), (first, second), strict=True):
        np.testing.assert_array_equal(told[:, :, [0, 2]], given[:, :, [0, 2]])
        np.testing.assert_array_equal(told[:, :, [1, 3]], 0.0)


@pytest.mark.parametrize(
    ("bounds", "rejected"),
    [
        ([0, 0, 0, 0, 0], []),
        ([0, 0, 0, 1, 0], [0]),
        ([1, 0, 0, 0, 0], []),
        ([0, 0, -1, 0, 0], []),
        ([0, 0, 0, -1, 0], [0]),
    ],
    ids=["all have a name", "the other at its bound", "itself alone", "no damping is none", "the other at its lower"],
)
def test_a_strained_law_is_believed_only_where_all_beside_it_has_a_name(
    bounds: list[int], rejected: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = Candidate(REGISTRY["joint_stop"], ("hip",), ())
    stiffening = Candidate(REGISTRY["nonlinear_stiffness"], ("maa",), ())
    parts = tuple(Part(own, {p.name: 1.0 for p in own.parameters}) for own in (stop, stiffening))
    assert [p.name for own in parts for p in own.candidate.parameters] == [
        "angle", "stiffness", "damping", "cubic", "centre"
    ]  # fmt: skip
    fit: Any = SimpleNamespace(at_bound=np.array([0, *bounds]))
    best = Fitted(parts, fit, None, 0.0)  # type: ignore[arg-type]
    traits = SimpleNamespace(held_in_place=False)
    data: Any = SimpleNamespace(
        free=SimpleNamespace(free=[None], model=SimpleNamespace(robot=SimpleNamespace(traits=traits)))
    )
    monkeypatch.setattr(unexplained, "_fall", lambda *given: 0.0)
    monkeypatch.setattr(unexplained, "_degenerate", lambda *given: [0])
    at: Any = SimpleNamespace(fitted=best, noise=())
    found = unexplained.redundant_parts(data, at, [best, best], 0.0, [])
    assert list(found) == rejected and all(reason == unexplained.DEGENERATE for reason in found.values())
