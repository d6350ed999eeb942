"""A morphology as a MuJoCo model, its elastic actuators as 3-2-1 elements.

A 3-2-1 element (Zhu et al., "EquiMus", 2025) has the energy of a uniform elastic rod of mass m: point masses
m/6, 2m/3, m/6 at the ends and the middle, two drives in series (each stiffness 2k, damping 2c, rest length l0/2,
force F) and one equality that keeps both halves equally long.

MuJoCo's x is the morphology's x and its z points up, so (x, y) becomes (x, 0, −y) and angles turn about +y.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.errors import ModelError, unknown_name
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.robots.elastic.morphology import BASE, ElasticActuator, Joint, Morphology, Phase, Point
from equimus_ctrl.types import Array

INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")
HINGE_AXIS = (0.0, 1.0, 0.0)
POINT_INERTIA = 1e-9  # MuJoCo wants more than none; a millionth of a link's
STOP_IMPEDANCE = 1e-4  # the least MuJoCo allows: the limit then acts as the plain spring and damper it stands for
STOP_SOLIMP = (STOP_IMPEDANCE, STOP_IMPEDANCE, 0.001, 0.5, 2.0)
ABSENT_STOP = 1e3  # where the limit of a missing stop is put [rad]

Scene = Callable[[Any], None]
"""Adds to an ``mujoco.MjSpec`` of a robot what stands around it, such as ``models.ball.add_ball``."""


@dataclass(frozen=True)
class SolverSettings:
    """How MuJoCo integrates and how hard it holds the equalities.

    Attributes:
        timestep: [s].
        integrator: ``"implicitfast"``, ``"Euler"``, ``"implicit"`` or ``"RK4"``.
        time_constant: of the equalities' error decay [s]; None means two time steps, the least MuJoCo allows.
        impedance: of the equalities, just below 1.
        softness: factor on how far the equalities give way; below 1 ``compile_model`` holds them harder than an
            impedance of 0.9999, the most that MuJoCo takes, at no cost in time.
        iterations: of the constraint solver, at most.
        tolerance: of the constraint solver.
    """

    timestep: float = 1 / 1200
    integrator: str = "implicitfast"
    time_constant: float | None = None
    impedance: float = 0.9999
    iterations: int = 50
    tolerance: float = 1e-10
    softness: float = 1.0

    def check(self) -> None:
        """Raise ModelError where MuJoCo could not work with these settings."""
        if self.integrator not in INTEGRATORS:
            raise ModelError(unknown_name("integrator", self.integrator, INTEGRATORS, "solver settings"))
        for key in ("timestep", "time_constant", "tolerance", "softness"):
            value = getattr(self, key)
            if value is not None and not 0 < value < math.inf:
                raise ModelError(f"solver settings: {key} is {value:g}, expected more than 0")
        if not 0 < self.impedance < 1:
            raise ModelError(f"solver settings: impedance is {self.impedance:g}, expected between 0 and 1")
        if self.iterations < 1:
            raise ModelError(f"solver settings: iterations is {self.iterations}, expected at least 1")


def point_position(point: Point) -> tuple[float, float, float]:
    """A morphology's point in MuJoCo's coordinates of the same body's frame."""
    x, y = point.xy
    return (x, 0.0, -y)


