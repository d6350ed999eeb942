"""Which fits of a search begin where, which go on, and which do not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from search_on_paper import DEAD, FULL, OFF, POOL, RUB, STICK, VALUES, Known, OnPaper, fitted

from equimus_ctrl.diagnosis.fitting import Fitted
from equimus_ctrl.diagnosis.group_splits import own_in_each_group
from equimus_ctrl.diagnosis.guessed_changes import rescaled
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.screening import Screened, ScreenedGains
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import Proposal, SearchHistory, no_rival
from equimus_ctrl.effects import REGISTRY
from equimus_ctrl.models.model import nominal_model


def coarse(deviance: float, label: str, converged: bool) -> Fitted:
    """A fit after a few steps."""
    own = fitted(deviance, label)
    return replace(own, fit=SimpleNamespace(**vars(own.fit), converged=converged))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("deviance", "converged", "many_minima", "goes_on"),
    [
        (1500.0, False, False, True),
        (1500.0, True, False, False),
        (1500.0, False, True, False),
        (3900.0, False, False, False),
    ],
    ids=["still gaining", "at its end", "where fits have many minima", "far behind"],
)
def test_a_fit_behind_the_first_ones_goes_on_where_its_rank_is_not_known(
    deviance: float, converged: bool, many_minima: bool, goes_on: bool
) -> None:
    settings = SearchSettings(kept=3, many_minima=many_minima)
    search = OnPaper(Known({(): 5000.0}), settings)
    options = [coarse(d, label, True) for d, label in ((1000.0, RUB), (1100.0, STICK), (1200.0, DEAD))]
    options.append(coarse(deviance, OFF, converged))
    further: list[str] = []

    def longer(hypothesis: tuple[Part, ...], *given: object, settled: object) -> Fitted:
        further.append(hypothesis[-1].candidate.label)
        return coarse(900.0, further[-1], True)

    vars(search.data).update(threads=1, coarse_fit=longer, converge=lambda f, settled: f, discontinuous=lambda *a: [])
    found = search._best_converged(search.known(), options, no_rival)
    assert further == [RUB, STICK, DEAD, *([OFF] if goes_on else [])]
    assert [f.deviance for f in found] == [900.0, 900.0, 900.0, 900.0 if goes_on else deviance]


def test_the_best_that_stands_for_no_other_parameters_is_converged_too() -> None:
    """Else it is compared, far above its minimum, with what has fewer parts."""
    options, whole = [coarse(1000.0, OFF, True), coarse(2000.0, RUB, True)], list[str]()
    search = OnPaper(Known({(): 5000.0}, aliased=[OFF]), SearchSettings(many_minima=True))

    def converge(option: Fitted, settled: bool) -> Fitted:
        whole.append(option.hypothesis[-1].candidate.label)
        return option

    def longer(hypothesis: tuple[Part, ...], *given: object, settled: object) -> Fitted:
        return coarse(1500.0, hypothesis[-1].candidate.label, True)

    vars(search.data).update(threads=1, coarse_fit=longer, converge=converge, discontinuous=lambda *a: [])
    found = search._best_of_its_own_converged(search.known(), options, options, no_rival)
    assert [f.deviance for f in found] == [1000.0, 1500.0] and whole == [RUB]
    own, already = options[1:], [options[0], found[1]]
    assert search._best_of_its_own_converged(search.known(), own, own, no_rival) == own and whole == [RUB]
    assert search._best_of_its_own_converged(search.known(), options, already, no_rival) == already and whole == [RUB]


@pytest.mark.parametrize(("deviance", "further"), [(4000.0, True), (4400.0, False)])
def test_what_cannot_come_near_its_rival_is_not_fitted_further(deviance: float, further: bool) -> None:
    """The rival gains 3000, so it has to gain 0.7·3000 − 50 = 2050; at most three times what a few steps gain."""
    search = OnPaper(Known({(): 5000.0}))
    asked: list[float] = []

    def longer(hypothesis: tuple[Part, ...], *given: object, settled: object) -> Fitted:
        asked.append(deviance)
        return coarse(deviance - 100.0, RUB, True)

    vars(search.data).update(threads=1, coarse_fit=longer, converge=lambda f, settled: f, discontinuous=lambda *a: [])
    (found,) = search._best_converged(search.known(), [coarse(deviance, RUB, False)], lambda t: 2000.0)
    assert asked == ([deviance] if further else []) and found.deviance == deviance - (100.0 if further else 0.0)


@pytest.mark.parametrize(
    ("gain", "converged", "further"), [(8.0, True, False), (9.0, True, True), (8.0, False, True)],
    ids=["too little", "perhaps enough", "still gaining"],
)  # fmt: skip
def test_what_has_come_to_its_end_and_gains_too_little_is_not_fitted_further(
    gain: float, converged: bool, further: bool
) -> None:
    """Three times what a few steps gain has to exceed the threshold, 25.7 with one parameter and five candidates."""
    search = OnPaper(Known({(): 5000.0}))
    threshold = search.threshold(1)
    asked: list[float] = []

    def longer(hypothesis: tuple[Part, ...], *given: object, settled: object) -> Fitted:
        asked.append(gain)
        return coarse(5000.0 - gain, OFF, True)

    vars(search.data).update(threads=1, coarse_fit=longer, converge=lambda f, settled: f, discontinuous=lambda *a: [])
    share = gain / 25.7
    search._best_converged(search.known(), [coarse(5000.0 - share * threshold, OFF, converged)], no_rival)
    assert asked == ([gain] if further else [])


@pytest.mark.parametrize(
    ("left", "by_force", "asked", "outdone"),
    [(0.6, 70.0, True, False), (0.6, 90.0, True, True), (0.6, None, True, False), (0.4, 100.0, False, False)],
    ids=["force explains less", "more", "motion not followed", "no force can"],
)
def test_residual_forces_are_asked_only_where_one_can_explain_twice_as_much(
    left: float, by_force: float | None, asked: bool, outdone: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No force explains more than all there is: an effect that explains more than half of it is not outdone."""
    looked: list[float | None] = []
    monkeypatch.setattr("equimus_ctrl.diagnosis.search.chi_squared", lambda noise, times, residuals: residuals)
    own = OnPaper(Known({(): 5000.0}))
    vars(own.data).update(times=[])
    best, top = (replace(fitted(1.0), fit=SimpleNamespace(residuals=chi2)) for chi2 in (100.0, 100.0 * left))  # type: ignore[arg-type]

    def force() -> float | None:
        looked.append(by_force)
        return by_force

    assert Search._outdone(own, best, top, force) is outdone
    assert bool(looked) is asked


