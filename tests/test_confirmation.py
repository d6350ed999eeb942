"""Held-out trials: what gets worse there is rejected, and a fit that says nothing of them has failed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pendulum_runs import MOTOR, PENDULUM, recorded

from equimus_ctrl.diagnosis.confirmation import (
    Confirmation,
    _makes_worse,
    _needless,
    carried_over,
    confirms,
    least_confirmed,
)
from equimus_ctrl.diagnosis.fitting import Data, chi_squared
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.holdout_residuals import HoldoutResiduals
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.diagnosis.stages import _failed
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.effects.force import CoulombFriction
from equimus_ctrl.identification.noise import JointNoise, white_noise
from equimus_ctrl.identification.simulators import simulator_for
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

SIGMA = 0.01


def segment(recording: int, start: float, count: int = 100, kind: str = "abcd") -> Any:
    times = start + 0.01 * np.arange(count)
    trial = SimpleNamespace(sample_times=times)
    return SimpleNamespace(
        recording=recording, recording_name=f"{kind[recording]}_{recording}", trial=trial, outputs=np.zeros((count, 1))
    )


class Given(HoldoutResiduals):
    """Residuals of models that are their own names."""

    def __init__(self, segments: list[Any], of: dict[str, list[np.ndarray]]) -> None:
        state: Any = SimpleNamespace(best=SimpleNamespace(noise=(JointNoise(SIGMA),)))
        super().__init__(SimpleNamespace(), SimpleNamespace(validation=segments), state)  # type: ignore[arg-type]
        self._known = of  # type: ignore[assignment]


def fit(model: str) -> Any:
    return SimpleNamespace(fit=SimpleNamespace(model=model))


def noisy(seed: int, count: int = 100, size: float = SIGMA) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, size, (count, 1))


SEARCH: Any = SimpleNamespace(data=SimpleNamespace(thresholds=Thresholds()))


def test_halves_are_halves_of_recordings_whatever_the_intervals() -> None:
    segments = [segment(0, 0.0), segment(0, 1.0), segment(0, 2.0), segment(3, 0.0)]
    names, halves = Given(segments, {}).halves
    assert names == [f"the {which} half of {k}" for k in ("a_0", "d_3") for which in ("first", "second")]
    counts = [sum(len(range(*rows.indices(100))) for _, rows in half) for half in halves]
    assert counts == [150, 150, 50, 50]


def test_recordings_of_a_kind_are_judged_together() -> None:
    """Names alike up to a digit; each is halved at its own middle."""
    segments = [segment(k, 1.0 * k, count, "rrxx") for k, count in ((0, 100), (1, 50), (2, 80))]
    names, halves = Given(segments, {}).halves
    assert names == [f"the {which} half of {whose}" for whose in ("each r", "x_2") for which in ("first", "second")]
    assert [[(k, *rows.indices(100)[:2]) for k, rows in half] for half in halves[:2]] == [
        [(0, 0, 50), (1, 0, 25)],
        [(0, 50, 100), (1, 25, 100)],
    ]


def test_a_part_that_extrapolates_wrongly_is_the_one_that_is_told() -> None:
    """The drift explains the first half of the run and spoils the second; the friction helps in both."""
    segments = [segment(0, 0.0), segment(0, 1.0)]
    wrong = 0.06 * np.ones((100, 1))
    of = {
        "base": [noisy(1) + 0.05, noisy(2) + 0.03],
        "both": [noisy(1), noisy(2) + wrong],
        "friction alone": [noisy(1) + 0.02, noisy(2)],
        "drift alone": [noisy(1) + 0.03, noisy(2) + 1.3 * wrong],
    }
    state: Any = SimpleNamespace(
        base=fit("base"), best=fit("both"), without=(fit("drift alone"), fit("friction alone"))
    )
    found = _makes_worse(SEARCH, Given(segments, of), state)
    assert found is not None
    place, said = found
    assert place == 1 and said.reason == "worse" and said.where == "the second half of a_0"
    assert said.found == pytest.approx((0.06**2 + SIGMA**2) / (0.03**2 + SIGMA**2), rel=0.1)
    assert "the second half of a_0 has" in str(said) and "the refitted model" in str(said)


def test_what_differs_by_chance_is_no_reason() -> None:
    segments = [segment(0, 0.0), segment(0, 1.0)]
    of = {
        "base": [noisy(1) + 0.05, noisy(2)],
        "best": [noisy(1), noisy(2) + 0.002],
        "less": [noisy(1) + 0.05, noisy(2)],
    }
    state: Any = SimpleNamespace(base=fit("base"), best=fit("best"), without=(fit("less"),))
    assert _makes_worse(SEARCH, Given(segments, of), state) is None


def test_where_no_part_is_to_blame_none_is_told() -> None:
    """All are worse without any part: the parameters of the model are."""
    segments = [segment(0, 0.0), segment(0, 1.0)]
    worse = noisy(2) + 0.05
    of = {"base": [noisy(1), noisy(2)], "best": [noisy(1), worse], "less": [noisy(1), 2 * worse]}
    state: Any = SimpleNamespace(base=fit("base"), best=fit("best"), without=(fit("less"),))
    assert _makes_worse(SEARCH, Given(segments, of), state) is None


def test_what_gained_beside_a_rejected_part_alone_is_not_needed() -> None:
    """A part without which the fit is better has no gain that held-out trials could confirm."""
    search: Any = SimpleNamespace(accepts=lambda simple, rich: simple.deviance - rich.deviance > 40.0)
    best, better, worse = scored("best", 100.0), scored("without it", 20.0), scored("without the other", 500.0)
    state: Any = SimpleNamespace(best=best, without=(worse, better))
    assert _needless(search, state) == 1
    assert _needless(search, SimpleNamespace(best=best, without=(worse,))) is None  # type: ignore[arg-type]
    assert _needless(search, SimpleNamespace(best=best, without=())) is None  # type: ignore[arg-type]


def scored(model: str, deviance: float) -> Any:
    return SimpleNamespace(fit=SimpleNamespace(model=model), deviance=deviance)


def test_a_gain_on_held_out_trials_is_the_fall_of_chi_squared_and_counts_by_sample() -> None:
    """Gauss's likelihood: −2 ln L of white noise falls by Σ(r₁² − r₂²)/σ²; half as many samples are to show half."""
    segments = [segment(0, 0.0), segment(1, 0.0)]
    of = {"simple": [noisy(1) + 0.02, noisy(2) + 0.01], "rich": [noisy(1), noisy(2)]}
    holdout = Given(segments, of)
    holdout.data = SimpleNamespace(n=400)  # type: ignore[assignment]
    simple, rich = scored("simple", 900.0), scored("rich", 100.0)
    fall = sum(((a**2).sum() - (b**2).sum()) / SIGMA**2 for a, b in zip(of["simple"], of["rich"], strict=True))
    assert holdout.gain(simple, rich) == pytest.approx(fall)
    assert holdout.carried_over(simple, rich) == pytest.approx(fall / (800.0 * 200 / 400))
    assert holdout.distance(simple, rich) == pytest.approx(100 * (0.02**2 + 0.01**2) / SIGMA**2)
    nothing = Given([], {"simple": [], "rich": []})
    assert np.isnan(nothing.gain(simple, rich))


