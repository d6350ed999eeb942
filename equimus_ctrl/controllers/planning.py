"""What predictive controllers begin with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, TypeVar

from equimus_ctrl.controllers.horizon import Horizon, HorizonSettings
from equimus_ctrl.controllers.valve_estimation import ValveEstimation
from equimus_ctrl.estimation.observer import Observer
from equimus_ctrl.settings import both
from equimus_ctrl.types import Observation, PlantSpec


class Planning(Protocol):
    """What is made once for a plant, or for one hypothesis about its valves."""

    @property
    def horizon(self) -> Horizon: ...
    @property
    def observer(self) -> Observer: ...
    def taken_over(self, state: Any) -> dict[str, Any]: ...


AnySettings = TypeVar("AnySettings", bound=HorizonSettings)


def begun(
    make: Callable[[PlantSpec, AnySettings, Horizon | None], Planning],
    spec: PlantSpec,
    settings: AnySettings,
    observation: Observation,
    said: str = "",
) -> dict[str, Any]:
    """The fields of a ``HorizonState`` for a robot that has long been at rest, without a plan.

    Args:
        make: tools of a spec and settings; the last is the horizon of the first ones, and None of these, which have a
            bank of valves and all that can be prepared before the robot moves.
        spec: of the plant.
        settings: of the controller.
        observation: the first.
        said: of the settings, for a person to read.
    """
    tools = make(spec, settings, None)
    own = tools.horizon.begin(observation)
    own["note"] = both(said, own["note"])
    bank, estimation = tools.observer.bank, None
    if bank is not None:
        # Lags make other functions, which are interpreted: a robot does not wait until a compiler is done.
        plain = replace(settings, compiled=settings.compiled and not bank.lags)
        estimation = ValveEstimation(spec, tools, lambda later: make(later, plain, tools.horizon), own["note"])
    watched = None if bank is None else own["observer"]
    return {**own, "plan": None, "tools": tools, "estimation": estimation, "watched": watched}
