"""What scenarios are built on: a robot, its poses, and what was recorded of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, elastic_of
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.types import Array, Recording, Start, frozen_array

POSITION = "pos."
"""Before a joint's name where something else has that name too, as in columns of recordings."""
RANGE_MARGIN = {"rad": 0.1, "m": 1e-3}
"""SI unit → how far into a joint's stop a reference may go: an equilibrium may press on a stop."""
INSIDE = 0.9
"""Of a joint's range what swings may take."""
ASIDE = 0.1
"""From a pose in which arms of actuators might vanish [rad or m]."""
LOOKS, NEAR = 200, 1e-2
"""At how many instants of a motion commands are looked at, and how exactly its share is found."""
LACKING = 1e-6
"""Share of the torque that a joint needs, and of 1 N·m or N, of which it lacks none."""


@dataclass(frozen=True, eq=False)
class CommandProfile:
    """Commands over time, each held until the next (zero-order hold).

    Attributes:
        times: (n,) ascending, the first at or before 0 [s].
        values: (n, na) pressures [Pa], or what else commands are.
    """

    times: Array
    values: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", frozen_array(self.times, 1, "command times"))
        object.__setattr__(self, "values", frozen_array(self.values, 2, "command values"))
        if len(self.times) != len(self.values) or len(self.times) == 0 or not np.all(np.diff(self.times) > 0):
            raise ConfigError("a command profile needs one row of pressures for each of its ascending times")
        if not (np.all(np.isfinite(self.times)) and np.all(np.isfinite(self.values))):
            raise ConfigError("a command profile's times and pressures must be finite numbers")

    def at(self, time: float) -> Array:
        """(na,) the commands in force at ``time`` [Pa]."""
        k = int(np.searchsorted(self.times, time + 1e-9, side="right")) - 1
        return np.asarray(self.values[max(k, 0)])