@pytest.mark.parametrize(
    ("same_kind", "gain", "distance", "deviance", "reason", "ratio"),
    [
        (True, 300.0, 400.0, 1000.0, "gain", 0.3),
        (True, 100.0, 400.0, 1000.0, "gain", 0.1),
        # Held-out trials of another kind show less of it: what they can show counts.
        (False, 100.0, 400.0, 1000.0, "distance", 0.25),
        (False, 100.0, 1000.0, 1000.0, "distance", 0.1),
        # They cannot show it at all; it is far above the least gain, or it is not.
        (False, 1.0, 15.0, 1000.0, "evident", np.inf),
        (False, 1.0, 15.0, 90.0, "uninformative", 1 / 90),
    ],
)
def test_what_held_out_trials_hardly_show_is_measured_by_what_they_can(
    same_kind: bool, gain: float, distance: float, deviance: float, reason: str, ratio: float
) -> None:
    traits = SimpleNamespace(same_kind_of_trials=same_kind)
    model = SimpleNamespace(robot=SimpleNamespace(traits=traits))
    data = SimpleNamespace(thresholds=Thresholds(), free=SimpleNamespace(model=model))
    search: Any = SimpleNamespace(data=data, threshold=lambda more, t: 20.0)
    holdout: Any = SimpleNamespace(
        gain=lambda *fits: gain,
        distance=lambda *fits: distance,
        own_distance=lambda *fits: distance,
        carried_over=lambda *fits: gain / deviance,
    )
    one, two = (SimpleNamespace(deviance=d, n_parameters=1) for d in (deviance, 0.0))
    found = carried_over(search, holdout, one, two)  # type: ignore[arg-type]
    assert (found.reason, found.found) == (reason, pytest.approx(ratio))


