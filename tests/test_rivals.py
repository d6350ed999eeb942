"""What a diagnosis leaves to decide between: kept, recorded, read back."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosed_arm import six_joints
from diagnosed_leg import consistent, part_of
from poor_legs import hidden
from rival_legs import of_a_pendulum, read_back, rivals_of, with_other

from equimus_ctrl.diagnosis import rivals as rivals_module
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, diagnose
from equimus_ctrl.diagnosis.explanations import just_below, with_richer_laws
from equimus_ctrl.diagnosis.holdout import split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Hypothesis, Part, default_free_parameters
from equimus_ctrl.diagnosis.results import Diagnosis, Named
from equimus_ctrl.diagnosis.rivals import Rivals, refitted_to
from equimus_ctrl.diagnosis.screening import Screened
from equimus_ctrl.effects.base import REGISTRY
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.experiments.separation import separations
from equimus_ctrl.identification.information import information, start_precision
from equimus_ctrl.identification.noise import whiten
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.proof.leg_simulation import recordings, simulate


def test_the_answer_comes_first_and_what_fits_as_well_behind_it(diagnosis: Diagnosis) -> None:
    rivals = rivals_of(diagnosis)
    assert [rival.label for rival in rivals.rivals] == ["dead_zone at baa", "no missing physics"]
    assert rivals.rivals[0].effects == (Named("dead_zone", ("baa",)),)
    assert [rival.n_effect_parameters for rival in rivals.rivals] == [1, 0]
    assert rivals.pairs == [(0, 1), (1, 0)]
    assert rivals.rate == pytest.approx(60.0)
    assert rivals.n == sum(s.measured.size for s in diagnosis.train)
    gain = diagnosis.base.deviance - diagnosis.best.deviance
    assert rivals.ahead(0, 1) == pytest.approx(gain - np.log(rivals.n)) == -rivals.ahead(1, 0)


def test_explanations_of_the_same_effects_are_one(diagnosis: Diagnosis) -> None:
    twice = replace(diagnosis, explanations=(diagnosis.base, diagnosis.best, diagnosis.base), nearest=(diagnosis.base,))
    assert [rival.accepted for rival in Rivals.of(twice).rivals] == [True, True]
    nearest = Rivals.of(replace(diagnosis, nearest=(diagnosis.base,)))
    assert [rival.accepted for rival in nearest.rivals] == [True, False]


def hidden_friction(size: float, places: tuple[str, ...] = ("knee",)) -> Hypothesis:
    part = part_of("coulomb_friction", places, {"friction": size})
    return (Part(replace(part.candidate, given=part.values), {}),)


def test_what_is_not_excluded_stands_beside_nothing(diagnosis: Diagnosis) -> None:
    small, large = hidden_friction(1e-3), hidden_friction(0.5)
    below = replace(consistent(diagnosis), best=diagnosis.base, below=(large, small))
    nothing, rubbing = Rivals.of(below).rivals
    assert (nothing.label, rubbing.label) == ("no missing physics", "coulomb_friction at knee")
    assert [effect.parameters()["friction"] for effect in rubbing.model.effects] == [1e-3]
    assert rubbing.given_sizes == (("friction", 1e-3, "N·m"),) and not nothing.given_sizes
    assert [own.label for own in Rivals.of(below).named] == [nothing.label]


def test_of_what_may_hide_beside_it_the_first_that_is_not_excluded_is_taken(
    diagnosis: Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rivals_module, "MOST_HIDDEN", 1)
    several = (hidden_friction(0.5), hidden_friction(1e-4, ("hip",)), hidden_friction(1e-3))
    found = Rivals.of(replace(consistent(diagnosis), best=diagnosis.base, below=several)).rivals
    assert [own.given_sizes for own in found] == [(), (("friction", 1e-4, "N·m"),)]


def test_beside_an_effect_of_known_size_all_else_is_refitted(diagnosis: Diagnosis) -> None:
    """What it makes of the recordings counts, not what it would make of them with the estimates without it."""
    nothing, rubbing = Rivals.of(
        replace(consistent(diagnosis), best=diagnosis.base, below=(hidden_friction(1e-3),))
    ).rivals
    assert rubbing.parameters.names == nothing.parameters.names
    assert not np.array_equal(rubbing.theta, nothing.theta) and rubbing.deviance != nothing.deviance
    again = refitted_to(rubbing, replace(diagnosis, best=diagnosis.base))
    assert again.deviance == pytest.approx(rubbing.deviance, abs=1.0)


def test_rivals_are_found_once(diagnosis: Diagnosis) -> None:
    """Those of known size are fits: whoever asks again has the same."""
    again = replace(diagnosis)
    assert again.rivals is again.rivals
    assert replace(again, nearest=(diagnosis.base,), explanations=()).rivals.rivals[1].accepted is False


def test_the_information_is_that_of_all_unknowns_together(diagnosis: Diagnosis) -> None:
    """By the inverse of the information of parameters and starts, which is the covariance of them all."""
    fit, noise = diagnosis.best.fit, diagnosis.best.noise
    p, own = len(fit.theta), [len(s.free_at) for s in fit.problem.segments]
    whole = np.zeros((p + sum(own), p + sum(own)))
    first = p
    for segment, slopes, starts in zip(fit.problem.segments, *fit.derivatives, strict=True):
        beside = np.zeros((*slopes.shape[:2], sum(own)))
        beside[..., first - p : first - p + starts.shape[2]] = starts
        rows = np.concatenate([slopes * fit.parameters.scale, beside], axis=2)
        whitened = whiten(noise, segment.trial.sample_times, rows).reshape(-1, whole.shape[0])
        whole += whitened.T @ whitened
        at = np.arange(first, first + starts.shape[2])
        whole[at, at] += start_precision(segment, noise) ** 2
        first += starts.shape[2]
    covariance = np.linalg.inv(whole)[:p, :p]
    assert np.linalg.inv(information(fit, noise)) == pytest.approx(covariance, rel=1e-6)


def test_draws_are_spread_as_the_recordings_say_and_within_bounds(diagnosis: Diagnosis) -> None:
    rival = rivals_of(diagnosis).rivals[0]
    free = rival.parameters
    drawn = rival.draws(np.random.default_rng(0), 2000)
    assert np.all((drawn >= free.low) & (drawn <= free.high))
    known = replace(rival, theta=(free.low + free.high) / 2, information=np.diag(np.linspace(1e3, 1e4, len(free.free))))
    share = (known.draws(np.random.default_rng(0), 2000) - known.theta) / free.scale
    assert np.cov(share.T) == pytest.approx(np.diag(1 / np.diag(known.information)), rel=0.1, abs=6e-5)


def test_a_draw_at_a_bound_keeps_what_is_known_of_combinations(diagnosis: Diagnosis) -> None:
    """Where the sum of two is known and one cannot grow, neither does the other fall."""
    rival = rivals_of(diagnosis).rivals[0]
    free, p = rival.parameters, len(rival.theta)
    combined = np.eye(p) * 1e4
    combined[:2, :2] = [[1e8 + 1, 1e8 - 1], [1e8 - 1, 1e8 + 1]]
    theta = (free.low + free.high) / 2
    theta[0] = free.high[0]
    drawn = replace(rival, theta=theta, information=combined).draws(np.random.default_rng(1), 200)
    total = ((drawn - theta) / free.scale)[:, :2].sum(axis=1)
    assert np.abs(total).max() < 1e-3 < np.ptp(drawn[:, 1] / free.scale[1])


def test_a_leg_is_read_back_the_same(diagnosis: Diagnosis) -> None:
    rivals = rivals_of(diagnosis)
    again = read_back(rivals)
    commands = Commands(np.array([0.0, 0.4]), np.array([[12e3, 6e3], [2e4, 2e3]]), 1.0)
    one, other = (separations(own, [commands])[0] for own in (rivals, again))
    assert np.array_equal(one.gram, other.gram) and one.gap(0, 1) > 0
    drawn = [own.rivals[0].draws(np.random.default_rng(5), 3) for own in (rivals, again)]
    assert np.array_equal(*drawn)
    assert again.to_dict() == rivals.to_dict() == with_other(diagnosis).to_dict()["rivals"]


@pytest.mark.parametrize("also", [(), ("vel.hinge",)])
def test_an_arm_is_read_back_the_same(also: tuple[str, ...]) -> None:
    rivals = of_a_pendulum(also)
    again = read_back(rivals)
    assert rivals.interval == 1.0 and rivals.trust is not None
    assert len(rivals.noise) == 1 + len(also) and rivals.notes == ({"also": "vel.hinge"} if also else {})
    commands = Commands(np.array([0.0, 0.5, 1.2]), np.array([[0.3], [-0.8], [0.9]]), 2.0)
    one, other = (separations(own, [commands])[0] for own in (rivals, again))
    assert np.array_equal(one.gram, other.gram) and one.gap(0, 1) > 10
    assert one.n == 200 * (1 + len(also))
    assert json.dumps(again.to_dict()) == json.dumps(rivals.to_dict())


def test_a_record_is_not_read_with_another_robot(diagnosis: Diagnosis) -> None:
    with pytest.raises(ConfigError, match="not the model that was diagnosed"):
        read_back(rivals_of(diagnosis), Model(six_joints()))


def test_the_least_visible_effects_stand_at_the_size_that_would_have_been_seen() -> None:
    guesses = tuple({"threshold": size} for size in (100.0, 200.0, 400.0))
    candidate, other = (Candidate(REGISTRY["dead_zone"], (place,), guesses) for place in ("baa", "maa"))

    def screened(own: object, strengths: list[float]) -> Screened:
        nothing = np.empty(0)
        return Screened(own, (), nothing, (0.0,), guesses, np.array(strengths))  # type: ignore[arg-type]

    clear, faint = screened(candidate, [400.0, 1600.0, 6400.0]), screened(other, [10.0, 40.0, 160.0])
    parts = just_below(nominal_model(), [clear, faint], 100.0)
    # χ² grows with the square of the size.
    assert [(part.candidate.locations, part.candidate.given["threshold"]) for part in parts] == [
        (("maa",), pytest.approx(100 * np.sqrt(10))),
        (("baa",), pytest.approx(50.0)),
    ]
    assert just_below(nominal_model(), [screened(other, [1.0, 4.0, 16.0])], 100.0) == ()


def test_a_richer_law_may_hide_behind_the_plain_one_with_what_that_lacks_given() -> None:
    plain = part_of("coulomb_friction", ("knee",), {"friction": 0.01})
    guesses = tuple({"friction": 0.1, "breakaway": size, "velocity": 0.2} for size in (0.02, 0.1))
    stribeck = Candidate(REGISTRY["stribeck_friction"], ("knee",), guesses)
    elsewhere = Candidate(REGISTRY["stribeck_friction"], ("hip",), guesses)
    both_ways = {"forward": 0.1, "backward": 0.2}  # at some sizes it is the plain law
    asymmetric = Candidate(REGISTRY["asymmetric_friction"], ("knee",), (both_ways,))
    search, best = SimpleNamespace(pool=[asymmetric, stribeck, elsewhere]), SimpleNamespace(hypothesis=(plain,))
    found = list(with_richer_laws(search, best))  # type: ignore[arg-type]
    assert [own.candidate.given for (own,) in found] == [
        {"breakaway": size, "velocity": 0.2}
        for size in (0.1, 0.02)  # the strongest first
    ]
    (strong,), _ = found
    assert strong.values == {"friction": 0.01} and strong.candidate.n_parameters == 1
    assert strong.effects[0].parameters() == {"friction": 0.01, "breakaway": 0.1, "velocity": 0.2}


@pytest.mark.slow
@pytest.mark.parametrize(("case", "verdict"), [(4, "explained"), (10, "consistent"), (11, "unexplained")])
def test_a_diagnosis_keeps_what_it_leaves_open(case: int, verdict: str) -> None:
    """Of two poor trials of a leg: an effect with an equivalent, one that is not seen, one that nothing explains."""
    model, truth = nominal_model(), hidden(77, case)
    trials = recordings(truth, simulate(truth))
    found = diagnose(default_free_parameters(model), split(model, trials), settings=DiagnosisSettings(threads=1))
    assert found.verdict == verdict
    first, *others = found.rivals.rivals
    if verdict == "explained":
        assert [str(own.named) for own in found.findings] == [first.label]
        equivalent = {own.label for own in others if not own.given}
        assert equivalent == {str(own) for own in found.findings[0].equivalent} != set()
    elif verdict == "consistent":
        assert first.label == "no missing physics" and all(own.given for own in others)
    else:
        assert [own.accepted for own in (first, *others)] == [True] + [False] * len(others) and others
        assert found.rivals.unexplained[0].location == found.unexplained[0].location
    below = [own for own in others if own.given]
    assert bool(below) == (verdict != "unexplained")
    sizes = {str(own.named): own.size for own in found.detectable}
    for rival in below:  # smaller than what would have been accepted
        assert rival.effects[:-1] == first.effects and rival.parameters.names == first.parameters.names
        effect = rival.model.effects[-1]
        size, nothing = next(iter(effect.parameters().values())), effect.grows_from()
        assert nothing is not None and 0 < abs(size - nothing) < sizes[str(rival.effects[-1])]
