"""What recordings say of parameters: Fisher information, the free numbers of starts eliminated with their prior."""

from __future__ import annotations

import numpy as np

from equimus_ctrl.identification.fit import Fit
from equimus_ctrl.identification.noise import Noise, whiten
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.types import Array


def root_of_inverse(precision: Array) -> Array:
    """(p, p) L with LLᵀ the inverse of a symmetric positive matrix."""
    strength, directions = np.linalg.eigh(precision)
    # Rounding can take a direction that is known far less than others below nothing.
    least = np.finfo(float).eps * strength[-1] * len(strength)
    return np.asarray(directions / np.sqrt(np.maximum(strength, least)))


def information(fit: Fit, noise: Noise) -> Array:
    """(p, p) Fisher information of a fit's recordings on its parameters, in units of their scale.

    A = Σ (W ∂y/∂θ)ᵀ(W ∂y/∂θ) over segments, W whitening the noise, each start eliminated by its Schur complement.

    Args:
        fit: whose derivatives are taken.
        noise: of joints and other channels.
    """
    by_theta, by_start = fit.derivatives
    p = len(fit.theta)
    total = np.zeros((p, p))
    for segment, slopes, starts in zip(fit.problem.segments, by_theta, by_start, strict=True):
        s = starts.shape[2]
        whole = np.concatenate([starts, slopes * fit.parameters.scale], axis=2)
        rows = whiten(noise, segment.trial.sample_times, whole).reshape(-1, s + p)
        prior = np.hstack([np.diag(start_precision(segment, noise)), np.zeros((s, p))])
        triangle: Array = np.asarray(np.linalg.qr(np.vstack([prior, rows]), mode="r"))[s:, s:]
        total += triangle.T @ triangle
    return np.asarray((total + total.T) / 2)


def start_precision(segment: Segment, noise: Noise) -> Array:
    """(s,) one over the standard deviation that is known of each free number of a segment's start."""
    sigma = np.array([noise[j].sigma for j in segment.start_joints])
    return np.asarray(segment.start_weights / sigma)
