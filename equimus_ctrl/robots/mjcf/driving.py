"""How an MJCF robot is driven: poses that its file names, and what its commands can be."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from equimus_ctrl.robots.base import Need, Robot
from equimus_ctrl.robots.mjcf.actuators import FILTERS, OWN, exerts_its_command
from equimus_ctrl.robots.mjcf.entries import Axis, Drive
from equimus_ctrl.robots.mjcf.obstacles import switched_off
from equimus_ctrl.types import Array, frozen_array

if TYPE_CHECKING:
    from equimus_ctrl.robots.mjcf.plan import Plan

SLEW = {int(mujoco.mjtGain.mjGAIN_PID): 1, int(mujoco.mjtGain.mjGAIN_DCMOTOR): 7}
"""Gain of an actuator → where among ``dynprm`` its fastest rate of a command stands, 0 for none."""


class Driven(Robot):
    """What plants and controllers ask of an MJCF robot."""

    if TYPE_CHECKING:  # what ``robots.mjcf.robot`` has

        @property
        def plan(self) -> Plan: ...

        @property
        def joints(self) -> tuple[Axis, ...]: ...

        @property
        def actuators(self) -> tuple[Drive, ...]: ...

        def mujoco_model(self, timestep: float | None = None) -> Any: ...

    @property
    def keyframes(self) -> Mapping[str, Array]:
        """As of any robot: the file's; unnamed ones are called ``key0`` and so on."""
        base, places = self.plan.base, [joint.position for joint in self.joints]
        names = [base.key(k).name or f"key{k}" for k in range(base.nkey)]
        return {name: frozen_array(base.key_qpos[k][places]) for k, name in enumerate(names)}

    @property
    def home(self) -> Array:
        """As of any robot: the first keyframe, else the file's own pose, within the joints' ranges."""
        own = self.plan.base.qpos0[[joint.position for joint in self.joints]]
        return frozen_array(np.clip(next(iter(self.keyframes.values()), own), *self.joint_range))

    @property
    def command_ranges(self) -> Array | None:
        """(2, na) the XML's ``ctrlrange`` of each command, where MuJoCo clips commands there."""
        if self.plan.base.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
            return None
        return np.array([drive.range for drive in self.actuators]).reshape(-1, 2).T

    @property
    def command_limits(self) -> tuple[Array, Array]:
        """As of any robot: the ``ctrlrange``, and of a command that is a force by what that is limited to."""
        ranges, model, n = self.command_ranges, self.mujoco_model(), len(self.actuators)
        low, high = np.full((2, n), [[-np.inf], [np.inf]]) if ranges is None else ranges.copy()
        for k, drive in enumerate(self.actuators):
            gain = float(model.actuator_gainprm[drive.index, 0])
            if model.actuator_forcelimited[drive.index] and gain and exerts_its_command(model, drive):
                ends = np.sort(model.actuator_forcerange[drive.index] / gain)
                low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
        return frozen_array(low), frozen_array(high)

    @property
    def command_rates(self) -> Array:
        """As of any robot: the ``slewmax``."""
        base, found = self.plan.base, np.full(len(self.actuators), np.inf)
        for k, drive in enumerate(self.actuators):
            entry = SLEW.get(int(base.actuator_gaintype[drive.index]))
            if entry is not None and base.actuator_dynprm[drive.index, entry] > 0:
                found[k] = base.actuator_dynprm[drive.index, entry]
        return frozen_array(found)

    def varying(self) -> list[tuple[str, tuple[str, ...]]]:
        """As of any robot: masses with inertias, damping, dry friction and springs of joints, where there are any."""
        numbers = self.parameters()

        def there(*names: str) -> tuple[str, ...]:
            return tuple(name for name in names if numbers.get(name, 0.0) > 0)

        found = [("mass", there(f"{body}.mass", f"{body}.inertia")) for body in self.plan.bodies]
        for joint in self.joint_names:
            found += [("damping", there(f"{joint}.{key}")) for key in ("damping", "frictionloss")]
            found.append(("stiffness", there(f"{joint}.stiffness")))
        return [(kind, names) for kind, names in found if names]

    @property
    def goals(self) -> tuple[bool, ...]:
        """As of any robot: those of servos."""
        return tuple(drive.servo for drive in self.actuators)

    def goals_at(self, position: Array) -> Array:
        """As of any robot: k u + b₀ + b₁ l = 0 of a gain k and a bias b along the actuator's length l."""
        model, found = self.mujoco_model(), np.zeros(len(self.actuators))
        if not any(self.goals):
            return found
        data = mujoco.MjData(model)
        for joint, value in zip(self.joints, np.asarray(position).tolist(), strict=True):
            data.qpos[int(model.joint(joint.name).qposadr[0])] = value
        mujoco.mj_fwdPosition(model, data)
        for k, drive in enumerate(self.actuators):
            if drive.servo:
                i = model.actuator(drive.actuator).id
                length = float(data.actuator_length[model.actuator_outadr[i]])
                gain, bias = float(model.actuator_gainprm[i, 0]), model.actuator_biasprm[i]
                own = int(model.actuator_gaintype[i]) in OWN or gain == 0
                found[k] = length if own else -(float(bias[0]) + float(bias[1]) * length) / gain
        return found

    @property
    def has_torque_domain(self) -> bool:
        """As of any robot: drives remember nothing but filtered commands, nothing ties joints, and all are measured."""
        base = self.plan.base
        filters = sum(int(kind) in FILTERS for kind in base.actuator_dyntype)
        return bool(base.na == filters and not base.neq and base.nv == len(self.joints) + len(self.prescribed_names))

    @property
    def offers(self) -> frozenset[Need]:
        """As of any robot; nothing where its equations are not solved for commands."""
        return frozenset() if self.uninvertible else frozenset[Need](("inverse",))

    @property
    def uninvertible(self) -> tuple[str, ...]:
        """As of any robot: also what ties joints or tendons, and actuators that exert an integral of their commands."""
        base, found = self.plan.base, list(self.obstacles)
        tied = range(base.neq) if "equality" not in switched_off(base) else ()
        for e in tied:
            if base.eq_active0[e]:
                of = base.tendon if int(base.eq_type[e]) == int(mujoco.mjtEq.mjEQ_TENDON) else base.joint
                both = [of(int(k)).name for k in (base.eq_obj1id[e], base.eq_obj2id[e]) if k >= 0]
                found.append(f"equality of {' and '.join(both)}")
        for i in np.flatnonzero(base.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)):
            found.append(f"integrating actuator {base.actuator(int(i)).name or int(i)!r}")
        return tuple(found)
