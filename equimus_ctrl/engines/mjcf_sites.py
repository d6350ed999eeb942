"""Where sites of MJCF robots are, by MuJoCo's forward kinematics."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from equimus_ctrl.engines.mjcf import Realised, function_address, realise, scratch
from equimus_ctrl.engines.mjcf_kernel import called
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array


def site_names(model: Model) -> tuple[str, ...]:
    """Sites of an MJCF robot that have names."""
    own = realise(model).mujoco
    names = (mujoco.mj_id2name(own, mujoco.mjtObj.mjOBJ_SITE, k) for k in range(own.nsite))
    return tuple(name for name in names if name)


def site_positions(models: Sequence[Model], trial: Trial, position: Array, sites: Sequence[str]) -> Array:
    """(k, m, ns, 3) where sites are in the room [m].

    Args:
        models: k of one MJCF robot.
        trial: in which some parameters are known to be others.
        position: (k, m, nj) of the joints of each model [rad or m]; where it is not finite sites are not either.
        sites: (ns) their names.
    """
    out = np.empty((*position.shape[:2], len(sites), 3))
    for model, own, found in zip(models, position, out, strict=True):
        _follow(realise(model, trial), own, sites, found)
    return out


def _follow(own: Realised, position: Array, sites: Sequence[str], out: Array) -> None:
    data = scratch.data(own.mujoco)
    chosen = np.array([own.mujoco.site(name).id for name in sites], dtype=np.int64)
    places, rotors = own.places[:, 0].copy(), own.rotors[:, [0, 2]].copy()
    kinematics = function_address("mj_kinematics")
    _along(
        kinematics, own.mujoco._address, data._address, places, rotors, chosen, np.ascontiguousarray(position),
        data.qpos, data.site_xpos, out,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _along(
    kinematics: int,
    model: int,
    data: int,
    places: NDArray[np.int64],
    rotors: NDArray[np.int64],
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
        for r in range(len(rotors)):
            qpos[rotors[r, 0]] = position[k, rotors[r, 1]]
        called(kinematics, model, data)
        for s in range(len(sites)):
            for axis in range(3):
                out[k, s, axis] = where[sites[s], axis]