@pytest.mark.parametrize("many_minima", [False, True])
def test_beside_other_effects_a_fit_begins_on_the_way_too(many_minima: bool) -> None:
    """All, a half and a quarter of the change to first order; of many minima also a quarter of the new effect's alone."""
    part = Part(POOL[OFF], VALUES["sensor_offset"])
    data: Any = SimpleNamespace(
        theta_of=lambda theta, parts: np.append(theta, [v for p in parts for v in p.values.values()])
    )
    simple = fitted(5000.0)
    for others, shares in (((), (1.0,)), ((Part(POOL[DEAD], VALUES["dead_zone"]),), (1.0, 0.5, 0.25))):
        before = np.array([2.0, 3.0, *(v for p in others for v in p.values.values())])
        of = replace(simple, hypothesis=others, fit=SimpleNamespace(theta=np.array([2.0, 3.0])))  # type: ignore[arg-type]
        change = np.array([0.4, -0.8, *(0.0 for _ in others), 0.1])
        whole = np.append(before, 0.0) + change
        screened = Screened(part.candidate, (*others, part), whole, ScreenedGains(1.0, 1.0), (), np.zeros(0))
        expected = [np.append(before, 0.0) + share * change for share in shares]
        expected += [np.append(before, 0.25 * 0.1)] if others and many_minima else []
        assert np.array(screened.begins(data, of, many_minima)) == pytest.approx(np.array(expected))


def test_sizes_that_fade_together_shrink_together_on_the_way() -> None:
    candidate = Candidate(REGISTRY["stribeck_friction"], ("knee",), (VALUES["stribeck_friction"],))
    data: Any = SimpleNamespace(
        theta_of=lambda theta, parts: np.append(theta, [v for p in parts for v in p.values.values()])
    )
    of = replace(fitted(5000.0, DEAD), fit=SimpleNamespace(theta=np.zeros(0)))  # type: ignore[arg-type]
    other = of.hypothesis[0]
    whole = np.array([1e3, 0.01, 0.012, 0.1])
    screened = Screened(
        candidate,
        (other, Part(candidate, VALUES["stribeck_friction"])),
        whole,
        ScreenedGains(1.0, 1.0),
        (),
        np.zeros(0),
    )
    half = screened.begins(data, of, False)[1]
    assert half == pytest.approx([1e3, 0.005, 0.006, 0.1])