def add_elastic_actuator(
    spec: mujoco.MjSpec,
    name: str,
    origin: str,
    insertion: str,
    *,
    mass: float,
    stiffness: float,
    damping: float,
    rest_length: float,
    area: float = 1.0,
    command_range: tuple[float, float] | None = None,
    settings: SolverSettings | None = None,
) -> mujoco.MjsActuator:
    """Put a linear elastic actuator between two sites of any MjSpec, as a 3-2-1 element.

    The element is built in the plane of the origin site's local x and z (its hinge turns about the site's local y),
    which suits planar mechanisms that move in that plane. Before the first step the element's own joints must be
    closed, see ``close_elements``.

    Args:
        spec: changed in place.
        name: of the actuator; the element's bodies and joints are called ``name/upper`` and so on.
        origin: name of the site at one end; its body carries the element.
        insertion: name of the site at the other end.
        mass: spread evenly [kg], more than 0.
        stiffness: [N/m].
        damping: [N·s/m].
        rest_length: [m].
        area: force per command [N] (m² where the command is a pressure in Pa).
        command_range: (low, high) of the command, or None for no limit.
        settings: whose equality settings to use.

    Returns:
        The actuator; a positive command lengthens it.

    Raises:
        ModelError: where a site does not exist or a number cannot be.
    """
    settings = settings or SolverSettings()
    settings.check()
    names = [site.name for site in spec.sites]
    for label in (origin, insertion):
        if label not in names:
            raise ModelError(
                f"actuator {name!r}: there is no site {label!r} (known: {', '.join(n for n in names if n) or 'none'})"
            )
    for key, value in (("mass", mass), ("rest_length", rest_length), ("area", area)):
        if not 0 < value < math.inf:
            raise ModelError(f"actuator {name!r}: {key} is {value:g}, expected more than 0")
    for key, value in (("stiffness", stiffness), ("damping", damping)):
        if not 0 <= value < math.inf:
            raise ModelError(f"actuator {name!r}: {key} is {value:g}, expected at least 0")
    if command_range is not None and not command_range[0] < command_range[1]:
        raise ModelError(
            f"actuator {name!r}: command_range is {command_range}, expected (low, high) with low below high"
        )
    if any(body.name == f"{name}/upper" for body in spec.bodies) or any(a.name == name for a in spec.actuators):
        raise ModelError(f"actuator {name!r}: the model already has one of that name")
    try:
        # Where a site really is (frames, Euler angles, defaults) is known to MuJoCo's compiler alone.
        probe = spec.copy()
        probe.compiler.fusestatic = False
        resolved = probe.compile()
    except ValueError as error:
        raise ModelError(f"actuator {name!r}: the model it is added to does not compile ({error})") from None
    start = resolved.site(origin)
    if start.bodyid[0] == resolved.site(insertion).bodyid[0]:
        where = resolved.body(int(start.bodyid[0])).name or "the same body"
        raise ModelError(f"actuator {name!r}: both sites are on body {where!r}, so it cannot lengthen")

    upper = spec.site(origin).parent.add_body(name=f"{name}/upper", pos=start.pos, quat=start.quat)
    _point_mass(upper, mass / 6)
    _plain_joint(upper, f"{name}/hinge", mujoco.mjtJoint.mjJNT_HINGE, HINGE_AXIS)
    tendon = spec.add_tendon(name=f"{name}/length")
    tendon.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    tendon.stiffness[:] = 0.0
    tendon.damping[:] = 0.0
    tendon.frictionloss = tendon.armature = 0.0
    body = upper
    for half, share in (("middle", 2 / 3), ("lower", 1 / 6)):
        body = body.add_body(name=f"{name}/{half}")
        _point_mass(body, mass * share)
        slide = _plain_joint(body, f"{name}/{half}", mujoco.mjtJoint.mjJNT_SLIDE, (1.0, 0.0, 0.0))
        slide.stiffness[0] = 2 * stiffness
        slide.damping[0] = 2 * damping
        slide.springref = rest_length / 2
        tendon.wrap_joint(slide.name, 1.0)
    body.add_site(name=f"{name}/end")
    solref = (settings.time_constant or 2 * settings.timestep, 1.0)
    solimp = (settings.impedance, settings.impedance, 0.001, 0.5, 2.0)
    halves = spec.add_equality(
        name=f"{name}/halves",
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=f"{name}/lower",
        name2=f"{name}/middle",
        solref=solref,
        solimp=solimp,
    )
    halves.data[:5] = (0.0, 1.0, 0.0, 0.0, 0.0)
    spec.add_equality(
        name=f"{name}/insertion",
        type=mujoco.mjtEq.mjEQ_CONNECT,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        name1=f"{name}/end",
        name2=insertion,
        solref=solref,
        solimp=solimp,
    )
    actuator = spec.add_actuator(
        name=name, trntype=mujoco.mjtTrn.mjTRN_TENDON, target=tendon.name, gaintype=mujoco.mjtGain.mjGAIN_FIXED
    )
    actuator.biastype = mujoco.mjtBias.mjBIAS_NONE
    actuator.dyntype = mujoco.mjtDyn.mjDYN_NONE
    actuator.gear[:] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    actuator.forcelimited = actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    actuator.gainprm[0] = area
    if command_range is not None:
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.ctrlrange = command_range
    return actuator


