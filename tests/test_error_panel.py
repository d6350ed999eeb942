"""Error panels: room for what curves do not show, and a word on what is beyond."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from equimus_ctrl.report.error_panel import draw_distance, error_limits


def limits(*errors: object, unit: str = "°") -> tuple[float, float, list[str]]:
    axes = Figure().add_subplot()
    error_limits(axes, [np.asarray(own, dtype=float) for own in errors], unit, 0.1)
    low, high = axes.get_ylim()
    return low, high, [text.get_text() for text in axes.texts]


def test_all_of_an_error_is_seen_where_it_is_alike_all_the_time() -> None:
    low, high, said = limits(np.sin(np.linspace(0, 20, 400)), [0.2, np.nan])
    assert high == -low and 1.0 < high < 1.2 and said == []


@pytest.mark.parametrize(("unit", "told"), [("°", "up to 40° beyond"), ("mm", "up to 40 mm beyond")])
def test_a_transient_leaves_room_for_what_comes_after_and_is_told(unit: str, told: str) -> None:
    late = 0.5 * np.ones(1000)
    late[:50] = -40.0
    low, high, said = limits(late, unit=unit)
    assert high == -low and 0.5 < high < 2.0 and said == [told]


def test_no_error_has_limits_too() -> None:
    assert limits(np.zeros(9))[1] == pytest.approx(0.1)
    assert limits([np.nan])[1] == pytest.approx(0.1) and limits()[1] == pytest.approx(0.1)


def test_distances_are_logarithmic_and_none_is_below_the_least() -> None:
    axes = Figure().add_subplot()
    distance = np.concatenate([[30.0], np.zeros(99)])
    draw_distance(axes, np.arange(100.0), distance, "k", 1e-3)
    assert axes.get_yscale() == "log" and axes.get_ylim()[0] == pytest.approx(1e-3) and axes.get_ylim()[1] > 30
    (drawn,) = axes.lines
    np.testing.assert_allclose(drawn.get_ydata(), np.maximum(distance, 1e-3))
