"""Smooth forces beside a hypothesis: a law that is not the right one leaves what they explain, the right one nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from named_pendulums import ROBOT, fitted_law
from scipy.interpolate import BSpline

from equimus_ctrl.diagnosis import smooth_laws
from equimus_ctrl.diagnosis.alternatives import without_parts
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters, parameters_of
from equimus_ctrl.diagnosis.residuals import ResidualForce
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.diagnosis.smooth_laws import SHAPES, SmoothLaw, analysed, beside, in_place_of_all, redundant
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.diagnosis.unexplained import GENERALISED, OUTDONE, ResidualAnalysis
from equimus_ctrl.effects import (
    REGISTRY,
    AsymmetricDamping,
    ConstantForce,
    CoulombFriction,
    Effect,
    ParallelSpring,
    PositionDependentFriction,
    QuadraticDamping,
    ViscousFriction,
    register,
)
from equimus_ctrl.effects.smooth import SmoothForce, splines
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.outside import AngleDamping


@dataclass(frozen=True)
class DampingOverAngle(AngleDamping):
    """As no law of the catalogue of MJCF robots."""

    robots = ("mjcf",)


TRUE = ViscousFriction("hinge", 0.08)
OUTSIDE = DampingOverAngle("hinge", 0.15, -0.6, 0.6)
SEVERAL = (
    QuadraticDamping("hinge", 0.03),
    PositionDependentFriction("hinge", 0.1, 0.3, 0.1),
    ParallelSpring("hinge", 1.0, 0.2),
)


def test_splines_are_those_of_scipy_and_sum_to_one_within_their_range() -> None:
    u, low, width = ca.SX.sym("u"), -0.7, 2.1
    own = ca.Function("own", [u], [ca.horzcat(*splines(u, ca.SX(low), ca.SX(width)))])
    step = width / 3
    knots = low + step * np.arange(-3, 7)
    x = np.linspace(low, low + width - 1e-9, 50)
    found = np.vstack([np.array(own(value)) for value in x])
    assert np.allclose(found, BSpline.design_matrix(x, knots, 3).toarray(), atol=1e-12)
    assert np.allclose(np.array(own(low + width + 1)), np.array(own(low + width)))


def test_it_does_nothing_without_coefficients_and_pushes_against_the_speed_with_them() -> None:
    x, rate = ca.SX(0.3), ca.SX(2.0)
    given = {"over_rate": 0.0, "times_rate": 1.0, "low": -1.0, "width": 2.0, "speed": 4.0, "force_scale": 3.0}

    def force(size: float) -> float:
        p = {key: ca.SX(v) for key, v in (dict.fromkeys(SmoothForce.neutral, size) | given).items()}
        return float(SmoothForce.force(x, rate, (), p))

    assert force(0.0) == 0.0
    assert force(0.5) == pytest.approx(-3.0 * 0.5 * 2.0 / 4.0)


def test_given_parameters_are_not_estimated_and_keep_their_places() -> None:
    given = {"over_rate": 0.0, "times_rate": 0.0, "low": -1.0, "width": 2.0, "speed": 1.0, "force_scale": 1.0}
    candidate = Candidate(SmoothForce, ("hinge",), (dict(SmoothForce.neutral),), given=given)
    assert [own.name for own in candidate.parameters] == list(SmoothForce.neutral)
    (effect,) = candidate.attached({**dict(SmoothForce.neutral), "c2": 0.5})
    assert effect.parameters() == {**SmoothForce.neutral, "c2": 0.5, **given}
    assert list(candidate.at(SmoothForce.neutral, "hinge")) == list(SmoothForce.parameter_info())
    assert candidate.alone("hinge").given == given
    part = Part(candidate, dict(SmoothForce.neutral))
    free = default_free_parameters(Model(ROBOT))
    assert len(parameters_of(free, (part,)).free) == len(free.free) + 6


def test_its_name_is_kept() -> None:
    with pytest.raises(ConfigError, match="name is 'smooth_force', which is kept for a diagnosis; expected another"):
        register(SmoothForce)
    assert SmoothForce.name not in REGISTRY


VISCOUS = Candidate(ViscousFriction, ("shoulder", "elbow", "wrist"), (), each=True)
"""Viscous friction with a size of its own at each of three joints."""


def at_three_joints() -> Part:
    return Part(
        VISCOUS, {f"{joint}.damping": size for joint, size in zip(VISCOUS.locations, (0.1, 0.2, 0.3), strict=True)}
    )


@pytest.mark.parametrize(
    ("smooth", "each", "rejected"),
    [
        (["elbow"], True, {(0, "elbow")}),
        (["elbow", "wrist"], True, {(0, "elbow"), (0, "wrist")}),
        (["elbow"], False, set()),  # of one size for all, no joint can be left out
        (["hand"], True, set()),
    ],
)
def test_a_law_with_a_size_at_each_joint_is_rejected_where_a_smooth_force_stands_for_it(
    smooth: Sequence[str], each: bool, rejected: set[tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    part = at_three_joints()
    if not each:
        part = Part(replace(VISCOUS, each=False), {"damping": 0.1})
    fitted: Any = SimpleNamespace(hypothesis=(part,))
    search: Any = SimpleNamespace(data=SimpleNamespace(thresholds=Thresholds()), accepts=lambda simple, rich: False)
    laws = [SmoothLaw(joint, SHAPES[0], fitted, 900.0) for joint in smooth]
    monkeypatch.setattr(smooth_laws, "_not_drawn", lambda *given: 0.5)
    monkeypatch.setattr(smooth_laws, "_without", lambda search, law, k: law.fitted)
    found = redundant(search, SearchState(fitted, fitted), laws)
    assert set(found) == rejected


def test_at_the_other_joints_it_stays() -> None:
    part = at_three_joints()
    analysis = ResidualAnalysis(redundant={0: GENERALISED}, fewer={0: ("shoulder", "wrist")})
    ((gone, reason),) = analysis.rejected((part,)).items()
    assert (gone.candidate.label, gone.values, reason) == ("viscous_friction:elbow", {"damping": 0.2}, GENERALISED)
    known: Any = SimpleNamespace(hypothesis=(part,))
    kept: list[Part] = []
    search: Any = SimpleNamespace(
        refit=lambda tried, fitted, hypothesis: (kept.extend(hypothesis), (known, tried))[1],
        moved=lambda state, fit: state,
    )
    without_parts(search, SearchState(known, known), [0], analysis.fewer)
    (left,) = kept
    assert left.candidate.label == "viscous_friction:shoulder,wrist"
    assert left.values == {"shoulder.damping": 0.1, "wrist.damping": 0.3}


def test_a_joint_whose_law_was_rejected_is_asked_again_beside_those_that_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not where a force is found there to first order."""
    part = at_three_joints().narrowed(("wrist",))
    state: Any = SimpleNamespace(best=SimpleNamespace(hypothesis=(part,)), base=None, without=())
    search: Any = SimpleNamespace(
        data=SimpleNamespace(
            free=SimpleNamespace(
                model=SimpleNamespace(robot=SimpleNamespace(traits=SimpleNamespace(held_in_place=False)))
            )
        )
    )

    def force(joint: str) -> ResidualForce:
        nothing = np.empty(0)
        return ResidualForce(joint, 1.0, (), (joint,), 90.0, 40.0, "N·m", None, "", nothing, nothing, nothing)

    asked: list[set[str]] = []
    monkeypatch.setattr(smooth_laws, "friction_in_place", lambda *given: {})
    monkeypatch.setattr(smooth_laws, "in_place_of_all", lambda *given: {})
    monkeypatch.setattr(smooth_laws, "beside", lambda search, state, split, also: asked.append(set(also)) or ())
    for known in ((), (force("elbow"),)):
        monkeypatch.setattr(smooth_laws, "residual_analysis", lambda *given, known=known: ResidualAnalysis(known))
        analysed(search, state, Split((), ()), [force("elbow")])
    assert asked == [{"elbow"}, set()]


