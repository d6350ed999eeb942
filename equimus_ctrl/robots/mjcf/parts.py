"""What is done to MuJoCo's model of a robot: drives of their own, springs to the room, surfaces, hard friction."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import mujoco
import numpy as np

from equimus_ctrl.effects.native import HARD
from equimus_ctrl.robots.mjcf.plan import Assets, spec_of
from equimus_ctrl.types import Array

STIFF = 0.25
"""Rate of the end of a play, in units of 1/step."""
Place = tuple[float, float, float]
"""Along the axes of a body, or of the room [m]."""


@dataclass(frozen=True)
class Compliance:
    """A drive that moves its joint through a spring: the joint's armature turns by itself.

    Attributes:
        joint: between whose drive and link.
        stiffness: of the spring [N·m/rad or N/m].
        damping: of its damper [N·m·s/rad or N·s/m].
        play: in place of both: way over which drive and joint do not feel each other [rad or m]; 0 for none.
    """

    joint: str
    stiffness: float
    damping: float
    play: float


@dataclass(frozen=True)
class Tether:
    """A spring from a site, or a body's centre of mass, to a point of the room.

    Attributes:
        place: the site or body.
        stiffness: [N/m].
        anchor: the point, along the room's axes [m].
        length: at which it is free of force [m].
    """

    place: str
    stiffness: float
    anchor: Place
    length: float = 0.0


@dataclass(frozen=True)
class Surface:
    """A level plane in the room below which a site, or a body's centre of mass, cannot go; without friction.

    Attributes:
        place: the site or body, which touches nothing else through it.
        height: of the plane, from the room's origin [m].
        up: the direction against the file's gravity.
        time_constant: of its contact, critically damped, so that what starts below it is not thrown [s].
    """

    place: str
    height: float
    up: Place
    time_constant: float


@dataclass(frozen=True)
class Coupling:
    """Friction over a joint and the next one down its chain, against v + sign·v' of their rates v and v'.

    Attributes:
        joint: the first.
        other: the next.
        sign: 1 for the sum of the rates, −1 for their difference.
        friction: dry [N·m].
        damping: viscous [N·m·s/rad].
    """

    joint: str
    other: str
    sign: int
    friction: float = 0.0
    damping: float = 0.0

    @property
    def name(self) -> str:
        """What it is called as a tendon."""
        return f"{self.joint} {'and' if self.sign > 0 else 'against'} {self.other}"


SOLIMP = 0.9, 0.95, 1e-3, 0.5, 2.0
"""Impedance of contact with a surface: MuJoCo's default, whatever the file's is. One nearer to 1 would let go of what
slides over the surface on an arc, for MuJoCo's constraints know no centripetal acceleration, and catch it again."""
STEPS_HARD, HARDEST = 2.0, 5e-4
"""Shortest time constant of contact, in physics steps of the file, as MuJoCo's ``refsafe`` has it; and one [s] as short
as that of a play's ends, ``packing.SHARP``."""
RADIUS = 1e-3
"""Of the sphere that stands for a point, by which its plane is lower: of no consequence [m]."""


def hardness(timestep: float) -> float:
    """Time constant of contact with a surface [s], by the file's physics step [s]."""
    return max(STEPS_HARD * timestep, HARDEST)


def rotor_of(joint: str) -> str:
    """What the drive of a joint that gives way is called, as a body, a joint and a tendon."""
    return f"{joint} drive"


OFF, ASKEW = (0.1, 0.2, 0.3), (0.5, 0.5, 0.5, 0.5)
"""Where sites and geoms that are moved begin [m], and how these are turned: of those at the frame of their body MuJoCo
does not read where they are."""


def tether_of(place: str) -> tuple[str, str, str]:
    """What a spring from a place to a point of the room is called, as a tendon, and its ends as sites."""
    return f"{place} tether", f"{place} tether end", f"{place} tether point"


def surface_of(place: str) -> tuple[str, str]:
    """What a surface that a place may touch is called, and the sphere there, as geoms."""
    return f"{place} surface", f"{place} surface point"


@dataclass(frozen=True)
class Parts:
    """What is added to a file's model; what of it has a size has none yet.

    Attributes:
        joints: whose drives turn by themselves, each tied to its joint by a tendon that can give way.
        tethered: bodies and sites with a tendon to a site of the room.
        touching: bodies and sites with a surface of their own.
        coupled: joints with a tendon over both of them.
    """

    joints: tuple[str, ...] = ()
    tethered: tuple[str, ...] = ()
    touching: tuple[str, ...] = ()
    coupled: tuple[Coupling, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.joints or self.tethered or self.touching or self.coupled)


@lru_cache(maxsize=64)
def with_parts(xml: str, assets: Assets, parts: Parts) -> Any:
    """``with_parts_spec`` compiled; not to be changed."""
    return with_parts_spec(xml, assets, parts).compile()


