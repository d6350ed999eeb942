"""A morphology linearised about a pose at rest."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from equimus_ctrl.models.morphology import Morphology, Phase, pack, structure
from equimus_ctrl.models.symbolic import Structure, build
from equimus_ctrl.types import Array


@lru_cache(maxsize=32)
def _jacobians(form: Structure, phase: Phase) -> ca.Function:
    m = build(form, phase)
    a = m.acceleration
    parts = [ca.jacobian(a, m.q), ca.jacobian(a, m.v), ca.jacobian(a, m.f) @ ca.diag(m.area)]
    return ca.Function("linear", [m.q, m.v, m.f, m.tau, m.p], parts)


def state_matrices(
    morphology: Morphology, pose: ArrayLike, pressure: ArrayLike, phase: Phase = "swing"
) -> tuple[Array, Array]:
    """(A, B) of d/dt (q, v) = A (q, v) + B P about a pose at rest.

    Args:
        morphology: the robot.
        pose: (nj,) [rad].
        pressure: (na,) that holds it there [Pa].
        phase: base fixed or foot pinned.

    Returns:
        A (2nj, 2nj) and B (2nj, na).
    """
    nj, na = len(morphology.joints), len(morphology.actuators)
    force = np.array([a.area for a in morphology.actuators]) * np.asarray(pressure, dtype=np.float64)
    zero = np.zeros(nj)
    by_q, by_v, by_p = (
        np.array(x)
        for x in _jacobians(structure(morphology), phase)(
            np.asarray(pose, dtype=np.float64), zero, force, zero, pack(morphology)
        )
    )
    a = np.block([[np.zeros((nj, nj)), np.eye(nj)], [by_q, by_v]])
    b = np.vstack([np.zeros((nj, na)), by_p])
    return a, b
