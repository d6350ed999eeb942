"""A user's own controller: a class with ``init`` and ``step``, or one function."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from equimus_ctrl.errors import ControllerError
from equimus_ctrl.types import Controller, Observation, PlantSpec, Reference


@dataclass(frozen=True)
class FunctionController:
    """A stateless controller made of a function.

    Attributes:
        function: (observation, reference) or (observation, reference, spec) → pressures (na,) [Pa].
        name: shown in tables.
    """

    function: Callable[..., ArrayLike]
    name: str = "function"

    def init(self, spec: PlantSpec, observation: Observation) -> PlantSpec:
        """The state is the plant's spec."""
        return spec

    def step(self, observation: Observation, reference: Reference, state: PlantSpec) -> tuple[ArrayLike, PlantSpec]:
        """The function's command."""
        if len(inspect.signature(self.function).parameters) == 3:
            return self.function(observation, reference, state), state
        return self.function(observation, reference), state


def as_controller(thing: Any, name: str) -> Controller:
    """A controller from a class, an instance or a function.

    Raises:
        ControllerError: where it is none of these, or a class that cannot be made without arguments.
    """
    if inspect.isclass(thing):
        try:
            thing = thing()
        except TypeError as error:
            raise ControllerError(f"{name}: the class cannot be made without arguments ({error})") from None
    if callable(getattr(thing, "init", None)) and callable(getattr(thing, "step", None)):
        controller: Controller = thing
        return controller
    if callable(thing):
        try:
            count = len(inspect.signature(thing).parameters)
        except (TypeError, ValueError):
            count = -1
        if count in (2, 3):
            return FunctionController(thing, name)
        raise ControllerError(
            f"{name}: a controller function takes (observation, reference) or (observation, reference, spec), "
            f"this one takes {count} parameters"
        )
    raise ControllerError(f"{name}: {type(thing).__name__} is neither a class with init and step nor a function")
