"""How a residual is divided among flexible torques: what each explains, on rows that were not fitted too."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from equimus_ctrl.diagnosis.explained_variance import explained
from equimus_ctrl.diagnosis.force_basis import ForceFamily
from equimus_ctrl.diagnosis.residual_force import LinearisedFit, force_candidates, judged
from equimus_ctrl.diagnosis.thresholds import Thresholds
from equimus_ctrl.diagnosis.unexplained import select_forces
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.whitened_fit import WhitenedFit
from equimus_ctrl.types import Array


def problem(seed: int, k: int = 5, p: int = 6, n: int = 400) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(n, p)))
    return rng.normal(size=n), q, rng.normal(size=(n, k)) * 10.0 ** rng.uniform(-6, 6, k)


FOLDS = [[slice(0, 100)], [slice(100, 150), slice(350, 400)], [slice(150, 350)]]


def test_the_gain_is_what_least_squares_gains() -> None:
    r, q, c = problem(0)
    found = explained(r, Nuisance.of(q), c, ridge=0.0)
    alone = r - q @ (q.T @ r)
    solution, left = np.linalg.lstsq(np.column_stack([q, c]), r, rcond=1e-20)[:2]
    assert found.total == pytest.approx(alone @ alone)
    assert found.total - found.gain == pytest.approx(left[0])
    assert found.coefficients == pytest.approx(solution[6:])
    assert found.rank == 5 and found.share == pytest.approx(found.gain / found.total)


def test_columns_that_say_nothing_new_count_for_nothing() -> None:
    r, q, c = problem(1)
    whole = explained(r, Nuisance.of(q), c, 0.0, FOLDS)
    doubled = explained(r, Nuisance.of(q), np.column_stack([c, 3 * c[:, :2], q[:, :3], np.zeros(400)]), 0.0, FOLDS)
    assert doubled.rank == whole.rank == 5
    assert doubled.gain == pytest.approx(whole.gain) and doubled.held_out == pytest.approx(whole.held_out)
    inside = explained(r, Nuisance.of(q), q @ np.ones((6, 2)), 0.0, FOLDS)
    assert (inside.rank, inside.gain, inside.held_out) == (0, 0.0, 0.0) and not inside.coefficients.any()
    assert explained(r, Nuisance.of(q), np.zeros((400, 0))).gain == 0.0


def test_held_out_is_the_error_on_rows_that_were_not_fitted() -> None:
    r, q, c = problem(2)
    r = r + c @ (np.array([0.5, 0, -0.5, 0, 0.2]) / np.linalg.norm(c, axis=0) * 20)
    found = explained(r, Nuisance.of(q), c, 0.0, FOLDS)
    rest, free = r - q @ (q.T @ r), c - q @ (q.T @ c)
    gained = 0.0
    for fold in FOLDS:
        own = np.concatenate([np.arange(400)[rows] for rows in fold])
        others = np.setdiff1d(np.arange(400), own)
        fitted = np.linalg.lstsq(free[others], rest[others], rcond=1e-20)[0]
        gained += (rest[own] ** 2).sum() - ((rest[own] - free[own] @ fitted) ** 2).sum()
    assert found.held_out == pytest.approx(gained)
    assert 0 < found.held_out < found.gain


def test_noise_gains_a_little_and_nothing_that_is_held_out() -> None:
    gains, held_out = [], []
    for seed in range(40):
        r, q, c = problem(seed)
        found = explained(r, Nuisance.of(q), c, folds=FOLDS)
        gains.append(found.gain)
        held_out.append(found.held_out)
    assert np.mean(gains) == pytest.approx(5.0, abs=1.5)  # as many as there are columns, each of variance 1
    assert np.mean(held_out) < -2.0


def test_a_price_holds_back_what_is_hardly_seen() -> None:
    r, q, c = problem(3)
    c[:, 4] = c[:, 3] + 1e-4 * np.linalg.norm(c[:, 3]) * c[:, 4] / np.linalg.norm(c[:, 4])
    bare, priced = explained(r, Nuisance.of(q), c, 0.0), explained(r, Nuisance.of(q), c, 1e-3)
    size = np.linalg.norm(c, axis=0)
    assert np.abs(priced.coefficients * size).max() < 0.01 * np.abs(bare.coefficients * size).max()
    assert priced.gain < bare.gain
    left = r - q @ (q.T @ r) - (c - q @ (q.T @ c)) @ priced.coefficients
    assert priced.total - priced.gain == pytest.approx(left @ left)


def test_of_one_trial_the_force_that_explains_most_for_its_parameters_is_the_best() -> None:
    r, q, c = problem(6)
    cause = c[:, :1] / np.linalg.norm(c[:, 0])
    nothing: list[list[slice]] = []  # a single trial has no folds
    columns = [c[:, 1:2], cause, np.column_stack([cause, c[:, 2:]])]
    forces = [ForceFamily(name, ("hip",), "time", None, (), {}) for name in ("other", "cause", "too many")]
    whitened_fit = WhitenedFit((), r + 30 * cause[:, 0], q, [])
    at = LinearisedFit(None, whitened_fit, forces, columns, nothing, (), [], 3.0, None)  # type: ignore[arg-type]
    ranked = force_candidates(at)
    assert [f.family.location for f in ranked] == ["cause", "too many", "other"]
    assert ranked[0].found.gain < ranked[1].found.gain and judged(ranked[0].found, at) > judged(ranked[1].found, at)


def test_forces_are_selected_one_beside_the_other_until_only_noise_is_left() -> None:
    """Of two causes the larger first; what does the same as one of them explains nothing beside it."""
    r, q, c = problem(7, k=8)
    c /= np.linalg.norm(c, axis=0)
    large, small, nothing = c[:, :2], c[:, 2:4], c[:, 4:6]
    again = large + 0.5 * c[:, 6:8]
    columns = {"nothing": nothing, "again": again, "small": small, "large": large}
    forces = [ForceFamily(name, ("hip",), "time", None, (), {}) for name in columns]
    whitened_fit = WhitenedFit((), r + large @ [30.0, -20.0] + small @ [15.0, 10.0], q, [])
    at = LinearisedFit(None, whitened_fit, forces, [*columns.values()], FOLDS, (), [], 3.0, None)  # type: ignore[arg-type]
    data: Any = SimpleNamespace(n=400, thresholds=Thresholds())
    selected = select_forces(data, at, 0.0)
    assert [force.candidate.family.location for force in selected] == ["large", "small"]
    assert [force.columns is columns[force.candidate.family.location] for force in selected] == [True, True]
    # One beside the other they explain what least squares of both explain.
    alone = whitened_fit.residual - q @ (q.T @ whitened_fit.residual)
    left = np.linalg.lstsq(np.column_stack([q, large, small]), whitened_fit.residual, rcond=None)[1]
    assert sum(force.gain for force in selected) == pytest.approx(alone @ alone - left[0], rel=1e-3)
    # Beside effects that explain several hundred times as much they are but a trace.
    assert not select_forces(data, at, 1e6)


@pytest.mark.parametrize("seed", range(8))
def test_parameters_at_bounds_that_hold_them_back_take_what_is_within_them(seed: int) -> None:
    """Of one that does: the same as least squares within its bound."""
    rng = np.random.default_rng(seed)
    slopes, columns, noise = rng.normal(size=(200, 3)), rng.normal(size=(200, 2)), rng.normal(size=200)
    columns[:, 0] += (4.0 if seed % 2 else -4.0) * slopes[:, 2]  # the force has to do with what is held
    residual = noise + slopes @ [0.0, 0.0, 1.5] + columns @ [0.8, 0.0]
    residual -= slopes[:, :2] @ np.linalg.lstsq(slopes[:, :2], residual, rcond=None)[0]  # the others are fitted
    side = int(np.sign(residual @ slopes[:, 2]))
    white = WhitenedFit((), residual, slopes, [], 1, np.array([0, 0, side]))
    bounds = (np.array([-np.inf] * 5), np.array([np.inf] * 5))
    bounds[side > 0][2] = 0.0
    alone = lsq_linear(slopes, residual, bounds=(bounds[0][:3], bounds[1][:3])).cost
    both = lsq_linear(np.column_stack([slopes, columns]), residual, bounds=bounds).cost
    force = ForceFamily("cause", ("hip",), "time", None, (), {})
    at = LinearisedFit(None, white, [force], [columns], FOLDS, (), [], 3.0, None)  # type: ignore[arg-type]
    (found,) = force_candidates(at)
    assert found.found.gain == pytest.approx(2 * (alone - both), rel=1e-3)
    (bare,) = force_candidates(replace(at, whitened_fit=replace(white, held=None)))
    assert bare.found.gain <= found.found.gain * (1 + 1e-9)


def test_rows_must_agree() -> None:
    r, q, c = problem(4)
    with pytest.raises(ConfigError, match="have 400, 400 and 399 rows"):
        explained(r, Nuisance.of(q), c[1:])