def test_what_a_part_alone_shows_is_seen_with_all_else_as_it_is() -> None:
    """The same model without its friction, though the fit without friction has other masses."""
    nominal = Model(MjcfRobot("arm", PENDULUM.format(drive=MOTOR)))
    parts = split(nominal, recorded(Model(nominal.robot, [CoulombFriction("hinge", 0.05)]), seed=3), shoot=2.0)
    data = Data(default_free_parameters(nominal), parts.train, simulator_for(nominal))
    starts = [s.start for s in parts.train]
    friction = Part(Candidate(CoulombFriction, ("hinge",), ({"friction": 0.04},)), {"friction": 0.04})
    noise = white_noise([s.outputs for s in parts.train])
    simple = data.coarse_fit((), [(data.free.start * 1.1, starts)], noise, 0)
    rich = data.coarse_fit((friction,), [(np.append(data.free.start, 0.04), starts)], noise, 0)
    end: Any = SimpleNamespace(best=rich)
    holdout = HoldoutResiduals(data, parts, end)
    without = holdout.residuals(replace(rich.fit.model, effects=()))
    differ = [a - b for a, b in zip(without, holdout.residuals(rich.fit.model), strict=True)]
    times = [s.trial.sample_times for s in parts.validation]
    assert holdout.own_distance(simple, rich) == pytest.approx(chi_squared(rich.noise, times, differ), rel=1e-9)
    assert holdout.own_distance(rich, rich) == 0.0 != holdout.own_distance(simple, rich)


@pytest.mark.parametrize(("there", "fails"), [(0.09, False), (0.13, True)])
def test_a_fit_that_says_nothing_of_other_trials_failed(there: float, fails: bool) -> None:
    robot = SimpleNamespace(joint_names=("elbow",))
    best = SimpleNamespace(fit=SimpleNamespace(rmse=np.array([0.005])), noise=(JointNoise(SIGMA),))
    data = SimpleNamespace(thresholds=Thresholds())
    inputs = SimpleNamespace(data=SimpleNamespace(free=SimpleNamespace(model=SimpleNamespace(robot=robot))))
    state: Any = SimpleNamespace(end=SimpleNamespace(best=best), data=data, inputs=inputs)
    said = _failed(state, [np.full((50, 1), there)])
    assert bool(said) is fails and (not fails or "13 times that on the fitted ones, at elbow" in said)
    assert not _failed(state, [])


def flipped(decide: Callable[[Any], object]) -> set[tuple[str, float]]:
    """Which thresholds, halved or doubled, would have let a decision fall otherwise."""
    found = set[tuple[str, float]]()

    def watch(condition: Callable[[Thresholds], bool], holds: bool) -> None:
        varied = [(t.name, factor) for t in Thresholds.listed() for factor in (0.5, 2.0)]
        found.update(own for own in varied if condition(Thresholds().scaled(*own)) != holds)

    decide(SimpleNamespace(data=SimpleNamespace(thresholds=Thresholds(watch=watch))))
    return found


@pytest.mark.parametrize(
    ("said", "by"),
    [
        (Confirmation("gain", 0.2), {("validation_share", 0.5)}),
        (Confirmation("gain", 0.3), {("validation_share", 2.0)}),
        (Confirmation("distance", 0.2), {("validation_share", 0.5)}),
        (Confirmation("torques", 0.2), {("torque_share", 0.5)}),
        (Confirmation("scatter", 5.0, stands_out=lambda t: 20.0 / t.blocks), {("blocks", 0.5)}),
        (Confirmation("evident", np.inf), set()),
        (Confirmation("worse", 1.2, "b_1"), set()),
    ],
    ids=lambda own: str(getattr(own, "reason", "")),
)
def test_each_reason_is_asked_of_its_own_threshold(said: Confirmation, by: set[tuple[str, float]]) -> None:
    assert flipped(lambda search: confirms(search, said)) == by


def test_which_part_is_rejected_is_a_decision_too() -> None:
    """0.6 of the least gain on held-out trials, 0.8 of what inverse dynamics have to show, and one that is confirmed."""
    said = [Confirmation("torques", 0.2), Confirmation("gain", 0.15), Confirmation("gain", 0.9)]
    assert least_confirmed(SEARCH, said) == 1 and least_confirmed(SEARCH, said[2:]) is None
    assert flipped(lambda search: least_confirmed(search, said)) == {("validation_share", 0.5), ("torque_share", 2.0)}