def _plain_joint(
    body: mujoco.MjsBody, name: str, kind: mujoco.mjtJoint, axis: tuple[float, float, float]
) -> mujoco.MjsJoint:
    """A joint that takes nothing from the model's default classes."""
    joint = body.add_joint(name=name, type=kind, axis=axis)
    joint.pos = (0.0, 0.0, 0.0)
    joint.limited = joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    joint.stiffness[:] = 0.0
    joint.damping[:] = 0.0
    joint.springdamper = (0.0, 0.0)
    joint.armature = joint.frictionloss = joint.springref = joint.ref = 0.0
    return joint


def _point_mass(body: mujoco.MjsBody, mass: float) -> None:
    body.mass = mass
    body.ipos = (0.0, 0.0, 0.0)
    body.inertia = (POINT_INERTIA,) * 3
    body.explicitinertial = True


def build_spec(morphology: Morphology, phase: Phase = "swing", settings: SolverSettings | None = None) -> mujoco.MjSpec:
    """The MjSpec of a morphology, base fixed (swing) or foot pinned (stance), with all joints at 0 and without stops.

    ``compile_model`` adds joint stops, ``close_elements`` closes elements; ``export_model`` writes files with both.

    In stance the base slides freely in the plane and keeps its orientation, and an equality pins the foot to the
    world's site ``foothold``.

    Args:
        morphology: the robot.
        phase: base fixed or foot pinned.
        settings: of MuJoCo's solver; its physics step among them.
    """
    settings = settings or SolverSettings()
    settings.check()
    spec = mujoco.MjSpec()
    spec.modelname = morphology.name
    spec.compiler.degree = False
    option = spec.option
    option.timestep = settings.timestep
    option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{settings.integrator.upper()}")
    option.iterations = settings.iterations
    option.tolerance = settings.tolerance
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT.value
    tilt = morphology.tilt
    option.gravity = (-morphology.gravity * math.sin(tilt), 0.0, -morphology.gravity * math.cos(tilt))

    base = spec.worldbody.add_body(name=BASE)
    bodies = {BASE: base}
    if phase == "stance":
        _point_mass(base, max(morphology.base_mass, 1e-6))
        for axis, direction in (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 0.0, -1.0))):
            base.add_joint(name=f"{BASE}/{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
    for joint in morphology.joints:
        link = morphology.link(joint.child)
        body = bodies[joint.parent].add_body(name=link.name, pos=point_position(morphology.joint_point(joint)))
        body.mass = link.mass
        body.ipos = (link.com, 0.0, 0.0)
        body.inertia = (max(link.inertia, POINT_INERTIA),) * 3
        body.explicitinertial = True
        hinge = body.add_joint(name=joint.name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=HINGE_AXIS)
        hinge.damping[0] = joint.damping
        bodies[link.name] = body
        _draw_link(body, link.length)
    _add_foot(spec, bodies[morphology.foot], morphology, phase, settings)
    for actuator in morphology.actuators:
        for label, point in (("origin", actuator.origin), ("insertion", actuator.insertion)):
            bodies[point.body].add_site(name=f"{actuator.name}/{label}", pos=point_position(point), size=(0.006,) * 3)
        _add_actuator(spec, actuator, morphology, settings)
    return spec


def _add_actuator(
    spec: mujoco.MjSpec, actuator: ElasticActuator, morphology: Morphology, settings: SolverSettings
) -> None:
    add_elastic_actuator(
        spec,
        actuator.name,
        f"{actuator.name}/origin",
        f"{actuator.name}/insertion",
        mass=actuator.mass,
        stiffness=actuator.stiffness,
        damping=actuator.damping,
        rest_length=actuator.rest_length,
        area=actuator.area,
        command_range=(morphology.command_low, morphology.command_high),
        settings=settings,
    )


def _add_foot(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, morphology: Morphology, phase: Phase, settings: SolverSettings
) -> None:
    length = morphology.link(morphology.foot).length
    body.add_site(name="foot", pos=(length, 0.0, 0.0), size=(0.012,) * 3, rgba=(0.1, 0.1, 0.1, 1.0))
    if phase == "swing":
        return
    spec.worldbody.add_site(name="foothold", pos=(0.0, 0.0, 0.0))
    spec.add_equality(
        name="foothold",
        type=mujoco.mjtEq.mjEQ_CONNECT,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        name1="foot",
        name2="foothold",
        solref=(settings.time_constant or 2 * settings.timestep, 1.0),
        solimp=(settings.impedance, settings.impedance, 0.001, 0.5, 2.0),
    )


def _draw_link(body: mujoco.MjsBody, length: float) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(0.0, 0.0, 0.0, length, 0.0, 0.0),
        size=(0.012, 0.0, 0.0),
        rgba=(0.45, 0.5, 0.58, 1.0),
        contype=0,
        conaffinity=0,
        mass=0.0,
    )


