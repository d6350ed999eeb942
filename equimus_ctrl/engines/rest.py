"""Where a robot rests under constant commands, all its effects included."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.force import laws_of
from equimus_ctrl.effects.valves import shaped_commands
from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.augmented import Laws, augmented_model, law_parameters
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.equilibrium import equilibrium
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.elastic.morphology import Phase, pack, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.types import Array

AT_REST = 1e-9
"""Torque that is none [N·m]."""
SINKING = 200.0
"""How long a robot sinks at 1 rad/s for each N·m; the leg's softest mode has some 0.3 N·m/rad [s]."""

Forces = Callable[[Array, Array], tuple[Array, Array]]
"""Pose (nj,) of a robot at rest [rad] and pressures (na,) [Pa] → torque on its joints (nj,) [N·m] and force along its
actuators (na,) [N] beside what the pressures exert on their own areas."""


@lru_cache(maxsize=16)
def _at_rest(form: Structure, phase: Phase, laws: Laws) -> ca.Function:
    """(q, pressure, p) → torque on the joints and force along the actuators that effects exert after a long rest."""
    m = augmented_model(form, phase, laws)
    force = m.force + m.more_area * m.pressure
    exerted = ca.substitute([m.torque, force], [m.v, m.z], [ca.SX.zeros(m.v.shape), m.rest_state])
    return ca.Function("at_rest", [m.q, m.pressure, m.p], exerted)


def forces_at_rest(model: Model) -> Forces | None:
    """What the effects of a model exert at rest, without dry friction; None where none of them is a force."""
    laws = laws_of(model.effects)
    if not laws:
        return None
    robot = changed_bodies(model.effects, model.morphology)
    form = structure(robot)
    slots = augmented_model(form, model.phase, laws).slots
    parameters = [*pack(robot), *law_parameters(slots, model.effects, robot.joint_names, robot.actuator_names)]
    function = _at_rest(form, model.phase, laws)

    def forces(q: Array, pressure: Array) -> tuple[Array, Array]:
        torque, force = function(q, pressure, parameters)
        return np.array(torque).ravel(), np.array(force).ravel()

    return forces


def rest_pose(model: Model, command: ArrayLike, near: ArrayLike | None = None) -> Array:
    """(nj,) where a model rests under constant commands, nothing held by dry friction [rad or m].

    Args:
        model: with its effects.
        command: (na,) [Pa, or the unit of each actuator's command].
        near: (nj,) where it is looked for where there may be several such poses [rad or m]; the robot's own pose by
            default.

    Raises:
        ModelError: where no such pose is found.
        NotAvailable: where neither statics of pressures nor equations of motion hold the robot.
    """
    return np.asarray(rest_poses(model, np.asarray(command, dtype=np.float64)[None], near)[0])


def rest_poses(model: Model, commands: ArrayLike, near: ArrayLike | None = None) -> Array:
    """(n, nj) where a model rests under each of constant commands (n, na), looked for near the one before.

    Args:
        model: with its effects.
        commands: (n, na) [Pa, or the unit of each actuator's command].
        near: (nj,) of the first, see ``rest_pose``.

    Raises:
        ModelError, NotAvailable: see ``rest_pose``.
    """
    robot, given = model.robot, np.asarray(commands, dtype=np.float64)
    reached = shaped_commands(model.effects, robot.actuator_names, given, robot.command_ranges)
    if "lengths" in robot.offers:
        return np.array([_rest_under(model, pressure) for pressure in reached])
    begin = robot.home if near is None else np.asarray(near, dtype=np.float64)
    found, dynamics = [np.zeros(len(robot.joint_names)) if begin is None else begin], Dynamics(model)
    for command in reached:
        found.append(equilibrium(dynamics, command, found[-1]))
    return np.array(found[1:])


def _rest_under(model: Model, pressure: Array) -> Array:
    """The same by the statics of what reaches the actuators (na,) [Pa]."""
    kinematics = Kinematics(changed_bodies(model.effects, model.morphology), model.phase)
    forces = forces_at_rest(model)
    if forces is None:
        return kinematics.equilibrium(pressure)
    q0, rests = _unforced(kinematics, pressure)
    if rests and not any(np.any(force) for force in forces(q0, pressure)):
        return q0
    return _settle(kinematics, pressure, forces, q0)


def settle(kinematics: Kinematics, pressure: Array, forces: Forces) -> Array:
    """(nj,) where a robot rests under constant pressures and further generalised forces [rad].

    Args:
        kinematics: of the robot.
        pressure: (na,) [Pa].
        forces: beside what the pressures exert.

    Raises:
        ModelError: where no such pose is found.
    """
    return _settle(kinematics, pressure, forces, _unforced(kinematics, pressure)[0])


def _unforced(kinematics: Kinematics, pressure: Array) -> tuple[Array, bool]:
    """Where a robot rests under its pressures alone, and True; where it does not, the middle of its joint ranges."""
    try:
        return kinematics.equilibrium(pressure), True
    except ModelError:
        low, high = (np.clip(side, -np.pi, np.pi) for side in kinematics.morphology.joint_range)
        return np.asarray((low + high) / 2), False


def _settle(kinematics: Kinematics, pressure: Array, forces: Forces, q0: Array) -> Array:
    def torque(q: Array) -> Array:
        jacobian = kinematics.jacobian(q)
        joint, force = forces(q, pressure)
        return np.asarray(kinematics.rest_torque(q, pressure)[0] + joint + jacobian.T @ force)

    def rests(q: Array, slope: Array) -> bool:
        stable = np.linalg.eigvalsh(-(slope + slope.T) / 2).min() > 0
        return bool(stable and np.abs(torque(q)).max() < AT_REST)

    found = least_squares(torque, q0, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    if not rests(found.x, found.jac):
        # Where there are several poses without torque, the robot sinks into one that is stable.
        sunk = solve_ivp(lambda _, q: torque(q), (0.0, SINKING), q0, method="BDF", rtol=1e-6, atol=1e-9).y[:, -1]
        found = least_squares(torque, sunk, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        if not rests(found.x, found.jac):
            shown = ", ".join(f"{value / 1e3:g}" for value in pressure)
            raise ModelError(
                f"{kinematics.morphology.name}: no pose at rest was found under pressures of {shown} kPa and its "
                "force effects"
            )
    return np.asarray(found.x)
