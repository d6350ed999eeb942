"""Whether bodies of a robot touch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

LOOKED_AT = 400
"""So many poses are looked at, spread evenly."""


def touching_now(model: Any, data: Any) -> tuple[str, str] | None:
    """Which geoms touch in an ``MjData`` whose contacts are known, the first two; None where none do."""
    for contact in data.contact[: data.ncon]:
        if contact.dist < contact.includemargin and contact.exclude == 0:
            first, second = (model.geom(int(g)).name or f"geom {int(g)}" for g in contact.geom)
            return first, second
    return None


def touching(robot: MjcfRobot, positions: Sequence[Array]) -> tuple[str, str] | None:
    """Which geoms touch in one of the poses (n, nj + np + nu); None where none do.

    Nothing is known of poses without the joints whose motion is prescribed or not measured.
    """
    model = robot.mujoco_model()
    off = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    if off or not positions or not (model.geom_contype.any() and model.geom_conaffinity.any()):
        return None
    poses = np.concatenate(positions)
    data = mujoco.MjData(model)
    joints = (*robot.joint_names, *robot.prescribed_names, *robot.unmeasured_names)
    if poses.shape[1] != len(joints):
        return None
    places = [int(model.joint(name).qposadr[0]) for name in joints]
    for pose in poses[:: max(len(poses) // LOOKED_AT, 1)]:
        data.qpos[places] = pose
        mujoco.mj_fwdPosition(model, data)
        if (found := touching_now(model, data)) is not None:
            return found
    return None
