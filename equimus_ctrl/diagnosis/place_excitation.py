"""What recordings show of each place of a robot, from which the sizes follow that are worth trying there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.engines.mjcf import command_at, joint_forces, others_along, places_in_room
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.types import Array

SLOPE_SAMPLES = 4
"""Half the number of samples over which a speed is read off measured positions."""
FEW = 400
"""So many samples decide which lengths an actuator covers, and which forces act."""
SELDOM = 0.95
"""A speed or force is "seldom exceeded" in this share of the samples."""
LEAST_WAY = 1e-3
"""A point that moves less hardly moves [m]."""
EDGE = 0.01
"""Share of the samples to either side of what a coordinate covers."""


@dataclass(frozen=True, eq=False)
class _Recorded:
    """What all segments show together.

    Attributes:
        position: (n, nj) of the joints [rad or m].
        speed: (nj,) what their rates seldom exceed [rad/s or m/s].
        rates: (m, nj) in the middle of ``SLOPE_SAMPLES`` samples to either side [rad/s or m/s].
        commands: (l, na) those before the segments included [Pa or unit of the commands].
        interval: usual time between samples [s].
        duration: of the longest segment [s].
        recorded: from a recording's start to a segment's last sample, the longest [s].
    """

    position: Array
    speed: Array
    rates: Array
    commands: Array
    interval: float
    duration: float
    recorded: float

    @classmethod
    def of(cls, segments: Sequence[Segment]) -> _Recorded:
        """Of some segments."""
        times = [s.trial.sample_times for s in segments]
        rates = np.concatenate([_central_rates(s.trial.sample_times, s.measured) for s in segments])
        return cls(
            np.concatenate([s.measured for s in segments]),
            np.quantile(np.abs(rates), SELDOM, axis=0),
            rates,
            np.concatenate([np.vstack([s.trial.before, s.trial.commands]) for s in segments]),
            float(np.median(np.concatenate([np.diff(t) for t in times]))),
            float(max(t[-1] - t[0] for t in times)),
            float(max(s.trial.sample_times[-1] - s.trial.times[0] for s in segments)),
        )


def excitation_of(model: Model, segments: Sequence[Segment]) -> dict[str, Excitation]:
    """For each place of a robot what recordings show of it."""
    if model.robot.traits.forces_along_actuators:
        return _excitation_along_actuators(model, segments)
    return _excitation_at_joints(model, segments)


def _excitation_along_actuators(model: Model, segments: Sequence[Segment]) -> dict[str, Excitation]:
    """Of joints, and of actuators that have lengths of their own.

    The force of a joint is its stiffness at the median pose, springs and gravity included, times the angle that it
    covers; that of an actuator its spring's over the lengths it covers. The rate of an actuator is an order of
    magnitude and no bound: median over the poses of |Σⱼ ∂l/∂qⱼ|, its rate if all joints turned the same way at 1 rad/s,
    times the speed of the fastest joint.
    """
    m, seen = model.morphology, _Recorded.of(segments)
    kinematics = Kinematics(m, model.phase)
    poses = seen.position[:: max(len(seen.position) // FEW, 1)]
    lengths = np.array([kinematics.lengths(q) for q in poses])
    along = np.abs(np.array([kinematics.jacobian(q) for q in poses]) @ np.ones(len(m.joints)))
    middle = np.median(seen.position, axis=0)
    _, slope = kinematics.rest_torque(middle)
    largest = np.maximum(seen.commands.max(axis=0), 1.0)
    mass = sum(link.mass for link in m.links) + sum(a.mass for a in m.actuators)
    found = {}
    for j, name in enumerate(m.joint_names):
        low, high = _covered(seen.position[:, j])
        force = abs(float(slope[j, j])) * (high - low)
        speed = max(float(seen.speed[j]), 1e-3)
        found[name] = Excitation(low, high, speed, force, float(largest.max()), seen.interval, seen.duration, mass)
    for i, actuator in enumerate(m.actuators):
        low, high = _covered(lengths[:, i])
        rate = float(np.median(along[:, i]) * seen.speed.max())
        force = actuator.stiffness * (high - low)
        found[actuator.name] = Excitation(
            low, high, max(rate, 1e-4), force, float(largest[i]), seen.interval, seen.duration, mass
        )
    return _elsewhere(m, found[m.joint_names[0]]) | found


def _excitation_at_joints(model: Model, segments: Sequence[Segment]) -> dict[str, Excitation]:
    """Of joints with their drives: forces are those of drives and gravity along the measured motion."""
    own, seen = realise(model), _Recorded.of(segments)
    robot = own.robot
    inner = slice(SLOPE_SAMPLES, -SLOPE_SAMPLES)
    rows = np.concatenate([command_at(s.trial, s.trial.sample_times[inner]) for s in segments])
    middles = np.concatenate([s.measured[inner] for s in segments])
    chosen = slice(None, None, max(len(middles) // FEW, 1))
    along = [others_along(own, s.trial, s.trial.sample_times[inner]) for s in segments]
    q, v = (np.concatenate(parts)[chosen] for parts in zip(*along, strict=True))
    drives, weights = joint_forces(own, middles[chosen], seen.rates[chosen], rows[chosen], (q, v))
    largest = np.maximum(np.abs(seen.commands).max(axis=0), 1e-9)
    most = float(largest.max(initial=1e-9))
    mass = float(own.mujoco.body_mass[1:].sum())
    speed = np.maximum(seen.speed, 1e-6)
    by_drive = {drive.name: float(np.abs(drives[:, i]).max()) for i, drive in enumerate(robot.actuators)}
    found = {}
    for j, joint in enumerate(robot.joints):
        low, high = _covered(seen.position[:, j])
        own_drives = [i for i, drive in enumerate(robot.actuators) if drive.joint == joint.name]
        whole = drives[:, own_drives].sum(axis=1)
        force = max(float(np.quantile(np.abs(v), SELDOM)) for v in (whole, weights[:, j])) or 1.0
        drive_force = max((by_drive[robot.actuators[i].name] for i in own_drives), default=force)
        found[joint.name] = Excitation(
            low, high, float(speed[j]), force, most, seen.interval, seen.duration, mass, drive_force,
            recorded=seen.recorded,
        )  # fmt: skip
    ends = {
        drive.name: replace(found[drive.joint], command=float(largest[i]), drive=by_drive[drive.name])
        for i, drive in enumerate(robot.actuators)
    }
    first = found[robot.joint_names[0]]
    links = {name: replace(first, reach=_reach(own.mujoco, name)) for name in robot.places()["link"]}
    carried = links | dict.fromkeys(robot.places()["foot"], first)
    at = places_in_room(own, middles[chosen], tuple(carried), q)
    moving = {name: _moving(carried[name], at[:, k], robot.up) for k, name in enumerate(carried)}
    # A joint and its drive may have one name; sizes of both are those of the joint then.
    return _elsewhere(robot, first) | moving | ends | found


def _moving(carried: Excitation, at: Array, up: Array | None) -> Excitation:
    """Of a body's centre or a site that is at places (n, 3) in the room; without gravity nothing is low or high."""
    x, y, z = (float(v) for v in np.median(at, axis=0))
    away = np.linalg.norm(at - (x, y, z), axis=1)
    found = replace(carried, middle=(x, y, z), roams=max(float(np.quantile(away, SELDOM)), LEAST_WAY))
    if up is None:
        return found
    heights = at @ up
    return replace(found, lowest=float(heights.min()), rises=max(float(np.ptp(heights)), LEAST_WAY))


