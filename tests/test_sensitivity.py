"""Sensitivities against simulating each changed model by itself, and against finite differences."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.engines.predict import predict
from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.identification.parameters import default_bounds
from equimus_ctrl.identification.sensitivity import SHARES
from equimus_ctrl.identification.simulators import STEP
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.report.sensitivity_figures import sensitivity_figures
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow import sensitivity

MODEL = nominal_model()


def made_up() -> Recording:
    time = np.arange(90) / 60
    command = np.where(time[:, None] < 0.7, (12e3, 5e3), (22e3, 2e3))
    start = Kinematics(MODEL.morphology).equilibrium([12e3, 5e3])
    bare = Recording("made_up", time, command, np.tile(start, (90, 1)), ("maa", "baa"), ("hip", "knee"))
    other = MODEL.with_parameters({"maa.stiffness": 280.0, "baa.area": 4.1e-4})
    return replace(bare, position=predict(other, bare, start=start, dt=STEP))


TRIAL = made_up()


@pytest.fixture(scope="module")
def found() -> Any:
    return sensitivity([TRIAL], MODEL)


def predicted(model: Model) -> Array:
    return predict(model, TRIAL, dt=STEP)


def rmse(angles: Array) -> Array:
    return np.asarray(np.sqrt(((angles - TRIAL.position) ** 2).mean(axis=0)))


def row(found: Any, name: str) -> int:
    return int(found.names.index(name))


def test_every_number_of_the_model_has_its_row(found: Any) -> None:
    assert set(found.names) == set(MODEL.parameters()) - {"command_low", "command_high"} and len(found.names) > 40
    assert found.shares == pytest.approx(SHARES) and found.rmse.shape == (len(found.names), len(SHARES), 2)
    assert found.base == pytest.approx(rmse(predicted(MODEL)), rel=1e-9)


@pytest.mark.parametrize("name", ["baa.area", "maa.rest_length", "calf.mass", "maa.insertion.angle", "knee.damping"])
def test_each_change_is_that_model_simulated_by_itself(name: str, found: Any) -> None:
    value = MODEL.parameters()[name]
    for k, share in enumerate(SHARES):
        changed = MODEL.with_parameters({name: value + share * abs(value)})
        assert found.rmse[row(found, name), k] == pytest.approx(rmse(predicted(changed)), rel=1e-9)


@pytest.mark.parametrize("name", ["baa.area", "maa.rest_length", "gravity", "hip.damping"])
def test_the_local_effect_is_the_derivative(name: str, found: Any) -> None:
    """One per cent of the slope over a wider difference of order four."""
    value, step = MODEL.parameters()[name], 1e-3
    ends = {k: predicted(MODEL.with_parameters({name: value * (1 + k * step)})) for k in (-2, -1, 1, 2)}
    slope = (8 * (ends[1] - ends[-1]) - (ends[2] - ends[-2])) / (12 * step)
    expected = 0.01 * np.sqrt((slope**2).mean(axis=0))
    assert found.local[row(found, name)] == pytest.approx(expected, rel=1e-3)


def test_a_number_that_is_zero_changes_by_shares_of_its_range(found: Any) -> None:
    assert MODEL.parameters()["tilt"] == 0
    low, high = default_bounds(MODEL, "tilt")
    i = row(found, "tilt")
    assert found.reference[i] == pytest.approx((high - low) / 2)
    changed = MODEL.with_parameters({"tilt": 0.1 * (high - low) / 2})
    assert found.rmse[i, -1] == pytest.approx(rmse(predicted(changed)), rel=1e-9) and np.all(found.local[i] > 0)


def test_what_matters_most_comes_first_and_what_cannot_matter_last(found: Any) -> None:
    strongest = found.local.max(axis=1)
    assert np.all(np.diff(strongest) <= 0)
    idle = {name for name, local in zip(found.names, found.local, strict=True) if np.all(local == 0)}
    assert {"base_mass", "calf.length", "knee.upper.stiffness"} <= idle
    assert set(found.names[-len(idle) :]) == idle


def test_variants_that_cannot_be_or_diverge_are_marked() -> None:
    found = sensitivity([TRIAL], MODEL, parameters=["hip.damping", "calf.mass"], shares=(-1.5, 1e5))
    damping, mass = row(found, "hip.damping"), row(found, "calf.mass")
    assert found.diverged.tolist()[damping] == [False, True], "too stiff for the step"
    assert np.isnan(found.rmse[damping]).all() and np.isnan(found.rmse[mass, 0]).all()
    data = found.to_dict()["parameters"][damping]["changes"]
    assert data[0] == {"share": -1.5, "rmse_rad": {"hip": None, "knee": None}, "diverged": False}, "a negative damping"
    assert data[1]["diverged"] is True
    assert np.isfinite(found.local).all()
    figures = sensitivity_figures(found)
    assert set(figures) == {"map", "curves", "local"}
    assert any(text.get_text() == "diverges" for axes in figures["map"].axes for text in axes.texts)


def test_engines_and_threads_agree(found: Any) -> None:
    names = ["baa.area", "maa.stiffness"]
    one = sensitivity([TRIAL], MODEL, parameters=names, threads=1)
    assert np.array_equal(one.rmse, found.rmse[[row(found, name) for name in one.names]])
    mujoco = sensitivity([TRIAL], MODEL, parameters=names, engine="mujoco")
    assert mujoco.names == one.names and mujoco.rmse == pytest.approx(one.rmse, abs=2e-4)
    assert mujoco.local == pytest.approx(one.local, rel=0.02)


def test_progress_and_refusals() -> None:
    told: list[float] = []
    sensitivity([TRIAL, TRIAL], MODEL, parameters=["gravity"], progress=told.append)
    assert told == [0.5, 1.0]
    with pytest.raises(ConfigError, match="no share was given"):
        sensitivity([TRIAL], MODEL, shares=())
    with pytest.raises(ConfigError, match="is nan, expected a finite number other than 0"):
        sensitivity([TRIAL], MODEL, shares=(0.1, float("nan")))
    with pytest.raises(
        SimulationDiverged, match="made_up: the simulation of nominal_leg diverges with the nominal model"
    ):
        sensitivity([TRIAL], MODEL.with_parameters({"hip.damping": 1e4}), parameters=["gravity"])
