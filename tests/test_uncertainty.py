"""Intervals of identified parameters hold what they promise, and say what the data do not tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from identified_leg import FEW, TRUE, poses_of, small_problem, trial, values

from equimus_ctrl.engines.predict import predict
from equimus_ctrl.engines.trials import Predicted
from equimus_ctrl.identification.fit import Fit, fit
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.identification.simulators import simulator_for
from equimus_ctrl.identification.step_error import with_step_error
from equimus_ctrl.identification.uncertainty import correlation_time, uncertainty
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array
from equimus_ctrl.workflow import identify_poses, identify_recordings


def refit(noise: list[Array]) -> Fit:
    start, segments = small_problem()
    noisy = [replace(s, measured=s.measured + n) for s, n in zip(segments, noise, strict=True)]
    return fit(free_parameters(start, FEW), noisy)


def coloured(rng: np.random.Generator, shape: tuple[int, int], memory: float) -> Array:
    """Noise of 2 mrad whose neighbours correlate by ``memory``."""
    white = rng.normal(0, 1, shape)
    out = white.copy()
    for k in range(1, len(out)):
        out[k] = memory * out[k - 1] + np.sqrt(1 - memory**2) * white[k]
    return 0.002 * out


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "each", "all_together"), [(0.0, 34, 107), (0.8, 30, 96)])
def test_intervals_hold_what_they_promise(memory: float, each: int, all_together: int) -> None:
    """Of 40 draws Binomial(40, 0.95) covers fewer than 34 in less than 1 % of cases; colour costs a little."""
    rng = np.random.default_rng(17)
    _, segments = small_problem()
    inside, widths = [], []
    for _ in range(40):
        done = refit([coloured(rng, s.measured.shape, memory) for s in segments])
        inside.append(np.abs(done.theta - values(TRUE, FEW)) <= done.uncertainty.half_width)
        widths.append(done.uncertainty.half_width / np.std(done.residuals[0]))
        samples = sum(r.size for r in done.residuals)
        share = done.uncertainty.effective_samples / samples
        assert share > 0.6 if memory == 0 else share < 0.4
    count = np.sum(inside, axis=0)
    assert count.min() >= each and count.sum() >= all_together, count
    assert np.all(np.array(widths) < np.inf)


def test_correlation_time_of_an_autoregression() -> None:
    rng = np.random.default_rng(3)
    for memory in (0.0, 0.5, 0.8):
        series = [coloured(rng, (4000, 2), memory) for _ in range(3)]
        assert correlation_time(series) == pytest.approx((1 + memory) / (1 - memory), rel=0.15)


def test_the_interval_of_a_mean_is_students() -> None:
    """One parameter that shifts everything: the textbook's interval of a mean."""
    rng = np.random.default_rng(1)
    x = rng.normal(0, 1, (400, 1))
    known = uncertainty([np.ones((400, 1, 1))], [x - x.mean()], [np.zeros((400, 1, 0))], ["a"], np.ones(1), np.ones(1))
    assert known.half_width[0] == pytest.approx(1.966 * x.std(ddof=1) / 20, rel=0.02)


def test_the_interval_of_a_common_slope_beside_an_intercept_for_each_run_is_students() -> None:
    """Two runs of five and four samples, a line through each: 9 − 1 − 2 degrees of freedom (Draper & Smith, 1998)."""
    size, runs = 0.01, [np.array([0.0, 1.0, 2.0, 4.0, 7.0]), np.array([0.0, 3.0, 4.0, 5.0])]
    found = uncertainty(
        [x[:, None, None] for x in runs],
        # Of one size and alternating: the sandwich is the textbook's s²(XᵀX)⁻¹, and each residual counts as one.
        [size * (-1.0) ** np.arange(len(x))[:, None] for x in runs],
        [np.ones((len(x), 1, 1)) for x in runs],
        ["slope"], np.ones(1), np.ones(1),
    )  # fmt: skip
    spread = sum(((x - x.mean()) ** 2).sum() for x in runs)
    error = np.sqrt(9 * size**2 / 6 / spread)
    assert found.effective_samples == 9
    assert found.standard_error[0] == pytest.approx(error, rel=1e-9)
    assert found.half_width[0] == pytest.approx(2.446912 * error, rel=1e-6), "Student's t at 0.975 for 6"