def test_a_gain_is_at_most_as_a_fall_of_the_deviance_at_one_joint() -> None:
    """Σ n_j ln(σ²_before/σ²_after) of two joints with n/2 samples each, however the gain is shared."""
    search = OnPaper(Known({(): 5000.0}))
    simple, n = search.known(), search.data.n
    assert simple.fit.residuals[0].shape[1] == 2
    for gain in (1.0, 0.2 * n, 0.45 * n):
        shares = np.linspace(0, gain, 11)
        falls = [-n / 2 * (np.log(1 - own / (n / 2)) + np.log(1 - (gain - own) / (n / 2))) for own in shares]
        assert search._most_fall(simple, gain) == pytest.approx(max(falls))
    assert search._most_fall(simple, 0.5 * n) == np.inf


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("fails", [False, True])
def test_what_is_fitted_does_not_depend_on_the_number_of_threads(threads: int, fails: bool) -> None:
    """The first fit gains so much that others are hopeless; these may have begun, and ended in an error."""
    search = OnPaper(Known({(): 5000.0}))
    hopes = {DEAD: 1e4, FULL: 900.0, OFF: 2000.0, RUB: 500.0, STICK: 400.0}
    gains = {DEAD: 4000.0, FULL: 1000.0, OFF: 1500.0, RUB: 100.0, STICK: 100.0}

    def coarse_fit(hypothesis: tuple[Part, ...], *given: object, settled: object) -> Fitted:
        label = hypothesis[-1].candidate.label
        if fails and hopes[label] < 1000.0:
            raise ValueError(label)
        return fitted(5000.0 - gains[label], label)

    vars(search.data).update(threads=threads, coarse_fit=coarse_fit)
    proposals = [Proposal(fitted(0.0, label).hypothesis, (), hope) for label, hope in hopes.items()]
    found = search._coarse_fits(search.known(), proposals, no_rival)
    assert [f.label for f in found] == [DEAD, OFF]
    if fails:
        with pytest.raises(ValueError, match=FULL):
            search._coarse_fits(search.known(), [p for p in proposals if p.hope < 1000.0], no_rival)


def test_where_minima_are_many_the_model_alone_is_refitted_from_the_first_effect_s_fit() -> None:
    """Its first fit had ended in a worse minimum; against the better one the effect is not needed."""

    class Refits(OnPaper):
        def refit(
            self, tried: SearchHistory, fitted: Fitted, hypothesis: tuple[Part, ...]
        ) -> tuple[Fitted, SearchHistory]:
            return (better, tried) if not hypothesis else super().refit(tried, fitted, hypothesis)

    known = Known({(): 5000.0, (RUB,): 3000.0})
    for deviance, labels in ((2990.0, set()), (4000.0, {RUB}), (6000.0, {RUB})):
        better = fitted(deviance)
        end = Refits(known, SearchSettings(many_minima=True)).run(known())
        assert end.best.labels == labels
        assert end.base.deviance == min(deviance, 5000.0)


def test_sizes_of_its_own_in_each_group_begin_at_the_common_one() -> None:
    part = Part(POOL[OFF], VALUES["sensor_offset"])
    split = own_in_each_group((part,), ("A", "B", "C"))
    assert split is not None
    theta = OnPaper(Known({(): 1.0}))._in_each_group(np.array([7.0, 0.05]), (part,), split)
    assert theta.tolist() == [7.0, 0.05, 0.05, 0.05]


def test_a_guess_is_rescaled_as_far_as_it_can_be() -> None:
    model, off = nominal_model(), Part(POOL[OFF], VALUES["sensor_offset"])
    half = rescaled(model, (off,), 0.5)
    assert half is not None and half[-1].values == {"offset": 0.05}
    assert rescaled(model, (off,), 1e6) is None


@pytest.mark.parametrize(
    ("label", "lower", "many_minima", "asked"),
    [("nonlinear_stiffness:baa", True, False, True), ("nonlinear_stiffness:baa", False, False, True),
     ("nonlinear_stiffness:baa", True, True, False), ("sensor_offset:hip", True, False, False)],
    ids=["lower there", "higher there", "where fits have many minima", "linear"],
)  # fmt: skip
def test_the_best_law_is_fitted_from_the_other_sign_too(
    label: str, lower: bool, many_minima: bool, asked: bool
) -> None:
    """A law that has more than a size may have a minimum on each side; a linear one has none but its own."""
    name, place = label.split(":")
    shape = {"centre": 0.3} if name == "nonlinear_stiffness" else {}
    size = "cubic" if shape else "offset"
    candidate = Candidate(REGISTRY[name], (place,), tuple({size: v, **shape} for v in (0.1, -0.2, 0.3)))
    search = OnPaper(Known({(): 5000.0}), SearchSettings(many_minima=many_minima))
    begun: list[list[float]] = []

    def other_side(hypothesis: tuple[Part, ...], begins: Any, *given: object, settled: object) -> Fitted:
        begun.append([theta[1] for theta, _ in begins])
        return replace(fitted(900.0 if lower else 1100.0), hypothesis=(Part(candidate, {size: 0.2, **shape}),))

    data: Any = vars(search.data)
    data.update(coarse_fit=other_side, theta_of=lambda theta, parts: np.append(theta, list(parts[-1].values.values())))
    data["free"].start = np.array([1.0])
    simple: Any = replace(fitted(5000.0), fit=SimpleNamespace(theta=np.array([2.0]), starts=[]))
    option = replace(fitted(1000.0), hypothesis=(Part(candidate, {size: -0.2, **shape}),))
    split = own_in_each_group(option.hypothesis, ("A", "B"))
    assert split is not None and search._or_of_other_sign(simple, replace(option, hypothesis=split)).hypothesis == split
    found = search._or_of_other_sign(simple, option)
    assert found.deviance == (900.0 if asked and lower else 1000.0)
    assert begun == ([[0.1, 0.3, 0.1, 0.3]] if asked else [])
