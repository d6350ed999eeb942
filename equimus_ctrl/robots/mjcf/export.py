"""An MJCF robot as MuJoCo's XML again."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.effects.native import Draft, unused
from equimus_ctrl.robots.mjcf.held_bodies import held_tendons
from equimus_ctrl.robots.mjcf.parts import surface_of, tether_of, with_parts_spec
from equimus_ctrl.robots.mjcf.plan import Assets
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

LINEAR = 1
"""MuJoCo's ``interp`` of buffers that are read along lines between their samples."""


def exported(
    robot: MjcfRobot,
    draft: Draft,
    left: Sequence[str] = (),
    folder: str = "",
    measured: Mapping[str, tuple[float, float]] | None = None,
) -> str:
    """MuJoCo's XML of a robot with the parameters that an ``MjModel`` made of it has.

    Args:
        robot: whose.
        draft: its model, see ``mujoco_model``, in which parameters may have been changed since; and further edits.
        left: what the XML does not hold, for a comment.
        folder: of the files that it names, as seen from where it is to be.
        measured: joint → by how much its measurements are late, 0 or at least a step [s], and their scale.
    """
    parts, model = robot.parts, draft.model
    spec = with_parts_spec(robot.xml, Assets(robot.assets), parts)
    before = spec.compile()  # gives ids to what has no name
    for body in spec.bodies[1:]:
        b = body.id
        body.mass, body.ipos, body.inertia = model.body_mass[b], model.body_ipos[b], model.body_inertia[b]
        body.iquat, body.explicitinertial, body.fullinertia = model.body_iquat[b], True, [math.nan] * 6
        for geom in body.geoms:
            geom.mass = 0.0
    given = {own.name for own in spec.joints} & set(robot.edits.prescribe)  # what moves them was not looked for
    copy_numbers(spec, model, given, held_tendons(model, robot.prescribed_names))
    spec.option.timestep = model.opt.timestep
    for place in parts.tethered:
        _, *ends = tether_of(place)
        for name in ends:
            if (site := spec.site(name)) is not None:
                site.pos = model.site_pos[model.site(name).id]
    for place in parts.touching:
        for name in surface_of(place):
            g = model.geom(name).id
            spec.geom(name).pos, spec.geom(name).quat = model.geom_pos[g], model.geom_quat[g]
        own, _ = surface_of(place)
        spec.pair(own).solref = model.pair_solref[model.pair(own).id]
    spec.option.gravity = model.opt.gravity
    finish(spec, draft, measured or {})
    fill_keyframes(spec, before)
    spec.compile()
    if folder and robot.assets:
        spec.meshdir, spec.texturedir = (f"{folder}/{own}".rstrip("/") for own in (spec.meshdir, spec.texturedir))
    return with_comment(spec.to_xml(), left)


def with_comment(xml: str, left: Sequence[str]) -> str:
    """An XML that says what it does not hold."""
    told = ", ".join(left).replace("--", "- -")
    return xml.replace("\n", f"\n  <!-- Not in here: {told}. -->\n", 1) if left else xml


def copy_numbers(spec: Any, model: Any, joints_kept: Collection[str] = (), tendons_kept: Collection[int] = ()) -> None:
    """Give joints, actuators and tendons of a spec the numbers that a model made of it has.

    Args:
        spec: a ``mujoco.MjSpec``, changed in place.
        model: a ``mujoco.MjModel``; what has no actuator of a name there keeps its own.
        joints_kept: that are to stay as they are.
        tendons_kept: likewise, by their ids.
    """
    turn = 180 / math.pi if spec.compiler.degree else 1.0
    driven = {model.actuator(k).name for k in range(model.nactuator)}
    for joint in spec.joints:
        if joint.name in joints_kept:
            continue
        j, d = model.joint(joint.name).id, model.joint(joint.name).dofadr[0]
        joint.damping = [model.dof_damping[d], *model.dof_dampingpoly[d]]
        joint.armature, joint.frictionloss = model.dof_armature[d], model.dof_frictionloss[d]
        joint.stiffness = [model.jnt_stiffness[j], *model.jnt_stiffnesspoly[j]]
        slides = int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
        joint.springref = model.qpos_spring[model.joint(joint.name).qposadr[0]] * (1.0 if slides else turn)
        joint.solref_friction, joint.solimp_friction = model.dof_solref[d], model.dof_solimp[d]
    for actuator in spec.actuators:
        if actuator.name not in driven:
            continue
        a = model.actuator(actuator.name).id
        actuator.gainprm, actuator.biasprm = model.actuator_gainprm[a], model.actuator_biasprm[a]
        actuator.biastype, actuator.dynprm = model.actuator_biastype[a], model.actuator_dynprm[a]
        actuator.dyntype, actuator.actearly = model.actuator_dyntype[a], bool(model.actuator_actearly[a])
        added = actuator.delay != model.actuator_delay[a]
        actuator.delay = model.actuator_delay[a]
        if actuator.delay:
            _buffer(actuator, model)
        if added:
            actuator.interp = LINEAR  # of a command that holds over whole steps the mean over a step
        actuator.forcelimited, actuator.forcerange = model.actuator_forcelimited[a], model.actuator_forcerange[a]
        actuator.lengthrange = model.actuator_lengthrange[a]  # that of a muscle, which its force depends on
    for tendon in spec.tendons:
        t = tendon.id
        if t in tendons_kept:
            continue
        tendon.limited, tendon.range = model.tendon_limited[t], model.tendon_range[t]
        tendon.solref_limit, tendon.solimp_limit = model.tendon_solref_lim[t], model.tendon_solimp_lim[t]
        tendon.stiffness = [model.tendon_stiffness[t], *model.tendon_stiffnesspoly[t]]
        tendon.damping = [model.tendon_damping[t], *model.tendon_dampingpoly[t]]
        tendon.springlength = model.tendon_lengthspring[t]
        tendon.frictionloss = model.tendon_frictionloss[t]
        tendon.solref_friction, tendon.solimp_friction = model.tendon_solref_fri[t], model.tendon_solimp_fri[t]