def with_parts_spec(xml: str, assets: Assets, parts: Parts) -> Any:
    """The model with drives of their own, springs to points of the room, surfaces, and friction over two joints.

    Args:
        xml: the model.
        assets: files that it names.
        parts: what is added.
    """
    spec = spec_of(xml, assets)
    for own in parts.coupled:
        tendon = spec.add_tendon(name=own.name, springlength=[0.0, 0.0])
        # Nothing of the file's defaults for tendons is to describe it.
        tendon.stiffness, tendon.damping, tendon.frictionloss, tendon.limited = [0.0] * 3, [0.0] * 3, 0.0, 0
        tendon.armature, tendon.actfrclimited = 0.0, 0
        tendon.wrap_joint(own.joint, 1.0)
        tendon.wrap_joint(own.other, float(own.sign))
    for place in parts.touching:
        _add_surface(spec, place)
    for place in parts.tethered:
        name, end, point = tether_of(place)
        spec.worldbody.add_site(name=end, pos=OFF)
        if spec.site(place) is None:
            spec.body(place).add_site(name=point, pos=OFF)
        tendon = spec.add_tendon(name=name, springlength=[0.0, 0.0])
        tendon.stiffness, tendon.damping, tendon.frictionloss, tendon.limited = [0.0] * 3, [0.0] * 3, 0.0, 0
        tendon.wrap_site(end)
        tendon.wrap_site(point if spec.site(place) is None else place)
    for name in parts.joints:
        joint = spec.joint(name)
        # Bodies of one joint each at the same place; the rotor's mass moves with the body that carries it.
        rotor = joint.parent.parent.add_body(name=rotor_of(name), pos=joint.parent.pos, quat=joint.parent.quat)
        # Nothing of the file's defaults for joints and tendons is to describe them.
        own = rotor.add_joint(name=rotor_of(name), type=joint.type, axis=joint.axis, pos=joint.pos, armature=1.0)
        own.damping, own.stiffness, own.frictionloss, own.limited = [0.0] * 3, [0.0] * 3, 0.0, 0
        own.springref, own.springdamper, own.ref = 0.0, [0.0, 0.0], joint.ref
        rotor.mass, rotor.inertia, rotor.explicitinertial = 1e-12, [1e-15] * 3, True
        tendon = spec.add_tendon(name=rotor_of(name), springlength=[0.0, 0.0])
        tendon.stiffness, tendon.damping, tendon.frictionloss, tendon.limited = [1.0, 0.0, 0.0], [0.0] * 3, 0.0, 0
        tendon.wrap_joint(rotor_of(name), 1.0)
        tendon.wrap_joint(name, -1.0)
        for actuator in spec.actuators:
            if actuator.target == name:
                actuator.target = rotor_of(name)
    return spec


def _add_surface(spec: Any, place: str) -> None:
    """Add a level plane, a sphere at a place, and contact between these two alone."""
    plane, ball = surface_of(place)
    # Nothing of the file's defaults for geoms and pairs is to describe them.
    kind, own = mujoco.mjtGeom, {"pos": OFF, "quat": ASKEW, "contype": 0, "conaffinity": 0, "mass": 0.0, "material": ""}
    spec.worldbody.add_geom(name=plane, type=kind.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], **own)
    carrier = spec.body(place) if spec.site(place) is None else spec.site(place).parent
    carrier.add_geom(name=ball, type=kind.mjGEOM_SPHERE, size=[RADIUS, 0.0, 0.0], **own)
    pair = spec.add_pair(name=plane, geomname1=plane, geomname2=ball)
    pair.condim, pair.margin, pair.gap, pair.adhesion = 1, 0.0, 0.0, 0.0
    pair.solimp = SOLIMP


def hook_of(model: Any, place: str) -> tuple[int, Array]:
    """The body that a site is fixed to and where, or a body and its centre of mass, in the body's frame [m]."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, place)
    if site >= 0:
        return int(model.site_bodyid[site]), np.array(model.site_pos[site])
    body = int(model.body(place).id)
    return body, np.array(model.body_ipos[body])


def loosen(model: Any, compliance: Compliance, armature: float) -> None:
    """Give a drive that turns by itself, see ``with_parts``, its inertia, and what ties it to its joint its numbers."""
    rotor, play = rotor_of(compliance.joint), compliance.play
    tendon = model.tendon(rotor).id
    model.tendon_stiffness[tendon], model.tendon_damping[tendon] = compliance.stiffness, compliance.damping
    if play:
        rate = STIFF / model.opt.timestep
        model.tendon_limited[tendon] = 1
        model.tendon_range[tendon] = -play / 2, play / 2
        model.tendon_solref_lim[tendon] = -(rate**2), -2 * rate
        model.tendon_solimp_lim[tendon] = HARD, HARD, 1e-3, 0.5, 2.0
    model.dof_armature[model.joint(rotor).dofadr[0]] = armature
    model.dof_armature[model.joint(compliance.joint).dofadr[0]] = 0.0


def stretch(model: Any, tether: Tether) -> None:
    """Give a spring to the room, see ``with_parts``, its stiffness, free length and end."""
    name, end, point = tether_of(tether.place)
    tendon = model.tendon(name).id
    model.tendon_stiffness[tendon], model.tendon_lengthspring[tendon] = tether.stiffness, tether.length
    model.site_pos[model.site(end).id] = tether.anchor
    own = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, point)
    if own >= 0:
        model.site_pos[own] = hook_of(model, tether.place)[1]


def lay(model: Any, surface: Surface) -> None:
    """Put a surface, see ``with_parts``, at its height, and the sphere that touches it where its place is."""
    plane, ball = (model.geom(name).id for name in surface_of(surface.place))
    up = np.array(surface.up)
    mujoco.mju_quatZ2Vec(model.geom_quat[plane], up)
    model.geom_pos[plane] = (surface.height - RADIUS) * up
    model.geom_pos[ball] = hook_of(model, surface.place)[1]
    model.pair_solref[model.pair(plane).id] = surface.time_constant, 1.0


def rub(model: Any, coupling: Coupling) -> None:
    """Give a tendon over two joints, see ``with_parts``, its friction, which stops it within a step."""
    tendon = model.tendon(coupling.name).id
    model.tendon_damping[tendon], model.tendon_frictionloss[tendon] = coupling.damping, coupling.friction
    model.tendon_solref_fri[tendon] = -1.0, -1.0 / model.opt.timestep
    model.tendon_solimp_fri[tendon] = HARD, HARD, 1e-3, 0.5, 2.0
