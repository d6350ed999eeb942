"""Forces of drives by the compiled engine's equations: what actuators exert along their lengths, before the gear."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from equimus_ctrl.engines.encoding import Encoded
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.robots.elastic.morphology import Phase
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array


@lru_cache(maxsize=32)
def _law(form: Structure, phase: Phase) -> tuple[ca.Function, ca.Function]:
    """(q, v, y, u, p) → forces (na,), and their derivatives by (q, v)."""
    m = build(form, phase)
    # What it drives are its lengths, each by itself, and nothing between or behind them.
    alone = replace(m.actuation, jacobian=ca.SX.eye(m.f.numel()), joints=(), added=None, through=None)
    _, forces = alone.drive(m.u)
    given = [m.q, m.v, m.inside.state, m.u, m.p]
    slopes = ca.jacobian(forces, ca.vertcat(m.q, m.v))
    return ca.Function("forces", given, [ca.densify(forces)]), ca.Function("slopes", given, [ca.densify(slopes)])


def drive_forces(coded: Encoded, index: int, motion: Array, command: Array) -> Array:
    """(n, nc) for each command of the robot the force of its actuator [N·m or N].

    Args:
        coded: models.
        index: which of them.
        motion: (n, 2 nv + nz) coordinates of its equations, their rates, and states of laws, the drives' own first.
        command: (n, nc + np) what the forces are made of, see ``effects.command.arrived``, with accelerations that are
            prescribed behind them.
    """
    found = _evaluated(coded, index, motion, command, 0).T
    return np.asarray(found[:, _driven(coded, index)])


def drive_slopes(coded: Encoded, index: int, motion: Array, command: Array) -> Array:
    """(n, nc, 2 nv) their derivatives by coordinates and rates, see ``drive_forces``; own states of drives are held."""
    own = coded.mechanics[index]
    found = _evaluated(coded, index, motion, command, 1).reshape(-1, len(motion), 2 * len(own.starts))
    return np.asarray(found.transpose(1, 0, 2)[:, _driven(coded, index)])


def _driven(coded: Encoded, index: int) -> list[int]:
    """The actuator of each command of the robot; what moves joints whose motion is prescribed is none of its drives."""
    count = len(coded.models[index].robot.actuator_names)
    return [channel.actuator for channel in coded.mechanics[index].channels[:count]]


def _evaluated(coded: Encoded, index: int, motion: Array, command: Array, which: int) -> Array:
    own, phase = coded.mechanics[index], coded.models[0].phase
    nv, ny = len(own.starts), build(own.form, phase).inside.state.numel()
    q, v, z = np.split(motion, [nv, 2 * nv], axis=1)
    inside = z[:, :ny].T if ny else ca.DM(0, 1)
    function = _law(own.form, phase)[which]
    return np.array(function(q.T, v.T, inside, command.T, own.parameters))