def finish(spec: Any, draft: Draft, measured: Mapping[str, tuple[float, float]]) -> None:
    """Do to a spec what a draft says beside its numbers, and give its sensors delays and scales, see ``exported``."""
    for edit in draft.edits:
        edit(spec)
    for name, (delay, scale) in measured.items():
        gauge = _add_gauge(spec, name, scale) if scale != 1.0 else ""
        for sensor in _sensors(spec, name):
            if gauge:
                sensor.type, sensor.objtype = mujoco.mjtSensor.mjSENS_TENDONPOS, mujoco.mjtObj.mjOBJ_TENDON
                sensor.objname = gauge
            if delay:
                sensor.delay += delay
                _buffer(sensor, draft.model)
                sensor.interp = LINEAR


def _add_gauge(spec: Any, joint: str, scale: float) -> str:
    """The name of a new tendon that is as long as a joint is measured to have turned."""
    name = unused(f"{joint} measured", spec.tendons)
    tendon = spec.add_tendon(name=name, springlength=[0.0, 0.0])
    # Nothing of the file's defaults for tendons is to describe it.
    tendon.stiffness, tendon.damping, tendon.frictionloss, tendon.limited = [0.0] * 3, [0.0] * 3, 0.0, 0
    tendon.armature, tendon.actfrclimited = 0.0, 0
    tendon.wrap_joint(joint, scale)
    return name


def _buffer(late: Any, model: Any) -> None:
    """Give something with a delay a buffer that holds it."""
    late.nsample = max(late.nsample, math.ceil(late.delay / model.opt.timestep - 1e-9))


def _sensors(spec: Any, joint: str) -> list[Any]:
    """The sensors of a joint's position, or a new one, called as the column of a recording is."""
    kind = mujoco.mjtSensor.mjSENS_JOINTPOS
    own = [sensor for sensor in spec.sensors if sensor.type == kind and sensor.objname == joint]
    if own:
        return own
    name = unused(f"pos.{joint}", spec.sensors)
    return [spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)]


def fill_keyframes(spec: Any, before: Any) -> None:
    """Give each keyframe a value for every state of actuators: its own, or of a filter that is new the key's command.

    Args:
        spec: a ``mujoco.MjSpec``, changed in place.
        before: its model before it had new filters.
    """
    kept = [(key, np.array(key.act), np.array(key.ctrl)) for key in spec.keys]
    for key, *_ in kept:
        key.act = np.empty(0)
    after = spec.compile()
    for key, own, commands in kept:
        own = own if len(own) else np.zeros(before.na)
        commands = commands if len(commands) else np.zeros(before.nu)
        states = np.zeros(after.na)
        for i in range(after.nactuator):
            first, count = int(after.actuator_actadr[i]), int(after.actuator_actnum[i])
            old = int(before.actuator_actadr[i]) if i < before.nactuator else -1
            if old >= 0:
                states[first : first + count] = own[old : old + count]
            elif count and after.actuator_ctrlnum[i]:
                states[first] = commands[after.actuator_ctrladr[i]]
        key.act = states
