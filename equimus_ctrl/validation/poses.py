"""Poses of a robot: where they are drawn, what holds them, and how fast they are returned to."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.elastic.morphology import Morphology, structure
from equimus_ctrl.types import Array
from equimus_ctrl.validation.reference import evaluate

OMEGA = ((math.pi / 6, 0.0), (2 * math.pi / 3, math.pi / 2))
"""The published workspace of the leg, hip and knee [rad]."""

FREE_HALF_RANGE = 1.2
"""Where a joint of another robot has no stop on a side, as far as this from its middle or its zero [rad]."""


def workspace(morphology: Morphology) -> tuple[Array, Array]:
    """(low, high), each (nj,): where poses are drawn [rad].

    The published workspace for a robot of the leg's structure and joints, within its stops; the middle nine tenths
    between the stops for any other.
    """
    low, high = morphology.joint_range
    leg = nominal_leg()
    if structure(morphology) == structure(leg) and morphology.joint_names == leg.joint_names:
        inner = np.maximum(low, OMEGA[0]), np.minimum(high, OMEGA[1])
        if np.all(inner[0] < inner[1]):
            return inner
    low = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - 2 * FREE_HALF_RANGE, -FREE_HALF_RANGE))
    high = np.where(np.isfinite(high), high, low + 2 * FREE_HALF_RANGE)
    return low + 0.05 * (high - low), high - 0.05 * (high - low)


def holding_pressure(morphology: Morphology, poses: Array) -> tuple[Array, Array]:
    """Pressures that hold poses by the Euler–Lagrange statics, without any stop.

    Args:
        morphology: the robot.
        poses: (n, nj) [rad].

    Returns:
        (n, na) pressures of any sign and size [Pa], and (n,) the greatest torque they leave [N·m]: above rounding
        where the actuators cannot hold the pose.
    """
    pressure, left = evaluate("holding", morphology, poses)
    return pressure, np.abs(left).max(axis=1)


def slowest_rate(morphology: Morphology, poses: Array, force: Array) -> Array:
    """(n,) the greatest real part of the eigenvalues at poses held by forces (n, na) [1/s]: negative where stable."""
    return np.asarray(_eigenvalues(morphology, poses, force).real.max(axis=1))


def _eigenvalues(morphology: Morphology, poses: Array, force: Array) -> NDArray[np.complex128]:
    n, nj = poses.shape
    by_q, by_v = evaluate("linear", morphology, poses, force)
    matrix = np.zeros((n, 2 * nj, 2 * nj))
    matrix[:, :nj, nj:] = np.eye(nj)
    matrix[:, nj:, :nj] = by_q.reshape(n, nj, nj).transpose(0, 2, 1)
    matrix[:, nj:, nj:] = by_v.reshape(n, nj, nj).transpose(0, 2, 1)
    return np.asarray(np.linalg.eigvals(matrix), dtype=np.complex128)
