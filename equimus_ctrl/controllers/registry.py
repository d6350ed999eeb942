"""The controllers known by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from equimus_ctrl.controllers.allowances import settable
from equimus_ctrl.controllers.lqr import LqrController, LqrSettings
from equimus_ctrl.controllers.nmpc import NmpcController, NmpcSettings
from equimus_ctrl.controllers.open_loop import OpenLoopController
from equimus_ctrl.controllers.pid import PidController
from equimus_ctrl.controllers.pid_settings import PidSettings
from equimus_ctrl.controllers.sampling import SamplingController
from equimus_ctrl.controllers.sampling_settings import SamplingSettings
from equimus_ctrl.controllers.search_space import Search
from equimus_ctrl.controllers.searched import lqr_space, nmpc_space, placed_space, sampling_space
from equimus_ctrl.errors import FAILURES, ConfigError, ControllerError, EquimusError
from equimus_ctrl.registry import Registry
from equimus_ctrl.robots.base import Need, Robot
from equimus_ctrl.settings import FileSettings
from equimus_ctrl.types import Array, Controller

AnySettings = TypeVar("AnySettings", bound=FileSettings)


@dataclass(frozen=True, eq=False)
class ControllerRequest:
    """What a controller may be made of.

    Attributes:
        settings: what its settings file holds; None where there is none.
        commands: time [s] → commands (na,) that the scenario has to play; None where it has none.
        robot: that it will drive; None where that is not known yet.
        where: the settings' file, for messages.
        chosen: whether somebody named that file, or it is the robot's own by its name.
        in_time: whether its steps are to keep up with the clock; else it may work out on the way what it needs.
    """

    settings: Mapping[str, Any] | None = None
    commands: Callable[[float], Array] | None = None
    robot: Robot | None = None
    where: str = "controller"
    chosen: bool = False
    in_time: bool = True


@dataclass(frozen=True)
class ControllerEntry:
    """A controller known by name.

    Attributes:
        summary: one line for lists.
        make: makes it; raises ConfigError where its settings are missing or do not fit.
        settings: the file name of its settings under ``controllers/``; None where it takes none.
        compared: whether a comparison takes it where nobody says which.
        needs: what a robot has to offer it, see ``Robot.offers``.
        plays: whether it needs that only where a scenario has no commands to play.
        search: what a tuning may change of its settings, see ``controllers.search_space``; None where nothing.
        compiled: whether the compiled loop of robots with elastic actuators holds it (``tuning.closed_loop``).
    """

    summary: str
    make: Callable[[ControllerRequest], Controller]
    settings: str | None = None
    compared: bool = True
    needs: frozenset[Need] = frozenset()
    plays: bool = False
    search: Search | None = None
    compiled: bool = False

    def __post_init__(self) -> None:
        if self.search is not None and self.settings is None:
            raise ConfigError(
                "a controller that declares what is searched of its settings needs a file of them, such as "
                "settings='mine.toml'"
            )

    def made(self, given: ControllerRequest) -> Controller:
        """A controller.

        Raises:
            EquimusError: where its settings do not fit, or it fails when it is made.
        """
        try:
            return self.make(given)
        except EquimusError:
            raise
        except FAILURES as error:
            raise ControllerError(f"{given.where}: fails when it is made: {type(error).__name__}: {error}") from error

    def lacks(self, robot: Robot, commands: bool = False) -> str:
        """What a robot does not offer it, as a phrase; empty where it offers all.

        Args:
            robot: that it would drive.
            commands: whether there are commands to play.
        """
        missing = sorted(self.needs - robot.offers)
        if not missing or (self.plays and commands):
            return ""
        if missing[0] == "inverse":
            return f"exact equations of motion, which cannot hold the {robot.uninvertible[0]} of {robot.name}"
        return f"lengths of elastic actuators, which {robot.name} does not have"


CONTROLLERS: Registry[ControllerEntry] = Registry("controller", ControllerError)


def register_controller(name: str, entry: ControllerEntry) -> None:
    """Make a controller known by a name.

    Args:
        name: a plain one.
        entry: how it is made, and what is said of it.

    Raises:
        ConfigError: where the name is another's or no plain name.
    """
    CONTROLLERS.add(name, entry)


def _pid(given: ControllerRequest) -> Controller:
    if given.settings is None:
        return PidController(None)
    settings = PidSettings.from_dict(given.settings, given.where)
    robot = given.robot
    if robot is not None and not settings.fits(robot):
        # Gains that name nothing of this robot are another's; a name that is wrong among right ones is a mistake.
        if not given.chosen and not settings.gains.keys() & {*robot.joint_names, *robot.actuator_names}:
            return PidController(None)
        try:
            settings.gain_matrix(settings.channels(robot))
        except ConfigError as error:
            raise ConfigError(f"{given.where}: {error}") from None
    return PidController(settings)


def _suited(kind: type[AnySettings], given: ControllerRequest, name: str) -> tuple[AnySettings, str]:
    """Settings of a regulator, and what has to be said of them.

    What would change nothing of the robot is refused where somebody named the file; of settings that all robots share
    it is left as by default, and said.
    """
    settings, robot = kind.from_dict(given.settings or {}, given.where), given.robot
    if robot is None:
        return settings, ""  # it is refused when it begins
    shared = "" if given.chosen else given.where
    return settings.suited(settable(robot), f"{given.where}: {name}", robot.name, shared)


def _lqr(given: ControllerRequest) -> Controller:
    settings, said = _suited(LqrSettings, given, "lqr")
    return LqrController(settings, given.in_time, said)


def _nmpc(given: ControllerRequest) -> Controller:
    settings, said = _suited(NmpcSettings, given, "nmpc")
    return NmpcController(settings, said=said)


def _sampling(given: ControllerRequest) -> Controller:
    settings = SamplingSettings.from_dict(given.settings or {}, given.where)
    # What would change nothing is refused when it begins, which is when it is known what plans are.
    return SamplingController(settings, shared="" if given.chosen or given.robot is None else given.where)


EXACT: frozenset[Need] = frozenset(("inverse",))
LENGTHS: frozenset[Need] = frozenset(("inverse", "lengths"))

register_controller(
    "open_loop",
    ControllerEntry(
        "the scenario's commands, or its reference's static pressures",
        lambda given: OpenLoopController(given.commands),
        compared=False,
        needs=EXACT,
        plays=True,
    ),
)
register_controller(
    "pid",
    ControllerEntry(
        "PID on joints or actuator lengths with feed-forward",
        _pid,
        "pid.toml",
        needs=EXACT,
        search=placed_space,
        compiled=True,
    ),
)
register_controller(
    "lqr",
    ControllerEntry(
        "LQR along the reference on an observer's state, with integral action",
        _lqr,
        "lqr.toml",
        needs=EXACT,
        search=lqr_space,
    ),
)
register_controller(
    "nmpc",
    ControllerEntry(
        "nonlinear model-predictive control on an observer's state",
        _nmpc,
        "nmpc.toml",
        needs=EXACT,
        search=nmpc_space,
    ),
)
register_controller(
    "sampling",
    ControllerEntry(
        "sampling MPC: predictive sampling, MPPI or CEM",
        _sampling,
        "sampling.toml",
        search=sampling_space,
    ),
)


def compared_controllers(robot: Robot | None = None) -> tuple[str, ...]:
    """Those that a comparison takes where nobody says which, and that can drive a robot.

    Raises:
        ControllerError: where none can.
    """
    found = (name for name, entry in CONTROLLERS.items() if entry.compared)
    able = tuple(name for name in found if robot is None or not CONTROLLERS[name].lacks(robot))
    if robot is not None and not able:
        name, entry = next((name, entry) for name, entry in CONTROLLERS.items() if entry.compared)
        raise ControllerError(
            f"no controller that is compared by default can drive {robot.name}: {name} computes with "
            f"{entry.lacks(robot)}; name one of your own, path/to/file.py:Name"
        )
    return able


def tunable(name: str) -> tuple[ControllerEntry, Search]:
    """A controller that declares what is searched of its settings, and what that is.

    Raises:
        ControllerError: for an unknown name, or one that declares nothing.
    """
    entry = CONTROLLERS.entry(name)
    if entry.search is None:
        able = ", ".join(other for other, own in CONTROLLERS.items() if own.search is not None)
        raise ControllerError(f"controller {name} declares nothing to be searched; those that do: {able}")
    return entry, entry.search


def make_controller(
    name: str,
    settings: Mapping[str, Any] | None = None,
    commands: Callable[[float], Array] | None = None,
    where: str = "controller",
    robot: Robot | None = None,
    chosen: bool = False,
) -> Controller:
    """A controller by name.

    Args:
        name: see ``CONTROLLERS``.
        settings: what its settings file holds.
        commands: time → commands, for ``open_loop``.
        where: the settings' file, for messages.
        robot: that it will drive, where that is known.
        chosen: whether somebody named the settings' file, or it is the robot's own by its name.

    Raises:
        ControllerError: for an unknown name, or one that cannot drive the robot.
        ConfigError: for settings that are missing or wrong.
    """
    entry = CONTROLLERS.entry(name)
    given = commands is not None
    if robot is not None and (missing := entry.lacks(robot, given)):
        able = ", ".join(other for other in CONTROLLERS if not CONTROLLERS[other].lacks(robot, given)) or "none"
        raise ControllerError(f"{name} computes with {missing}; those that can drive it: {able}")
    return entry.made(ControllerRequest(settings, commands, robot, where, chosen))
