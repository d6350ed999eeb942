"""A robot that MuJoCo's own XML describes: hinges and slides, driven by motors, servos or general actuators.

Its parameters are those that its file holds. Each has a dotted name, such as ``arm.mass`` for a body,
``elbow.damping`` for a joint and ``motor.gain`` for an actuator, and any of them can be changed.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import mujoco
import numpy as np

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.errors import ConfigError, ModelError, unknown_name
from equimus_ctrl.robots.base import Robot, RobotTraits
from equimus_ctrl.robots.mechanics import Mechanics
from equimus_ctrl.robots.mjcf.actuators import OWN, exerts_its_command
from equimus_ctrl.robots.mjcf.bounds import POSITIVE, bounds_of, size_of
from equimus_ctrl.robots.mjcf.driving import Driven
from equimus_ctrl.robots.mjcf.editing import Edits
from equimus_ctrl.robots.mjcf.entries import SLIDING, Axis, Drive
from equimus_ctrl.robots.mjcf.independent import base_names, default_names
from equimus_ctrl.robots.mjcf.mechanics import mechanics_of
from equimus_ctrl.robots.mjcf.obstacles import obstacles
from equimus_ctrl.robots.mjcf.parts import (
    Compliance,
    Coupling,
    Parts,
    Place,
    Surface,
    Tether,
    hardness,
    with_parts,
    with_parts_spec,
)
from equimus_ctrl.robots.mjcf.plan import Assets, Plan, plan_of, spec_of
from equimus_ctrl.robots.mjcf.prescribing import ease_solver, prescribed_positions, recorded_columns, suited_turns
from equimus_ctrl.robots.mjcf.reading import next_hinges
from equimus_ctrl.robots.mjcf.scratch import Scratch
from equimus_ctrl.robots.mjcf.traits import TRAITS
from equimus_ctrl.robots.mjcf.unmeasured import tied
from equimus_ctrl.robots.mjcf.writing import write, write_parameters
from equimus_ctrl.types import Array, frozen_array

BASE = "base"
"""The place of what concerns the whole robot."""
LEAST_PLAY = 2e-9
"""A play that is none [rad or m]."""


@dataclass(frozen=True, eq=False, repr=False)
class MjcfRobot(Driven):
    """A robot from a MuJoCo model.

    Attributes:
        name: of the model.
        xml: the model, in one piece.
        assets: files that the XML names.
        source: name of the file it came from.
        edits: what was made of that file.
        values: parameters that differ from the XML, by dotted name.
        payloads: (body or site, mass [kg], place beside its centre or the site [m]) of what it carries beside.
        compliances: drives that are not rigid.
        tethers: springs to points of the room, one to a link at most.
        surfaces: level planes in the room below which a point of it cannot go, one at most.
        couplings: friction over two joints, one for a pair and a sign.
        gains: (actuator, factor) on the forces of actuators.
        limits: (actuator, size) to which forces of actuators are limited [N·m or N].

    Raises:
        ModelError: where the XML is no model, or of a kind that is not for this.
    """

    traits: ClassVar[RobotTraits] = TRAITS

    name: str
    xml: str
    assets: Mapping[str, bytes] = field(default_factory=dict)
    source: str = ""
    edits: Edits = field(default_factory=Edits)
    values: Mapping[str, float] = field(default_factory=dict)
    payloads: tuple[tuple[str, float, Place], ...] = ()
    compliances: tuple[Compliance, ...] = ()
    tethers: tuple[Tether, ...] = ()
    surfaces: tuple[Surface, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    gains: tuple[tuple[str, float], ...] = ()
    limits: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", dict(self.values))
        _ = self.joints, self.actuators

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that it is but its name and the file's."""
        files = [(name, hashlib.sha256(data).hexdigest()) for name, data in sorted(self.assets.items())]
        parts = (self.xml, files, sorted(self.values.items()), self.payloads, self.compliances, self.gains, self.limits)
        given = self.edits.prescribe, sorted(self.edits.turns.items()), self.edits.unmeasured
        whole = (*parts, *(own for own in (self.tethers, self.surfaces, self.couplings, *given) if own))
        return hashlib.sha256(repr(whole).encode()).hexdigest()

    @property
    def fingerprint(self) -> str:
        """As of any robot."""
        return self.digest

    @cached_property
    def plan(self) -> Plan:
        """What the file says."""
        return plan_of(self.name, self.xml, self.beside_xml)

    @cached_property
    def beside_xml(self) -> Assets:
        """What its model is made of beside the XML."""
        return Assets(self.assets, self.edits.prescribe, self.edits.turns, self.edits.unmeasured)

    @property
    def prescribed_names(self) -> tuple[str, ...]:
        """Joints whose motion is an input, see ``robots.mjcf.prescribing``."""
        return tuple(joint.name for joint in self.plan.prescribed)

    @property
    def unmeasured_names(self) -> tuple[str, ...]:
        """As of any robot, see ``robots.mjcf.unmeasured``."""
        return tuple(joint.name for joint, _ in self.plan.unmeasured)

    @property
    def loose_count(self) -> int:
        """As of any robot: those that are tied to no other."""
        return sum(tie is None for _, tie in self.plan.unmeasured)

    def with_unmeasured(self, position: Array, velocity: Array, beside: Array) -> tuple[Array, Array]:
        """As of any robot; tied ones are where their ties put them."""
        if not self.plan.unmeasured:
            return position, velocity
        return tied(self.plan.unmeasured, (*self.joint_names, *self.prescribed_names), position, velocity, beside)

    @property
    def prescribed_columns(self) -> tuple[str, ...]:
        """As of any robot; the pose of a free base, see ``free_base.POSE``."""
        return recorded_columns(self.edits.prescribe, self.edits.turns)

    @property
    def prescribed_range(self) -> tuple[Array, Array]:
        """As of any robot: what the file says of them."""
        low, high = ([joint.range[side] for joint in self.plan.prescribed] for side in (0, 1))
        return frozen_array(low, 1), frozen_array(high, 1)

    def prescribed_positions(self, where: str, recorded: Array) -> Array:
        """As of any robot.

        Raises:
            ConfigError: for what is no pose of a free base, or one that its hinges cannot follow.
        """
        return prescribed_positions(where, self.edits.prescribe, self.edits.turns, recorded)

    def suited(self, read: Callable[[], Sequence[tuple[str, Array]]]) -> MjcfRobot:
        """As of any robot: with the hinges in the place of free joints that suit, see ``free_base.sequence_for``."""
        if not self.edits.turns:
            return self
        return replace(
            self, edits=replace(self.edits, turns=suited_turns(self.edits.prescribe, self.edits.turns, read()))
        )

    @cached_property
    def joints(self) -> tuple[Axis, ...]:
        """In the file's order."""
        return self.plan.joints

    @cached_property
    def actuators(self) -> tuple[Drive, ...]:
        """In the file's order."""
        return self.plan.drives

    @property
    def joint_range(self) -> tuple[Array, Array]:
        """(low, high), each (nj,): ends of the joints [rad or m], ±inf where there are none."""
        low, high = ([joint.range[side] for joint in self.joints] for side in (0, 1))
        return frozen_array(low, 1), frozen_array(high, 1)

    @property
    def timestep(self) -> float:
        """The physics step that the file asks for [s]."""
        return float(self.plan.base.opt.timestep)

    def places(self) -> dict[str, tuple[str, ...]]:
        """Kind of place → names of those an effect can sit at."""
        return {
            "joint": self.joint_names,
            "actuator": self.actuator_names,
            "link": self.plan.bodies,
            "foot": self.plan.sites,
            "base": (BASE,),
        }

    def parameters(self) -> dict[str, float]:
        """Every parameter by its dotted name."""
        return {number.name: self.values.get(number.name, number.value) for number in self.plan.parameters.values()}

    def has_parameters(self, names: Iterable[str]) -> bool:
        """Whether it has parameters of all these names."""
        return all(name in self.plan.parameters for name in names)

    def with_parameters(self, values: Mapping[str, float]) -> MjcfRobot:
        """A copy with some parameters replaced.

        Raises:
            ModelError: for a name that does not exist, or a value that cannot be.
        """
        for name, value in values.items():
            if name not in self.plan.parameters:
                raise ModelError(unknown_name("parameter", name, self.plan.parameters, self.name))
            if not math.isfinite(value) or (value < 0 and self.plan.parameters[name].kind in POSITIVE):
                least = " of at least 0" if self.plan.parameters[name].kind in POSITIVE else ""
                raise ModelError(f"{self.name}: {name} is {value:g}, expected a finite number{least}")
        return replace(self, values={**self.values, **{name: float(v) for name, v in values.items()}})

    def unit(self, name: str) -> str:
        """Of a parameter, SI."""
        return self.plan.parameters[name].unit

    def positive(self, name: str) -> bool:
        """Whether a parameter is at least 0."""
        return self.plan.parameters[name].kind in POSITIVE

    def bounds(self, name: str) -> tuple[float, float]:
        """Default bounds (lowest, highest) of a free parameter of this kind."""
        return bounds_of(self.plan, self.parameters()[name], name)

    def size(self, name: str) -> float | None:
        """Of a change of a parameter that counts, see ``bounds.size_of``."""
        return size_of(self.plan, self.parameters()[name], name)

    def slides(self, joint: str) -> bool:
        """Whether a joint is a slide."""
        return next(axis.slides for axis in self._axes if axis.name == joint)

    def place_unit(self, unit: str, place: str) -> str:
        """The unit of something at a joint or actuator, see ``Robot.place_unit``."""
        hinge, _, _ = unit.partition(" | ")
        drive = next((drive for drive in self.actuators if drive.name == place), None)
        if hinge == "command":
            return drive.unit if drive else "1"
        if hinge == "1/command":
            own = {drive.unit} if drive else {each.unit for each in self.actuators}
            unit = own.pop() if len(own) == 1 else "1"
            return "1" if unit == "1" else f"1/({unit})" if "·" in unit else f"1/{unit}"
        joint = drive.joint if drive else place
        return SLIDING.get(hinge, hinge) if any(own.name == joint and own.slides for own in self._axes) else hinge

    @property
    def _axes(self) -> tuple[Axis, ...]:
        """Of all joints, whatever is known of their motion."""
        return (*self.joints, *self.plan.prescribed, *(joint for joint, _ in self.plan.unmeasured))

    def driven_joints(self, actuator: str) -> frozenset[str]:
        """The joint that a drive is at, or drives most."""
        return frozenset({next(drive.joint for drive in self.actuators if drive.name == actuator)})

    def command_unit(self, actuator: str) -> str:
        """Of an actuator's command."""
        return self.place_unit("command", actuator)

    def length_unit(self, actuator: str) -> str:
        """Of the coordinate of the joint that an actuator drives."""
        return self.place_unit("rad", actuator)

    def clipped_commands(self) -> dict[str, tuple[float, float]]:
        """Actuator → the XML's ``ctrlrange``, where it has one: MuJoCo clips commands there."""
        own = self.mujoco_model()
        ranges = {drive.name: own.actuator_ctrlrange[drive.control] for drive in self.actuators}
        limited = [drive.name for drive in self.actuators if own.actuator_ctrllimited[drive.control]]
        return {name: (float(ranges[name][0]), float(ranges[name][1])) for name in limited}

    def to_dict(self) -> dict[str, Any]:
        """What a model file says of it: the name of its XML, and what differs from that."""
        return {"mjcf": self.source, **self.edits.to_dict(), "parameters": dict(self.values)}

    # What effects on bodies and drives need of a robot.

    @property
    def weights(self) -> Mapping[str, float]:
        """Joint → inertia that it moves by itself, where the file has it [kg·m² or kg]."""
        return self.plan.weights

    @property
    def tilt(self) -> float:
        """Angle by which gravity is turned about ``tilt_axis`` [rad]."""
        return self.parameters()["tilt"]

    def with_payload(self, place: str, mass: float, beside: Place = (0.0, 0.0, 0.0)) -> MjcfRobot:
        """A copy that carries a mass [kg] at a site, or at the centre of mass of a body, or beside it [m]."""
        return replace(self, payloads=(*self.payloads, (place, mass, beside)))

    def with_tether(self, place: str, stiffness: float, anchor: Place, length: float = 0.0) -> MjcfRobot:
        """A copy with a spring from a site or a body's centre of mass to a point of the room, see ``Tether``."""
        return replace(self, tethers=(*self.tethers, Tether(place, stiffness, anchor, length)))

    @property
    def up(self) -> Array | None:
        """(3,) the direction against the file's gravity, along the room's axes; None where there is no gravity."""
        gravity = np.array(self.plan.base.opt.gravity)
        size = float(np.linalg.norm(gravity))
        return frozen_array(-gravity / size, 1) if size > 0 else None

    def with_surface(self, place: str, height: float) -> MjcfRobot:
        """A copy with a level plane below which a site or a body's centre of mass cannot go, see ``Surface``.

        Raises:
            ConfigError: where nothing says what is level.
        """
        if self.up is None:
            raise ConfigError(f"{self.name}: gravity is 0, expected more: a level surface lies across it")
        x, y, z = (float(part) for part in self.up)
        return replace(self, surfaces=(*self.surfaces, Surface(place, height, (x, y, z), hardness(self.timestep))))

    @property
    def joints_without_rotor(self) -> tuple[str, ...]:
        """Joints of drives with which nothing turns, for they have no armature."""
        numbers, driven = self.parameters(), {drive.joint for drive in self.actuators}
        return tuple(name for name in self.joint_names if name in driven and numbers[f"{name}.armature"] <= 0)

    @property
    def motors(self) -> tuple[str, ...]:
        """Actuators whose command is no goal for where something is."""
        return tuple(drive.name for drive in self.actuators if not drive.servo)

    @cached_property
    def next_hinges(self) -> dict[str, str]:
        """Hinge → the only joint that it carries next, where that is a hinge and both have drives."""
        base, driven = self.plan.base, {drive.joint for drive in self.actuators}
        pairs = [(base.joint(first).name, base.joint(second).name) for first, second in next_hinges(base)]
        return {first: second for first, second in pairs if {first, second} <= driven}

    def with_coupling(self, joint: str, sign: int, friction: float = 0.0, damping: float = 0.0) -> MjcfRobot:
        """A copy with friction over a joint and the next one beside what it has there, see ``Coupling``.

        Raises:
            ConfigError: where there is dry friction over the same joints with the other sign.
        """
        other = self.next_hinges[joint]
        there = {own.sign: own for own in self.couplings if own.joint == joint}
        if friction > 0 and -sign in there and there[-sign].friction > 0:
            raise ConfigError(
                f"{self.name}: dry friction over {joint} and {other} acts against the sum and the difference of their "
                "rates, expected one of both"
            )
        old = there.pop(sign, Coupling(joint, other, sign))
        new = replace(old, friction=old.friction + friction, damping=old.damping + damping)
        return replace(self, couplings=(*(own for own in self.couplings if own != old), new))

    @property
    def sharing(self) -> tuple[str, ...]:
        """All actuators, where the commands of all are forces of one unit, as motors' are; else none."""
        forces = all(exerts_its_command(self.plan.base, drive) for drive in self.actuators)
        return self.actuator_names if forces and len({drive.unit for drive in self.actuators}) == 1 else ()

    @property
    def ends(self) -> dict[str, tuple[str, ...]]:
        """``places`` of what sticks out: sites, or where there are none the bodies that carry no other."""
        carrying = {int(parent) for parent in self.plan.base.body_parentid}
        last = tuple(name for name in self.plan.bodies if self.plan.base.body(name).id not in carrying)
        return {**self.places(), "link": () if self.plan.sites else last}

    def with_compliance(self, joint: str, stiffness: float, damping: float, play: float = 0.0) -> MjcfRobot:
        """A copy with a spring between a joint and its drive, see ``Compliance``.

        Raises:
            ConfigError: where nothing turns with the drive.
        """
        if self.parameters()[f"{joint}.armature"] <= 0:
            raise ConfigError(
                f"{self.name}: {joint} has no armature, expected more than 0: what turns with a drive that gives way"
            )
        return replace(self, compliances=(*self.compliances, Compliance(joint, stiffness, damping, play)))

    def with_play(self, joint: str, play: float) -> MjcfRobot:
        """A copy with play between a joint and its drive; its ends are as hard as physics steps can follow."""
        return self.with_compliance(joint, 0.0, 0.0, max(play, LEAST_PLAY))

    def check(self, effects: Sequence[Effect]) -> None:
        """As of any robot; also where the XML switches off what an effect needs, or lacks what it changes."""
        super().check(effects)
        for effect in effects:
            for flag in effect.mujoco_flags:
                if int(self.plan.base.opt.disableflags) & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag.upper()}")):
                    raise ConfigError(
                        f"{self.name}: effect {effect.name} needs what the XML switches off: "
                        f'<flag {flag}="disable"/>; leave that flag out'
                    )
        changed_bodies(effects, self)

    def with_gain(self, actuator: str, factor: float) -> MjcfRobot:
        """A copy whose actuator's forces are as many times as large.

        Raises:
            ConfigError: for an actuator whose force is not a gain and a bias.
        """
        i = self.plan.base.actuator(self.actuator_of(actuator)).id
        if int(self.plan.base.actuator_gaintype[i]) in OWN:
            raise ConfigError(f"{self.name}: actuator {actuator!r} has a law of its own, expected a gain and a bias")
        return replace(self, gains=(*self.gains, (actuator, factor)))

    def actuator_of(self, command: str) -> str:
        """MuJoCo's actuator that takes a command."""
        return next(drive.actuator for drive in self.actuators if drive.name == command)

    def with_limit(self, actuator: str, size: float) -> MjcfRobot:
        """A copy whose actuator's forces are limited to a size [N·m or N]."""
        return replace(self, limits=(*self.limits, (actuator, size)))

    def mechanics(self) -> Mechanics:
        assets = self.beside_xml
        model, data = _scratch.blank(self.xml, assets, self.plan.base)
        write_parameters(model, self)
        drives = {}
        for c in self.compliances:
            dof = int(model.joint(c.joint).dofadr[0])
            drives[c.joint] = float(model.dof_armature[dof]), c.stiffness, c.damping, c.play
            model.dof_armature[dof] = 0.0
        mujoco.mj_setConst(model, data)
        parts = self.tethers, self.surfaces, self.couplings
        return mechanics_of(
            model, self.xml, assets, self.joint_names, (*self.prescribed_names, *self.unmeasured_names), drives, *parts
        )

    @property
    def obstacles(self) -> tuple[str, ...]:
        """What compiled equations of motion cannot hold of it, a phrase each; contacts are another matter."""
        return _obstacles(self.xml, self.beside_xml)

    def mujoco_model(self, timestep: float | None = None, scene: Callable[[Any], None] | None = None) -> Any:
        """An ``mujoco.MjModel`` of one's own with all of this in it.

        Args:
            timestep: another physics step than the XML's [s].
            scene: adds to an ``mujoco.MjSpec`` what stands around the robot.
        """
        model = copy.copy(self._base()) if scene is None else self._within(scene)
        model.opt.timestep = timestep or model.opt.timestep
        write(model, self)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        if self.prescribed_names:
            ease_solver(model, self.prescribed_names)
        return model

    def _base(self) -> Any:
        """MuJoCo's model of the file, with what ``with_parts`` adds to it; not to be changed."""
        return with_parts(self.xml, self.beside_xml, self.parts) if self.parts else self.plan.base

    def _within(self, scene: Callable[[Any], None]) -> Any:
        """``_base`` with what stands around it."""
        spec = with_parts_spec(self.xml, self.beside_xml, self.parts)
        scene(spec)
        return spec.compile()

    @property
    def parts(self) -> Parts:
        """What is added to the file's model."""
        joints = tuple(c.joint for c in self.compliances)
        tethered, touching = (tuple(own.place for own in which) for which in (self.tethers, self.surfaces))
        bare = tuple(replace(own, friction=0.0, damping=0.0) for own in self.couplings)
        return Parts(joints, tethered, touching, bare)

    def default_names(self) -> list[str]:
        """Parameters that are free by default, see ``independent.default_names``."""
        return default_names(self, self.plan.parameters)

    def base_names(self) -> list[str]:
        """Inertial parameters, as many as there are base parameters, see ``independent.base_names``."""
        return base_names(self, self.plan.parameters)


def mjcf_of(robot: Robot) -> MjcfRobot:
    """A robot as what it has to be where MuJoCo's XML is needed.

    Raises:
        ConfigError: where it is described otherwise.
    """
    if not isinstance(robot, MjcfRobot):
        raise ConfigError(f"{robot.name}: is no MJCF robot")
    return robot


_scratch = Scratch()


@lru_cache(maxsize=64)
def _obstacles(xml: str, assets: Assets) -> tuple[str, ...]:
    return tuple(obstacles(spec_of(xml, assets).compile()))