def compile_model(
    morphology: Morphology,
    phase: Phase = "swing",
    settings: SolverSettings | None = None,
    scene: Scene | None = None,
) -> mujoco.MjModel:
    """The compiled MuJoCo model of a morphology, with its joint stops set.

    A stop is a joint limit of the least impedance d MuJoCo allows: its force d·(k r + b v − a)/A is then that of a
    one-sided spring and damper, but for the share d of what the bare acceleration a would need. A joint limit has one
    k and one b, so where a joint's stops differ the upper one is the limit of a fixed tendon over that joint.

    Args:
        morphology: the robot.
        phase: base fixed or foot pinned.
        settings: of MuJoCo's solver.
        scene: adds what stands around it.
    """
    spec = build_spec(morphology, phase, settings)
    if scene is not None:
        scene(spec)
    model = compile_with_stops(spec, morphology)
    if settings is not None and settings.softness != 1.0:
        # What an equality gives way is proportional to these; the joint stops use the hinges' alone.
        model.body_invweight0[:] *= settings.softness
        model.dof_invweight0[element_slides(model)] *= settings.softness
    return model


def compile_with_stops(spec: mujoco.MjSpec, morphology: Morphology) -> mujoco.MjModel:
    """A spec that has a morphology's joints, compiled with their stops; see ``compile_model``."""
    for joint in morphology.joints:
        _limit(spec, joint)
    model = spec.compile()
    for joint in morphology.joints:
        index = model.joint(joint.name).id
        # With direct stiffness K and damping C MuJoCo's limit exerts (K r + C v) / inverse_inertia.
        if stop := joint.lower or joint.upper:
            inverse_inertia = model.dof_invweight0[model.jnt_dofadr[index]]
            model.jnt_solref[index] = (-stop.stiffness * inverse_inertia, -stop.damping * inverse_inertia)
        if joint.upper and stops_differ(joint):
            tendon = model.tendon(stop_tendon(joint.name)).id
            inverse_inertia = model.tendon_invweight0[tendon]
            upper = (-joint.upper.stiffness * inverse_inertia, -joint.upper.damping * inverse_inertia)
            model.tendon_solref_lim[tendon] = upper
    return model


def element_slides(model: mujoco.MjModel) -> list[int]:
    """The degrees of freedom along all 3-2-1 elements of a model."""
    halves = [f"{name}/{half}" for name in _element_names(model) for half in ("middle", "lower")]
    return [int(model.joint(half).dofadr[0]) for half in halves]


def stop_tendon(joint: str) -> str:
    """What the tendon is called that is a joint's upper stop where a joint limit cannot be both."""
    return f"{joint}/upper"


def stops_differ(joint: Joint) -> bool:
    """Whether a joint's two stops differ in stiffness or damping, which takes more than one MuJoCo limit."""
    a, b = joint.lower, joint.upper
    return bool(a and b and (a.stiffness, a.damping) != (b.stiffness, b.damping))


def _limit(spec: mujoco.MjSpec, joint: Joint) -> None:
    low = joint.lower.angle if joint.lower else -ABSENT_STOP
    high = joint.upper.angle if joint.upper else ABSENT_STOP
    if joint.lower is None and joint.upper is None:
        return
    split_stops = stops_differ(joint)
    hinge = spec.joint(joint.name)
    hinge.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    hinge.range = (low, ABSENT_STOP if split_stops else high)
    hinge.solimp_limit = STOP_SOLIMP
    hinge.solref_limit = (1.0, 1.0)
    if split_stops:
        tendon = spec.add_tendon(name=stop_tendon(joint.name))
        tendon.wrap_joint(joint.name, 1.0)
        tendon.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        tendon.range = (-ABSENT_STOP, high)
        tendon.solimp_limit = STOP_SOLIMP
        tendon.solref_limit = (1.0, 1.0)