@dataclass(frozen=True, eq=False)
class ScenarioContext:
    """What a scenario may build on.

    Attributes:
        robot: the nominal one.
        phase: base fixed or foot pinned.
        recording: file kind (``"triangle"``, ``"step_release"``) → its trials, empty where there are none.
        missing: sentence that says how to get recordings.
        effects: what is known to be attached to the robot.
        read_path: gives times (n,) [s] and positions (n, nj) [rad or m] of a file.
    """

    robot: Robot
    phase: Phase = "swing"
    recording: Callable[[str], tuple[Recording, ...]] = lambda kind: ()
    missing: str = "there are no recordings"
    effects: tuple[Effect, ...] = ()
    read_path: Callable[[str, Robot], tuple[Array, Array]] | None = None

    @property
    def morphology(self) -> Morphology:
        """The robot where it has to have elastic actuators.

        Raises:
            ConfigError: where it has none.
        """
        return elastic_of(self.robot)

    @property
    def kinematics(self) -> Kinematics:
        """Geometry and statics of the nominal robot."""
        return Kinematics(self.morphology, self.phase)

    def require(self, joints: tuple[str, ...], actuators: tuple[str, ...], scenario: str) -> None:
        """Raise ConfigError unless the robot has exactly these joints and actuators."""
        m = self.robot
        if (m.joint_names, m.actuator_names) != (joints, actuators):
            raise ConfigError(
                f"scenario {scenario} is for a robot with joints {', '.join(joints)} and actuators "
                f"{', '.join(actuators)}; {m.name} has {', '.join(m.joint_names)} and {', '.join(m.actuator_names)}"
            )

    def profile(self, times: Any, values: Any) -> CommandProfile:
        """A command profile, checked against the robot's actuators and range.

        Raises:
            ConfigError: where a command is missing or outside the range.
        """
        m = self.robot
        profile = CommandProfile(times, values)
        if profile.values.shape[1] != len(m.actuators):
            raise ConfigError(f"a command profile for {m.name} needs {len(m.actuators)} commands in each row")
        low, high = m.command_limits
        beyond = np.maximum(low - profile.values, profile.values - high)
        if beyond.max() > 0:
            row, i = np.unravel_index(int(beyond.argmax()), beyond.shape)
            own = reading(m.command_units[i])
            raise ConfigError(
                f"{m.actuator_names[i]}: a command of {own.text(profile.values[row, i])} lies outside the range of "
                f"{m.name}, {low[i] * own.factor:g} to {own.text(high[i])}"
            )
        return profile

    # Poses.

    @cached_property
    def dynamics(self) -> Dynamics:
        """The exact equations of motion of the nominal robot.

        Raises:
            NotAvailable: where they cannot hold it.
        """
        return Dynamics(Model(self.robot, self.effects, self.phase))

    @cached_property
    def home(self) -> Array:
        """(nj,) the pose that the robot's description names [rad or m].

        Where it names none, and springs hold the robot: half way between where it rests under the lowest and under the
        highest commands.
        """
        if self.robot.home is not None:
            return self.robot.home
        model = Model(self.robot, self.effects, self.phase)
        return np.asarray(np.mean([rest_pose(model, command) for command in self.robot.command_limits], axis=0))

    def pose(self, given: Mapping[str, float], keyframe: str = "") -> Array:
        """(nj,) a pose in which some joints are where people say, the others where they are in a keyframe [rad or m].

        Args:
            given: joint → position in ° or mm.
            keyframe: by name; ``home`` by default.

        Raises:
            ConfigError: for a keyframe or a joint that there is not, or a position that is no number.
        """
        robot = self.robot
        if keyframe and keyframe not in robot.keyframes:
            raise ConfigError(unknown_name("keyframe", keyframe, robot.keyframes, robot.name))
        pose = np.array(robot.keyframes[keyframe] if keyframe else self.home)
        for joint, value in given.items():
            joint = joint if joint in robot.joint_names else joint.removeprefix(POSITION)
            if joint not in robot.joint_names:
                raise ConfigError(unknown_name("joint", joint, robot.joint_names, robot.name))
            if not math.isfinite(value):
                raise ConfigError(f"{joint} is {value:g}, expected a finite number")
            j = robot.joint_names.index(joint)
            pose[j] = value / reading(robot.joint_units[j]).factor
        return pose

    def swings(self, size: float, about: Array | None = None) -> tuple[Array, Array]:
        """A middle (nj,) near a pose, and by how much (nj,) each joint may swing about it within its range [rad or m].

        Args:
            size: of a swing in ° or mm.
            about: (nj,) [rad or m]; ``home`` by default.
        """
        low, high = self.robot.joint_range
        most = np.array([size / reading(unit).factor for unit in self.robot.joint_units])
        most = np.minimum(most, np.where(np.isfinite(high - low), INSIDE * (high - low) / 2, np.inf))
        most *= self.driven
        return np.clip(self.home if about is None else about, low + most / INSIDE, high - most / INSIDE), most

    def joints_of(self, text: str) -> dict[str, float]:
        """Joint → position as people say it, of ``shoulder=30 elbow=-20``.

        Raises:
            ConfigError: where it is not of that form.
        """
        found = {}
        for part in text.replace(",", " ").split():
            joint, _, number = part.partition("=")
            try:
                found[joint] = float(number)
            except ValueError:
                raise ConfigError(f"{part!r} is no way point; expected JOINT=POSITION, such as elbow=30") from None
        return found

    def path_file(self, file: str) -> tuple[Array, Array]:
        """Times (n,) from 0 on [s] and positions (n, nj) [rad or m] that a CSV file says.

        Raises:
            ConfigError, RecordingError: where no file can be read here, or not this, or it is no path.
        """
        if self.read_path is None:
            raise ConfigError(f"{file}: no files are read here")
        times, values = self.read_path(file, self.robot)
        if len(times) < 2:
            raise ConfigError(f"{file}: there is one row, expected a path of at least two")
        return times - times[0], values

    def start(self, pose: Array) -> Start:
        """A start at rest in a pose (nj,) [rad or m], under the commands that come nearest to holding it there."""
        if "inverse" not in self.robot.offers:
            return Start(position=pose)
        low, high = self.robot.command_limits
        return Start(command=np.clip(self.dynamics.holding(pose)[0], low, high), position=pose)

    def within_means(self, times: Array, middle: Array, swings: Array) -> tuple[float, Array]:
        """As much of a motion about a pose as the actuators can do, and that motion.

        Args:
            times: (n,) evenly spaced [s].
            middle: (nj,) the pose [rad or m].
            swings: (n, nj) the motion about it [rad or m].

        Returns:
            The share of the motion, and (n, nj) positions [rad or m].
        """
        if "inverse" not in self.robot.offers:
            return 1.0, middle + swings
        rates, dynamics = np.gradient(swings, times, axis=0), self.dynamics
        accelerations = np.gradient(rates, times, axis=0)
        some = np.unique(np.linspace(0, len(times) - 1, min(len(times), LOOKS)).astype(int))

        def possible(share: float) -> bool:
            for k in some:
                q, v = middle + share * swings[k], share * rates[k]
                torque = dynamics.needed(q, v, share * accelerations[k])
                command = dynamics.commands(q, v, torque)
                if np.any((command < dynamics.low) | (command > dynamics.high)):
                    return False
                off = np.abs(dynamics.exerted(q, v, command) - torque)
                if np.any((off > LACKING * np.maximum(1.0, np.abs(torque))) & self.driven):
                    return False
            return True

        low, high = (1.0, 1.0) if possible(1.0) else (0.0, 1.0)
        while high - low > NEAR:
            middle_share = (low + high) / 2
            low, high = (middle_share, high) if possible(middle_share) else (low, middle_share)
        return low, middle + low * swings

    @cached_property
    def driven(self) -> NDArray[np.bool_]:
        """(nj,) the joints on which an actuator acts."""
        if "inverse" not in self.robot.offers:
            return np.ones(len(self.home), dtype=bool)
        drive, _ = self.dynamics.authority(self.home + ASIDE, np.zeros(len(self.home)))
        return np.asarray(np.any(drive != 0, axis=1))

    def check_held(self, pose: Array) -> None:
        """Raise ConfigError where a joint cannot be held in a pose (nj,) [rad or m], and nothing else holds the robot.

        The sentence says which joint is out of its range, or lacks what. Ends of joints and dry friction hold what they
        can. Where springs pull the robot to one pose whatever is commanded, it comes to rest as near as it can, and
        nothing is said.
        """
        robot = self.robot
        if robot.traits.held_in_place:
            return
        if outside := out_of_range(robot, pose):
            raise ConfigError(f"{robot.name}: a pose to be held has {outside}")
        if "inverse" not in robot.offers:
            return
        command, lack = self.dynamics.holding(pose)
        low, high = robot.joint_range
        at_end = ((pose <= low) & (lack > 0)) | ((pose >= high) & (lack < 0))
        still = np.zeros(len(pose))
        needed = self.dynamics.needed(pose, still, still)
        short = np.where(at_end, 0.0, np.abs(lack)) > LACKING * np.maximum(1.0, np.abs(needed))
        if not short.any():
            return
        j = int(np.argmax(np.where(short, np.abs(lack), 0.0)))
        joint, place = robot.joint_names[j], reading(robot.joint_units[j]).text(pose[j])
        force = robot.place_unit("N·m", joint)
        way = np.sign(needed[j]) or np.sign(lack[j])
        where = f"{robot.name}: {joint} cannot be held at {place}, which takes {way * needed[j]:.3g} {force}"
        if not np.any(self.dynamics.authority(pose, still)[0][j]):
            raise ConfigError(f"{where}: no actuator acts on it; expected a pose in which it rests by itself")
        given, bound = way * self.dynamics.exerted(pose, still, command)[j], "most" if way * lack[j] > 0 else "least"
        raise ConfigError(f"{where}: its actuators exert {given:.3g} {force} at {bound}")


def out_of_range(robot: Robot, pose: Array) -> str:
    """Which joint of a pose (nj,) [rad or m] is beyond its range, and that range, in words; empty where none is."""
    low, high = robot.joint_range
    for joint, unit, place, least, most in zip(robot.joint_names, robot.joint_units, pose, low, high, strict=True):
        margin, text = RANGE_MARGIN.get(unit, 0.0), reading(unit).text
        if not least - margin <= place <= most + margin:
            return (
                f"{joint} at {text(place, '.1f')}, outside the joint's range of {text(least, '.1f')} to "
                f"{text(most, '.1f')}"
            )
    return ""
