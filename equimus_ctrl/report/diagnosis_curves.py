"""The curves of the findings: of force effects, from their own laws, and of unstructured residual forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import casadi as ca
import numpy as np

from equimus_ctrl.diagnosis import display_units
from equimus_ctrl.diagnosis.coordinates import Coordinate
from equimus_ctrl.diagnosis.residuals import ResidualForce, Unexplained
from equimus_ctrl.diagnosis.results import Finding
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.bodies import BodyEffect, changed_bodies
from equimus_ctrl.effects.description import CURVE_MARGIN
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.effects.sensors import SensorEffect
from equimus_ctrl.identification.parameters import place_unit, unit_of
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.diagnosis_panels import (
    Line,
    Panel,
    Scene,
    band,
    changes,
    in_time,
    name_of,
    settled,
    variants,
)
from equimus_ctrl.report.diagnosis_signals import command_panels, sensor_panels
from equimus_ctrl.report.diagnosis_words import coordinates_text, number, quantity, reading
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array

POINTS, POSES = 240, 121
CYCLES, CYCLE = 3, 2000
"""A motion to and fro is repeated until the states follow it; steps in each."""
RAMP, LONGEST, STEP = 0.05, 20.0, 1e-3
"""A step's duration, what follows at most, and the integration step of both [s]."""
FAST = 1.3
"""A force is drawn up to this multiple of the speed that is seldom exceeded."""
VISIBLE = 0.02
"""A curve is drawn where it varies by at least this share of the largest force."""
CLIPPED = 1.6
"""A modelled stop is drawn up to so many times the torque of the one found."""


def panels(scene: Scene, finding: Finding) -> list[Panel]:
    """The curves of a finding at the first of its places, the most informative one first.

    Args:
        scene: what was recorded.
        finding: whose.
    """
    best, others = finding.part.effects, variants(finding)
    if drawn := _own_panels(scene, best[0], [o[0] for o in others]):
        return drawn
    if isinstance(best[0], ForceEffect):
        drawn = _force_panels(scene, best[0], [cast(ForceEffect, o[0]) for o in others])
    elif isinstance(best[0], BodyEffect):
        drawn = _body_panels(scene, best, others)
    else:
        make = sensor_panels if isinstance(best[0], SensorEffect) else command_panels
        drawn = make(scene, best, others)
    # A force that is always the same has no curve.
    return drawn or [Panel("parameters of the effect", rows=_parameters_of(scene.model, best[0]))]


def unexplained_panel(scene: Scene, residual: Unexplained) -> Panel | None:
    """The curve of an unstructured residual force; None where it has no coordinate."""
    if not isinstance(residual, ResidualForce) or residual.axis is None or len(residual.x) == 0:
        return None
    along = reading(residual.axis_unit, float(np.abs(residual.x).max()))
    unit = reading(residual.unit, float(np.abs(residual.force).max()))
    x, y, half = residual.x * along.factor, residual.force * unit.factor, residual.band * unit.factor
    values = scene.values(residual.axis)
    return Panel(
        f"at {' and '.join(residual.places)}",
        f"{coordinates_text([residual.axis], scene.model).removeprefix('the ')} {along.bracket}",
        f"residual force {unit.bracket}",
        (Line(x, np.zeros(len(x)), "as modelled", True), Line(x, y, "unstructured residual force")),
        (x, y - half, y + half),
        None if values is None else values * along.factor,
    )