def test_the_steps_error_widens_intervals_by_what_parameters_would_make_good_of_it() -> None:
    """An engine whose coarser step does what another stiffness does, and one whose coarser step diverges."""
    start, segments = small_problem()
    found = fit(free_parameters(start, FEW), segments)
    own, change, ratio = simulator_for(start), 0.02, 3.0

    def coarser(models: Sequence[Model], given: Sequence[Segment], starts: Sequence[Array]) -> list[Predicted]:
        stiffness = models[0].parameters()["maa.stiffness"] + change
        return own([models[0].with_parameters({"maa.stiffness": stiffness})], given, starts)

    def diverging(models: Sequence[Model], given: Sequence[Segment], starts: Sequence[Array]) -> list[Predicted]:
        found = own(models, given, starts)  # numbers after a divergence mean nothing
        return [replace(p, position=p.position + 1.0, reached=np.full_like(p.reached, 3)) for p in found]

    more = {
        name: with_step_error(found, segments, own, other, ratio).uncertainty.half_width - found.uncertainty.half_width  # type: ignore[arg-type]
        for name, other in (("coarser", coarser), ("diverging", diverging))
    }
    # By C·h of its own step, half of C·h·(3 − 1), it may be wrong.
    assert more["coarser"] / found.parameters.scale == pytest.approx(
        np.array([0.0, change / 2, 0.0]) / found.parameters.scale, abs=0.02 * change / found.parameters.scale[1]
    )
    assert not more["diverging"].any()


def test_without_pressure_the_areas_cannot_be_seen() -> None:
    recorded = trial(((0, 0),), notes={"settled": "no"})
    moved = replace(recorded, position=recorded.position + np.array([0.1, -0.1]))
    moving = replace(moved, position=predict(TRUE, moved))
    done = identify_recordings([moving], TRUE, free=["maa.area", "maa.stiffness", "baa.area"], folds=0)
    width = dict(zip(done.fit.parameters.names, done.fit.uncertainty.half_width, strict=True))
    assert np.isinf(width["maa.area"]) and np.isinf(width["baa.area"]) and np.isfinite(width["maa.stiffness"])
    blind = [t for t in done.fit.uncertainty.trade_offs if t.correlation is None]
    assert sorted(name for t in blind for name in t.weights) == ["baa.area", "maa.area"] and len(blind) == 2
    assert str(blind[0]).endswith("is not identifiable from these data")
    assert done.fit.theta == pytest.approx(values(TRUE, done.fit.parameters.names), rel=1e-6), "they stay"
    rows = {row["name"]: row for row in done.to_dict()["parameters"]}
    assert rows["maa.area"]["low"] is None and rows["maa.stiffness"]["low"] is not None
    nan = np.isnan(done.fit.uncertainty.correlation)
    assert nan.sum() == 8, "all but the stiffness with itself"


def test_forces_are_known_up_to_a_common_factor_only() -> None:
    """Poses at rest do not change when every stiffness, area and weight is doubled."""
    names = ["maa.stiffness", "baa.stiffness", "maa.area", "baa.area", "gravity"]
    done = identify_poses(poses_of(TRUE), TRUE, free=names)
    assert np.all(np.isinf(done.fit.uncertainty.half_width))
    (blind,) = [t for t in done.fit.uncertainty.trade_offs if t.correlation is None]
    assert set(blind.weights) == set(names)
    assert list(blind.weights.values()) == pytest.approx([1.0] * 5, rel=1e-3)
    assert "at once makes no difference at all" in str(blind) and "+10 %" in str(blind)


def test_a_strong_trade_off_is_told_with_its_direction() -> None:
    """Stiffness and rest length of a spring whose length hardly changes: k·(l − l0) is what is seen."""
    small = [trial(((10e3, 5e3), (10.5e3, 5.2e3)), noise=1e-4)]
    done = identify_recordings(small, TRUE, free=["maa.stiffness", "maa.rest_length"], folds=0)
    (trade,) = done.fit.uncertainty.trade_offs
    assert trade.correlation is not None and abs(trade.correlation) > 0.9
    kinematics = Kinematics(TRUE.morphology)
    length = kinematics.lengths(small[0].position.mean(axis=0))[0]
    spring = TRUE.parameters()["maa.rest_length"]
    expected = (length - spring) / spring  # d l0 / l0 for d k / k = 1 at a constant k·(l − l0)
    ratio = trade.weights["maa.rest_length"] / trade.weights["maa.stiffness"]
    assert ratio == pytest.approx(expected, rel=0.1)
    assert "makes hardly any difference (correlation" in str(trade)
