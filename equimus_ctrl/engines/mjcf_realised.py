"""A model of an MJCF robot as MuJoCo and the kernel that steps it take it."""

from __future__ import annotations

import ctypes
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from operator import attrgetter
from pathlib import Path
from threading import local
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.command import DELAY
from equimus_ctrl.effects.force import ForceEffect, force_effects, laws_with
from equimus_ctrl.effects.native import harden
from equimus_ctrl.effects.sensors import sensor_settings
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.engines import compiled
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import NotAvailable
from equimus_ctrl.models.augmented import Laws
from equimus_ctrl.models.mjcf import Scene
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.parts import rotor_of
from equimus_ctrl.robots.mjcf.robot import MjcfRobot, mjcf_of
from equimus_ctrl.types import Array

LOST = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
"""What MuJoCo warns of where its numbers are no motion any more."""


@lru_cache(maxsize=8)
def function_address(name: str) -> int:
    """Address of one of MuJoCo's functions void(const mjModel*, mjData*)."""
    folder, version = Path(mujoco.__file__).parent, mujoco.__version__
    for file in (f"libmujoco.so.{version}", f"libmujoco.{version}.dylib", "mujoco.dll"):
        try:
            library = ctypes.CDLL(str(folder / file))
        except OSError:
            continue
        address = ctypes.cast(getattr(library, name), ctypes.c_void_p).value
        assert address is not None
        return address
    raise NotAvailable(f"MuJoCo's library is not where its package is expected to have it, in {folder}")


@dataclass(frozen=True, eq=False)
class Realised:
    """A model as MuJoCo and the kernel take it.

    Attributes:
        robot: with all effects on bodies and drives.
        mujoco: its ``MjModel``; what the kernel changes of it is set anew before each run.
        effects: all of the model's.
        places: (nj, 3) of the joints in qpos and qvel, and in qvel of what drives them.
        moved: (np, 2) of joints whose motion is prescribed, in qpos and qvel.
        others: (np + nu, 2) the same, and of those that were not measured.
        rotors: (n, 3) of drives that turn by themselves: in qpos, in qvel, and which joint they drive.
        stepped: laws that are stepped beside MuJoCo.
        laws: (nj, nc) prepared constants of these.
        loss: (nj,) dry friction in the model.
        valve: (na, 6), see ``effects.command.DELAY``.
        sensor: (nj, 4), see ``effects.sensors.OFFSET``.
        rows: what ``mjcf.rows_of`` has worked out, by history.
    """

    robot: MjcfRobot
    mujoco: Any
    effects: tuple[Effect, ...]
    places: NDArray[np.int64]
    moved: NDArray[np.int64]
    others: NDArray[np.int64]
    rotors: NDArray[np.int64]
    stepped: Laws
    laws: Array
    loss: Array
    valve: Array
    sensor: Array
    rows: dict[Hashable, Array] = field(default_factory=dict)


def realise(
    model: Model,
    trial: Trial | None = None,
    dt: float | None = None,
    hard_friction: bool = True,
    scene: Scene | None = None,
) -> Realised:
    """What MuJoCo and the kernel need of an MJCF robot with effects.

    Args:
        model: of an MJCF robot.
        trial: in which some parameters are known to be others.
        dt: another physics step than the XML's [s].
        hard_friction: whether effects' dry friction holds what it stops; else it creeps as the XML's constraints do.
        scene: adds what stands around it.
    """
    given = mjcf_of(model.robot)
    robot = changed_bodies(model.effects, given if trial is None else trial.robot_in(given))
    own = robot.mujoco_model(dt, scene)
    # To look which constraints hang together takes longer than to solve those of a few joints at once.
    own.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    dofs = {joint.name: int(own.joint(joint.name).dofadr[0]) for joint in robot.joints}
    laws, stepped = force_effects(model.effects), stepped_laws(model.effects)
    for effect in laws:
        if effect.mujoco_field is not None:
            field, entry = effect.mujoco_field
            (value,) = effect.parameters().values()
            place = dofs[effect.location]
            getattr(own, field)[place if entry is None else (place, entry)] += value
        if hard_friction and effect.dry:
            harden(own, dofs[effect.location])
    valve = valve_settings(model.effects, robot.actuator_names)
    # The XML's own delays are exact with any step, as those of effects are, and know the command before a recording.
    valve[:, DELAY] += own.actuator_delay[[drive.index for drive in robot.actuators]]
    own.actuator_delay[:] = 0.0
    names = robot.joint_names
    turning = [(own.joint(rotor_of(c.joint)), names.index(c.joint)) for c in robot.compliances]
    rotors = [(int(rotor.qposadr[0]), int(rotor.dofadr[0]), j) for rotor, j in turning]
    drives = {j: int(rotor.dofadr[0]) for rotor, j in turning}
    places = [(int(own.joint(name).qposadr[0]), dofs[name], drives.get(j, dofs[name])) for j, name in enumerate(names)]
    return Realised(
        robot,
        own,
        model.effects,
        np.array(places, dtype=np.int64),
        places_of(own, robot.prescribed_names),
        places_of(own, (*robot.prescribed_names, *robot.unmeasured_names)),
        np.array(rotors, dtype=np.int64).reshape(-1, 3),
        stepped,
        _laws(stepped, laws, names),
        np.array([own.dof_frictionloss[dofs[name]] for name in names]),
        valve,
        sensor_settings(model.effects, names),
    )


def places_of(model: Any, joints: Sequence[str]) -> NDArray[np.int64]:
    """(n, 2) where some joints are in qpos and qvel of an ``MjModel``."""
    own = [model.joint(name) for name in joints]
    return np.array([(int(j.qposadr[0]), int(j.dofadr[0])) for j in own], dtype=np.int64).reshape(-1, 2)


def stepped_laws(effects: Sequence[Effect]) -> Laws:
    """The laws that MuJoCo has no field for; those with states where one of the effects has them."""
    return tuple(law for law in laws_with(effects, "mjcf") if law.mujoco_field is None)


def _laws(stepped: Laws, effects: Sequence[ForceEffect], joints: Sequence[str]) -> Array:
    """(nj, nc) prepared constants of some laws, those of no effect doing nothing."""
    generated, _ = compiled.load_mjcf(stepped)
    attached = {(type(e), e.location): e for e in effects}
    rows = []
    for joint in joints:
        values: list[float] = []
        for law in stepped:
            own = attached.get((law, joint))
            for key, meta in law.parameter_info().items():
                values.append(law.neutral.get(key, meta["high"]) if own is None else float(getattr(own, key)))
        rows.append(generated.prepare(np.array(values)))
    return np.array(rows)


@cache
def _sizes() -> attrgetter[tuple[int, ...]]:
    """A model's sizes, on which its ``MjData`` depends: MuJoCo would write beyond the ends of another's."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    return attrgetter(*(name for name in dir(model) if name.startswith("n") and isinstance(getattr(model, name), int)))


def sizes_of(model: Any) -> tuple[int, ...]:
    """All sizes of a model."""
    return _sizes()(model)


class _Scratch(local):
    """One ``MjData`` for each size of model and thread: to make one takes as long as hundreds of steps."""

    def __init__(self) -> None:
        self.known: dict[tuple[int, ...], Any] = {}

    def data(self, model: Any) -> Any:
        key = (*_sizes()(model), hash(model.names))
        if key not in self.known:
            self.known[key] = mujoco.MjData(model)
        data = self.known[key]
        mujoco.mj_resetData(model, data)
        return data


scratch = _Scratch()
