"""The numbers that decide: all of them told, and varied without another line."""

from __future__ import annotations

import pytest
from scipy.stats import chi2, norm

from equimus_ctrl.diagnosis.policy import Thresholds


def test_every_number_says_what_it_decides_and_where_it_comes_from() -> None:
    told = list(Thresholds.listed())
    assert len(told) == len({t.name for t in told}) > 20
    for one in told:
        assert getattr(Thresholds(), one.name) == one.value > 0
        assert len(one.meaning.split()) > 5 and one.origin.why
        if one.origin.basis == "calibration":
            assert "benchmarks/thresholds.py" in one.origin.why


def test_theory_gives_the_numbers_that_it_is_said_to_give() -> None:
    thresholds = Thresholds()
    least = 20.0  # about the least gain of one parameter over the candidates of a leg
    assert chi2.isf(thresholds.significance / 100, 1) == pytest.approx(least, abs=1.0)
    lowest = least + norm.ppf(0.05) * 2 * least**0.5
    assert thresholds.validation_share == pytest.approx(lowest / least, abs=0.03)
    assert thresholds.uninformative == pytest.approx((2 * 2) ** 2)
    assert (
        chi2.isf(thresholds.significance / 40, 8)
        < thresholds.residual_gain
        < 1.2 * chi2.isf(thresholds.significance / 40, 8)
    )
    assert chi2.isf(0.0025, 2) == pytest.approx(thresholds.colour, abs=0.1)
    assert (1 + thresholds.far_off) ** 0.5 == 2.0 and thresholds.step_matters < thresholds.simulation_error


def test_decisions_are_told_to_whoever_varies_the_numbers() -> None:
    seen = []

    def watch(condition: object, holds: bool) -> None:
        thresholds = Thresholds()
        flips = {
            (t.name, f)
            for t in Thresholds.listed()
            for f in (0.5, 2.0)
            if condition(thresholds.scaled(t.name, f)) != holds
        }  # type: ignore[operator]
        seen.append(flips)

    thresholds = Thresholds(watch=watch)
    assert thresholds.decides(lambda t: t.validation_share <= 0.3)
    assert not thresholds.decides(lambda t: t.residual_gain < 3.0)
    assert seen == [{("validation_share", 2.0)}, set()]
    assert thresholds.scaled("trace", 2.0).trace == 0.02 and thresholds.scaled("trace", 2.0).watch is watch
    assert thresholds == Thresholds() and repr(thresholds) == repr(Thresholds())
