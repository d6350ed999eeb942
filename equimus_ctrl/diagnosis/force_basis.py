"""Basis functions of unstructured residual forces, and the coordinates that these may depend on.

A family is one place, the coordinates that the force there depends on, and the basis functions of that dependence,
evaluated along a model's own motions. The functions are cubic B-splines unless said otherwise, with more knots where
the motions are more often. Families are not orthogonal to each other, nor to the model's own parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import InitVar, dataclass, field

import numpy as np
from numba import njit
from scipy.interpolate import BSpline

from equimus_ctrl.diagnosis.coordinates import TIME, Coordinate, read, written
from equimus_ctrl.diagnosis.linear_response import along_actuator
from equimus_ctrl.engines.base import ForceResponse
from equimus_ctrl.engines.motion import Inner, Motion
from equimus_ctrl.identification.parameters import place_unit
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array, frozen_array

FUNCTIONS = 8
"""Basis functions of a curve over one coordinate."""
SPOTS = 16
"""Basis functions of dry friction over the angle, which may differ from spot to spot."""
FINE = 40
"""Basis functions of the detailed curve over a joint's own angle."""
SURFACE = 5
"""Basis functions along each coordinate of a surface over two."""
DEGREE = 3
"""Of the splines."""
SLOW = 1e-3
"""Rate over which dry friction turns [rad/s]; the motions are a model's, without noise."""
AT_ONCE = 512
"""Columns that are carried along a motion together."""
WIDTHS = np.geomspace(0.02, 0.7, 6)
"""Ways after which elements slip, as shares of half the way there is."""
MEMORIES = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Time constants of what is forgotten [s]."""


@dataclass(frozen=True, eq=False)
class Axis:
    """Basis functions over one coordinate.

    Attributes:
        coordinate: over which.
        unit: SI.
        knots: (k + 4,) of its cubic B-splines, the ends repeated.
    """

    coordinate: Coordinate
    unit: str
    knots: Array

    @classmethod
    def over(cls, coordinate: Coordinate, unit: str, values: Sequence[Array], functions: int = FUNCTIONS) -> Axis:
        """Knots half way between evenly spaced ones and such that there is as much data between any two."""
        everything = np.concatenate(values)
        shares = np.linspace(0, 1, functions - DEGREE + 1)
        low, high = everything.min(), everything.max()
        if not high > low:
            high = low + 1.0
        inner = (np.quantile(everything, shares) + low + shares * (high - low))[1:-1] / 2
        ends = DEGREE + 1
        return cls(coordinate, unit, frozen_array(np.concatenate([[low] * ends, inner, [high] * ends])))

    @property
    def range(self) -> tuple[float, float]:
        """The least and the greatest value there are data for."""
        return float(self.knots[0]), float(self.knots[-1])

    def basis(self, x: Array) -> Array:
        """(n, k) the functions at x (n,), beyond the range as at its end."""
        inside = np.clip(x, *self.range)
        return np.asarray(BSpline.design_matrix(inside, self.knots, DEGREE).toarray())

    def slopes(self, x: Array) -> Array:
        """(n, k) their derivatives at x (n,)."""
        functions = BSpline(self.knots, np.eye(len(self.knots) - DEGREE - 1), DEGREE)
        return np.asarray(functions.derivative()(np.clip(x, *self.range)))


@dataclass(frozen=True, eq=False)
class ForceFamily:
    """One place and what an unstructured force there depends on.

    Attributes:
        location: the joint or actuator, or several joined by ``+``.
        joints: on which it acts.
        over: coordinates, the factor among them, or their text.
        factor: what the functions are multiplied by; None for nothing.
        axes: of the functions, one for a curve, two for a surface (the first one's functions vary slowest), none where
            they are no functions of a coordinate.
        forces: for each place (kind, index) and each trial (m − 1, k) torque [N·m] or force [N], constant between
            samples.
        coordinates: that the force depends on, several where it is a product or a surface of them.
    """

    location: str
    joints: tuple[str, ...]
    over: InitVar[Sequence[Coordinate] | str]
    factor: Coordinate | None
    axes: tuple[Axis, ...]
    forces: Mapping[tuple[str, int], tuple[Array, ...]]
    coordinates: tuple[Coordinate, ...] = field(init=False)

    def __post_init__(self, over: Sequence[Coordinate] | str) -> None:
        object.__setattr__(self, "coordinates", read(over) if isinstance(over, str) else tuple(over))

    @property
    def depends_on(self) -> str:
        """The coordinates as a report's data have them."""
        return written(self.coordinates)

    @property
    def size(self) -> int:
        """Number of functions."""
        return int(next(iter(self.forces.values()))[0].shape[1])

    def torques(self, motions: Sequence[Motion]) -> list[Array]:
        """For each trial (m − 1, nj, k) the joint torques of the functions [N·m]."""
        return torques([self], motions)

    def curve(self, coefficients: Array, *x: Array) -> Array:
        """(n,) the fitted function, without its factor, at points (n,) of each axis."""
        rows = np.ones((len(x[0]), 1))
        for axis, values in zip(self.axes, x, strict=True):
            rows = _product(rows, axis.basis(values))
        return np.asarray(rows @ coefficients)


@dataclass(frozen=True, eq=False)
class Scene:
    """A model and its motions, as the makers of families see them."""

    model: Model
    motions: tuple[Motion, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Their names."""
        return self.model.robot.joint_names

    @property
    def actuators(self) -> tuple[str, ...]:
        """Their names."""
        return self.model.robot.actuator_names

    def since(self) -> list[Array]:
        """For each trial (m − 1,) the time since its recording began [s]."""
        return [m.between.time - m.start for m in self.motions]

    def values(self, of: Callable[[Inner], Array]) -> list[Array]:
        """For each trial (m − 1,) something of its motion."""
        return [of(m.between) for m in self.motions]

    def axis(self, coordinate: Coordinate, functions: int = FUNCTIONS) -> tuple[Axis, list[Array]]:
        """A coordinate's axis and its values in each trial.

        Args:
            coordinate: the time, or position or speed of a joint, or command, length or rate of an actuator.
            functions: how many.
        """
        kind, name = coordinate.kind, coordinate.place
        if kind == "time":
            values, unit = self.since(), "s"
        elif kind in ("pos", "vel"):
            i = self.joints.index(name)
            values = self.values(lambda m: (m.position if kind == "pos" else m.velocity)[:, i])
            unit = place_unit(self.model, "rad" if kind == "pos" else "rad/s", name)
        else:
            i = self.actuators.index(name)
            part = {"cmd": "pressure", "len": "length", "rate": "rate"}[kind]
            values = self.values(lambda m: getattr(m, part)[:, i])
            robot, length = self.model.robot, self.model.robot.length_unit(name)
            unit = {"cmd": robot.command_unit(name), "len": length, "rate": f"{length}/s"}[kind]
        return Axis.over(coordinate, unit, values, functions), values

    def acts_on(self, actuator: int) -> tuple[str, ...]:
        """Joints on which an actuator has a lever arm anywhere."""
        reach = np.max([np.abs(m.arm[:, actuator]).max(axis=0) for m in self.motions], axis=0)
        return tuple(name for name, arm in zip(self.joints, reach, strict=True) if arm > 1e-6 * reach.max())

    def family(
        self,
        place: tuple[str, int],
        coordinates: Sequence[Coordinate],
        factor: Coordinate | None = None,
        by: Sequence[Array] | None = None,
        functions: int | None = None,
    ) -> ForceFamily:
        """Functions of coordinates, times a factor, at one place.

        Args:
            place: (kind, index).
            coordinates: see ``axis``.
            factor: what the functions are multiplied by; None for nothing.
            by: its values in each trial (m − 1,).
            functions: how many along each coordinate.
        """
        count = functions or (FUNCTIONS if len(coordinates) == 1 else SURFACE)
        axes = [self.axis(c, count) for c in coordinates]
        columns = []
        for trial in range(len(self.motions)):
            rows = np.ones((len(self.motions[trial].between.time), 1)) if by is None else by[trial][:, None]
            for axis, values in axes:
                rows = _product(rows, axis.basis(values[trial]))
            columns.append(rows)
        kind, index = place
        names = {"joint": self.joints, "actuator": self.actuators}[kind]
        joints = (names[index],) if kind == "joint" else self.acts_on(index)
        over = (*coordinates, factor) if factor else coordinates
        return ForceFamily(names[index], joints, over, factor, tuple(a for a, _ in axes), {place: tuple(columns)})


Maker = Callable[[Scene, int], Iterator[ForceFamily]]


def _product(a: Array, b: Array) -> Array:
    """(n, ka·kb) all products of columns."""
    return np.asarray((a[:, :, None] * b[:, None, :]).reshape(len(a), -1))


def _own_angle(s: Scene, j: int) -> Iterator[ForceFamily]:
    yield s.family(("joint", j), [Coordinate("pos", s.joints[j])])


def _fine_angle(s: Scene, j: int) -> Iterator[ForceFamily]:
    yield s.family(("joint", j), [Coordinate("pos", s.joints[j])], functions=FINE)


def _own_speed(s: Scene, j: int) -> Iterator[ForceFamily]:
    yield s.family(("joint", j), [Coordinate("vel", s.joints[j])])


def _other_angles(s: Scene, j: int) -> Iterator[ForceFamily]:
    for other in s.joints:
        if other != s.joints[j]:
            yield s.family(("joint", j), [Coordinate("pos", other)])


def _both_angles(s: Scene, j: int) -> Iterator[ForceFamily]:
    for other in s.joints:
        if other != s.joints[j]:
            yield s.family(("joint", j), [Coordinate("pos", s.joints[j]), Coordinate("pos", other)])


def _shared_energy(s: Scene, j: int) -> Iterator[ForceFamily]:
    """Springs across two joints: −∂V/∂q at both, V a surface over their angles."""
    for other in range(j + 1, len(s.joints)):
        names = s.joints[j], s.joints[other]
        (one, first), (two, second) = (s.axis(Coordinate("pos", name), SURFACE) for name in names)
        forces = {
            ("joint", j): tuple(-_product(one.slopes(a), two.basis(b)) for a, b in zip(first, second, strict=True)),
            ("joint", other): tuple(-_product(one.basis(a), two.slopes(b)) for a, b in zip(first, second, strict=True)),
        }
        yield ForceFamily("+".join(names), names, (one.coordinate, two.coordinate), None, (one, two), forces)


def _angle_damping(s: Scene, j: int) -> Iterator[ForceFamily]:
    speed = Coordinate("vel", s.joints[j])
    yield s.family(("joint", j), [Coordinate("pos", s.joints[j])], speed, s.axis(speed)[1])


def _angle_friction(s: Scene, j: int) -> Iterator[ForceFamily]:
    name = s.joints[j]
    by = [np.tanh(v / SLOW) for v in s.axis(Coordinate("vel", name))[1]]
    yield s.family(("joint", j), [Coordinate("pos", name)], Coordinate("vel", name, sign=True), by, SPOTS)


def _joint_time(s: Scene, j: int) -> Iterator[ForceFamily]:
    yield s.family(("joint", j), [TIME])


def _time_damping(s: Scene, j: int) -> Iterator[ForceFamily]:
    """Damping that drifts while a trial lasts, as of a drive that warms up."""
    speed = Coordinate("vel", s.joints[j])
    yield s.family(("joint", j), [TIME], speed, s.axis(speed)[1])


def _own_pressure(s: Scene, a: int) -> Iterator[ForceFamily]:
    yield s.family(("actuator", a), [Coordinate("cmd", s.actuators[a])])


def _own_length(s: Scene, a: int) -> Iterator[ForceFamily]:
    yield s.family(("actuator", a), [Coordinate("len", s.actuators[a])])


def _own_rate(s: Scene, a: int) -> Iterator[ForceFamily]:
    yield s.family(("actuator", a), [Coordinate("rate", s.actuators[a])])


def _pressure_damping(s: Scene, a: int) -> Iterator[ForceFamily]:
    rate = Coordinate("rate", s.actuators[a])
    yield s.family(("actuator", a), [Coordinate("cmd", s.actuators[a])], rate, s.axis(rate)[1])


def _pressure_time(s: Scene, a: int) -> Iterator[ForceFamily]:
    command = Coordinate("cmd", s.actuators[a])
    yield s.family(("actuator", a), [TIME], command, s.axis(command)[1])


def _stretch_time(s: Scene, a: int) -> Iterator[ForceFamily]:
    length = Coordinate("len", s.actuators[a])
    rest = s.model.morphology.actuators[a].rest_length
    yield s.family(("actuator", a), [TIME], length, [x - rest for x in s.axis(length)[1]])


def _other_pressures(s: Scene, a: int) -> Iterator[ForceFamily]:
    for other in s.actuators:
        if other != s.actuators[a]:
            yield s.family(("actuator", a), [Coordinate("cmd", other)])


def _exchange(s: Scene, a: int) -> Iterator[ForceFamily]:
    """Pressure that one actuator loses to another, by their difference."""
    for other in range(a + 1, len(s.actuators)):
        names = s.actuators[a], s.actuators[other]
        first, second = (s.axis(Coordinate("cmd", name))[1] for name in names)
        differences = [x - y for x, y in zip(first, second, strict=True)]
        axis = Axis.over(Coordinate("cmd", *names), "Pa", differences)
        columns = [axis.basis(x) for x in differences]
        areas = [s.model.morphology.actuators[i].area for i in (a, other)]
        forces = {
            ("actuator", a): tuple(-areas[0] * c for c in columns),
            ("actuator", other): tuple(areas[1] * c for c in columns),
        }
        reached = {*s.acts_on(a), *s.acts_on(other)}
        joints = tuple(name for name in s.joints if name in reached)
        yield ForceFamily("+".join(names), joints, [axis.coordinate], None, (axis,), forces)


def _pressure_length(s: Scene, a: int) -> Iterator[ForceFamily]:
    command = Coordinate("cmd", s.actuators[a])
    yield s.family(("actuator", a), [Coordinate("len", s.actuators[a])], command, s.axis(command)[1])


def _path(s: Scene, a: int) -> Iterator[ForceFamily]:
    """Elements that slip after a way of their own (Prandtl and Ishlinskii): any hysteresis without rate."""
    name = s.actuators[a]
    _, lengths = s.axis(Coordinate("len", name))
    way = max(np.ptp(x) for x in lengths) / 2
    widths = way * WIDTHS
    columns = []
    for x in lengths:
        columns.append(_slipped(x, widths) / widths)
    yield ForceFamily(name, s.acts_on(a), [Coordinate("path", name)], None, (), {("actuator", a): tuple(columns)})


@njit(cache=True, nogil=True, error_model="numpy")
def _slipped(x: Array, widths: Array) -> Array:
    """(n, k) deflections of elements dragged along x (n,) that slip at these widths (k,)."""
    rows = np.zeros((len(x), len(widths)))
    for i in range(1, len(x)):
        for k in range(len(widths)):
            rows[i, k] = min(max(rows[i - 1, k] + x[i] - x[i - 1], -widths[k]), widths[k])
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def _relaxed(x: Array, kept: Array) -> Array:
    """(n, k) deflections of springs stretched along x (n,) that keep so much of theirs (n, k) over each step."""
    rows = np.zeros_like(kept)
    for i in range(1, len(x)):
        for k in range(kept.shape[1]):
            rows[i, k] = kept[i, k] * (rows[i - 1, k] + x[i] - x[i - 1])
    return rows


def _memory(s: Scene, a: int) -> Iterator[ForceFamily]:
    """Springs that relax, each with a time constant of its own: any linear viscoelasticity."""
    name = s.actuators[a]
    _, lengths = s.axis(Coordinate("len", name))
    columns = []
    for x, motion in zip(lengths, s.motions, strict=True):
        step = np.diff(motion.between.time, prepend=motion.between.time[0])
        columns.append(_relaxed(x, np.exp(-step[:, None] / np.array(MEMORIES))))
    yield ForceFamily(name, s.acts_on(a), [Coordinate("past", name)], None, (), {("actuator", a): tuple(columns)})


AT_JOINTS: dict[str, Maker] = {
    "own angle": _own_angle,
    "own angle in detail": _fine_angle,
    "own speed": _own_speed,
    "other angles": _other_angles,
    "both angles": _both_angles,
    "energy of two angles": _shared_energy,
    "damping by angle": _angle_damping,
    "friction by angle": _angle_friction,
    "time": _joint_time,
    "damping by time": _time_damping,
}
AT_ACTUATORS: dict[str, Maker] = {
    "own pressure": _own_pressure,
    "own length": _own_length,
    "own rate": _own_rate,
    "damping by pressure": _pressure_damping,
    "pressure by time": _pressure_time,
    "stretch by time": _stretch_time,
    "other pressures": _other_pressures,
    "pressure difference": _exchange,
    "pressure by length": _pressure_length,
    "path": _path,
    "memory": _memory,
}
"""What families there are: a new kind is one more function here."""
OF_DRIVES = ("own pressure", "damping by pressure")
"""Those of drives that are where their joints are: their commands stand in the place of pressures."""


def families(model: Model, motions: Sequence[Motion]) -> list[ForceFamily]:
    """All families of both tables at every joint and actuator.

    Args:
        model: what moves.
        motions: of this model, one for each trial.
    """
    scene = Scene(model, tuple(motions))
    along = model.robot.traits.forces_along_actuators
    at_actuators = AT_ACTUATORS if along else {kind: AT_ACTUATORS[kind] for kind in OF_DRIVES}
    tables = ((len(scene.joints), AT_JOINTS), (len(scene.actuators), at_actuators))
    return [
        family
        for count, table in tables
        for index in range(count)
        for make in table.values()
        for family in make(scene, index)
    ]


def batches(families: Sequence[ForceFamily]) -> Iterator[list[ForceFamily]]:
    """Some families at a time, whose responses are worked out together: many columns take hardly longer than a few."""
    batch: list[ForceFamily] = []
    for family in families:
        batch.append(family)
        if sum(own.size for own in batch) >= AT_ONCE:
            yield batch
            batch = []
    if batch:
        yield batch


def torques(families: Sequence[ForceFamily], motions: Sequence[Motion]) -> list[Array]:
    """For each trial (m − 1, nj, k) the joint torques of all functions of some families [N·m]."""
    nj, ends = motions[0].position.shape[1], np.cumsum([family.size for family in families])
    answers = [np.zeros((len(motion.between.time), nj, int(ends[-1]))) for motion in motions]
    for family, end in zip(families, ends, strict=True):
        own = slice(int(end) - family.size, int(end))
        for (kind, index), columns in family.forces.items():
            for torque, motion, force in zip(answers, motions, columns, strict=True):
                if kind == "joint":
                    torque[:, index, own] += force
                else:
                    torque[:, :, own] += along_actuator(motion, index, force)
    return answers


def responses(linearised: ForceResponse, families: Sequence[ForceFamily]) -> list[Array]:
    """For each trial (m, nj, k) the change of the measured angles by all functions of some families."""
    return linearised.response(torques(families, linearised.motions))


def harmonics(model: Model, motions: Sequence[Motion], frequencies: Sequence[float]) -> list[ForceFamily]:
    """At every joint and each frequency [Hz] a torque of sine and cosine of the time since a recording began."""
    scene = Scene(model, tuple(motions))
    waves = []
    for j, name in enumerate(scene.joints):
        for f in frequencies:
            turns = [2 * np.pi * f * t for t in scene.since()]
            columns = tuple(np.column_stack([np.sin(x), np.cos(x)]) for x in turns)
            waves.append(
                ForceFamily(name, (name,), [Coordinate("time", frequency=f)], None, (), {("joint", j): columns})
            )
    return waves
