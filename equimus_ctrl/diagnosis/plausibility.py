"""What can be seen of recordings before any search: other units, signs, an order or a zero than the model's.

Each would be taken for missing physics, and each is somebody's mistake that takes a minute to mend. Angles are compared
with the joints' ranges; what the motion needs (``engines.mjcf_inverse``) is compared with what the drives exert by the
model. Masses may be wrong by a factor, and physics may be missing; neither makes a force the opposite of another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from equimus_ctrl.diagnosis.conventions import ALIKE, mistaken
from equimus_ctrl.diagnosis.holdout import Split
from equimus_ctrl.engines.mjcf_inverse import (
    MeasuredMotion,
    inverse_dynamics,
    motions_of,
    weighed_as_motion,
)
from equimus_ctrl.engines.predict import in_its_condition
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.channels import channels_of, require_alike
from equimus_ctrl.identification.noise import noise_of_differences, resolution
from equimus_ctrl.identification.segments import DELAY_SHARE, begins_in_motion
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.mjcf.actuators import moments_at
from equimus_ctrl.robots.mjcf.robot import MjcfRobot, mjcf_of
from equimus_ctrl.types import Array, Recording

UNLIKE = 0.5
"""Below this a joint's own drive is not what moves it, where another one is alike."""
UNIT = 5.0
"""Masses are not so many times what they are taken to be: the forces have another unit."""
WIDTHS = (4, 8, 16)
"""Widths of test functions in samples; the one with the best correlations counts."""
LEAST_ROWS = 30
"""Fewer independent samples show no correlation."""
BEYOND = 0.25
"""Share of a joint's range by which most samples have to lie beyond its end."""
MOST_OUTSIDE = 0.5
"""Share of the samples that most are, where they lie beyond a range,"""
MOST_INSIDE = 0.9
"""and where another unit would put them within it: then it is the unit."""
WHOLE_TURNS = 2
"""Turns beyond which an angle of a joint with a range is not one in radians."""
RANGE_OF_DEGREES = 7.0
"""A range below so many degrees is one of radians that were taken for degrees [°]: 2π is 6.3."""
LONG_ENOUGH = 8
"""Widths of test functions that a recording has to last, to be looked at with these."""
DEGREE = math.pi / 180
"""[rad]"""
COARSE = 2.0
"""Steps of so many standard deviations of the noise by second differences are most of it: evenly spread errors alone
are of 0.29 steps."""
POWER = 1e-3
"""So near to a whole number of bits a turn an encoder has that many."""
ROUNDED = 1e-9
"""Forces that vary by less, as a share of their size, do not vary."""
FEW = 10
"""Poses of a recording in which actuators that drive a joint are looked for."""


def check(model: Model, recordings: Sequence[Recording]) -> None:
    """Raise ConfigError, a sentence that says what to do, where recordings and model cannot belong together.

    Args:
        model: of any robot. Of one whose stops give way, angles may lie beyond them; they are not looked at.
        recordings: with the robot's joints and actuators, in its order.
    """
    if not model.robot.traits.stops_give_way:
        _check_angles(model.robot, recordings)
    if model.robot.has_torque_domain:
        _check_forces(model, mjcf_of(model.robot), recordings)
        _check_measured(model, mjcf_of(model.robot), recordings)


def coarse_steps(robot: Robot, recordings: Sequence[Recording]) -> list[str]:
    """A sentence for joints whose positions come in steps that are all of their noise: an encoder's resolution.

    Args:
        robot: whose joints they are.
        recordings: of it.
    """
    noise, found = noise_of_differences([np.array(r.position) for r in recordings]), dict[str, list[str]]()
    for j, name in enumerate(robot.joint_names):
        step = resolution(np.concatenate([r.position[:, j] for r in recordings]))
        if step >= COARSE * noise[j].sigma:
            found.setdefault(_in_words(step, robot.slides(name)), []).append(f"pos.{name}")
    return [f"{', '.join(names)}: {words}" for words, names in found.items()]


