"""What a robot says about itself, whatever it was described by."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self

import numpy as np

from equimus_ctrl.effects import base as effects_base
from equimus_ctrl.effects.base import Effect, Robots
from equimus_ctrl.robots.mechanics import Mechanics
from equimus_ctrl.shown import Short, listed
from equimus_ctrl.types import Array, frozen_array

Need = Literal["lengths", "inverse"]
"""What a controller may compute with: lengths of actuators and the statics of pressures along them, or the exact
equations of motion solved for forces (``models.dynamics``)."""


class _Named(Protocol):
    @property
    def name(self) -> str: ...


@dataclass(frozen=True)
class RobotTraits:
    """What kind of motion, recordings and commands a robot has. Each trait stands alone.

    Which engine simulates the robot is none of them; see ``engines.base``.

    Attributes:
        catalogue: whose effects can be attached, see ``Effect.robots``.
        starts_at_rest: a recording begins settled under the command before it. So a trial starts from its first angles
            with zero velocity, and before its start it was there too. Else positions and velocities at the start are
            read off the measurements, and before its start the robot moved as it does there.
        held_in_place: springs pull every joint to one pose under each command. So small errors do not grow along a
            trial, which can be fitted whole, and poses at rest identify parameters. Else errors add up: fits have many
            local minima, and trials may have to be cut into shooting intervals.
        stops_give_way: joints may go beyond the ends of their ranges, where elastic stops push them back. Else recorded
            positions lie within.
        smooth_motion: a motion of a tenth of a second is a parabola, so velocities are read off that much of a
            recording and trusted as much as samples are. Motors change velocities within a few samples.
        forces_along_actuators: actuators have a length of their own, which changes with the pose, and forces act along
            it. Else a drive with a fixed gear is where its joint is, and forces act at joints alone.
        commands_are_pressures: commands are pressures in Pa, so actuators fill and vent; else they are what each
            actuator asks for.
        same_kind_of_trials: all recordings are of one kind of experiment, so what is found in some has to show in the
            others. Else some may never come near a drive's limit, say.
        keeps_states_of_laws: its compiled equations always hold the laws with states of their own, so that there is one
            kernel for whatever effects it has. Else only where a model has such a law: a small robot's equations, which
            are one short function without, would be several times slower.
        has_stance: it has a foot that can be pinned while the base moves.
        damping_known_within: factor by which damping is off at most when missing physics is looked for; beyond, it
            would stand in for what is missing. None where the parameter's own bounds are as narrow as is known.
        bounds_of_any_size: bounds of parameters hold for robots of any size, so they are far apart: what is near to one
            is measured by the parameter, not by the way between its bounds.
        least_command: commands that stay within this do not move it [unit of the commands]; 0 where it may move by
            itself.
        least_motion: a joint that stays within this does not move [rad or m].
        most_angle: angles beyond this are degrees, not radians [rad].
        usual_lag: time constant of what usually stands between a command and its force, where nobody knows it [s].
        usual_delay: dead time of the same [s].
    """

    catalogue: Robots
    starts_at_rest: bool
    held_in_place: bool
    stops_give_way: bool
    smooth_motion: bool
    forces_along_actuators: bool
    commands_are_pressures: bool
    same_kind_of_trials: bool
    keeps_states_of_laws: bool
    has_stance: bool
    damping_known_within: float | None
    bounds_of_any_size: bool
    least_command: float
    least_motion: float
    most_angle: float
    usual_lag: float
    usual_delay: float


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Short, ABC):
    """A robot: its joints and actuators, its parameters by dotted name, and where effects can be attached.

    A subclass is a frozen dataclass with joints and actuators, each in the order of every vector of theirs.

    Attributes:
        name: what it is called.
    """

    traits: ClassVar[RobotTraits]
    name: str

    if TYPE_CHECKING:  # a field where the robot is described by them, a property where they are read off a file

        @property
        def joints(self) -> tuple[_Named, ...]: ...

        @property
        def actuators(self) -> tuple[_Named, ...]: ...

    def told(self) -> str:
        """Joints and actuators."""
        return f" {self.name}: {listed(self.joint_names, 'joint')}, {listed(self.actuator_names, 'actuator')}"

    def __getstate__(self) -> dict[str, Any]:
        # What was worked out is worked out again elsewhere.
        return {own.name: getattr(self, own.name) for own in fields(self)}

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Joint names in the order of every vector of positions."""
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def actuator_names(self) -> tuple[str, ...]:
        """Actuator names in the order of every vector of commands."""
        return tuple(actuator.name for actuator in self.actuators)

    @property
    def prescribed_names(self) -> tuple[str, ...]:
        """Joints beside these whose motion is an input: measured, and taken as it is."""
        return ()

    @property
    def unmeasured_names(self) -> tuple[str, ...]:
        """Joints beside these that no column tells of and that move by themselves, those that begin anywhere first."""
        return ()

    @property
    def loose_count(self) -> int:
        """How many of these begin anywhere; where the others begin follows, see ``with_unmeasured``."""
        return 0

    def with_unmeasured(self, position: Array, velocity: Array, beside: Array) -> tuple[Array, Array]:
        """Positions and rates (…, nj + np) at a start with those of unmeasured joints behind them.

        Args:
            position: of the joints and of those whose motion is prescribed [rad or m].
            velocity: theirs [rad/s or m/s].
            beside: (…, 2 nl) positions and rates of unmeasured joints that begin anywhere.
        """
        return position, velocity

    @property
    def prescribed_columns(self) -> tuple[str, ...]:
        """The positions that were recorded of them, by the columns' names."""
        return ()

    @property
    def prescribed_range(self) -> tuple[Array, Array]:
        """(low, high), each (np,): between what they can be [rad or m], ±inf where nothing says so."""
        return np.empty(0), np.empty(0)

    def prescribed_positions(self, where: str, recorded: Array) -> Array:
        """(n, np) positions of these joints [rad or m], of (n, nc) what was recorded.

        Args:
            where: it was recorded, for messages.
            recorded: ``prescribed_columns``.
        """
        return recorded

    def suited(self, read: Callable[[], Sequence[tuple[str, Array]]]) -> Self:
        """A copy whose prescribed joints suit some recordings, where there is a choice.

        Args:
            read: gives the name of each, and (n, nc) ``prescribed_columns``.
        """
        return self

    @property
    @abstractmethod
    def joint_range(self) -> tuple[Array, Array]:
        """(low, high), each (nj,): where the joints' ranges end [rad or m], ±inf where they do not."""

    @property
    @abstractmethod
    def tilt(self) -> float:
        """Angle by which gravity is turned [rad]."""

    @abstractmethod
    def places(self) -> dict[str, tuple[str, ...]]:
        """Kind of place (see ``effects.base.PLACES``) → names of those an effect can sit at."""

    def force_places(self) -> dict[str, tuple[str, ...]]:
        """``places`` of effects that exert a force: at actuators only where forces can act along them."""
        along = self.traits.forces_along_actuators
        return self.places() if along else {**self.places(), "actuator": ()}

    @property
    def foot_link(self) -> str | None:
        """The link whose tip is the foot: the same place by another name. None where every place has one name."""
        return None

    def carrying_point(self, place: str) -> str:
        """In words where a payload at a link or foot sits."""
        return place

    # Parameters.

    @abstractmethod
    def parameters(self) -> dict[str, float]:
        """Every parameter by its dotted name."""

    @abstractmethod
    def has_parameters(self, names: Iterable[str]) -> bool:
        """Whether all of these are names of ``parameters()``."""

    @abstractmethod
    def with_parameters(self, values: Mapping[str, float]) -> Self:
        """A copy with some parameters replaced.

        Raises:
            ModelError: for a name that does not exist, or a value that cannot be.
        """

    @abstractmethod
    def unit(self, name: str) -> str:
        """The SI unit of a parameter."""

    @abstractmethod
    def bounds(self, name: str) -> tuple[float, float]:
        """(low, high): between what a parameter can plausibly be."""

    def size(self, name: str) -> float | None:
        """A change that counts, where its value or its bounds do not say it; None where they do."""
        return None

    def positive(self, name: str) -> bool:
        """Whether bounds below 0 are refused for a parameter. Where not, a value that cannot be is refused when set."""
        return False

    @abstractmethod
    def default_names(self) -> list[str]:
        """The parameters that are known least: free by default."""

    def base_names(self) -> list[str]:
        """The base parameters: inertial ones that inverse dynamics identify; none where a robot has no such list."""
        return []

    @abstractmethod
    def varying(self) -> list[tuple[str, tuple[str, ...]]]:
        """What differs between robots built alike: kinds such as ``mass``, and parameters that vary together."""

    # Units.

    def slides(self, joint: str) -> bool:
        """Whether a joint is a slide, with positions in m; else it is a hinge."""
        return False

    @abstractmethod
    def place_unit(self, unit: str, place: str) -> str:
        """The unit of something at a joint or actuator.

        Args:
            unit: of it at a hinge; ``joint unit | actuator unit`` where actuators have another, ``command`` for the
                unit of commands, ``1/command`` for its inverse.
            place: the joint's or actuator's name, or the base for all actuators.
        """

    @abstractmethod
    def driven_joints(self, actuator: str) -> frozenset[str]:
        """The joints that an actuator's force acts on in some pose."""

    @abstractmethod
    def command_unit(self, actuator: str) -> str:
        """Of an actuator's command."""

    @abstractmethod
    def length_unit(self, actuator: str) -> str:
        """Of the coordinate along which an actuator acts; its rate is that over s."""

    # What plants and controllers ask.

    @property
    def fingerprint(self) -> str:
        """Of all that it is beside ``to_dict``, such as the text of its file."""
        return ""

    @cached_property
    def joint_units(self) -> tuple[str, ...]:
        """SI units of the joints' positions."""
        return tuple("m" if self.slides(joint) else "rad" for joint in self.joint_names)

    @cached_property
    def command_units(self) -> tuple[str, ...]:
        """SI units of the actuators' commands; ``1`` where they have none."""
        return tuple(self.command_unit(actuator) for actuator in self.actuator_names)

    @property
    @abstractmethod
    def command_limits(self) -> tuple[Array, Array]:
        """(low, high), each (na,): between what commands make a difference, ±inf where nothing limits them."""

    @property
    def command_rates(self) -> Array:
        """(na,) how fast what a command asks for can change by the description itself, +inf where nothing says so."""
        return frozen_array(np.full(len(self.actuator_names), np.inf))

    @property
    def goals(self) -> tuple[bool, ...]:
        """Of each actuator whether its command is a goal for where something is."""
        return (False,) * len(self.actuator_names)

    def goals_at(self, position: Array) -> Array:
        """(na,) the goals at which servos exert nothing at rest in a pose (nj,) [rad or m]; 0 of other commands."""
        return np.zeros(len(self.actuator_names))

    @property
    def keyframes(self) -> Mapping[str, Array]:
        """Name → (nj,) pose [rad or m] that its description names."""
        return {}

    @property
    def home(self) -> Array | None:
        """(nj,) the pose in which its description has it, within its ranges [rad or m]; the first keyframe if any.

        None where it names none: then springs decide.
        """
        return next(iter(self.keyframes.values()), None)

    @property
    def scenario_options(self) -> Mapping[str, Mapping[str, str]]:
        """Name of a scenario → option → what its description has in the place of the scenario's own default."""
        return {}

    @property
    def timestep(self) -> float | None:
        """The physics step that its description asks for [s]; None where it asks for none."""
        return None

    @property
    def obstacles(self) -> tuple[str, ...]:
        """What compiled equations of motion cannot hold of it, a phrase each; contacts are another matter."""
        return ()

    @property
    def uninvertible(self) -> tuple[str, ...]:
        """What keeps a controller from solving its equations of motion for commands, a phrase each."""
        return self.obstacles

    @property
    @abstractmethod
    def offers(self) -> frozenset[Need]:
        """What a controller of it can compute with."""

    # What effects and recordings ask.

    @property
    def has_torque_domain(self) -> bool:
        """Whether forces of all drives follow from where joints are, how fast they move and what was commanded lately.

        Then models can also be compared by inverse dynamics along measured motions, see ``engines.mjcf_inverse``.
        """
        return False

    def clipped_commands(self) -> dict[str, tuple[float, float]]:
        """Actuator → (low, high) at which a simulation clips its commands, for those where it does."""
        return {}

    @property
    def command_ranges(self) -> Array | None:
        """(2, na) between what drives clip their commands; None where none does."""
        return None

    @abstractmethod
    def with_payload(self, place: str, mass: float) -> Self:
        """A copy that carries a point mass [kg] at a link or foot."""

    def check(self, effects: Sequence[Effect]) -> None:
        """Raise ConfigError where effects cannot be attached: not to this kind of robot, not there, not together."""
        effects_base.check_robots(effects, self.traits.catalogue, self.name)
        for effect in effects:
            effects_base.check_locations([effect], effect.places_on(self), self.name)
        effects_base.check_exclusive(effects, self, self.name)

    @abstractmethod
    def mechanics(self) -> Mechanics:
        """The robot as compiled equations of motion take it.

        Raises:
            ModelError: where it has what they cannot hold.
        """

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """What a model file says of it, beside its name."""