def close_elements(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Set the joints of all 3-2-1 elements so that their ends meet, for the skeleton's current qpos and qvel.

    Args:
        model: compiled, of a morphology.
        data: its state, changed in place.

    Raises:
        ModelError: where an element's two ends lie on the same spot.
    """
    mujoco.mj_kinematics(model, data)
    own: list[int] = []
    for name in _element_names(model):
        hinge = model.joint(f"{name}/hinge")
        upper = model.body(f"{name}/upper").id
        end = model.equality(f"{name}/insertion").obj2id[0]
        frame = data.xmat[model.body_parentid[upper]].reshape(3, 3) @ _rotation(model.body_quat[upper])
        x, _, z = frame.T @ (data.site_xpos[end] - data.xanchor[hinge.id])
        length = math.hypot(x, z)
        if length < 1e-9:
            raise ModelError(f"actuator {name!r} has no length at this pose, so its direction is undefined")
        data.qpos[hinge.qposadr[0]] = model.qpos0[hinge.qposadr[0]] + math.atan2(-z, x)
        own.append(hinge.dofadr[0])
        for half in ("middle", "lower"):
            slide = model.joint(f"{name}/{half}")
            begins = model.qpos0[slide.qposadr[0]] - model.body(f"{name}/{half}").pos[0]
            data.qpos[slide.qposadr[0]] = begins + length / 2
            own.append(slide.dofadr[0])
    if not own:
        return
    skeleton = data.qvel.copy()
    skeleton[own] = 0.0
    data.qvel[:] = skeleton
    mujoco.mj_forward(model, data)
    equality = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    jacobian = np.zeros((data.nefc, model.nv))
    for i in range(data.nefc):
        if mujoco.mj_isSparse(model):
            first, count = data.efc_J_rowadr[i], data.efc_J_rownnz[i]
            jacobian[i, data.efc_J_colind[first : first + count]] = data.efc_J[first : first + count]
        else:
            jacobian[i] = data.efc_J[i * model.nv : (i + 1) * model.nv]
    jacobian = jacobian[equality]
    data.qvel[own] = np.linalg.lstsq(jacobian[:, own], -jacobian @ skeleton, rcond=None)[0]
    mujoco.mj_forward(model, data)


def _element_names(model: mujoco.MjModel) -> list[str]:
    names = [model.equality(i).name for i in range(model.neq)]
    found = [name.removesuffix("/insertion") for name in names if name.endswith("/insertion")]
    parts = ((mujoco.mjtObj.mjOBJ_JOINT, "hinge"), (mujoco.mjtObj.mjOBJ_BODY, "upper"))
    return [n for n in found if all(mujoco.mj_name2id(model, kind, f"{n}/{part}") >= 0 for kind, part in parts)]


def _rotation(quaternion: Array) -> Array:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def place(
    model: mujoco.MjModel, data: mujoco.MjData, kinematics: Kinematics, position: Array, velocity: Array | None = None
) -> None:
    """Put a compiled morphology into a pose: joints, base (in stance, so that the foot is on its foothold), elements.

    Args:
        model: made by ``compile_model``.
        data: changed in place.
        kinematics: of the same morphology and phase.
        position: (nj,) [rad].
        velocity: (nj,) [rad/s]; none by default.
    """
    joints = [model.joint(name) for name in kinematics.morphology.joint_names]
    speed = np.zeros(len(joints)) if velocity is None else velocity
    data.qpos[[joint.qposadr[0] for joint in joints]] = position
    data.qvel[[joint.dofadr[0] for joint in joints]] = speed
    if kinematics.phase == "stance":
        base = [model.joint(f"{BASE}/{axis}") for axis in "xy"]
        data.qpos[[joint.qposadr[0] for joint in base]] = -kinematics.foot(position)
        data.qvel[[joint.dofadr[0] for joint in base]] = -kinematics.foot_jacobian(position) @ speed
    close_elements(model, data)
