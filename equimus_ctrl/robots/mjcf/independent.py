"""Numbers of an MJCF robot that no combination of others can stand in for: base parameters among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, Self

import mujoco
import numpy as np

from equimus_ctrl.robots.mjcf.entries import ModelParameter
from equimus_ctrl.robots.mjcf.inertia import SHAPE
from equimus_ctrl.types import Array

TRIES = 6
"""States at which it is looked what a number changes."""
CHANGED = 1e-4
"""Share of its bounds by which a number is changed both ways to see what it does."""
INDEPENDENT = 1e-6
"""A number whose effect is within this share of what others can do is left to them."""


class Numbered(Protocol):
    """A robot with parameters that is simulated in MuJoCo."""

    def parameters(self) -> dict[str, float]: ...

    def bounds(self, name: str) -> tuple[float, float]: ...

    def with_parameters(self, values: Mapping[str, float]) -> Self: ...

    def mujoco_model(self) -> Any: ...

    @property
    def joint_names(self) -> tuple[str, ...]: ...

    @property
    def unmeasured_names(self) -> tuple[str, ...]: ...


def independent(robot: Numbered, names: Sequence[str]) -> list[str]:
    """The first parameters of a list that are linearly independent: no combination of earlier ones replaces them.

    Inverse dynamics are linear in the inertial parameters of all bodies, and only some combinations of these matter:
    the base parameters (Gautier & Khalil, "Direct calculation of minimum set of inertial parameters of serial robots",
    1990). Which numbers are enough to move all of these is seen at random states. What drives joints whose motion is
    prescribed is not known, so their forces tell nothing.

    Args:
        robot: whose.
        names: in the order in which they are preferred.
    """
    model = robot.mujoco_model()
    data = mujoco.MjData(model)
    rows_of = [int(model.joint(name).dofadr[0]) for name in (*robot.joint_names, *robot.unmeasured_names)]
    states = np.random.default_rng(0).normal(size=(TRIES, 3, model.nv))

    def forces(changed: Numbered) -> Array:
        m, rows = changed.mujoco_model(), []
        for q, v, a in states:
            data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
            mujoco.mj_inverse(m, data)
            rows.append(data.qfrc_inverse[rows_of].copy())
        return np.concatenate(rows)

    values, size = robot.parameters(), float(np.linalg.norm(forces(robot)))
    basis = np.empty((TRIES * len(rows_of), 0))
    kept: list[str] = []
    for name in names:
        low, high = robot.bounds(name)
        way = CHANGED * (high - low) / 2
        ends = [forces(robot.with_parameters({name: values[name] + side * way})) for side in (1, -1)]
        column = (ends[0] - ends[1]) / (2 * CHANGED)
        left = column - basis @ (basis.T @ column)
        if np.linalg.norm(left) > INDEPENDENT * max(size, float(np.linalg.norm(column))):
            basis = np.column_stack([basis, left / np.linalg.norm(left)])
            kept.append(name)
    return kept


def default_names(robot: Numbered, known: Mapping[str, ModelParameter]) -> list[str]:
    """Parameters that are free by default: masses, inertias, and those of joints that are not 0 in the file.

    Those that others can replace are not among them. Centres of mass, the orientation of inertias and actuators are
    taken to be known.

    Args:
        robot: whose.
        known: all of its parameters.
    """
    values = robot.parameters()
    kept = independent(robot, [n for n in _of_kinds(known, ("mass", "inertia", "armature")) if values[n] > 0])
    rubbing = _of_kinds(known, ("damping", "quadratic_damping", "frictionloss", "stiffness"))
    return kept + [n for n in rubbing if values[n] > 0]


def base_names(robot: Numbered, known: Mapping[str, ModelParameter]) -> list[str]:
    """Of masses, centres, inertias and armatures as many as there are base parameters, see ``independent``.

    Args:
        robot: whose.
        known: all of its parameters.
    """
    wanted, values = (
        _of_kinds(known, ("mass", "com_x", "com_y", "com_z", "inertia", *SHAPE, "armature")),
        robot.parameters(),
    )
    return independent(robot, [n for n in wanted if not n.endswith(".armature") or values[n] > 0])


def _of_kinds(known: Mapping[str, ModelParameter], kinds: Sequence[str]) -> list[str]:
    """Names, kind by kind."""
    return [name for kind in kinds for name, own in known.items() if own.kind == kind]
