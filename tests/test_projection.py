"""What is left beside nuisance parameters, whatever the rank of their columns."""

from __future__ import annotations

import numpy as np
import pytest

from equimus_ctrl.identification.projection import Nuisance

ROWS = 60


def independent(rng: np.random.Generator, n: int = 4) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.asarray(rng.normal(size=(ROWS, n)))


def test_what_is_left_is_what_least_squares_leave() -> None:
    rng = np.random.default_rng(0)
    columns, values = independent(rng) * [1e-6, 1.0, 1e4, 3.0], rng.normal(size=(ROWS, 3))
    own = Nuisance.of(columns)
    found = np.linalg.lstsq(columns / np.linalg.norm(columns, axis=0), values, rcond=None)[0]
    expected = values - columns / np.linalg.norm(columns, axis=0) @ found
    np.testing.assert_allclose(own.project_out(values), expected, rtol=0, atol=1e-13)
    assert own.squares_beyond(values[:, 0]) == pytest.approx(float((expected[:, 0] ** 2).sum()), rel=1e-12)
    np.testing.assert_allclose(own.basis @ own.factor, columns, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(
        columns @ own.solution(own.basis.T @ values, 1e-14), values - expected, rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("place", range(5))
def test_a_column_that_depends_on_others_takes_nothing_more(place: int) -> None:
    """Wherever it stands: those behind it lose nothing by it either."""
    rng = np.random.default_rng(place)
    columns, values = independent(rng), rng.normal(size=ROWS)
    more = columns @ np.array([1.0, -2.0, 0.5, 0.1]) * (1 + 1e-13 * rng.normal(size=ROWS))
    own, whole = Nuisance.of(columns), Nuisance.of(np.insert(columns, place, more, axis=1))
    assert own.basis.shape[1] == whole.basis.shape[1] == 4
    np.testing.assert_allclose(whole.project_out(values), own.project_out(values), rtol=0, atol=1e-10)
    np.testing.assert_allclose(whole.project_out(columns), 0.0, rtol=0, atol=1e-10)


def test_columns_of_nothing_do_nothing() -> None:
    values = np.arange(float(ROWS))
    for columns in (np.zeros((ROWS, 3)), np.zeros((ROWS, 0))):
        own = Nuisance.of(columns)
        assert own.basis.shape == (ROWS, 0)
        np.testing.assert_array_equal(own.project_out(values), values)
        assert own.solution(own.basis.T @ values, 1e-8).shape == (columns.shape[1],)
