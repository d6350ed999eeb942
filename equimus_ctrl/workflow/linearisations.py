"""A model linearised about a pose at rest, for the design of regulators."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.frames import dataframe
from equimus_ctrl.models import linear
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.shown import Short, counted
from equimus_ctrl.types import Array, frozen_array

if TYPE_CHECKING:
    import control
    from pandas import DataFrame

SCHEMA = "equimus-ctrl/linear-model/1"


@dataclass(frozen=True, eq=False, repr=False)
class Linearised(Short):
    """d/dt x = A x + B u, y = C x about a pose at rest, all as departures from it.

    Attributes:
        model: of the robot.
        pose: (nj,) about which it is [rad or m].
        a: (n, n).
        b: (n, na).
        c: (nj, n).
        states: names: ``pos_hip``, ``vel_hip``, ``pressure_maa``.
        inputs: names: ``cmd_maa``.
        outputs: names: ``pos_hip``, as the sensors show them.
    """

    model: Model
    pose: Array
    a: Array
    b: Array
    c: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def told(self) -> str:
        """Its size, and where its slowest and fastest poles are."""
        real = self.poles.real
        sizes = (counted(len(own), noun) for own, noun in ((self.states, "state"), (self.inputs, "input")))
        return (
            f" of {self.model.name}: {', '.join(sizes)}, {counted(len(self.outputs), 'output')}; poles with real parts "
            f"from {real.min():.4g} to {real.max():.4g} 1/s"
        )

    @property
    def poles(self) -> NDArray[np.complex128]:
        """(n,) eigenvalues of A, the slowest first [1/s]."""
        found = np.linalg.eigvals(self.a).astype(np.complex128)
        return np.asarray(found[np.lexsort((found.imag, np.abs(found)))])

    @property
    def system(self) -> control.StateSpace:
        """The same for python-control."""
        import control  # takes half a second

        zero = np.zeros((len(self.outputs), len(self.inputs)))
        return control.ss(
            self.a, self.b, self.c, zero, states=list(self.states), inputs=list(self.inputs),
            outputs=list(self.outputs), name=self.model.name,
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """As JSON data, SI."""
        return {
            "schema": SCHEMA,
            "model": self.model.name,
            "pose": dict(zip(self.model.robot.joint_names, self.pose.tolist(), strict=True)),
            "states": list(self.states),
            "inputs": list(self.inputs),
            "outputs": list(self.outputs),
            "a": self.a.tolist(),
            "b": self.b.tolist(),
            "c": self.c.tolist(),
            "poles": [{"real": float(own.real), "imaginary": float(own.imag)} for own in self.poles],
        }

    def to_dataframe(self) -> DataFrame:
        """A row for each pole: real and imaginary part [1/s], natural frequency [Hz], damping ratio.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        size = np.abs(self.poles)
        ratio = np.divide(-self.poles.real, size, out=np.full(len(size), np.nan), where=size > 0)
        return dataframe(
            {"real": self.poles.real, "imaginary": self.poles.imag, "frequency": size / (2 * np.pi), "damping": ratio}
        )


def linearise(
    model: Model | None = None,
    pose: ArrayLike | Mapping[str, float] | None = None,
    command: ArrayLike | None = None,
) -> Linearised:
    """A model about a pose at rest, from what reaches its valves or drives to its positions.

    Delays of valves and sensors, dry friction, limited rates and play take no part, see ``models.linear.linearise``.

    Args:
        model: the nominal leg by default.
        pose: (nj,), or a position for each joint by its name; by default the first keyframe, or the pose in which the
            robot's description has it [rad or m].
        command: (na,) that holds it there; by default the one that does [Pa, or the unit of commands].

    Raises:
        ConfigError: for a joint that there is not, one without a position, positions of another number, or where none
            are given and the robot's description names none.
        NotAvailable: where no equations of motion hold the robot, or it has joints that are not measured.
        ModelError: where nothing holds the pose.
    """
    model = model or nominal_model()
    at = _pose(model, pose)
    found = linear.linearise(model, at, command)
    return Linearised(
        model, frozen_array(at), frozen_array(found.A), frozen_array(found.B), frozen_array(found.C),
        tuple(found.state_labels), tuple(found.input_labels), tuple(found.output_labels),
    )  # fmt: skip


def _pose(model: Model, pose: ArrayLike | Mapping[str, float] | None) -> Array:
    robot = model.robot
    joints = robot.joint_names
    if pose is None:
        if robot.home is None:
            raise ConfigError(f"{robot.name}: its description names no pose, expected one: {', '.join(joints)}")
        return robot.home
    if isinstance(pose, Mapping):
        for name in pose:
            if name not in joints:
                raise ConfigError(unknown_name("joint", name, joints, robot.name))
        if missing := [name for name in joints if name not in pose]:
            raise ConfigError(f"{robot.name}: the pose lacks {', '.join(missing)}, expected a position of each joint")
        return np.array([pose[name] for name in joints], dtype=np.float64)
    at = np.asarray(pose, dtype=np.float64)
    if at.shape != (len(joints),):
        raise ConfigError(
            f"{robot.name}: the pose has shape {at.shape}, expected ({len(joints)},): {', '.join(joints)}"
        )
    return at