@pytest.mark.slow
def test_a_law_that_depends_on_more_than_it_says_is_redundant_beside_a_smooth_force() -> None:
    search, state, parts = fitted_law(OUTSIDE)
    (law,) = beside(search, state, parts)
    assert (law.joint, law.shape) == ("hinge", SHAPES[2])
    assert list(redundant(search, state, [law])) == [(0, "hinge")]
    analysis = analysed(search, state, parts)
    assert analysis.redundant == {0: GENERALISED}
    (force,) = analysis.unexplained
    assert isinstance(force, ResidualForce)
    assert force.depends_on == "pos.hinge·vel.hinge"
    true = -OUTSIDE.damping * ((force.x - OUTSIDE.centre) / OUTSIDE.width) ** 2
    seen = np.abs(force.x - np.median(force.x)) < 0.3 * np.ptp(force.x)
    assert np.abs(force.force - (true - true.mean()))[seen].max() < 0.1 * np.abs(true).max()
    assert np.all(force.band[seen] > 0)


@pytest.mark.slow
def test_the_right_law_leaves_nothing_that_a_smooth_force_explains() -> None:
    search, state, parts = fitted_law(TRUE)
    assert beside(search, state, parts) == ()
    assert analysed(search, state, parts).redundant == {}


@pytest.mark.slow
def test_a_right_law_that_a_smooth_force_could_draw_stays_beside_what_else_is_missing() -> None:
    search, state, parts = fitted_law(
        TRUE,
        ConstantForce("hinge", 0.1),
        QuadraticDamping("hinge", 0.02),
        named=("viscous_friction:hinge", "constant_force:hinge"),
    )
    (law,) = beside(search, state, parts)
    assert law.shape == SHAPES[1] and redundant(search, state, [law]) == {}
    (force,) = analysed(search, state, parts).unexplained
    assert force.depends_on == "vel.hinge" and force.location == "hinge"


