"""Identification from poses at rest: what poses determine is found again, and rest poses are those of the kinematics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from identified_leg import NOMINAL, TRUE, poses_of, values
from morphologies import pendulum

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification import statics
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.residuals import joint_rmse
from equimus_ctrl.identification.statics import rest_poses, static_names
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import StaticPoses
from equimus_ctrl.workflow import identify_poses


def test_poses_at_rest_give_stiffness_area_and_rest_length() -> None:
    done = identify_poses(poses_of(TRUE))
    assert done.fit.parameters.names and set(done.fit.parameters.names) == set(static_names(NOMINAL))
    assert done.fit.theta == pytest.approx(values(TRUE, done.fit.parameters.names), rel=1e-4)
    assert np.abs(done.fit.residuals).max() < 1e-6 and np.abs(done.fit.heldout).max() < 1e-4
    assert np.abs(done.fit.pressure_error).max() < 1.0
    data = done.to_dict()
    assert data["rmse_rad"]["after_together"] < 1e-6 < data["rmse_rad"]["before_together"]


@pytest.mark.parametrize(("bounds", "end", "side"), [((320.0, 400.0), 320.0, -1), ((200.0, 280.0), 280.0, 1)])
def test_a_bound_that_holds_poses_back_is_marked(bounds: tuple[float, float], end: float, side: int) -> None:
    """The truth is 300 N/m; of 280 to 320 it is inside."""
    start = TRUE.with_parameters({"maa.stiffness": sum(bounds) / 2})
    done = identify_poses(poses_of(TRUE), start, free=["maa.stiffness"], bounds={"maa.stiffness": bounds}, folds=0)
    assert done.fit.theta[0] == pytest.approx(end, rel=1e-6) and done.fit.at_bound.tolist() == [side]
    free = identify_poses(poses_of(TRUE), TRUE, free=["maa.stiffness"], bounds={"maa.stiffness": (280, 320)}, folds=0)
    assert free.fit.at_bound.tolist() == [0]


@pytest.mark.slow
def test_noisy_poses_are_explained_to_the_noise_and_the_truth_is_inside() -> None:
    done = identify_poses(poses_of(TRUE, 0.002), heldout=[poses_of(TRUE)])
    assert np.all(done.fit.rmse < 0.003)
    assert np.all(
        np.abs(done.fit.theta - values(TRUE, done.fit.parameters.names)) <= 1.5 * done.fit.uncertainty.half_width
    )
    assert joint_rmse([done.fit.heldout]).max() > joint_rmse([done.fit.residuals]).max()
    assert np.all(joint_rmse([done.heldout[0].after]) < 0.004)


@pytest.mark.slow
def test_the_real_poses(leg_dir: Path) -> None:
    """Published: 0.0203 and 0.0416 rad over 36 poses, 0.0170 and 0.0566 over 13."""
    for count, limits in ((36, (0.0203, 0.0416)), (13, (0.0170, 0.0566))):
        done = identify_poses(leg_dir / f"static_poses_{count}.csv")
        assert len(done.poses.pressure) == count and np.all(done.fit.rmse < limits)
        assert np.isnan(done.fit.pressure_error).any() == (count == 36), "some of the 36 lean on the knee's stop"


def test_rest_poses_are_those_of_the_kinematics() -> None:
    pressure = np.array([[0, 0], [12e3, 6e3], [30e3, 2e3], [50e3, 50e3]])
    found = rest_poses(TRUE, pressure, np.tile([1.4, 0.5], (4, 1)))
    kinematics = Kinematics(TRUE.morphology)
    assert found.found.all() and not found.unstable.any()
    assert found.angles == pytest.approx(np.array([kinematics.equilibrium(p) for p in pressure]), abs=1e-8)


def test_the_slope_of_rest_poses_by_parameters() -> None:
    pressure = np.array([[12e3, 6e3], [30e3, 2e3]])
    guess = rest_poses(TRUE, pressure, np.tile([1.4, 0.5], (2, 1)))
    free = free_parameters(TRUE, ["maa.stiffness", "baa.rest_length"])
    slopes = statics._by_theta(free, free.start, guess)
    for k, step in enumerate((1e-2, 1e-6)):
        ends = [
            rest_poses(free.model_at(free.start + sign * step * np.eye(2)[k]), pressure, guess.angles).position
            for sign in (-1, 1)
        ]
        assert slopes[:, :, k] == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-4, abs=1e-9)


def test_an_equilibrium_that_does_not_last_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pendulum standing upright rests until it is touched; one on its way rests nowhere yet."""
    model = Model(pendulum())
    found = rest_poses(model, np.zeros((2, 1)), np.array([[-np.pi / 2], [1.3]]))
    assert found.found.tolist() == [False, True] and found.unstable.tolist() == [True, False]
    assert found.angles[1] == pytest.approx(np.pi / 2) and np.all(found.by_parameter[0] == 0)
    monkeypatch.setattr(statics, "NEWTON_STEPS", 1)
    stopped = rest_poses(model, np.zeros((1, 1)), np.array([[0.3]]))
    assert not stopped.found.any() and not stopped.unstable.any()


def test_too_few_poses() -> None:
    few = poses_of(TRUE)
    with pytest.raises(ConfigError, match="3 poses are too few to identify 6 parameters from; expected more than 3"):
        identify_poses(StaticPoses("few", few.pressure[:3], few.position[:3]))
