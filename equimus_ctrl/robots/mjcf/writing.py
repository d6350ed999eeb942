"""What an MJCF robot has that its file has not, put into a copy of MuJoCo's model of the file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import mujoco

from equimus_ctrl.robots.mjcf.actuators import hold_peak_forces, limit_force, scale_force
from equimus_ctrl.robots.mjcf.inertia import SHAPE, add_mass, reshape_inertias
from equimus_ctrl.robots.mjcf.parts import Compliance, Coupling, Place, Surface, Tether, lay, loosen, rub, stretch
from equimus_ctrl.robots.mjcf.plan import Plan


class Changed(Protocol):
    """A robot that differs from its file, see ``robot.MjcfRobot``."""

    @property
    def plan(self) -> Plan: ...

    @property
    def values(self) -> Mapping[str, float]: ...

    @property
    def payloads(self) -> tuple[tuple[str, float, Place], ...]: ...

    @property
    def compliances(self) -> tuple[Compliance, ...]: ...

    @property
    def tethers(self) -> tuple[Tether, ...]: ...

    @property
    def surfaces(self) -> tuple[Surface, ...]: ...

    @property
    def couplings(self) -> tuple[Coupling, ...]: ...

    @property
    def gains(self) -> tuple[tuple[str, float], ...]: ...

    @property
    def limits(self) -> tuple[tuple[str, float], ...]: ...

    def parameters(self) -> dict[str, float]: ...

    def actuator_of(self, command: str) -> str: ...


def write(model: Any, robot: Changed) -> None:
    """Put all that is not as in the file into a copy of its model, with what ``parts.with_parts`` adds to it.

    Args:
        model: an ``mujoco.MjModel``, changed.
        robot: whose.
    """
    write_parameters(model, robot)
    for compliance in robot.compliances:
        loosen(model, compliance, robot.parameters()[f"{compliance.joint}.armature"])
    for tether in robot.tethers:
        stretch(model, tether)
    for surface in robot.surfaces:
        lay(model, surface)
    for coupling in robot.couplings:
        rub(model, coupling)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def write_parameters(model: Any, robot: Changed) -> None:
    """The same of parameters, payloads and the drives' forces alone: no part is needed.

    Args:
        model: an ``mujoco.MjModel``, changed.
        robot: whose.
    """
    hold_peak_forces(model, robot.plan.base)
    for name, value in robot.values.items():
        robot.plan.parameters[name].write(model, value)
    reshape_inertias(model, _shapes(robot))
    for place, mass, beside in robot.payloads:
        add_mass(model, place, mass, beside)
    for name, factor in robot.gains:
        scale_force(model, robot.actuator_of(name), factor)
    for name, size in robot.limits:
        limit_force(model, robot.actuator_of(name), size)


def _shapes(robot: Changed) -> dict[str, list[float]]:
    """Body → how its mass is spread, see ``SHAPE``, where that is not as in the file."""
    bodies = {name.rpartition(".")[0] for name, value in robot.values.items() if value and name.endswith(SHAPE)}
    return {body: [robot.values.get(f"{body}.{kind}", 0.0) for kind in SHAPE] for body in sorted(bodies)}
