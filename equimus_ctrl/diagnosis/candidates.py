"""Candidates: every known effect at every place, with initial sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.effects.base import REGISTRY, Effect
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.engines.encoding import KNOWN_KINDS
from equimus_ctrl.engines.mjcf import command_at, joint_forces, realise
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.parameters import (
    FreeParameter,
    FreeParameters,
    default_bounds,
    free_parameters,
    unit_of,
)
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

SLOPE_SAMPLES = 4
"""Half the number of samples over which a speed is read off measured angles."""
FEW = 400
"""So many poses decide what lengths an actuator covers."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect at one place, or alike at several.

    Attributes:
        effect: its class.
        locations: where.
        guesses: parameter sets to begin from.
    """

    effect: type[Effect]
    locations: tuple[str, ...]
    guesses: tuple[Mapping[str, float], ...]

    @property
    def label(self) -> str:
        """Such as ``dead_zone:baa``."""
        return f"{self.effect.name}:{'+'.join(self.locations)}"

    @property
    def n_parameters(self) -> int:
        """How many parameters it adds."""
        return len(self.effect.parameter_info())

    def attached(self, values: Mapping[str, float]) -> tuple[Effect, ...]:
        """The effects with these values."""
        return tuple(self.effect(location, **values) for location in self.locations)


@dataclass(frozen=True, eq=False)
class Part:
    """A candidate with values: one piece of missing physics in a hypothesis.

    Attributes:
        candidate: what and where.
        values: of its parameters.
    """

    candidate: Candidate
    values: Mapping[str, float]

    @property
    def effects(self) -> tuple[Effect, ...]:
        """To be attached to a model."""
        return self.candidate.attached(self.values)


Hypothesis = tuple[Part, ...]
"""All that is taken to be missing from a model."""


def default_free_parameters(
    model: Model,
    names: Sequence[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fix: Sequence[str] = (),
) -> FreeParameters:
    """The parameters to estimate, see ``free_parameters``; bounds of damping are narrow where it is known well."""
    chosen = free_parameters(model, names, bounds, fix)
    if (within := model.robot.traits.damping_known_within) is None:
        return chosen
    known = dict(bounds or {})
    own = model.robot.parameters()
    for f in chosen.free:
        if f.name.endswith(".damping") and f.name in own and own[f.name] > 0:
            known.setdefault(f.name, (own[f.name] / within, own[f.name] * within))
    return free_parameters(model, names, known, fix)


def model_of(model: Model, hypothesis: Sequence[Part]) -> Model:
    """The model with the hypothesis' effects.

    Raises:
        ConfigError: where two effects exclude each other.
    """
    return replace(model, effects=(*model.effects, *(e for part in hypothesis for e in part.effects)))


def with_part(model: Model, hypothesis: Hypothesis, part: Part) -> Hypothesis:
    """The hypothesis with one more part, without those that it excludes."""
    kept: Hypothesis = (*hypothesis, part)
    while True:
        try:
            model_of(model, kept)
        except ConfigError:
            for k, old in enumerate(kept[:-1]):
                if not _compatible(model, old, part):
                    kept = (*kept[:k], *kept[k + 1 :])
                    break
            else:
                raise
        else:
            return kept


def _compatible(model: Model, first: Part, second: Part) -> bool:
    try:
        model_of(model, (first, second))
    except ConfigError:
        return False
    return True


def parameters_of(free: FreeParameters, hypothesis: Hypothesis) -> FreeParameters:
    """What is free in a model with a hypothesis' effects: what is free without them, and their own parameters.

    Args:
        free: of the model without them.
        hypothesis: with values to start from.
    """
    whole = model_of(free.model, hypothesis)
    prefixes = whole.effect_prefixes()[len(free.model.effects) :]
    found = list(free.free)
    for part in hypothesis:
        own, prefixes = prefixes[: len(part.effects)], prefixes[len(part.effects) :]
        for key, value in part.values.items():
            names = [prefix + key for prefix in own]
            bounds = [default_bounds(whole, name) for name in names]
            low, high = max(b[0] for b in bounds), min(b[1] for b in bounds)
            size = abs(value) or None
            start = float(np.clip(value, low, high))
            found.append(FreeParameter(names[0], start, low, high, unit_of(whole, names[0]), tuple(names[1:]), size))
    return FreeParameters(whole, tuple(found))


def refined(hypothesis: Hypothesis, values: Array) -> Hypothesis:
    """The hypothesis with the values (k,) of all its parameters in their order."""
    left = [float(v) for v in values]
    parts = []
    for part in hypothesis:
        own = dict(zip(part.values, left, strict=False))
        left = left[len(own) :]
        parts.append(Part(part.candidate, own))
    return tuple(parts)


def excitation_of(model: Model, segments: Sequence[Segment]) -> dict[str, Excitation]:
    """For each place of a robot what recordings show of it."""
    if not model.robot.traits.forces_along_actuators:
        return _seen_at_joints(model, segments)
    m = model.morphology
    kinematics = Kinematics(m, model.phase)
    times = [s.trial.sample_times for s in segments]
    angles = [s.measured for s in segments]
    stacked = np.concatenate(angles)
    poses = stacked[:: max(len(stacked) // FEW, 1)]
    lengths = np.array([kinematics.lengths(q) for q in poses])
    speeds = np.concatenate([_speed(t, q) for t, q in zip(times, angles, strict=True)])
    along = np.abs(np.array([kinematics.jacobian(q) for q in poses]) @ np.ones(len(m.joints)))
    middle = np.median(stacked, axis=0)
    _, slope = kinematics.rest_torque(middle)
    commands = np.concatenate([np.vstack([s.trial.before, s.trial.commands]) for s in segments])
    largest = np.maximum(commands.max(axis=0), 1.0)
    interval = float(np.median(np.concatenate([np.diff(t) for t in times])))
    duration = float(max(t[-1] - t[0] for t in times))
    mass = sum(link.mass for link in m.links) + sum(a.mass for a in m.actuators)
    speed = np.quantile(np.abs(speeds), 0.95, axis=0)
    found = {}
    for j, name in enumerate(m.joint_names):
        low, high = _covered(stacked[:, j])
        force = abs(float(slope[j, j])) * (high - low)
        found[name] = Excitation(
            low, high, max(float(speed[j]), 1e-3), force, float(largest.max()), interval, duration, mass
        )
    for i, actuator in enumerate(m.actuators):
        low, high = _covered(lengths[:, i])
        rate = float(np.median(along[:, i]) * speed.max())
        force = actuator.stiffness * (high - low)
        found[actuator.name] = Excitation(
            low, high, max(rate, 1e-4), force, float(largest[i]), interval, duration, mass
        )
    first = found[m.joint_names[0]]
    return {name: first for kind in ("link", "foot", "base") for name in m.places()[kind]} | found


def _seen_at_joints(model: Model, segments: Sequence[Segment]) -> dict[str, Excitation]:
    """The same where drives are at joints: forces of drives and gravity along the measured motion."""
    own = realise(model)
    robot = own.robot
    times = [s.trial.sample_times for s in segments]
    angles = np.concatenate([s.measured for s in segments])
    speeds = np.concatenate([_speed(s.trial.sample_times, s.measured) for s in segments])
    rows = np.concatenate([command_at(s.trial, s.trial.sample_times[SLOPE_SAMPLES:-SLOPE_SAMPLES]) for s in segments])
    middles = np.concatenate([s.measured[SLOPE_SAMPLES:-SLOPE_SAMPLES] for s in segments])
    chosen = slice(None, None, max(len(middles) // FEW, 1))
    drives, weights = joint_forces(own, middles[chosen], speeds[chosen], rows[chosen])
    largest = np.maximum(
        np.abs(np.concatenate([np.vstack([s.trial.before, s.trial.commands]) for s in segments])).max(axis=0), 1e-9
    )
    interval = float(np.median(np.concatenate([np.diff(t) for t in times])))
    duration = float(max(t[-1] - t[0] for t in times))
    mass = float(own.mujoco.body_mass[1:].sum())
    speed = np.maximum(np.quantile(np.abs(speeds), 0.95, axis=0), 1e-6)
    by_drive = {drive.name: float(np.abs(drives[:, i]).max()) for i, drive in enumerate(robot.actuators)}
    found = {}
    for j, joint in enumerate(robot.joints):
        low, high = _covered(angles[:, j])
        own_drives = [i for i, drive in enumerate(robot.actuators) if drive.joint == joint.name]
        whole = drives[:, own_drives].sum(axis=1)
        force = max(float(np.quantile(np.abs(v), 0.95)) for v in (whole, weights[:, j])) or 1.0
        drive_force = max((by_drive[robot.actuators[i].name] for i in own_drives), default=force)
        found[joint.name] = Excitation(
            low, high, float(speed[j]), force, float(largest.max()), interval, duration, mass, drive_force
        )
    ends = {
        drive.name: replace(found[drive.joint], command=float(largest[i]), drive=by_drive[drive.name])
        for i, drive in enumerate(robot.actuators)
    }
    first = found[robot.joint_names[0]]
    others = {name: first for kind in ("link", "foot", "base") for name in robot.places()[kind]}
    # A joint and its drive may have one name; sizes of both are those of the joint then.
    return others | ends | found


def _covered(values: Array) -> tuple[float, float]:
    low, high = (float(v) for v in np.quantile(values, [0.01, 0.99]))
    least = 1e-3 * max(abs(low), abs(high), 1e-3)
    return (low, high) if high - low > least else (low - least, high + least)


def _speed(time: Array, angles: Array) -> Array:
    """(n, nj) rates over a few samples [rad/s]."""
    k = min(SLOPE_SAMPLES, (len(time) - 1) // 2)
    return np.asarray((angles[2 * k :] - angles[: -2 * k]) / (time[2 * k :] - time[: -2 * k])[:, None])


def candidates(
    model: Model, segments: Sequence[Segment], registry: Mapping[str, type[Effect]] = REGISTRY
) -> list[Candidate]:
    """All effects at all places of a robot that recordings could show."""
    robot, excitation = model.robot, excitation_of(model, segments)
    found: dict[tuple[str, tuple[str, ...]], Candidate] = {}
    for name in sorted(registry):
        cls = registry[name]
        if not issubclass(cls, KNOWN_KINDS) or robot.traits.catalogue not in cls.robots:
            continue
        where = robot.force_places() if issubclass(cls, ForceEffect) else robot.places()
        for kind in cls.sits_at:
            # The last link's tip is the foot: one place is not to have two names.
            twice = robot.foot_link if kind == "link" and "foot" in cls.sits_at else None
            sites = [site for site in where[kind] if site != twice]
            groups: list[tuple[str, ...]] = [(site,) for site in sites]
            if cls.alike and len(sites) > 1 and kind in ("joint", "actuator"):
                groups.append(tuple(sites))
            for group in groups:
                tried = (_within(cls, g) for site in group for g in cls.guesses(excitation[site]))
                guesses = {tuple(g.items()): g for g in tried}
                usable = [g for g in guesses.values() if _attaches(model, cls, group, g)]
                if usable:
                    found.setdefault((name, group), Candidate(cls, group, tuple(usable)))
    return list(found.values())


def _within(cls: type[Effect], values: Mapping[str, float]) -> Mapping[str, float]:
    """Values within the effect's bounds: sizes that follow from hardly any motion may lie beyond."""
    info = cls.parameter_info()
    return {key: float(np.clip(v, info[key]["low"], info[key]["high"])) for key, v in values.items()}


def _attaches(model: Model, cls: type[Effect], locations: tuple[str, ...], values: Mapping[str, float]) -> bool:
    try:
        replace(model, effects=tuple(cls(location, **values) for location in locations))
    except ConfigError:
        return False
    return True
