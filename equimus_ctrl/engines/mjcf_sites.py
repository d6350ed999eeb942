"""Where sites of MJCF robots are, by MuJoCo's forward kinematics."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.engines.mjcf_kernel import called
from equimus_ctrl.engines.mjcf_realised import function_address, scratch
from equimus_ctrl.robots.mjcf.held_bodies import moved_bodies
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array


def site_names(robot: MjcfRobot) -> tuple[str, ...]:
    """Sites that have names."""
    base = robot.plan.base
    names = (mujoco.mj_id2name(base, mujoco.mjtObj.mjOBJ_SITE, k) for k in range(base.nsite))
    return tuple(name for name in names if name)


def unmeasured_sites(robot: MjcfRobot) -> frozenset[str]:
    """Sites that joints move which were not measured."""
    base = robot.plan.base
    moved = moved_bodies(base, (int(base.joint(name).dofadr[0]) for name in robot.unmeasured_names))
    return frozenset(name for name in site_names(robot) if int(base.site(name).bodyid[0]) in moved)


def site_positions(robot: MjcfRobot, position: Array, sites: Sequence[str], moved: Array | None = None) -> Array:
    """(k, m, ns, 3) where sites are in the room [m]. No parameter and no effect moves them along their links.

    Args:
        robot: whose.
        position: (k, m, nj) of its joints [rad or m]; where it is not finite sites are not either.
        sites: (ns) their names.
        moved: (m, np) of joints whose motion is prescribed.
    """
    base = robot.plan.base
    data = scratch.data(base)
    out = np.empty((*position.shape[:2], len(sites), 3))
    names = (*robot.joint_names, *robot.prescribed_names)
    places = np.array([int(base.joint(name).qposadr[0]) for name in names], dtype=np.int64)
    if moved is not None and moved.shape[1]:
        position = np.concatenate([position, np.broadcast_to(moved, (len(position), *moved.shape))], axis=2)
    _along(
        function_address("mj_kinematics"), base._address, data._address, places,
        np.array([base.site(name).id for name in sites], dtype=np.int64),
        np.ascontiguousarray(position).reshape(-1, len(places)), data.qpos, data.site_xpos,
        out.reshape(-1, len(sites), 3),
    )  # fmt: skip
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _along(
    kinematics: int,
    model: int,
    data: int,
    places: NDArray[np.int64],
    sites: NDArray[np.int64],
    position: Array,
    qpos: Array,
    where: Array,
    out: Array,
) -> None:
    for k in range(len(position)):
        if not np.all(np.isfinite(position[k])):
            out[k] = np.nan
            continue
        for j in range(len(places)):
            qpos[places[j]] = position[k, j]
        called(kinematics, model, data)
        for s in range(len(sites)):
            for axis in range(3):
                out[k, s, axis] = where[sites[s], axis]
