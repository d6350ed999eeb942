"""Where named points of a robot are, and how joints move them, whatever the robot was described by."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from equimus_ctrl.effects.base import Robots
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import mjcf_of
from equimus_ctrl.types import Array


class Points(Protocol):
    """Points of a robot that have a name.

    Attributes:
        names: of all that joints move.
        ends: of those that stick out.
        y_down: whether y points downwards, as in the plane of robots with elastic actuators.
    """

    names: tuple[str, ...]
    ends: tuple[str, ...]
    y_down: bool

    def at(self, name: str, q: ArrayLike) -> tuple[Array, Array]:
        """A point (3,) [m] in a pose (nj,) [rad or m], and (3, nj) how it moves with the joints."""
        ...


class MjcfPoints:
    """Sites of an MJCF robot, and centres of mass of its bodies, in the room.

    Args:
        model: with its effects.

    Raises:
        NotAvailable: where it moves by joints that are not measured.
    """

    y_down = False

    def __init__(self, model: Model) -> None:
        robot = mjcf_of(changed_bodies(model.effects, model.robot))
        if others := (*robot.prescribed_names, *robot.unmeasured_names):
            raise NotAvailable(f"{robot.name}: where its sites are depends on {', '.join(others)}, which no pose tells")
        places = robot.places()
        ends = robot.ends
        self.names = tuple(dict.fromkeys((*places["foot"], *places["link"])))
        self.ends = ends["foot"] or ends["link"]
        self._mujoco = robot.mujoco_model()
        self._data = mujoco.MjData(self._mujoco)
        joints = [self._mujoco.joint(name) for name in robot.joint_names]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._dof = np.array([joint.dofadr[0] for joint in joints])
        self._sites = {name: self._mujoco.site(name).id for name in places["foot"]}
        self._whole = np.zeros((3, self._mujoco.nv))

    def at(self, name: str, q: ArrayLike) -> tuple[Array, Array]:
        """As of any points."""
        model, data = self._mujoco, self._data
        data.qpos[self._qpos] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        if name in self._sites:
            mujoco.mj_jacSite(model, data, self._whole, None, self._sites[name])
            place = data.site_xpos[self._sites[name]]
        else:
            body = model.body(name).id
            mujoco.mj_jacBodyCom(model, data, self._whole, None, body)
            place = data.xipos[body]
        return place.copy(), self._whole[:, self._dof]


class ElasticPoints:
    """The foot and the links' tips of a planar robot relative to its base: x to the right, y down, z = 0.

    Args:
        model: with its effects.
    """

    y_down = True

    def __init__(self, model: Model) -> None:
        robot = changed_bodies(model.effects, model.morphology)
        self._kinematics = Kinematics(robot, model.phase)
        carried = [joint.child for joint in robot.joints]
        self._tips = {name: carried.index(name) for name in carried} | {"foot": carried.index(robot.foot)}
        self.names: tuple[str, ...] = ("foot", *carried)
        self.ends: tuple[str, ...] = ("foot",)

    def at(self, name: str, q: ArrayLike) -> tuple[Array, Array]:
        """As of any points."""
        places, slopes = self._kinematics.tips(q)
        k = self._tips[name]
        return np.append(places[k], 0.0), np.vstack([slopes[k], np.zeros(slopes.shape[2])])


POINTS_OF: dict[Robots, Callable[[Model], Points]] = {"elastic": ElasticPoints, "mjcf": MjcfPoints}
"""Kind of robots (``RobotTraits.catalogue``) → its points."""


def points_of(model: Model) -> Points:
    """The named points of a model.

    Raises:
        NotAvailable: where poses do not tell where they are.
    """
    return POINTS_OF[model.robot.traits.catalogue](model)
