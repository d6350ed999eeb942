"""The controllers known by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from equimus_ctrl.controllers.lqr import LqrController, LqrSettings
from equimus_ctrl.controllers.nmpc import NmpcController, NmpcSettings
from equimus_ctrl.controllers.open_loop import OpenLoopController
from equimus_ctrl.controllers.pid import PidController, PidSettings
from equimus_ctrl.controllers.sampling import SamplingController, SamplingSettings
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.registry import Registry
from equimus_ctrl.robots.elastic.morphology import Morphology
from equimus_ctrl.types import Array, Controller


@dataclass(frozen=True, eq=False)
class ControllerRequest:
    """What a controller may be made of.

    Attributes:
        settings: what its settings file holds; None where there is none.
        commands: time [s] → pressures (na,) [Pa] that the scenario has to play; None where it has none.
        morphology: of the robot that it will drive; None where that is not known yet.
        where: the settings' file, for messages.
    """

    settings: Mapping[str, Any] | None = None
    commands: Callable[[float], Array] | None = None
    morphology: Morphology | None = None
    where: str = "controller"


@dataclass(frozen=True)
class ControllerEntry:
    """A controller known by name.

    Attributes:
        summary: one line for lists.
        make: makes it; raises ConfigError where its settings are missing or do not fit.
        settings: the file name of its settings under ``controllers/``; None where it takes none.
        compared: whether a comparison takes it where nobody says which.
    """

    summary: str
    make: Callable[[ControllerRequest], Controller]
    settings: str | None = None
    compared: bool = True


CONTROLLERS: Registry[ControllerEntry] = Registry("controller", ControllerError)


def register_controller(name: str, entry: ControllerEntry) -> None:
    """Make a controller known by a name.

    Raises:
        ConfigError: where the name is another's or no plain name.
    """
    CONTROLLERS.add(name, entry)


def _pid(given: ControllerRequest) -> Controller:
    if given.settings is None:
        raise ConfigError(f"{given.where}: the PID has no settings; tune it with: equimus-ctrl autotune-pid")
    settings = PidSettings.from_dict(given.settings, given.where)
    if given.morphology is not None:
        try:
            settings.gain_matrix(settings.channels(given.morphology))
        except ConfigError as error:
            raise ConfigError(f"{given.where}: {error}") from None
    return PidController(settings)


register_controller(
    "open_loop",
    ControllerEntry(
        "the scenario's commands, or its reference's static pressures",
        lambda given: OpenLoopController(given.commands),
        compared=False,
    ),
)
register_controller(
    "pid", ControllerEntry("PID on actuator lengths or joint angles with feed-forward", _pid, "pid.toml")
)
register_controller(
    "lqr",
    ControllerEntry(
        "LQR along the reference on an observer's state, with integral action",
        lambda given: LqrController(LqrSettings.from_dict(given.settings or {}, given.where)),
        "lqr.toml",
    ),
)
register_controller(
    "nmpc",
    ControllerEntry(
        "nonlinear model-predictive control on an observer's state",
        lambda given: NmpcController(NmpcSettings.from_dict(given.settings or {}, given.where)),
        "nmpc.toml",
    ),
)
register_controller(
    "sampling",
    ControllerEntry(
        "sampling MPC in MuJoCo: predictive sampling, MPPI or CEM",
        lambda given: SamplingController(SamplingSettings.from_dict(given.settings or {}, given.where)),
        "sampling.toml",
    ),
)


def compared_controllers() -> tuple[str, ...]:
    """Those that a comparison takes where nobody says which."""
    return tuple(name for name, entry in CONTROLLERS.items() if entry.compared)


def make_controller(
    name: str,
    settings: Mapping[str, Any] | None = None,
    commands: Callable[[float], Array] | None = None,
    where: str = "controller",
    morphology: Morphology | None = None,
) -> Controller:
    """A controller by name.

    Args:
        name: see ``CONTROLLERS``.
        settings: what its settings file holds.
        commands: time → pressures, for ``open_loop``.
        where: the settings' file, for messages.
        morphology: of the robot that it will drive, where that is known.

    Raises:
        ControllerError: for an unknown name.
        ConfigError: for settings that are missing or wrong.
    """
    return CONTROLLERS.entry(name).make(ControllerRequest(settings, commands, morphology, where))