def left_out_at_first(
    recordings: Sequence[Recording], parts: Split, window: tuple[float, float] | None = None
) -> list[str]:
    """A sentence on recordings whose first moments are not compared, see ``segments.unknown_for``.

    Args:
        recordings: that were cut.
        parts: what they were cut into.
        window: (from, to) of each that counts at all [s].
    """
    begun, longest, left = dict[str, float](), dict[str, float](), dict[str, float]()
    for segment in (*parts.train, *parts.validation, *parts.test):
        name, trial = segment.recording_name, segment.trial
        begun[name] = min(trial.start, begun.get(name, math.inf))
        longest[name] = max(float(trial.sample_times[-1]) - trial.start, longest.get(name, 0.0))
    for r in filter(begins_in_motion, recordings):
        counted = r.time if window is None else r.time[r.time >= window[0]]
        if begun.get(r.name, 0.0) > counted[0]:
            late = begun[r.name] - float(r.time[0])
            # Of long recordings not all intervals are fitted, and the first may not be among them.
            left[r.name] = late if late < longest[r.name] else DELAY_SHARE * longest[r.name]
    if not left:
        return []
    least, most = (f"{of(left.values()):.2g}" for of in (min, max))
    span = least if least == most else f"{least} to {most}"
    return [
        f"{', '.join(left)}: in motion at the first row (settled = no), and what was commanded before is not known, so "
        f"the first {span} s are not compared; before.cmd.<actuator> in the notes says it"
    ]


def other_joints(robot: Robot, recordings: Sequence[Recording]) -> list[str]:
    """Sentences on joints that are not compared: whose motion is an input, and that were not measured.

    Args:
        robot: whose joints they are.
        recordings: of it.
    """
    loose, tied = (robot.unmeasured_names[part] for part in (slice(robot.loose_count), slice(robot.loose_count, None)))
    said = [f"not measured, and simulated from a start that is fitted: {', '.join(loose)}"] if loose else []
    said += [f"not measured, and simulated as equalities tie it to others: {', '.join(tied)}"] if tied else []
    return [*_prescribed(robot, recordings), *said]


def _prescribed(robot: Robot, recordings: Sequence[Recording]) -> list[str]:
    """A sentence on joints whose motion is an input, and by how much measurements scatter about what it was made."""
    found = [r.prescribed.noise for r in recordings if r.prescribed is not None]
    if not found:
        return []
    noise = 1e3 * np.sqrt(np.mean(np.square(found), axis=0))
    units = ["mm" if robot.slides(name) else "mrad" for name in robot.prescribed_names]
    named = zip(robot.prescribed_names, noise, units, strict=True)
    each = ", ".join(f"{name} ({size:.2g} {unit})" for name, size, unit in named)
    return [f"taken as measured, and smoothed by as much as their noise: the motion of {each}"]


def _in_words(step: float, slides: bool) -> str:
    unit, bits = "mm" if slides else "mrad", math.log2(2 * math.pi / step)
    whole = f" ({2 ** round(bits)} a turn)" if not slides and abs(bits - round(bits)) < POWER else ""
    size, error = f"{1e3 * step:.3g} {unit}{whole}", f"{1e3 * step / math.sqrt(12):.2g} {unit}"
    return (
        f"measured in steps of {size}, which are most of the noise: whatever the model, an error of {error} is theirs"
    )


def _check_angles(robot: Robot, recordings: Sequence[Recording]) -> None:
    """Raise ConfigError where angles are in degrees, or lie where a joint cannot be."""
    positions = np.concatenate([r.poses for r in recordings])
    low, high = (np.concatenate(ends) for ends in zip(robot.joint_range, robot.prescribed_range, strict=True))
    for j, name in enumerate((*robot.joint_names, *robot.prescribed_names)):
        span = float(high[j] - low[j])
        if not math.isfinite(span) or span <= 0:
            continue
        column, unit = positions[:, j], "m" if robot.slides(name) else "rad"
        between = f"{low[j]:.3g} to {high[j]:.3g} {unit}"
        outside = float(np.mean((column < low[j] - BEYOND * span) | (column > high[j] + BEYOND * span)))
        if outside < MOST_OUTSIDE:
            continue
        seen = f"{name} goes from {column.min():.4g} to {column.max():.4g} {unit}, but the model's range is {between}"
        covers = _inside(column * DEGREE, low[j], high[j])
        if unit == "rad" and np.abs(column).max() > WHOLE_TURNS * 2 * math.pi and covers:
            raise ConfigError(f"{seen}; are the recorded angles in degrees? They are expected in rad")
        if unit == "rad" and _inside(column, low[j] / DEGREE, high[j] / DEGREE) and span < RANGE_OF_DEGREES * DEGREE:
            raise ConfigError(
                f"{seen}; are the XML's angles in rad? MuJoCo takes them for degrees where the file does not say "
                '<compiler angle="radian"/>'
            )
        raise ConfigError(
            f"{seen}; most samples lie beyond it, so the encoder's zero or its sign is another than the model's, or "
            "the range is wrong"
        )


def _inside(values: Array, low: float, high: float) -> bool:
    """Whether most values lie about within a range."""
    way = BEYOND * (high - low)
    return bool(np.mean((values > low - way) & (values < high + way)) > MOST_INSIDE)