def _reach(model: Any, body: str) -> float:
    """Half the length of a rod with a body's mass and largest moment of inertia [m]."""
    b = model.body(body).id
    return float(np.sqrt(3.0 * max(float(model.body_inertia[b].max()), 1e-12) / max(float(model.body_mass[b]), 1e-9)))


def _elsewhere(robot: Robot, first: Excitation) -> dict[str, Excitation]:
    """Of places that have no coordinate of their own: what the first joint shows."""
    return {name: first for kind in ("link", "foot", "base") for name in robot.places()[kind]}


def _covered(values: Array) -> tuple[float, float]:
    low, high = (float(v) for v in np.quantile(values, [EDGE, 1 - EDGE]))
    least = 1e-3 * max(abs(low), abs(high), 1e-3)
    return (low, high) if high - low > least else (low - least, high + least)


def _central_rates(time: Array, position: Array) -> Array:
    """(m, nj) rates (x[i + k] − x[i − k])/(t[i + k] − t[i − k]) with k = ``SLOPE_SAMPLES`` [rad/s or m/s].

    Only where both samples exist, so m = n − 2k; k is smaller in a recording that is too short.
    ``localization.speeds`` has a rate for every sample, one-sided towards the ends, and ``predict.local_motion`` that
    of a parabola, which follows an acceleration too.
    """
    k = min(SLOPE_SAMPLES, (len(time) - 1) // 2)
    return np.asarray((position[2 * k :] - position[: -2 * k]) / (time[2 * k :] - time[: -2 * k])[:, None])
