"""What the generator writes for each robot structure; the kernels are written against these signatures.

Angles, velocities, forces and lengths travel as tuples of floats, so that nothing is allocated in a loop; ``c`` is
the array that ``prepare`` makes from the parameter vector (``robots.elastic.morphology.pack``).
"""

from __future__ import annotations

from equimus_ctrl.types import Array

Floats = tuple[float, ...]

N_JOINTS = 0
N_ACTUATORS = 0


def prepare(p: Array) -> Array:
    """The constants ``c`` of one parameter vector."""
    raise NotImplementedError


def actuator_lengths(q: Floats, c: Array) -> Floats:
    """Actuator lengths [m]."""
    raise NotImplementedError


def actuator_areas(c: Array) -> Floats:
    """Force per pressure of each actuator [m²]."""
    raise NotImplementedError


def static_pressure(q: Floats, c: Array) -> Floats:
    """Pressures that hold q at rest [Pa]."""
    raise NotImplementedError


def torque_pressure(q: Floats, tau: Floats, c: Array) -> Floats:
    """Pressures that make the joint torques tau [N·m], least norm [Pa]."""
    raise NotImplementedError


def pressure_torque(q: Floats, f: Floats, c: Array) -> Floats:
    """Joint torques that pressures f [Pa] make [N·m]."""
    raise NotImplementedError


def joint_tuple(values: Array) -> Floats:
    """The first N_JOINTS entries as a tuple."""
    raise NotImplementedError


def actuator_tuple(values: Array) -> Floats:
    """The first N_ACTUATORS entries as a tuple."""
    raise NotImplementedError