def _check_forces(model: Model, robot: MjcfRobot, recordings: Sequence[Recording]) -> None:
    """Raise ConfigError where what moves a joint is the opposite of its drive's force, another's, or far larger."""
    needed, exerted, width = _forces(model, recordings)
    nj = len(robot.joint_names)
    if len(needed) < LEAST_ROWS:
        return
    if said := mistaken(robot, recordings, lambda changed: _forces(model, changed, (width,))[:2]):
        raise ConfigError(said)
    size = np.sqrt((exerted**2).mean(axis=0))
    driven = [j for j in range(nj) if size[j] > 0]
    whole = np.sqrt((needed**2).mean(axis=0))
    alike = np.zeros((nj, nj))
    for j in driven:
        for k in driven:
            alike[j, k] = float((needed[:, j] * exerted[:, k]).mean() / max(whole[j] * size[k], 1e-300))
    drive = {name: [d.name for d in robot.actuators if d.joint == name] for name in robot.joint_names}
    for j in driven:
        name = robot.joint_names[j]
        # What friction holds needs nothing: there both are constant, and of whatever sign.
        if alike[j, j] < -ALIKE and _varies_alike(needed[:, j], exerted[:, j]) < -ALIKE:
            column = " and ".join(f"cmd.{own}" for own in drive[name])
            raise ConfigError(
                f"the forces of {name} look negated: what its motion needs is the opposite of what {column} exerts "
                f"(correlation {alike[j, j]:.2f}); change the sign of the column or of the actuator's gear, or that of "
                f"pos.{name}"
            )
    rows, columns = linear_sum_assignment(-alike[np.ix_(driven, driven)])
    swapped = [(driven[a], driven[b]) for a, b in zip(rows, columns, strict=True) if a != b]
    if swapped and all(alike[j, k] > ALIKE and alike[j, j] < UNLIKE for j, k in swapped):
        first, second = (robot.joint_names[j] for j in swapped[0])
        raise ConfigError(
            f"the columns look exchanged: what the motion of {first} needs is what the drive of {second} exerts "
            f"(correlation {alike[swapped[0]]:.2f}, with its own drive {alike[swapped[0][0], swapped[0][0]]:.2f}); are "
            "the recorded joints or actuators in another order than their names say?"
        )
    # A servo's force follows from where its joint is: its unit is none of the recording's.
    servos = {d.joint for d in robot.actuators if d.servo}
    motors = [j for j in driven if robot.joint_names[j] not in servos]
    factors = {j: float((needed[:, j] * exerted[:, j]).mean() / size[j] ** 2) for j in motors if alike[j, j] > ALIKE}
    if factors and len(factors) == len(motors) and all(not 1 / UNIT < f < UNIT for f in factors.values()):
        j = next(iter(factors))
        raise ConfigError(
            f"the forces look like those of another unit, such as currents: what the motion of {robot.joint_names[j]} "
            f"needs is {factors[j]:.3g} times what its drive exerts by the model (correlation {alike[j, j]:.2f}); give "
            "the factor as the actuator's gear or gain"
        )


def _varies_alike(needed: Array, exerted: Array) -> float:
    """The correlation about the means; 0 of what does not vary."""
    a, b = needed - needed.mean(), exerted - exerted.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > ROUNDED * float(np.linalg.norm(needed) * np.linalg.norm(exerted)) else 0.0


def _check_measured(model: Model, robot: MjcfRobot, recordings: Sequence[Recording]) -> None:
    """Raise ConfigError where forces that were measured are the opposite of what moves a joint, or far from its size.

    Of joints that only drives of their own drive, all of which have a sensor.
    """
    compared = [channels_of(model, r) for r in recordings]
    require_alike(compared, [r.name for r in recordings])
    joints = _measured_joints(robot, compared[0].forces, recordings)
    for joint, (needed, shown) in zip(joints, _measured(model, recordings, joints), strict=True):
        if len(needed) < LEAST_ROWS or not shown.any():
            continue
        sizes = float(np.linalg.norm(needed) * np.linalg.norm(shown))
        alike = float(needed @ shown) / max(sizes, 1e-300)
        name = robot.joint_names[joint.index]
        column = " and ".join(f"meas.{robot.actuator_names[i]}" for i in joint.places)
        if alike < -ALIKE:
            raise ConfigError(
                f"{column} looks negated: what the motion of {name} needs is the opposite of what was measured "
                f"(correlation {alike:.2f}); change the sign of the column, or that of pos.{name}"
            )
        factor = float(needed @ shown / (shown @ shown))
        if alike > ALIKE and not 1 / UNIT < factor < UNIT:
            raise ConfigError(
                f"{column} looks like a force in another unit, such as a current, or behind the gear: what the motion "
                f"of {name} needs is {factor:.3g} times what was measured (correlation {alike:.2f}); N·m or N before "
                "the gear are expected"
            )


