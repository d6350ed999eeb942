"""An MJCF robot as MuJoCo's XML again."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.robots.mjcf.held_bodies import held_tendons
from equimus_ctrl.robots.mjcf.parts import surface_of, tether_of, with_parts_spec
from equimus_ctrl.robots.mjcf.plan import Assets
from equimus_ctrl.robots.mjcf.robot import MjcfRobot


def exported(
    robot: MjcfRobot,
    model: Any,
    left: Sequence[str] = (),
    folder: str = "",
    late: Mapping[str, float] | None = None,
) -> str:
    """MuJoCo's XML of a robot with the parameters that an ``MjModel`` made of it has.

    Args:
        robot: whose.
        model: see ``mujoco_model``; parameters may have been changed in it since.
        left: what the XML cannot hold, for a comment.
        folder: of the files that it names, as seen from where it is to be.
        late: joint → by how much its measurements are late, at least a step [s]: the delay of its sensors.
    """
    parts = robot.parts
    spec = with_parts_spec(robot.xml, Assets(robot.assets), parts)
    before = spec.compile()  # gives ids to what has no name
    turn = 180 / math.pi if spec.compiler.degree else 1.0
    for body in spec.bodies[1:]:
        b = body.id
        body.mass, body.ipos, body.inertia = model.body_mass[b], model.body_ipos[b], model.body_inertia[b]
        body.iquat, body.explicitinertial, body.fullinertia = model.body_iquat[b], True, [math.nan] * 6
        for geom in body.geoms:
            geom.mass = 0.0
    given = {own.name for own in spec.joints} & set(robot.edits.prescribe)
    driven = {model.actuator(k).name for k in range(model.nactuator)}
    for joint in spec.joints:
        if joint.name in given:
            continue  # what moves it was not looked for
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
        actuator.delay = model.actuator_delay[a]
        if model.actuator_delay[a]:
            # Of a command that holds over whole steps the mean over a step.
            _buffer(actuator, model)
        actuator.forcelimited, actuator.forcerange = model.actuator_forcelimited[a], model.actuator_forcerange[a]
        actuator.lengthrange = model.actuator_lengthrange[a]  # that of a muscle, which its force depends on
    held = held_tendons(model, robot.prescribed_names)
    for tendon in spec.tendons:
        t = tendon.id
        if t in held:
            continue  # as it is in the file
        tendon.limited, tendon.range = model.tendon_limited[t], model.tendon_range[t]
        tendon.solref_limit, tendon.solimp_limit = model.tendon_solref_lim[t], model.tendon_solimp_lim[t]
        tendon.stiffness = [model.tendon_stiffness[t], *model.tendon_stiffnesspoly[t]]
        tendon.damping = [model.tendon_damping[t], *model.tendon_dampingpoly[t]]
        tendon.springlength = model.tendon_lengthspring[t]
        tendon.frictionloss = model.tendon_frictionloss[t]
        tendon.solref_friction, tendon.solimp_friction = model.tendon_solref_fri[t], model.tendon_solimp_fri[t]
    for name, delay in (late or {}).items():
        for sensor in _sensors(spec, name):
            sensor.delay += delay
            _buffer(sensor, model)
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
    _fill(spec, before)
    spec.compile()
    if folder and robot.assets:
        spec.meshdir, spec.texturedir = (f"{folder}/{own}".rstrip("/") for own in (spec.meshdir, spec.texturedir))
    text: str = spec.to_xml()
    if left:
        text = text.replace("\n", f"\n  <!-- Not in here: {', '.join(left)}. -->\n", 1)
    return text


def _buffer(late: Any, model: Any) -> None:
    """Give something with a delay a buffer that holds it, linear between the samples in it."""
    late.nsample = max(late.nsample, math.ceil(late.delay / model.opt.timestep - 1e-9))
    late.interp = 1


def _sensors(spec: Any, joint: str) -> list[Any]:
    """The sensors of a joint's position, or a new one, called as the column of a recording is."""
    kind = mujoco.mjtSensor.mjSENS_JOINTPOS
    own = [sensor for sensor in spec.sensors if sensor.type == kind and sensor.objname == joint]
    return own or [spec.add_sensor(name=f"pos.{joint}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)]


def _fill(spec: Any, before: Any) -> None:
    """Give each keyframe a value for every filter: its own, or of one that is new the key's command."""
    filters = [i for i, actuator in enumerate(spec.actuators) if int(actuator.dyntype)]
    if len(filters) == before.na:
        return
    for key in spec.keys:
        own, commands = np.array(key.act), np.array(key.ctrl)
        own = own if len(own) else np.zeros(before.na)
        commands = commands if len(commands) else np.zeros(before.nu)
        places = before.actuator_actadr
        key.act = np.array([own[places[i]] if places[i] >= 0 else commands[i] for i in filters])
