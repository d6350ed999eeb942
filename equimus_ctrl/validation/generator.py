"""Random robots of two to four joints with mono- and bi-articular actuators, and inputs that excite them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.robots.elastic.morphology import BASE, ElasticActuator, Joint, Link, Morphology, Point
from equimus_ctrl.types import Array
from equimus_ctrl.validation.experiment import Experiment
from equimus_ctrl.validation.plan import SAMPLE_RATE

SHAPES: dict[str, tuple[int, tuple[tuple[int, int], ...]]] = {
    "two_joints": (2, ((-1, 0), (-1, 1))),
    "two_joints_three_drives": (2, ((-1, 0), (0, 1), (-1, 1))),
    "three_joints": (3, ((-1, 0), (-1, 1), (0, 2))),
    "three_joints_free_root": (3, ((0, 1), (0, 2))),
    "four_joints": (4, ((-1, 0), (-1, 1), (0, 2), (1, 3))),
    "four_joints_crossed": (4, ((-1, 0), (0, 1), (0, 2), (1, 3))),
}
"""Name → how many joints in series, and the bodies that each actuator spans (−1 is the base): one joint or two."""

FLOATING = (2, ((0, 1),))
"""As an entry of ``SHAPES``: no actuator is tied to the base, so nothing turns the robot as a whole."""

SHORT, LONG = 0.05, 0.8
"""Lengths that an actuator may have over the poses that are looked at [m]."""

POSES = 200
REACH = 0.6
"""Poses looked at lie within this of the robot hanging down [rad]."""

LEAST_ARM = 0.01
"""Every actuator turns some joint with at least this moment arm [m]."""

MOST_CONDITION = 2e3
"""Of the mass matrix over those poses."""

ATTEMPTS = 1000
PULSES = 5


@dataclass(frozen=True)
class _Draw:
    rng: np.random.Generator

    def __call__(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))


def random_robot(
    shape: str | tuple[int, tuple[tuple[int, int], ...]], rng: np.random.Generator, name: str = "robot"
) -> Morphology:
    """A robot of one of ``SHAPES`` with every number drawn at random, drawn again until its poses are sensible.

    Sensible means: near the robot hanging down every actuator is 5 to 80 cm long and has a moment arm of at least 1 cm
    about some joint, the mass matrix is well conditioned, and without pressure the robot rests, stably, near there.

    Args:
        shape: a name of ``SHAPES``, or an entry like theirs.
        rng: where the numbers come from.
        name: of the robot.

    Raises:
        ModelError: where no such robot was found.
    """
    joints, spans = SHAPES[shape] if isinstance(shape, str) else shape
    for _ in range(ATTEMPTS):
        robot = _drawn(joints, spans, rng, name)
        if is_sensible(robot, rng):
            return robot
    raise ModelError(f"no sensible robot of shape {shape!r} was found in {ATTEMPTS} attempts")


def hanging(robot: Morphology) -> Array:
    """(nj,) the pose in which all links hang straight down [rad]."""
    pose = np.zeros(len(robot.joints))
    pose[0] = math.pi / 2
    return pose


def is_sensible(robot: Morphology, rng: np.random.Generator) -> bool:
    """Whether a robot's poses near hanging down are of use, see ``random_robot``."""
    kinematics = Kinematics(robot)
    for q in hanging(robot) + rng.uniform(-REACH, REACH, (POSES // 10, len(robot.joints))):
        lengths = kinematics.lengths(q)
        arms = np.abs(kinematics.jacobian(q)).max(axis=1)
        if lengths.min() < SHORT or lengths.max() > LONG or arms.min() < LEAST_ARM:
            return False
        if np.linalg.cond(kinematics.mass(q)) > MOST_CONDITION:
            return False
    try:
        rest = kinematics.equilibrium(np.zeros(len(robot.actuators)), hanging(robot))
    except ModelError:
        return False
    return bool(np.abs(rest - hanging(robot)).max() < 2 * REACH and kinematics.lengths(rest).min() > SHORT)


def _drawn(n: int, spans: tuple[tuple[int, int], ...], rng: np.random.Generator, name: str) -> Morphology:
    u = _Draw(rng)
    body = [*(f"link{i}" for i in range(n)), BASE]  # body[-1] is the base
    links = tuple(Link(body[i], u(0.15, 0.3), u(0.06, 0.2), u(0.06, 0.14), u(3e-4, 1.5e-3)) for i in range(n))
    joints = tuple(Joint(f"joint{i}", body[i - 1], body[i], damping=u(0.02, 0.2)) for i in range(n))
    actuators = []
    for k, (origin, insertion) in enumerate(spans):
        side = 1.0 if rng.random() < 0.5 else -1.0
        if origin < 0:
            start = Point(BASE, u(0.05, 0.12), math.pi if side < 0 else 0.0)
        else:
            # On the upper half of the link, beside its line, as a muscle's origin is.
            start = Point.cartesian(body[origin], u(0.0, 0.5) * links[origin].length, side * u(0.03, 0.08))
        across = -side if origin < 0 else side
        end = Point.cartesian(body[insertion], u(0.4, 0.9) * links[insertion].length, across * u(0.0, 0.06))
        actuators.append(
            ElasticActuator(
                f"drive{k}",
                start,
                end,
                mass=u(0.05, 0.3),
                stiffness=u(80, 350),
                damping=u(4, 25),
                rest_length=0.2,
                area=u(2e-4, 6e-4),
            )
        )
    robot = Morphology(name, links, joints, tuple(actuators), foot=body[n - 1], base_mass=u(0.1, 0.3))
    lengths = Kinematics(robot).lengths(hanging(robot))
    sized = (
        replace(a, rest_length=max(u(0.85, 1.1) * float(le), 0.02)) for a, le in zip(actuators, lengths, strict=True)
    )
    return replace(robot, actuators=tuple(sized))


def pulsed_runs(
    robots: tuple[Morphology, ...], runs: int, duration: float, rng: np.random.Generator, strength: float = 0.6
) -> Experiment:
    """Runs under several pulses of pressure in every actuator.

    Each robot starts at rest, up to 0.3 rad from where it hangs without pressure. At five instants common to all runs
    each actuator is switched: to nothing, or to a random pressure up to ``strength`` of the range.

    Args:
        robots: of one shape.
        runs: of each robot.
        duration: [s].
        rng: where starts, instants and pressures come from.
        strength: share of the command range in use.
    """
    own = tuple(robot for robot in robots for _ in range(runs))
    n, nj, na = len(own), len(robots[0].joints), len(robots[0].actuators)
    rest = np.array([Kinematics(r).equilibrium(np.zeros(na), hanging(r)) for r in robots])
    start = np.repeat(rest, runs, axis=0) + rng.uniform(-0.3, 0.3, (n, nj))
    samples = round(duration * SAMPLE_RATE)
    later = 1 + rng.choice(samples - 2, PULSES - 1, replace=False)
    switch = np.sort(np.append(0, later)) / SAMPLE_RATE
    most = strength * np.array([r.command_high for r in own])[:, None, None]
    pressure = most * rng.uniform(0.2, 1.0, (n, PULSES, na)) * (rng.random((n, PULSES, na)) < 0.6)
    return Experiment(own, "swing", start, switch, pressure, duration)
