"""How large the missing physics of an MJCF robot is: in units of what its recordings show of each place.

Pushes are in units of the largest that the drive or gravity exerts there, rates and ways in units of what is covered.
The weak ends hardly show, the strong ones are plain to the eye.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from equimus_ctrl.effects.base import Seen
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.sizes import Size


def mjcf_sizes(model: Model, seen: Mapping[str, Seen]) -> tuple[Size, ...]:
    """The table for an MJCF robot: of the catalogue and of what is outside it.

    Args:
        model: of the robot.
        seen: what its recordings show of each place.
    """
    where = model.robot.places()
    rows: list[Size] = []
    for joint in where["joint"]:
        rows += _of_joint(joint, seen[joint])
    for actuator in where["actuator"]:
        rows += _of_actuator(actuator, seen[actuator])
    for body in dict.fromkeys((*where["link"], *where["foot"])):
        mass = seen[body].mass
        rows.append(Size("payload_mass", "mass", 0.01 * mass, 0.5 * mass, "of all that moves", at=body))
    rows.append(Size("gravity_tilt", "angle", 0.005, 0.15, "0.3 to 9°", "either sign"))
    return tuple(rows)


def _of_joint(name: str, s: Seen) -> Iterator[Size]:
    push, damping, drag = s.push, s.push / s.speed, s.push / s.speed**2

    def row(effect: str, key: str, unit: float, low: float, high: float, law: str = "log") -> Size:
        return Size(effect, key, low * unit, high * unit, "of what is seen there", law, name)  # type: ignore[arg-type]

    yield row("coulomb_friction", "friction", push, 0.003, 0.3)
    yield row("stribeck_friction", "friction", push, 0.003, 0.2)
    yield row("stribeck_friction", "breakaway", push, 0.01, 0.3)
    yield row("stribeck_friction", "velocity", s.speed, 0.02, 0.3)
    yield row("asymmetric_friction", "forward", push, 0.003, 0.3)
    yield row("asymmetric_friction", "backward", push, 0.003, 0.3)
    yield row("load_friction", "share", 1.0, 0.01, 0.4)
    yield row("viscous_friction", "damping", damping, 0.003, 0.5)
    yield row("quadratic_damping", "drag", drag, 0.003, 0.5)
    yield row("asymmetric_damping", "difference", damping, 0.01, 0.5, "either sign")
    yield row("constant_force", "size", push, 0.003, 0.3, "either sign")
    yield row("parallel_spring", "stiffness", push / s.span, 0.01, 0.5)
    yield Size("parallel_spring", "rest", s.low, s.high, "within its range", "linear", name)
    yield row("joint_compliance", "stiffness", push / s.span, 2.0, 100.0)
    yield row("joint_compliance", "damping", damping, 0.02, 0.3)
    yield row("drive_play", "play", s.span, 0.002, 0.1)
    yield row("backlash", "play", s.span, 0.001, 0.05)
    yield row("sensor_offset", "offset", s.span, 0.002, 0.1, "either sign")
    yield row("sensor_scale", "scale", 1.0, 0.003, 0.2, "about one")
    yield row("sensor_delay", "delay", s.span / s.speed, 0.005, 0.2)
    # Outside the catalogue.
    yield row("rough_spot", "friction", push, 0.02, 0.5)
    yield Size(
        "rough_spot", "centre", s.low + 0.25 * s.span, s.high - 0.25 * s.span, "within its range", "linear", name
    )
    yield row("rough_spot", "width", s.span, 0.05, 0.15)
    yield row("angle_damping", "damping", damping, 0.02, 0.5)
    yield Size(
        "angle_damping", "centre", s.low + 0.25 * s.span, s.high - 0.25 * s.span, "within its range", "linear", name
    )
    yield row("angle_damping", "width", s.span, 0.2, 0.4)
    yield row("cogging", "size", push, 0.01, 0.3)
    yield row("cogging", "pitch", s.span, 0.1, 0.3)
    yield row("periodic_torque", "size", push, 0.003, 0.3)
    yield row("periodic_torque", "frequency", s.speed / s.span, 0.1, 1.0)


def _of_actuator(name: str, s: Seen) -> Iterator[Size]:
    time = s.span / s.speed
    yield Size("actuator_gain", "factor", 0.01, 0.3, "1 to 30 %", "about one", name)
    yield Size("torque_saturation", "level", 0.4 * s.drive, 0.97 * s.drive, "below the largest force", "linear", name)
    yield Size("transport_delay", "delay", 0.005 * time, 0.2 * time, "of the time of a motion", at=name)
    yield Size("first_order_lag", "time_constant", 0.005 * time, 0.2 * time, "of the time of a motion", at=name)
