"""Dry friction of any size over the angle: what imitates it gives way to it, and a true friction law stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest
from named_pendulums import fitted_law

from equimus_ctrl.diagnosis import friction_over_angle
from equimus_ctrl.diagnosis.friction_over_angle import friction_in_place, knots_about, knots_of, largest
from equimus_ctrl.diagnosis.residuals import ResidualForce
from equimus_ctrl.diagnosis.smooth_laws import analysed, analysed_without, without_redundant
from equimus_ctrl.diagnosis.unexplained import GENERALISED, ResidualAnalysis
from equimus_ctrl.effects import (
    REGISTRY,
    CoulombFriction,
    Effect,
    PositionDependentFriction,
    StribeckFriction,
    ViscousFriction,
    register,
)
from equimus_ctrl.effects.smooth import SmoothFriction
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.statics import rest_poses
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.proof.outside import RoughSpot
from equimus_ctrl.types import Array

KNOTS = tuple(f"x{k}" for k in range(1, len(SmoothFriction.neutral) + 1))


@dataclass(frozen=True)
class RoughHinge(RoughSpot):
    """As no law of the catalogue of MJCF robots."""

    robots = ("mjcf",)


SPOT = RoughHinge("hinge", 0.5, 0.1, 0.15)


def friction(joint: str, x: Array, sizes: Array, scale: float = 1.0) -> SmoothFriction:
    given = dict(zip(KNOTS, map(float, x), strict=True)) | dict(
        zip(SmoothFriction.neutral, map(float, sizes), strict=True)
    )
    return SmoothFriction(joint, **given, force_scale=scale)


def test_its_size_is_linear_between_knots_and_that_of_the_nearest_beyond() -> None:
    rng = np.random.default_rng(0)
    x, sizes = np.cumsum(rng.uniform(0.01, 0.5, len(KNOTS))), rng.uniform(0, 2, len(KNOTS))
    p = {key: ca.SX(value) for key, value in friction("hinge", x, sizes, 3.0).parameters().items()}
    for at in rng.uniform(x[0] - 1, x[-1] + 1, 50):
        own = float(SmoothFriction.dry_friction(ca.SX(at), ca.SX(2.0), p))
        assert own == pytest.approx(3 * np.interp(at, x, sizes))


def test_its_name_is_kept() -> None:
    with pytest.raises(ConfigError, match="name is 'smooth_friction', which is kept for a diagnosis; expected another"):
        register(SmoothFriction)
    assert SmoothFriction.name not in REGISTRY


def test_a_leg_has_it_in_motion_and_at_rest() -> None:
    """As Coulomb friction where it is the same everywhere, though the catalogue of its compiled equations has it not."""
    leg, even = nominal_model(), np.full(len(KNOTS), 0.5)
    other = friction("hip", np.linspace(1.4, 1.7, len(KNOTS)), even, 0.04)
    time = np.arange(0, 1.5, 0.01)
    pressure = 2e4 + 1e4 * np.sin(2 * np.pi * np.column_stack([time, 0.7 * time]))
    start = np.array([1.55, 0.4])
    trial = Trial("t", time, pressure, pressure[0], 0.0, start, time)
    found = [
        simulate([replace(leg, effects=(effect,))], [trial], threads=1)[0].position[0]
        for effect in (CoulombFriction("hip", 0.02), other)
    ]
    assert np.ptp(found[0][:, 0]) > 0.01
    assert np.allclose(*found, atol=1e-9)
    held = [
        rest_poses(replace(leg, effects=(effect,)), pressure[:3], np.tile(start, (3, 1)))
        for effect in (CoulombFriction("hip", 0.02), other)
    ]
    assert np.allclose(held[0].position, held[1].position, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_knots_are_where_the_samples_are_and_nowhere_far_apart(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.normal(0.3, 1e-3, 900), rng.uniform(-2, 2, 100)])
    knots = knots_of(x, 12)
    low, high = np.quantile(x, friction_over_angle.COVERED)
    assert (knots[0], knots[-1]) == (pytest.approx(low), pytest.approx(high))
    gaps = np.diff(knots)
    assert np.all(gaps > 0) and gaps.max() < 2.2 * (high - low) / 11
    assert np.sum(np.abs(knots - 0.3) < 0.1) >= 5
    assert np.all(np.diff(knots_of(np.full(50, 0.7), 12)) > 0)


def test_knots_come_closer_together_where_the_friction_is() -> None:
    sizes = np.array([0.4, 0.0, 0.1, 0.3, 0.2, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.1])
    assert largest(sizes)[0] in (7, 8) and len(largest(sizes)) == friction_over_angle.PEAKS
    assert largest(np.zeros(12)) == []
    for centre in (-15.0, -2.0, 0.1, 1.2):
        knots = knots_about(centre, 0.05, -15.0, 1.2, 12)
        assert np.all(np.diff(knots) > 0) and (knots[0], knots[-1]) == (-15.0, 1.2)
        at = int(np.argmin(np.abs(knots - centre)))
        assert knots[at] == centre
        assert all(abs(knots[k] - centre) < 0.1 for k in (at - 1, at + 1) if 0 <= k < 12)


@pytest.mark.slow
def test_a_law_that_imitates_a_rough_spot_gives_way_to_it() -> None:
    search, state, parts = fitted_law(SPOT, named=("stribeck_friction:hinge",))
    assert state.without[0].deviance - state.best.deviance > 100
    ((k, found),) = friction_in_place(search, state, parts).items()
    assert k == 0 and found.joint == "hinge" and found.gain > 100
    told = found.told(search)
    assert told.x[np.argmin(told.force)] == pytest.approx(SPOT.centre, abs=SPOT.width / 2)
    assert told.force.min() == pytest.approx(-SPOT.friction, rel=0.25) and told.force.max() <= 0
    far = np.abs(told.x - SPOT.centre) > 3 * SPOT.width
    assert np.all(np.abs(told.force[far]) < 0.05 * SPOT.friction)
    assert analysed(search, state, parts).redundant == {0: GENERALISED}
    analysis = ResidualAnalysis((told,), {0: GENERALISED}, instead={"hinge": told})
    end, dropped = without_redundant(search, state, analysis)
    assert [gone.candidate.label for gone in dropped] == ["stribeck_friction:hinge"] and not end.best.hypothesis
    left = analysed_without(search, end, parts, analysis)
    (force,) = left.unexplained
    assert isinstance(force, ResidualForce) and force.x is told.x
    assert told.depends_on == "pos.hinge·sign(vel.hinge)" and told.location == "hinge"


@pytest.mark.slow
@pytest.mark.parametrize(
    "truth",
    [
        (CoulombFriction("hinge", 0.2),),
        (StribeckFriction("hinge", 0.15, 0.3, 0.2),),
        (PositionDependentFriction("hinge", 0.3, 0.2, 0.1),),
        (ViscousFriction("hinge", 0.1), SPOT),
    ],
    ids=lambda truth: truth[0].name,
)
def test_true_laws_stay(truth: Sequence[Effect]) -> None:
    """Damping beside a rough spot too: friction over the angle in its place does not gain more."""
    search, state, parts = fitted_law(*truth, named=(f"{truth[0].name}:hinge",))
    assert friction_in_place(search, state, parts) == {}