@dataclass(frozen=True, eq=False)
class _Law:
    """An effect's own law, evaluated numerically.

    Attributes:
        effect: whose.
        function: (x, rate, |rate|, z, p) → force, dry friction, dz/dt.
        rest: (x, p) → z.
        p: (np, 1) its parameters.
    """

    effect: ForceEffect
    function: ca.Function
    rest: ca.Function
    p: Array

    @classmethod
    def of(cls, effect: ForceEffect, load: float = 0.0) -> _Law:
        x, rate, speed = ca.SX.sym("x"), ca.SX.sym("rate"), ca.SX.sym("speed")
        z = ca.SX.sym("z", effect.n_states)
        states = ca.vertsplit(z) if effect.n_states else []
        p = {key: ca.SX.sym(key) for key in effect.parameter_info()}
        names = ca.vertcat(*p.values())
        parts = [
            ca.SX(effect.force(x, rate, states, p)) + effect.force_of_drive(ca.SX(load), p),
            ca.SX(effect.dry_friction(x, speed, p)) + effect.friction_of_load(ca.SX(load), speed, p),
            ca.vertcat(*effect.state_rate(x, rate, states, p)),
        ]
        function = ca.Function("law", [x, rate, speed, z, names], parts)
        rest = ca.Function("rest", [x, names], [ca.vertcat(*effect.rest_state(x, p))])
        return cls(effect, function, rest, np.array(list(effect.parameters().values()))[:, None])

    def settled(self, x: Array) -> Array:
        """(nz, n) states after a long rest at each x (n,)."""
        states = self.rest(x[None, :], np.repeat(self.p, len(x), axis=1))
        return np.array(states).reshape(self.effect.n_states, len(x))

    def exerted(self, x: Array, rate: Array, z: Array) -> Array:
        """(n,) what acts on the coordinate [N·m or N], dry friction against the rate."""
        many = np.repeat(self.p, len(x), axis=1)
        force, rub, _ = self.function(x[None, :], rate[None, :], np.abs(rate)[None, :], z, many)
        return np.array(force).ravel() - np.sign(rate) * np.array(rub).ravel()

    def along(self, x: Array, rate: Array, dt: float) -> Array:
        """((n + 1)/2,) the force at every other instant of a motion (n,) given at half steps of ``dt``; Runge–Kutta."""
        z = self.settled(x[:1])
        if self.effect.n_states:
            n = (len(x) - 1) // 2
            s, u, p = ca.SX.sym("s", len(z)), ca.SX.sym("u", 6), ca.SX.sym("p", len(self.p))

            def slope(at: ca.SX, k: int) -> ca.SX:
                return self.function(u[k], u[3 + k], ca.fabs(u[3 + k]), at, p)[2]

            k1 = slope(s, 0)
            k2 = slope(s + dt / 2 * k1, 1)
            k3 = slope(s + dt / 2 * k2, 1)
            k4 = slope(s + dt * k3, 2)
            step = ca.Function("step", [s, u, p], [s + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
            rows = [part[k : len(part) - 2 + k : 2] for part in (x, rate) for k in range(3)]
            later = step.mapaccum("steps", n)(z, np.array(rows), np.repeat(self.p, n, axis=1))
            z = np.hstack([z, np.array(later)])
        else:
            z = np.zeros((0, (len(x) + 1) // 2))
        return self.exerted(x[::2], rate[::2], z)


@dataclass(frozen=True, eq=False)
class _Place:
    """Motions of a joint or an actuator by which a force there is shown, within what recordings cover of it.

    Attributes:
        name: of it.
        noun: "angle", "position" or "length".
        covered: what recordings show of it.
        x_unit: SI unit of its coordinate.
        force_unit: SI unit of a force there.
    """

    name: str
    noun: str
    covered: Excitation
    x_unit: str
    force_unit: str

    @classmethod
    def of(cls, scene: Scene, name: str) -> _Place:
        noun = display_units.noun(scene.model, name) if name in scene.model.robot.joint_names else "length"
        x_unit, force_unit = (place_unit(scene.model, unit, name) for unit in ("rad | m", "N·m | N"))
        return cls(name, noun, scene.seen[name], x_unit, force_unit)

    @property
    def middle(self) -> float:
        return (self.covered.low + self.covered.high) / 2

    @property
    def half(self) -> float:
        return self.covered.span / 2

    @property
    def period(self) -> float:
        """Of a sine over the whole range whose largest speed is that of the recordings [s]."""
        return float(2 * np.pi * self.half / self.covered.speed)

    @property
    def range(self) -> Array:
        """(POINTS,) coordinates, somewhat beyond what is covered."""
        beyond = CURVE_MARGIN * self.covered.span
        return np.linspace(self.covered.low - beyond, self.covered.high + beyond, POINTS)

    @property
    def rates(self) -> Array:
        """(2 POINTS,) speeds either way, dense about 0."""
        fast = FAST * self.covered.speed
        return np.concatenate([-np.geomspace(fast, 1e-9, POINTS), np.geomspace(1e-9, fast, POINTS)])

    @property
    def to_and_fro(self) -> tuple[Array, Array, float]:
        """(n,) coordinate, (n,) rate and twice their interval [s] of a sine."""
        turn = np.linspace(0, 2 * np.pi * CYCLES, 2 * CYCLES * CYCLE + 1)
        rate = self.covered.speed * np.cos(turn)
        return self.middle + self.half * np.sin(turn), rate, self.period / CYCLE

    @property
    def step(self) -> tuple[Array, Array, Array]:
        """(n,) time [s], at half steps, (n,) coordinate and (n,) rate of a ramp over half the range."""
        time = np.arange(-round(4 * RAMP / STEP), round(2 * LONGEST / STEP) + 1) * STEP / 2
        x = self.middle + self.half * (np.clip(time / RAMP, 0, 1) - 0.5)
        return time, x, np.where((time >= 0) & (time < RAMP), self.half / RAMP, 0)

    def at_rest(self, law: _Law) -> Array:
        """(POINTS,) the force over the range, after a long rest."""
        x = self.range
        return law.exerted(x, np.zeros(len(x)), law.settled(x))

    def sliding(self, law: _Law) -> Array:
        """(POINTS,) the same at the speed of the recordings."""
        x = self.range
        return law.exerted(x, np.full(len(x), self.covered.speed), law.settled(x))

    def in_motion(self, law: _Law) -> Array:
        """(2 POINTS,) the force over the rates, in the middle of the range."""
        x = np.full(2 * POINTS, self.middle)
        return law.exerted(x, self.rates, law.settled(x))

    def around(self, law: _Law) -> Array:
        """(CYCLE + 1,) the force over the last period to and fro."""
        return law.along(*self.to_and_fro)[-CYCLE - 1 :]

    def relaxing(self, law: _Law) -> Array:
        """(n,) the force after the step."""
        _, x, rate = self.step
        return law.along(x, rate, STEP)


def _force_panels(scene: Scene, best: ForceEffect, others: Sequence[ForceEffect]) -> list[Panel]:
    """Force against the coordinate, against its rate, around a loop and after a step: those that say anything."""
    place = _Place.of(scene, best.location)
    law, rest = _Law.of(best, place.covered.force), [_Law.of(o, place.covered.force) for o in others]
    loop, still, moving = place.around(law), place.at_rest(law), place.in_motion(law)
    size = max(float(np.abs(curve).max()) for curve in (loop, still, moving))
    unit = reading(place.force_unit, size)
    label = f"{'torque' if place.force_unit == 'N·m' else 'force'} {unit.bracket}"
    far = reading(place.x_unit, float(np.abs(place.range).max()))
    quick = reading(f"{place.x_unit}/s", place.covered.speed)
    axis, data = f"{place.noun} of {place.name} {far.bracket}", scene.position(place.name) * far.factor

    def panel(title: str, x: str, along: Array, of: Callable[[_Law], Array], where: Array | None = None) -> Panel:
        curve = of(law) * unit.factor
        ends = np.array([along.min(), along.max()])
        lines = Line(ends, np.zeros(2), "without", True), Line(along, curve, name_of([best]))
        return Panel(title, x, label, lines, band(along, curve, [of(o) * unit.factor for o in rest]), where)

    def varies(curve: Array) -> bool:
        return float(np.ptp(curve)) > VISIBLE * size

    drawn = []
    if best.n_states or varies(place.sliding(law) - still):
        title = f"to and fro, once in {quantity(place.period, 's')}"
        x = place.to_and_fro[0][::2][-CYCLE - 1 :]
        drawn.append(panel(title, axis, x * far.factor, place.around, data))
    instants = place.step[0][::2]
    if best.n_states and varies((relaxed := place.relaxing(law))[instants > RAMP]):
        until = float(np.clip(1.4 * settled(instants[instants > RAMP], relaxed[instants > RAMP]), 4 * RAMP, LONGEST))
        kept = instants <= until
        shown, time = in_time(instants[kept])
        title = f"after a step of {quantity(place.half, place.x_unit)}"
        drawn.append(panel(title, time, shown, lambda own: place.relaxing(own)[kept]))
    if varies(moving):
        fast = scene.values(Coordinate("vel", place.name))
        where = None if fast is None else fast * quick.factor
        x_label = f"speed of {place.name} {quick.bracket}"
        drawn.append(panel("against the speed", x_label, place.rates * quick.factor, place.in_motion, where))
    if varies(still):
        drawn.append(panel(f"against the {place.noun}", axis, place.range * far.factor, place.at_rest, data))
    return drawn


def _own_panels(scene: Scene, best: Effect, others: Sequence[Effect]) -> list[Panel]:
    """The curves that an effect has of its own."""
    robot, place = scene.model.robot, best.location
    shown, rest = (best.curves(robot, scene.seen[place]), [o.curves(robot, scene.seen[place]) for o in others])
    drawn = []
    for k, curve in enumerate(shown):
        far, up = (
            reading(unit, float(np.abs(values).max()))
            for unit, values in ((curve.x_unit, curve.along), (curve.y_unit, curve.values))
        )
        along, values = curve.along * far.factor, curve.values * up.factor
        without = np.full(2, curve.without * up.factor)
        lines = Line(along[[0, -1]], without, "without", True), Line(along, values, name_of([best]))
        axes = f"{curve.x} of {place} {far.bracket}".rstrip(), f"{curve.y} {up.bracket}".rstrip()
        around = band(along, values, [own[k].values * up.factor for own in rest])
        data = scene.position(place) * far.factor if curve.where_seen else None
        drawn.append(Panel(curve.title, *axes, lines, around, data))
    return drawn


def _body_panels(scene: Scene, best: Sequence[Effect], others: Sequence[Sequence[Effect]]) -> list[Panel]:
    """What another robot's weight, springs and stops do to the joints at rest, and its parameters."""
    if not scene.model.robot.traits.held_in_place:  # so no pose is one at rest
        return [Panel("parameters of the effect", rows=_parameters_of(scene.model, best[0]))]
    m = scene.model.morphology

    def robot(effects: Sequence[Effect]) -> Morphology:
        return changed_bodies((*scene.model.effects, *effects), m)

    modelled, now, rest = robot(()), robot(best), [robot(o) for o in others]
    pose = np.median(scene.angles, axis=0)
    drawn = []
    for what in ("stops", "gravity", "springs"):
        for j, joint in enumerate(m.joint_names):
            seen = scene.position(joint)
            beyond = 0.03 * float(np.ptp(seen))
            angles = np.linspace(seen.min() - beyond, seen.max() + beyond, POSES)
            poses = np.tile(pose, (POSES, 1))
            poses[:, j] = angles
            plain, curve = (_torque(own, scene.model, what, poses)[:, j] for own in (modelled, now))
            if not changes(curve, plain):
                continue
            size = float(np.abs(curve).max()) or float(np.abs(plain).max())
            unit = reading("N·m", size)
            clipped = np.where(np.abs(plain) <= CLIPPED * size, plain, np.nan)
            x = np.degrees(angles)
            lines = (
                Line(x, clipped * unit.factor, "as modelled", True),
                Line(x, curve * unit.factor, name_of(best)),
            )
            curves = [_torque(own, scene.model, what, poses)[:, j] * unit.factor for own in rest]
            around = band(x, curve * unit.factor, curves)
            axes = f"angle of {joint} [°]", f"torque of {what} {unit.bracket}"
            drawn.append(Panel(f"{what} at the {joint}", *axes, lines, around, np.degrees(seen)))
    return [*drawn, Panel("parameters of the robot", rows=_changed_parameters(scene.model, modelled, now))]


def _torque(robot: Morphology, model: Model, what: str, poses: Array) -> Array:
    """(n, nj) the part of the torque at rest that comes of weight, springs or stops [N·m]."""
    free = robot.without_stops()
    loose = replace(free, actuators=tuple(replace(a, stiffness=0.0) for a in robot.actuators))
    more, less = {"stops": (robot, free), "springs": (free, loose), "gravity": (loose, None)}[what]

    def torque(of: Morphology) -> Array:
        kinematics = Kinematics(of, model.phase)
        return np.array([kinematics.rest_torque(q)[0] for q in poses])

    return torque(more) - (torque(less) if less else 0.0)


def _parameters_of(model: Model, effect: Effect) -> tuple[tuple[str, ...], ...]:
    """(what, how much) of an effect's parameters."""
    info = effect.parameter_info()
    rows = []
    for key, value in effect.parameters().items():
        scale = reading(place_unit(model, info[key]["unit"], effect.location), value)
        rows.append((str(info[key]["doc"]), scale(number(value * scale.factor))))
    return tuple(rows)


def _changed_parameters(model: Model, before: Morphology, after: Morphology) -> tuple[tuple[str, ...], ...]:
    """(number, ``modelled → now``) of all that differ."""
    old, new = before.parameters(), after.parameters()
    rows = []
    for name, value in new.items():
        if old.get(name) != value:
            scale = reading(unit_of(model, name), max(abs(old.get(name, 0.0)), abs(value)))
            first = number(old[name] * scale.factor) if name in old else "none"
            rows.append((name, f"{first} → {scale(number(value * scale.factor))}"))
    return tuple(rows)
