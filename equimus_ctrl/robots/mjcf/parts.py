"""What is done to MuJoCo's model of a robot: drives that turn by themselves, friction made hard."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from equimus_ctrl.robots.mjcf.plan import Assets, spec_of

HARD = 0.9999
"""Impedance of dry friction: what a rubbing joint at rest creeps is this near to nothing."""


def rotor_of(joint: str) -> str:
    """What the drive of a joint that gives way is called, as a body, a joint and a tendon."""
    return f"{joint} drive"


@lru_cache(maxsize=64)
def with_rotors(xml: str, assets: Assets, joints: tuple[str, ...]) -> Any:
    """``with_rotors_spec`` compiled; not to be changed."""
    return with_rotors_spec(xml, assets, joints).compile()


def with_rotors_spec(xml: str, assets: Assets, joints: tuple[str, ...]) -> Any:
    """The model with drives of their own, each tied to its joint by a tendon that can give way."""
    spec = spec_of(xml, assets)
    for name in joints:
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


def harden(model: Any, dof: int) -> None:
    """Make dry friction at a degree of freedom stop it within a step, not within MuJoCo's usual tenths of seconds."""
    model.dof_solref[dof] = -1.0, -1.0 / model.opt.timestep
    model.dof_solimp[dof] = HARD, HARD, 1e-3, 0.5, 2.0
