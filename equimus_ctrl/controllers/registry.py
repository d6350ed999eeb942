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
from equimus_ctrl.errors import ConfigError, ControllerError, unknown_name
from equimus_ctrl.types import Array, Controller


@dataclass(frozen=True)
class ControllerEntry:
    """A controller known by name.

    Attributes:
        summary: one line for lists.
        make: (settings table or None, open-loop commands or None) → controller.
        settings: the file name of its settings under ``controllers/``, or None.
    """

    summary: str
    make: Callable[[Mapping[str, Any] | None, Callable[[float], Array] | None, str], Controller]
    settings: str | None = None


def _open_loop(settings: Mapping[str, Any] | None, commands: Any, where: str) -> Controller:
    return OpenLoopController(commands)


def _pid(settings: Mapping[str, Any] | None, commands: Any, where: str) -> Controller:
    if settings is None:
        raise ConfigError(f"{where}: the PID has no settings; tune it with: equimus-ctrl autotune-pid")
    return PidController(PidSettings.from_dict(settings, where))


def _lqr(settings: Mapping[str, Any] | None, commands: Any, where: str) -> Controller:
    return LqrController(LqrSettings.from_dict(settings or {}, where))


def _nmpc(settings: Mapping[str, Any] | None, commands: Any, where: str) -> Controller:
    return NmpcController(NmpcSettings.from_dict(settings or {}, where))


def _sampling(settings: Mapping[str, Any] | None, commands: Any, where: str) -> Controller:
    return SamplingController(SamplingSettings.from_dict(settings or {}, where))


CONTROLLERS: dict[str, ControllerEntry] = {
    "open_loop": ControllerEntry("the scenario's commands, or its reference's static pressures", _open_loop),
    "pid": ControllerEntry("PID on actuator lengths or joint angles with feed-forward", _pid, "pid.toml"),
    "lqr": ControllerEntry("LQR along the reference on an observer's state, with integral action", _lqr, "lqr.toml"),
    "nmpc": ControllerEntry("nonlinear model-predictive control on an observer's state", _nmpc, "nmpc.toml"),
    "sampling": ControllerEntry("sampling MPC in MuJoCo: predictive sampling, MPPI or CEM", _sampling, "sampling.toml"),
}


def make_controller(
    name: str,
    settings: Mapping[str, Any] | None = None,
    commands: Callable[[float], Array] | None = None,
    where: str = "controller",
) -> Controller:
    """A controller by name.

    Args:
        name: see ``CONTROLLERS``.
        settings: what its settings file holds.
        commands: time → pressures, for ``open_loop``.
        where: the settings' file, for messages.

    Raises:
        ControllerError: for an unknown name.
        ConfigError: for settings that are missing or wrong.
    """
    if name not in CONTROLLERS:
        raise ControllerError(unknown_name("controller", name, CONTROLLERS))
    return CONTROLLERS[name].make(settings, commands, where)