@pytest.mark.slow
@pytest.mark.parametrize(
    "right", [AsymmetricDamping("hinge", 0.1), QuadraticDamping("hinge", 0.05)], ids=lambda effect: effect.name
)
def test_damping_over_the_speed_that_a_smooth_force_could_draw_stays_where_something_else_is_missing(
    right: Effect,
) -> None:
    search, state, parts = fitted_law(right, ConstantForce("hinge", 0.1), named=(f"{right.name}:hinge",))
    (law,) = beside(search, state, parts)
    assert law.shape in SHAPES[:2] and redundant(search, state, [law]) == {}


@pytest.mark.slow
def test_damping_that_hardly_depends_on_the_angle_keeps_its_name() -> None:
    truth = ViscousFriction("hinge", 0.3), DampingOverAngle("hinge", 0.02, 0.0, 0.6)
    search, state, parts = fitted_law(*truth)
    laws = [law for law in beside(search, state, parts) if law.shape.times_rate]
    assert redundant(search, state, laws) == {}


@pytest.mark.slow
def test_dry_friction_in_the_place_of_viscous_friction_is_seen_over_the_speed() -> None:
    search, state, parts = fitted_law(CoulombFriction("hinge", 0.3))
    (law,) = beside(search, state, parts)
    assert law.shape == SHAPES[1]
    assert law.gain > 1000


@pytest.mark.slow
def test_several_laws_that_imitate_one_force_together_give_way_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    search, state, parts = fitted_law(OUTSIDE, named=[f"{law.name}:hinge" for law in SEVERAL])
    ((joint, (law, places)),) = in_place_of_all(search, state, parts).items()
    assert (joint, law.shape, places) == ("hinge", SHAPES[2], [0, 1, 2])
    assert law.fitted.n_parameters <= state.best.n_parameters and search.outdoes(law.fitted, state.best)
    monkeypatch.setattr(smooth_laws, "residual_analysis", lambda *given: ResidualAnalysis())
    analysis = analysed(search, state, parts)
    assert analysis.redundant == dict.fromkeys(range(3), OUTDONE)
    (force,) = analysis.unexplained
    assert isinstance(force, ResidualForce) and force.depends_on == "pos.hinge·vel.hinge"
    assert list(analysis.instead) == ["hinge"] and analysis.instead["hinge"].force is force.force


@pytest.mark.slow
def test_several_right_laws_of_a_joint_stay() -> None:
    search, state, parts = fitted_law(*SEVERAL, named=[f"{law.name}:hinge" for law in SEVERAL])
    assert in_place_of_all(search, state, parts) == {}
    assert OUTDONE not in analysed(search, state, parts).redundant.values()


def test_laws_with_fewer_parameters_than_a_smooth_force_are_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    search, state, parts = fitted_law(TRUE, named=("viscous_friction:hinge", "constant_force:hinge"))
    monkeypatch.setattr(smooth_laws, "fitted_without", None)
    assert in_place_of_all(search, state, parts) == {}