@dataclass(frozen=True, eq=False)
class _MeasuredJoint:
    """A joint, by its place, all of whose drives have a sensor: for each a command of it, and its gear."""

    index: int
    places: list[int]
    gear: Array


def _measured_joints(robot: MjcfRobot, forces: Sequence[int], recordings: Sequence[Recording]) -> list[_MeasuredJoint]:
    """Those that only drives of their own drive, by the commands whose forces are compared."""
    base, found = robot.plan.base, list[_MeasuredJoint]()
    if not forces:
        return found
    poses = recordings[0].poses[:: max(len(recordings[0].time) // FEW, 1)]
    moments = moments_at(base, (*robot.joint_names, *robot.prescribed_names), poses)
    for j, name in enumerate(robot.joint_names):
        drives = [d for d in robot.actuators if moments[base.actuator_outadr[d.index], base.joint(name).dofadr[0]] > 0]
        # An actuator with several commands exerts one force, of which any of their columns tells.
        places = {d.actuator: i for i, d in reversed(list(enumerate(robot.actuators))) if d in drives and i in forces}
        if not drives or {d.actuator for d in drives} != set(places) or not all(d.at_joint for d in drives):
            continue
        outputs = [base.actuator_outadr[robot.actuators[i].index] for i in places.values()]
        found.append(_MeasuredJoint(j, list(places.values()), np.array([base.actuator_gear[k, 0] for k in outputs])))
    return found


def _measured(
    model: Model, recordings: Sequence[Recording], joints: Sequence[_MeasuredJoint]
) -> list[tuple[Array, Array]]:
    """For each joint (m,) what its motion needs of its drives, and what was measured of them, at the likest width."""
    best, found = [-math.inf] * len(joints), [(np.empty(0), np.empty(0))] * len(joints)
    motions = measured_motions(model, recordings) if joints else []
    forces = [
        [np.interp(m.time, r.time, np.asarray(r.measured)[:, joint.places] @ joint.gear) for joint in joints]
        for m, r in zip(motions, recordings, strict=False)
    ]
    for width in WIDTHS:
        long = [k for k, m in enumerate(motions) if len(m.time) > LONG_ENOUGH * width]
        if not long:
            break
        at = inverse_dynamics(model, [motions[k] for k in long], width)
        for n, joint in enumerate(joints):
            needed = np.concatenate([one.weighted((one.missing + one.drives)[:, joint.index]) for one in at])
            smooth = [one.weighted(weighed_as_motion(forces[k][n], width)) for k, one in zip(long, at, strict=True)]
            shown = np.concatenate(smooth)
            alike = abs(float(needed @ shown)) / max(float(np.linalg.norm(needed) * np.linalg.norm(shown)), 1e-300)
            if alike > best[n]:
                best[n], found[n] = alike, (needed, shown)
    return found


def _forces(model: Model, recordings: Sequence[Recording], widths: Sequence[int] = WIDTHS) -> tuple[Array, Array, int]:
    """(m, nj) what the motion needs of the drives, and what they exert, at the width that makes them most alike."""
    best, found = -math.inf, (np.empty((0, 0)), np.empty((0, 0)), widths[0])
    motions = measured_motions(model, recordings)
    for width in widths:
        long = [m for m in motions if len(m.time) > LONG_ENOUGH * width]
        if not long:
            break
        at = inverse_dynamics(model, long, width)
        needed = np.concatenate([one.weighted(one.missing + one.drives) for one in at])
        exerted = np.concatenate([one.weighted(one.drives) for one in at])
        sizes = np.maximum(np.sqrt((needed**2).mean(axis=0) * (exerted**2).mean(axis=0)), 1e-300)
        alike = float(np.median(np.abs((needed * exerted).mean(axis=0) / sizes)))
        if alike > best:
            best, found = alike, (needed, exerted, width)
    return found


def measured_motions(model: Model, recordings: Sequence[Recording]) -> list[MeasuredMotion]:
    """What was measured, for inverse dynamics of whole recordings."""
    trials = [in_its_condition(model, r, Trial.of(r, r.position[0])) for r in recordings]
    measured = [np.array(r.position) for r in recordings]
    noise = np.array([own.sigma for own in noise_of_differences(measured)])
    return motions_of(trials, measured, noise)
