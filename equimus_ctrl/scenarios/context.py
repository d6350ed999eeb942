"""What scenarios are built on: a robot, its poses, and what was recorded of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
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
from equimus_ctrl.models.points import Points, points_of
from equimus_ctrl.recordings.commands import CommandFile
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase, elastic_of
from equimus_ctrl.robots.reading import reading
from equimus_ctrl.scenarios.reaching import Reacher
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
GRAVITY = 9.81
"""Weight of a kilogram [N]."""
LACKING = 1e-6
"""Share of the torque that a joint needs, and of 1 N·m or N, of which it lacks none."""


ANY_LOAD = 1e9
"""What is borne beyond this is not limited [N·m or N]."""
SHARE = 0.2
"""Of what actuators can bear beside holding a pose, that a disturbance has where nobody says its size."""
QUICKENING = 1.0
"""By what it would speed up a free joint where nothing limits the actuators [rad/s² or m/s²]."""


@dataclass(frozen=True, eq=False)
class CommandProfile:
    """Commands over time, each held until the next (zero-order hold).

    Attributes:
        times: (n,) ascending, the first at or before 0 [s].
        values: (n, na) pressures [Pa], or what else commands are.
        linear: whether they go along a line from each to the next, in place of being held.
    """

    times: Array
    values: Array
    linear: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", frozen_array(self.times, 1, "command times"))
        object.__setattr__(self, "values", frozen_array(self.values, 2, "command values"))
        if len(self.times) != len(self.values) or len(self.times) == 0 or not np.all(np.diff(self.times) > 0):
            raise ConfigError("a command profile needs one row of pressures for each of its ascending times")
        if not (np.all(np.isfinite(self.times)) and np.all(np.isfinite(self.values))):
            raise ConfigError("a command profile's times and pressures must be finite numbers")

    def at(self, time: float) -> Array:
        """(na,) the commands in force at ``time`` [Pa]."""
        if self.linear:
            return np.array([np.interp(time, self.times, column) for column in self.values.T])
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
        read_path: gives times (n,) [s] and named columns (n, k) of a file.
        read_play: gives commands of actuators, within ranges, to be played from a file, see
            ``recordings.read_commands``.
        given: options of the scenario that people gave; others are defaults or the robot's description's.
    """

    robot: Robot
    phase: Phase = "swing"
    recording: Callable[[str], tuple[Recording, ...]] = lambda kind: ()
    missing: str = "there are no recordings"
    effects: tuple[Effect, ...] = ()
    read_path: Callable[[str, Sequence[str]], tuple[Array, Array]] | None = None
    read_play: Callable[[str, Sequence[str], Sequence[str], Array, Array], CommandFile] | None = None
    given: frozenset[str] = frozenset()

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

    def profile(self, times: Any, values: Any, linear: bool = False) -> CommandProfile:
        """A command profile, checked against the robot's actuators and range.

        Raises:
            ConfigError: where a command is missing or outside the range.
        """
        m = self.robot
        profile = CommandProfile(times, values, linear)
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

        Raises:
            ConfigError: where a keyframe that it is has a joint out of its range.
        """
        for name, pose in itertools.islice(self.robot.keyframes.items(), 1):
            self._require_within(name, pose, range(len(pose)))
        return self._somewhere

    @cached_property
    def _somewhere(self) -> Array:
        """(nj,) ``home``, or what is nearest to it within the joints' ranges [rad or m]."""
        return self._between_rests if self.robot.home is None else self.robot.home

    def pose(self, given: Mapping[str, float], keyframe: str = "") -> Array:
        """(nj,) a pose in which some joints are where people say, the others where they are in a keyframe [rad or m].

        Args:
            given: joint → position in ° or mm.
            keyframe: by name; ``home`` by default.

        Raises:
            ConfigError: for a keyframe or a joint that there is not, a position that is no number, or a keyframe that
                has a joint out of its range of which nobody says where it is.
        """
        robot = self.robot
        if keyframe and keyframe not in robot.keyframes:
            raise ConfigError(unknown_name("keyframe", keyframe, robot.keyframes, robot.name))
        keyframe = keyframe or next(iter(robot.keyframes), "")
        pose = np.array(robot.keyframes[keyframe] if keyframe else self.home)
        left = set(range(len(pose)))
        for joint, value in given.items():
            joint = joint if joint in robot.joint_names else joint.removeprefix(POSITION)
            if joint not in robot.joint_names:
                raise ConfigError(unknown_name("joint", joint, robot.joint_names, robot.name))
            if not math.isfinite(value):
                raise ConfigError(f"{joint} is {value:g}, expected a finite number")
            j = robot.joint_names.index(joint)
            pose[j] = value / reading(robot.joint_units[j]).factor
            left.discard(j)
        if keyframe:
            self._require_within(keyframe, pose, left)
        return pose

    def _require_within(self, keyframe: str, pose: Array, joints: Iterable[int]) -> None:
        """Raise ConfigError where some joints of a keyframe (nj,) are out of their ranges, with the nearest within."""
        robot = self.robot
        near = np.clip(pose, *robot.joint_range)
        for j in joints:
            if outside := out_of_range(robot, np.where(np.arange(len(pose)) == j, pose, near)):
                text = reading(robot.joint_units[j]).text(near[j], ".1f")
                raise ConfigError(
                    f"{robot.name}: keyframe {keyframe!r} has {outside}; the nearest that can be reached is {text}"
                )

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
        """Times (n,) from 0 on [s] and positions (n, nj) [rad or m] that a CSV file says, see ``read_columns``."""
        return self.read_columns(file, [f"{POSITION}{joint}" for joint in self.robot.joint_names])

    def read_columns(self, file: str, columns: Sequence[str]) -> tuple[Array, Array]:
        """Times (n,) from 0 on [s] and columns (n, k) that a CSV file has.

        Raises:
            ConfigError, RecordingError: where no file can be read here, or not this, or it is no path.
        """
        if self.read_path is None:
            raise ConfigError(f"{file}: no files are read here")
        times, values = self.read_path(file, columns)
        if len(times) < 2:
            raise ConfigError(f"{file}: there is one row, expected a path of at least two")
        return times - times[0], values

    def read_commands(self, file: str) -> CommandFile:
        """What a CSV file says is to be commanded.

        Raises:
            ConfigError, RecordingError: where no file can be read here, or not this, or it says what cannot be.
        """
        if self.read_play is None:
            raise ConfigError(f"{file}: no files are read here")
        m = self.robot
        return self.read_play(file, m.actuator_names, m.joint_names, *m.command_limits)

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
        rates = np.gradient(swings, times, axis=0)
        accelerations = np.gradient(rates, times, axis=0)
        some = _some(len(times))

        def possible(share: float) -> bool:
            return all(
                self._exertable(middle + share * swings[k], share * rates[k], share * accelerations[k]) for k in some
            )

        low, high = (1.0, 1.0) if possible(1.0) else (0.0, 1.0)
        while high - low > NEAR:
            middle_share = (low + high) / 2
            low, high = (middle_share, high) if possible(middle_share) else (low, middle_share)
        return low, middle + low * swings

    def can_do(self, times: Array, values: Array) -> bool:
        """Whether the actuators can do a motion (n, nj) at evenly spaced times (n,) [s], as far as is known."""
        if "inverse" not in self.robot.offers:
            return True
        rates = np.gradient(values, times, axis=0)
        accelerations = np.gradient(rates, times, axis=0)
        return all(self._exertable(values[k], rates[k], accelerations[k]) for k in _some(len(times)))

    def can_hold(self, pose: Array) -> bool:
        """Whether the actuators can hold a pose (nj,) [rad or m], as far as is known."""
        return "inverse" not in self.robot.offers or self._exertable(pose, np.zeros(len(pose)), np.zeros(len(pose)))

    @cached_property
    def middle(self) -> Array:
        """(nj,) ``home``; where the actuators cannot hold that and springs do, half way between poses at rest."""
        if self.can_hold(self.home) or not self.robot.traits.held_in_place:
            return self.home
        return self._between_rests

    @property
    def _between_rests(self) -> Array:
        model = Model(self.robot, self.effects, self.phase)
        return np.asarray(np.mean([rest_pose(model, command) for command in self.robot.command_limits], axis=0))

    def _exertable(self, q: Array, v: Array, a: Array, more: Array | float = 0.0) -> bool:
        """Whether commands within their limits exert what a motion needs, and more (nj,), at driven joints."""
        dynamics = self.dynamics
        torque = dynamics.needed(q, v, a) + more
        command = dynamics.commands(q, v, torque)
        if np.any((command < dynamics.low) | (command > dynamics.high)):
            return False
        off = np.abs(dynamics.exerted(q, v, command) - torque)
        return not np.any((off > LACKING * np.maximum(1.0, np.abs(torque))) & self.driven)

    def borne(self, pose: Array, load: Array) -> float:
        """How many times a load (nj,) on the joints the actuators can bear at rest in a pose (nj,) [N·m or N].

        inf where nothing limits them, 0 where they do not even hold the pose.
        """
        still, size = np.zeros(len(pose)), float(np.abs(load[self.driven]).max(initial=0.0))
        if not self._exertable(pose, still, still):
            return 0.0
        low, high = 0.0, 1.0 / size if size > 0 else np.inf
        while self._exertable(pose, still, still, -high * load) if np.isfinite(high) else False:
            low, high = high, 2 * high if high * size < ANY_LOAD else np.inf
        while np.isfinite(high) and high - low > NEAR * high:
            middle = (low + high) / 2
            low, high = (middle, high) if self._exertable(pose, still, still, -middle * load) else (low, middle)
        return low if np.isfinite(high) else np.inf

    def usual_load(self, pose: Array, load: Array) -> float:
        """How many times a load (nj,) on the joints [N·m or N] is a disturbance that a robot in a pose (nj,) can bear.

        ``SHARE`` of what the actuators bear, see ``borne``; of ``QUICKENING`` where that is none or any.

        Raises:
            ConfigError: where its equations of motion do not tell, or the load does not act on a driven joint.
        """
        if "inverse" not in self.robot.offers:
            raise ConfigError(
                f"{self.robot.name}: what its actuators can bear is not known, expected the size of the disturbance"
            )
        if not np.any(load[self.driven]):
            raise ConfigError(f"{self.robot.name}: the disturbance moves no driven joint, expected one that does")
        most = self.borne(pose, load)
        if 0 < most < np.inf:
            return SHARE * most
        moved = np.ix_(self.driven, self.driven)
        given = np.linalg.solve(self.dynamics.effective_mass(pose, self.driven)[moved], load[self.driven])
        return QUICKENING / float(np.abs(given).max())

    def usual_torques(self, pose: Array, pushed: NDArray[np.bool_]) -> Array:
        """(nj,) disturbances on some joints (nj,), each in its proportion to what its actuators bear [N·m or N]."""
        rows = zip(np.eye(len(pose)), pushed, strict=True)
        load = np.array([self.usual_load(pose, row) if own else 0.0 for row, own in rows])
        return min(1.0, self.usual_load(pose, load)) * load

    def usual_mass(self, point: str, pose: Array) -> float:
        """A load at a point [kg] that a robot in a pose (nj,) can bear.

        ``SHARE`` of what the actuators bear; where that is none or any, so much that it adds this share to the inertia
        of the joint that it adds most to.

        Raises:
            ConfigError: where its equations of motion do not tell, or the point moves with no driven joint.
        """
        slope = self.points.at(point, pose)[1][:, self.driven]
        if "inverse" not in self.robot.offers or not np.any(slope):
            raise ConfigError(
                f"{self.robot.name}: what its actuators can bear at {point} is not known, expected the mass of the load"
            )
        still = np.zeros(len(pose))
        laden = Dynamics(Model(self.robot.with_payload(point, 1.0), self.effects, self.phase))
        weight = laden.needed(pose, still, still) - self.dynamics.needed(pose, still, still)
        if np.abs(weight[self.driven]).max() > LACKING * GRAVITY:
            most = self.borne(pose, -weight)
            if 0 < most < np.inf:
                return SHARE * most
        added = np.sum(slope**2, axis=0)
        felt = added > 0
        return SHARE * float((np.diag(self.dynamics.mass(pose))[self.driven][felt] / added[felt]).min())

    # Named points.

    @cached_property
    def points(self) -> Points:
        """The robot's named points.

        Raises:
            NotAvailable: where its poses do not tell where they are.
        """
        return points_of(Model(self.robot, self.effects, self.phase))

    def point(self, name: str) -> str:
        """A point of this name; without one, of those that stick out that which most driven joints move.

        Raises:
            ConfigError: where there is none of this name.
        """
        if not name:
            slopes = {end: self.points.at(end, self._somewhere + ASIDE)[1] for end in self.points.ends}
            if not slopes:
                raise ConfigError(f"{self.robot.name}: has no site that moves; expected one")
            return max(reversed(slopes), key=lambda end: int((np.any(slopes[end] != 0, axis=0) & self.driven).sum()))
        if name not in self.points.names:
            raise ConfigError(unknown_name("site or body", name, self.points.names, self.robot.name))
        return name

    def free_way(self, name: str, pose: Array) -> Array:
        """(3,) the direction in which a point gives way most in a pose (nj,), as the joints' inertia lets it.

        The eigenvector of J M⁻¹ Jᵀ (Khatib, 1995) with the largest eigenvalue; J alone where M is not known.
        """
        slope = self.points.at(name, pose)[1] * self.driven
        if "inverse" in self.robot.offers:
            mobility = slope @ np.linalg.inv(self.dynamics.mass(pose)) @ slope.T
        else:
            mobility = slope @ slope.T
        way = np.linalg.eigh(mobility)[1][:, -1]
        return np.asarray(way * np.sign(way[np.abs(way).argmax()]))

    def reacher(self, name: str) -> Reacher:
        """What puts a point in its place, see ``point``; joints without actuator stay where they are."""
        return Reacher(self.robot, self.points, self.point(name), self.driven)

    @cached_property
    def driven(self) -> NDArray[np.bool_]:
        """(nj,) the joints on which an actuator acts."""
        if "inverse" not in self.robot.offers:
            return np.ones(len(self._somewhere), dtype=bool)
        drive, _ = self.dynamics.authority(self._somewhere + ASIDE, np.zeros(len(self._somewhere)))
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


def _some(count: int) -> NDArray[np.int64]:
    """Instants of so many at which commands are looked at."""
    return np.unique(np.linspace(0, count - 1, min(count, LOOKS)).astype(np.int64))


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
