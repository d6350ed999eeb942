"""How strong a case is: what the missing physics leaves when all else has been fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import lsq_linear
from threadpoolctl import threadpool_limits

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.identification.fit import FitSettings, fit
from equimus_ctrl.identification.parameters import default_names, free_parameters
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.drawing import Excess, GroundTruth, recordings_of
from equimus_ctrl.types import Array

SEARCH = FitSettings(tolerance=2e-2, steps=12)
"""The search begins at the truth, and a few per cent of the excess are no matter."""


def excess(
    ground_truth: GroundTruth, clean: Sequence[Array], effects: Sequence[Effect] = (), refit: bool = True
) -> Excess:
    """The excess residual variance of a leg with ``effects`` alone fitted to a ground truth, by the joints' noise.

    Args:
        ground_truth: what happened.
        clean: for each trial (n, nj) angles without noise [rad].
        effects: what the fitted leg has, at its true size.
        refit: whether the ten default parameters are fitted; else they stay at the truth.
    """
    with threadpool_limits(limits=1, user_api="blas"):  # sums in another order would change the last bits
        return _excess(ground_truth, clean, Model(ground_truth.leg, tuple(effects)), refit)


def _excess(ground_truth: GroundTruth, clean: Sequence[Array], model: Model, refit: bool) -> Excess:
    measured = recordings_of(ground_truth, clean)
    segments = cut(model, measured)
    simulator = reduced_simulator(threads=1)
    noise = np.array(ground_truth.noise)

    def joint_excess(residuals: Sequence[Array]) -> Array:
        return np.asarray(((np.concatenate(residuals) / noise) ** 2).mean(axis=0))

    if not refit:
        found = joint_excess(residuals_of(model, segments, simulator))
        return rounded(found, {})
    free = free_parameters(model, default_names(Model(ground_truth.leg)))
    searched = fit(free, segments, simulator=simulator, settings=SEARCH)
    best, theta = joint_excess(searched.residuals), searched.theta
    # The search weighs both joints alike; one linear step takes it to where their noise counts.
    system = np.concatenate([j / noise[:, None] for j in searched.jacobians]).reshape(-1, len(theta)) * free.scale
    target = (np.concatenate(searched.residuals) / noise).ravel()
    room = 1e-9 * np.ones(len(theta))
    low = np.minimum((free.low - theta) / free.scale, -room)
    high = np.maximum((free.high - theta) / free.scale, room)
    q, r = np.linalg.qr(system)
    step = lsq_linear(r, q.T @ target, bounds=(low, high), method="bvls").x
    moved = np.clip(theta + free.scale * step, free.low, free.high)
    weighted = joint_excess(residuals_of(free.model_at(moved), segments, simulator))
    if weighted.mean() < best.mean():
        best, theta = weighted, moved
    return rounded(best, dict(zip(free.names, theta.tolist(), strict=True)))


def rounded(joints: Array, parameters: dict[str, float]) -> Excess:
    """An excess (nj,) and what was fitted, to six digits."""

    def digits(value: float) -> float:
        return float(f"{value:.6g}")

    shortened = {name: digits(value) for name, value in parameters.items()}
    return Excess(digits(float(joints.mean())), tuple(digits(value) for value in joints.tolist()), shortened)
