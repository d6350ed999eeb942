"""What one set of axes shows of a diagnosis, as plain numbers in units that a person reads."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.diagnosis.coordinates import Coordinate
from equimus_ctrl.diagnosis.localization import commands, speeds
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.diagnosis.results import Diagnosis, Finding
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.segments import Segment
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

ROUNDING = 1e-9
"""Differences up to this are of arithmetic."""
LEAST_BAND = 5e-3
"""Share of a curve's height below which a band about it cannot be seen."""
FEW = 400
"""Poses from which an actuator's lengths are worked out."""


@dataclass(frozen=True, eq=False)
class Line:
    """One curve.

    Attributes:
        x: (n,).
        y: (n,).
        label: for the legend.
        without: whether the effect is omitted from it.
    """

    x: Array
    y: Array
    label: str
    without: bool = False


Band = tuple[Array, Array, Array]
"""x, lower and upper edge (n,) of where a curve may lie."""


@dataclass(frozen=True, eq=False)
class Panel:
    """What one set of axes shows.

    Attributes:
        title: what it is about.
        x: label of the axis, with its unit.
        y: the same.
        lines: curves.
        band: where the curve with the effect may lie, or None.
        data: (m,) where along x the recordings lie, or None where that means nothing.
        rows: a table in place of curves.
    """

    title: str
    x: str = ""
    y: str = ""
    lines: tuple[Line, ...] = ()
    band: Band | None = None
    data: Array | None = None
    rows: tuple[tuple[str, ...], ...] = ()


@dataclass(frozen=True, eq=False)
class Scene:
    """What recordings show.

    Attributes:
        model: the nominal model.
        segments: all that was measured.
        seen: place → what is seen of it.
    """

    model: Model
    segments: Sequence[Segment]
    seen: Mapping[str, Excitation]

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> Scene:
        """All recordings of a diagnosis."""
        segments = (*diagnosis.train, *diagnosis.validation, *diagnosis.test)
        return cls(diagnosis.model, segments, excitation_of(diagnosis.model, segments))

    @property
    def angles(self) -> Array:
        """(m, nj) measured [rad]."""
        return np.concatenate([s.measured for s in self.segments])

    @property
    def speeds(self) -> Array:
        """(m, nj) of them [rad/s]."""
        return np.concatenate([speeds(s) for s in self.segments])

    @property
    def commands(self) -> Array:
        """(m, na) in force when they were measured [Pa]."""
        return np.concatenate([commands(s)[0] for s in self.segments])

    def values(self, coordinate: Coordinate) -> Array | None:
        """(m,) of a coordinate; None of those that recordings do not show."""
        if coordinate.less:
            places = coordinate.place, coordinate.less
            first, second = (self.values(replace(coordinate, place=place, less="")) for place in places)
            return None if first is None or second is None else first - second
        kind, name, robot = coordinate.kind, coordinate.place, self.model.robot
        if kind == "time" and coordinate.frequency is None:
            return np.concatenate([s.trial.sample_times - s.trial.times[0] for s in self.segments])
        if kind in ("pos", "vel") and name in robot.joint_names:
            return np.asarray((self.angles if kind == "pos" else self.speeds)[:, robot.joint_names.index(name)])
        if kind == "cmd" and name in robot.actuator_names:
            return np.asarray(self.commands[:, robot.actuator_names.index(name)])
        if kind == "len" and name in robot.actuator_names and robot.traits.forces_along_actuators:
            kinematics, column = Kinematics(self.model.morphology, self.model.phase), robot.actuator_names.index(name)
            poses = self.angles[:: max(len(self.angles) // FEW, 1)]
            return np.array([kinematics.lengths(q)[column] for q in poses])
        return None

    def position(self, place: str) -> Array:
        """(m,) positions of a joint or lengths of an actuator."""
        joint = place in self.model.robot.joint_names
        values = self.values(Coordinate("pos" if joint else "len", place))
        assert values is not None
        return values


def variants(finding: Finding) -> list[tuple[Effect, ...]]:
    """The effects with one parameter after the other at the ends of its interval."""
    candidate, varied = finding.part.candidate, []
    info = candidate.effect.parameter_info()
    for key, estimate in finding.parameters.items():
        for end in (estimate.low, estimate.high):
            if math.isfinite(end):
                inside = float(np.clip(end, info[key]["low"], info[key]["high"]))
                try:
                    varied.append(candidate.attached({**finding.part.values, key: inside}))
                except ConfigError:  # an effect may refuse parameter values that do not go together
                    continue
    return varied


def band(x: Array, best: Array, others: Sequence[Array]) -> Band | None:
    """Between what the curves of the variants (n,) lie; None where there are none or it is a mere line."""
    every = np.array([best, *(other for other in others if np.all(np.isfinite(other)))])
    low, high = every.min(axis=0), every.max(axis=0)
    height = float(np.ptp(best)) or float(np.abs(best).max())
    thin = float((high - low).max()) <= LEAST_BAND * height
    return None if thin else (x, low, high)


def changes(with_it: Array, without: Array) -> bool:
    """Whether one curve (n,) visibly differs from another."""
    height = max(float(np.abs(without).max()), float(np.abs(with_it).max()))
    return float(np.abs(with_it - without).max()) > max(1e-3 * height, ROUNDING)


def name_of(effects: Sequence[Effect]) -> str:
    """For a legend."""
    return f"with {effects[0].name.replace('_', ' ')}"


def settled(time: Array, values: Array) -> float:
    """The time from which on values (n,) stay within a hundredth of where they end."""
    away = np.abs(values - values[-1]) > 0.01 * max(float(np.ptp(values)), 1e-12)
    last = int(np.flatnonzero(away)[-1]) + 1 if away.any() else 0
    return float(time[min(last, len(time) - 1)])


def in_time(time: Array) -> tuple[Array, str]:
    """Times [s] as a person reads them, and the axis' label."""
    short = float(np.abs(time).max()) < 1.0
    return (time * 1e3, "time [ms]") if short else (time, "time [s]")
